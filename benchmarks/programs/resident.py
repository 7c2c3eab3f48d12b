"""The program that is measured: a resident size, and a part of it written anew all the time, spread over all of it.

``python3 resident.py MEGABYTES DIRTY_KILOBYTES [1]``: prints "ready", then writes DIRTY_KILOBYTES (a byte in every page) and
sleeps 50 ms, for ever. The content does not compress to nothing: it is not zeros. With a 1 it is chance, and all of every page
is written anew: none of it compresses at all.
"""

import mmap
import os
import random
import sys
import time

PAGE = 4096

size, dirty = int(sys.argv[1]) * 1_000_000, int(sys.argv[2]) * 1000
by_chance = sys.argv[3:] == ["1"]
memory: bytearray | mmap.mmap
if by_chance:
    memory = mmap.mmap(-1, size // PAGE * PAGE, flags=mmap.MAP_PRIVATE)
    memory[:] = os.urandom(len(memory))
else:
    memory = bytearray(os.urandom(PAGE) * (size // PAGE))
pages = dirty // PAGE
stride = max(len(memory) // PAGE // max(pages, 1), 1) * PAGE
turn = 0
print("ready", flush=True)
while True:
    turn = (turn + 1) % 256
    for index in range(pages):
        if by_chance:
            memory[index * stride : index * stride + PAGE] = random.randbytes(PAGE)
        else:
            memory[index * stride] = turn
    time.sleep(0.05)
