"""Freed memory goes back to the kernel: counted in bytes that the C library holds, in a process of its own."""

from __future__ import annotations

import ctypes
import subprocess
import sys

import pytest

WORKS = """
import ctypes, threading
from checkpoint.runtime import allocator

allocator.be_frugal()
kept = []

def work(number):
    for turn in range(40):
        large = bytearray((1 + (turn * 7 + number) % 5) << 20)
        kept.append(bytes(2000))  # what stays is small, and lies behind it
        del large

for wave in range(4):
    threads = [threading.Thread(target=work, args=(number,)) for number in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
allocator.give_back()

class Held(ctypes.Structure):
    _fields_ = [(name, ctypes.c_size_t) for name in "arena a b c hblkhd d e uordblks fordblks keepcost".split()]

mallinfo = ctypes.CDLL(None).mallinfo2
mallinfo.restype = Held
held = mallinfo()
print(held.arena + held.hblkhd, held.uordblks)
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="needs a glibc that tells what it holds (2.33)")
def test_threads_with_large_blocks_leave_nothing_behind() -> None:
    told = subprocess.run([sys.executable, "-c", WORKS], capture_output=True, text=True, check=True).stdout
    held, used = map(int, told.split())
    assert held < used + (8 << 20)
