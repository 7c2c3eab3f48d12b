"""A program that notices when it stands still.

``python3 watching.py MEGABYTES DIRTY_KILOBYTES``: prints "ready", then reads the clock without a pause, writes a byte in every
page of DIRTY_KILOBYTES each 50 ms, and prints each 50 ms the instant (CLOCK_MONOTONIC, ns) and the longest time between two
readings since the line before (ns). The content is random and does not compress.
"""

import os
import sys
import time

PAGE = 4096
TURN_NS = 50_000_000
PAGES_A_READING = 16

size, dirty = int(sys.argv[1]) * 1_000_000, int(sys.argv[2]) * 1000
memory = bytearray(os.urandom(size))
pages = min(dirty, size) // PAGE
stride = max(len(memory) // PAGE // max(pages, 1), 1) * PAGE
clock = time.monotonic_ns
print("ready", flush=True)
last = clock()
turn = 0
while True:
    turn = (turn + 1) % 256
    longest, until = 0, last + TURN_NS
    index = 0
    while last < until:
        for page in range(index, min(index + PAGES_A_READING, pages)):
            memory[page * stride] = turn
        index += PAGES_A_READING
        now = clock()
        longest = max(longest, now - last)
        last = now
    os.write(1, b"%d %d\n" % (last, longest))
