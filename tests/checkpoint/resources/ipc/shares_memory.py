"""A program that shares memory with others: maps files of /dev/shm, a memory file and a System V segment, and tells what it sees.

Arguments: NAME (a file to map for reading and writing, opened as long as it runs), READ (one that it only reads), "" for none;
then the id of a System V segment and the descriptor of a memory file, or -1; then "child", to have a child that shares all.

It counts at the beginning of NAME. Where a file ``ask`` appears it answers in the file ``answer``, as JSON.
"""

import ctypes
import json
import mmap
import os
import sys
import time

name, read, segment, memory_file, rest = sys.argv[1], sys.argv[2], int(sys.argv[3]), int(sys.argv[4]), sys.argv[5:]
places: dict[str, mmap.mmap] = {}
file = os.open(name, os.O_RDWR)
places["own"] = mmap.mmap(file, 0)
if read:
    only_read = os.open(read, os.O_RDONLY)
    places["read"] = mmap.mmap(only_read, 0, prot=mmap.PROT_READ)
    os.close(only_read)
if memory_file >= 0:
    places["memory_file"] = mmap.mmap(memory_file, 0)
if segment >= 0:
    libc = ctypes.CDLL(None)
    libc.shmat.restype = ctypes.c_void_p
    at = libc.shmat(segment, None, 0)
    assert at not in (None, ctypes.c_void_p(-1).value)
if rest and os.fork() == 0:
    while True:  # the child counts in the second page
        places["own"][4096:4104] = (int.from_bytes(places["own"][4096:4104], "little") + 1).to_bytes(8, "little")
        time.sleep(0.002)

count = 0
print("ready", flush=True)
while True:
    count += 1
    places["own"][0:8] = count.to_bytes(8, "little")
    if os.path.exists("ask"):
        os.unlink("ask")
        found = {key: place[8192:8208].rstrip(b"\0").decode() for key, place in places.items()}
        found |= {"count": int.from_bytes(os.pread(file, 8, 0), "little"), "mine": count}
        found |= {"child": int.from_bytes(places["own"][4096:4104], "little")}
        if segment >= 0:
            found["segment"] = ctypes.string_at(at + 8192, 16).rstrip(b"\0").decode()
        with open("answer.part", "w") as answer:
            json.dump(found, answer)
        os.rename("answer.part", "answer")
    time.sleep(0.002)
