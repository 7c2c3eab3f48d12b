"""The program that is measured: writes so many MB a second, all over twice as much memory: ``writing.py MEGABYTES``."""

import sys
import time

STEP_S = 0.01
size = int(sys.argv[1]) * 1_000_000
memory = bytearray(2 * size)
step = int(size * STEP_S)
print("ready", flush=True)
place, turn = 0, 0
begun = time.monotonic()
while True:
    turn = (turn + 1) % 256
    memory[place : place + step] = bytes([turn]) * step
    place = (place + step) % (2 * size - step)
    begun += STEP_S
    left = begun - time.monotonic()
    if left > 0:
        time.sleep(left)
    else:
        begun = time.monotonic()
