"""A program that works as fast as it can.

``python3 working.py MEGABYTES DIRTY_KILOBYTES``: prints "ready", then calculates without a pause, writes a byte in every page of
DIRTY_KILOBYTES each 50 ms, and prints each 50 ms the instant (CLOCK_MONOTONIC, ns) and how many steps it has done in all.
"""

import os
import sys
import time

PAGE = 4096
TURN_NS = 50_000_000

size, dirty = int(sys.argv[1]) * 1_000_000, int(sys.argv[2]) * 1000
memory = bytearray(os.urandom(size))
pages = min(dirty, size) // PAGE
stride = max(len(memory) // PAGE // max(pages, 1), 1) * PAGE
clock = time.monotonic_ns
print("ready", flush=True)
steps = turn = 0
value = 1
until = clock()
while True:
    turn = (turn + 1) % 256
    until += TURN_NS
    for index in range(pages):
        memory[index * stride] = turn
    while clock() < until:
        for _ in range(200):
            value = (value * 1103515245 + 12345) & 0x7FFFFFFF
        steps += 1
    os.write(1, b"%d %d\n" % (clock(), steps))
