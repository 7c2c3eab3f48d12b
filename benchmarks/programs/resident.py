"""The program that is measured: a resident size, and a part of it written anew all the time, spread over all of it.

``python3 resident.py MEGABYTES DIRTY_KILOBYTES``: prints "ready", then writes DIRTY_KILOBYTES (a byte in every page) and
sleeps 50 ms, for ever. The content does not compress to nothing: it is not zeros.
"""

import os
import sys
import time

PAGE = 4096

size, dirty = int(sys.argv[1]) * 1_000_000, int(sys.argv[2]) * 1000
memory = bytearray(os.urandom(PAGE) * (size // PAGE))
pages = dirty // PAGE
stride = max(len(memory) // PAGE // max(pages, 1), 1) * PAGE
turn = 0
print("ready", flush=True)
while True:
    turn = (turn + 1) % 256
    for index in range(pages):
        memory[index * stride] = turn
    time.sleep(0.05)
