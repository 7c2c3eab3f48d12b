"""A long file goes to the disk while it grows, so that a sync of another file does not wait for gigabytes."""

from __future__ import annotations

import ctypes
import os
from pathlib import Path

import pytest

from checkpoint.store.disk import WRITEBACK_SIZE, Disk, DiskFile

CACHESTAT = 451
"""The number of cachestat(2) on every processor, since Linux 6.5."""
SIZE = 16 * WRITEBACK_SIZE


class Range(ctypes.Structure):
    _fields_ = (("offset", ctypes.c_uint64), ("length", ctypes.c_uint64))


class Cache(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_uint64) for name in ("cached", "dirty", "under_way", "evicted", "lately"))


def waiting(descriptor: int) -> int:
    """Bytes of a file that the disk does not have yet."""
    found = Cache()
    whole = Range(0, 0)
    if ctypes.CDLL(None, use_errno=True).syscall(CACHESTAT, descriptor, ctypes.byref(whole), ctypes.byref(found), 0):
        pytest.skip(f"cachestat(2): {os.strerror(ctypes.get_errno())}")
    return (found.dirty + found.under_way) * os.sysconf("SC_PAGE_SIZE")


def test_little_of_a_long_file_waits_for_the_disk(tmp_path: Path) -> None:
    disk = Disk()
    content = os.urandom(1 << 20)
    with (tmp_path / "plain").open("wb", buffering=0) as plain:
        for _ in range(SIZE >> 20):
            plain.write(content)
        if waiting(plain.fileno()) < SIZE // 2:
            pytest.skip("this file system writes at once, or keeps files in memory")
    descriptor = disk.create(tmp_path / "long")
    try:
        file = DiskFile(disk, descriptor)
        most = 0
        for _ in range(SIZE >> 20):
            file.write(content)
            most = max(most, waiting(descriptor))
        assert 0 < most <= 3 * WRITEBACK_SIZE
        assert os.fstat(descriptor).st_size == SIZE
    finally:
        os.close(descriptor)


def test_a_file_that_lies_in_memory_is_written_whole() -> None:
    descriptor = os.memfd_create("long")
    content = os.urandom(WRITEBACK_SIZE)
    try:
        file = DiskFile(Disk(), descriptor)
        for _ in range(3):
            file.write(content)
        assert os.pread(descriptor, 4 * WRITEBACK_SIZE, 0) == 3 * content
    finally:
        os.close(descriptor)
