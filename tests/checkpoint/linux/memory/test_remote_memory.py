"""The memory of a process that ends while it is read; ranges of it that several threads write."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from checkpoint.engines.ptrace.capture.memory import READ_CHUNK, MemoryCapture, RunningCopy
from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import PIECE, Memory, address_of
from checkpoint.pages import page_set


def test_a_process_that_ends_between_two_ways_to_read_it_is_said_to_have_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its memory goes before its PID does: the first way finds pages that are not mapped, the second finds nobody."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    memory = Memory(gone.pid)

    def unmapped(*_: Any) -> None:
        raise CaptureError("Bad address")

    monkeypatch.setattr(memory, "read_into", unmapped)
    with pytest.raises(ProcessGoneError):
        memory.read_pages(np.array([[abi.PAGE_SIZE, 2 * abi.PAGE_SIZE]], dtype=np.uint64))


def extents_from(pairs: list[tuple[int, int]]) -> page_set.Words:
    return np.array(pairs, np.uint64).reshape(-1, 2)


@pytest.mark.parametrize("lengths", [(), (1,), (10,), (11,), (3, 7, 10), (25, 1, 4), (100,), (1,) * 30], ids=str)
def test_stretches_are_cut_after_each_so_many_bytes(lengths: tuple[int, ...]) -> None:
    stretches = extents_from([(1_000 * number, 1_000 * number + length) for number, length in enumerate(lengths, 1)])
    pieces = [[tuple(row) for row in piece.tolist()] for piece in page_set.cut(stretches, 10)]
    assert len(pieces) == -(-sum(lengths) // 10)
    assert all(sum(end - begin for begin, end in rows) == 10 for rows in pieces[:-1])
    each = [place for begin, end in stretches.tolist() for place in range(begin, end)]
    assert [place for rows in pieces for begin, end in rows for place in range(begin, end)] == each


@pytest.mark.parametrize("threads", [1, 3])
def test_what_several_threads_write_is_what_one_writes(threads: int) -> None:
    memory, dice = np.zeros(3 * PIECE, np.uint8), random.Random(5)
    cuts = [0, *sorted(dice.sample(range(1, 3 * PIECE), 200))]
    pairs = [(address_of(memory) + begin, address_of(memory) + end) for begin, end in zip(cuts[::2], cuts[1::2], strict=False)]
    dice.shuffle(pairs)
    content = np.frombuffer(dice.randbytes(sum(end - begin for begin, end in pairs)), np.uint8)
    Memory(os.getpid()).write_side_by_side(extents_from(pairs), content, threads)
    expected, position = np.zeros_like(memory), 0
    for begin, end in pairs:
        place = begin - address_of(memory)
        expected[place : place + end - begin] = content[position : position + end - begin]
        position += end - begin
    assert np.array_equal(memory, expected)


def test_memory_that_is_not_there_is_refused_by_several_threads_as_by_one() -> None:
    content = np.zeros(2 * PIECE, np.uint8)
    stretches = extents_from([(address_of(content), address_of(content) + PIECE), (abi.PAGE_SIZE, abi.PAGE_SIZE + PIECE)])
    with pytest.raises(CaptureError, match=f"at {abi.PAGE_SIZE:#x}: Bad address"):
        Memory(os.getpid()).write_side_by_side(stretches, content, 2)


HOLLOW = """
import ctypes, mmap, random, sys
size, *hollow = map(int, sys.argv[1:])
place = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
place.write(random.Random(6).randbytes(size))
begin = ctypes.addressof(ctypes.c_char.from_buffer(place))
for page in hollow:
    assert ctypes.CDLL(None).munmap(ctypes.c_void_p(begin + page * mmap.PAGESIZE), mmap.PAGESIZE) == 0
print(begin, flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("readers", [1, 3])
def test_what_several_threads_read_of_memory_with_holes_is_what_is_there(readers: int) -> None:
    size = 5 * READ_CHUNK
    whole, count = np.frombuffer(random.Random(6).randbytes(size), np.uint8), size // abi.PAGE_SIZE
    hollow = {0, count - 1, READ_CHUNK // abi.PAGE_SIZE, *random.Random(7).sample(range(count), 20)}
    there = [page for page in range(count) if page not in hollow]
    command = [sys.executable, "-c", HOLLOW, str(size), *map(str, hollow)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        begin = int(program.stdout.readline())
        capture, copied = MemoryCapture.__new__(MemoryCapture), RunningCopy()
        capture._memory, capture.readers = Memory(program.pid), readers
        capture._read_into(copied, np.array([[begin, begin + size]], dtype=np.uint64))
        program.communicate()
    (copy,) = copied.copies
    assert page_set.addresses_of(copy.pages, abi.PAGE_SIZE).tolist() == [begin + page * abi.PAGE_SIZE for page in there]
    found = np.frombuffer(copy.content, np.uint8)[: len(there) * abi.PAGE_SIZE]
    assert (found.reshape(-1, abi.PAGE_SIZE) == whole.reshape(-1, abi.PAGE_SIZE)[there]).all()
