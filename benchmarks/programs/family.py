"""Four processes with one resident size between them: ``python3 family.py MEGABYTES DIRTY_KILOBYTES``.

Each has a quarter of it for itself, and all share a megabyte; prints "ready" when all have their memory. Each writes its part of
DIRTY_KILOBYTES (a byte in every page) and sleeps 50 ms, for ever, or until the first one has ended.
"""

import mmap
import os
import sys
import time

PAGE = 4096
COUNT = 4

size, dirty = int(sys.argv[1]) * 1_000_000 // COUNT, int(sys.argv[2]) * 1000 // COUNT
shared = mmap.mmap(-1, 1 << 20)
shared[:] = os.urandom(1 << 20)
read_end, write_end = os.pipe()
first = os.getpid()
for _ in range(1, COUNT):
    if os.fork() == 0:
        break
memory = bytearray(os.urandom(PAGE) * (size // PAGE))
stride = max(size // PAGE // max(dirty // PAGE, 1), 1) * PAGE
if os.getpid() == first:
    for _ in range(1, COUNT):
        os.read(read_end, 1)
    print("ready", flush=True)
else:
    os.write(write_end, b"x")
turn = 0
while os.getpid() == first or os.getppid() == first:
    turn = (turn + 1) % 256
    for index in range(dirty // PAGE):
        memory[index * stride] = turn
    shared[0] = turn
    time.sleep(0.05)
