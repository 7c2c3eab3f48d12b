"""Read and write another process's memory in long vectors, without stopping the process."""

from __future__ import annotations

import ctypes
import errno
import os
from typing import Final, TypeAlias

import numpy as np

from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.pages import page_set
from checkpoint.runtime import parallel
from checkpoint.runtime.lazy_numpy import NDArray

Ranges: TypeAlias = "NDArray[np.uint64]"
"""Shape (n, 2): address and length in bytes, one row a range; exactly an array of struct iovec."""

MAX_TRANSFER: Final = 1 << 30
"""Bytes that we ask of one call; the kernel itself stops short of 2 GiB (MAX_RW_COUNT)."""

PIECE: Final = 16 << 20
"""Bytes that one of several threads moves at a time."""


def ranges_of(pairs: list[tuple[int, int]] | tuple[tuple[int, int], ...]) -> Ranges:
    """Make an array of (address, length) rows."""
    return np.array(pairs, dtype=np.uint64).reshape(len(pairs), 2)


def address_of(buffer: bytearray | memoryview | NDArray[np.uint8]) -> int:
    """Where a writable buffer lies in our own memory; the caller keeps it alive."""
    if isinstance(buffer, np.ndarray):
        return int(buffer.ctypes.data)
    return ctypes.addressof(ctypes.c_char.from_buffer(buffer))


class Memory:
    """The address space of one process, named by its PID.

    Reading and writing honour the page protections and need no stop. `poke` goes through ``/proc/PID/mem``, which
    ignores them (a private copy of the page is made); it needs the right to trace.
    """

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._local, self._remote = abi.IoVec(), abi.IoVec()

    def read(self, address: int, size: int) -> bytes:
        """Read ``size`` bytes.

        Raises:
            ProcessGoneError: the process has ended.
            CaptureError: some of it is not mapped or not readable.
        """
        if not size:
            return b""
        buffer = bytearray(size)
        remote, local = self._remote, self._local
        remote.base, remote.length, local.base, local.length = address, size, address_of(buffer), size
        if abi.process_vm_readv(self.pid, ctypes.addressof(local), 1, ctypes.addressof(remote), 1, 0) != size:
            self.read_into(ranges_of([(address, size)]), buffer)
        return bytes(buffer)

    def read_into(self, ranges: Ranges, buffer: bytearray | memoryview | NDArray[np.uint8]) -> None:
        """Read all ranges, one after the other, into ``buffer`` (as many bytes as the lengths add up to).

        Raises:
            ProcessGoneError: the process has ended.
            CaptureError: one of them is not mapped or not readable; the bytes read until then are in the buffer.
        """
        self._transfer(abi.process_vm_readv, "read", ranges, address_of(buffer))

    def read_pages(self, extents: Ranges) -> bytearray:
        """Read the pages of a set, rows ``[start, end)``, in order, also pages without read permission.

        Raises:
            ProcessGoneError: the process has ended.
            CaptureError: one of them is not mapped.
        """
        buffer = bytearray(page_set.total_size(extents))
        self.read_pages_into(extents, buffer)
        return buffer

    def read_pages_into(self, extents: Ranges, buffer: bytearray | memoryview) -> None:
        """As `read_pages`, into a buffer that is long enough."""
        if not len(extents):
            return
        ranges = extents.copy()
        ranges[:, 1] -= ranges[:, 0]
        try:
            self.read_into(ranges, buffer)
        except ProcessGoneError:
            raise
        except CaptureError:
            self._peek_into(ranges, memoryview(buffer))

    def readable_pages(self, extents: Ranges) -> tuple[Ranges, bytearray]:
        """The pages of a set that can be read just now, as extents, and their bytes. Raises as `readable_pages_into`."""
        buffer = bytearray(page_set.total_size(extents))
        readable = self.readable_pages_into(extents, memoryview(buffer))
        size = page_set.total_size(readable)
        return readable, buffer if size == len(buffer) else buffer[:size]

    def readable_pages_into(self, extents: Ranges, buffer: memoryview) -> Ranges:
        """Fill a buffer, as long as the whole set, with those of its pages that can be read just now: which.

        Raises:
            ProcessGoneError: the process has ended.
        """
        try:
            self.read_pages_into(extents, buffer)
        except ProcessGoneError:
            raise
        except CaptureError:
            return self._read_singly(extents, buffer)
        return extents

    def _read_singly(self, extents: Ranges, buffer: memoryview) -> Ranges:
        kept: list[int] = []
        for address in page_set.addresses_of(extents, abi.PAGE_SIZE).tolist():
            page = np.array([[address, address + abi.PAGE_SIZE]], dtype=np.uint64)
            try:
                self.read_pages_into(page, buffer[len(kept) * abi.PAGE_SIZE :])
            except ProcessGoneError:
                raise
            except CaptureError:
                continue
            kept.append(address)
        return page_set.extents_of_addresses(np.array(kept, dtype=np.uint64), abi.PAGE_SIZE)

    def _peek_into(self, ranges: Ranges, buffer: memoryview) -> None:
        """Read in spite of the protection, through ``/proc/PID/mem``."""
        try:
            descriptor = os.open(f"/proc/{self.pid}/mem", os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise self._failure("read", 0, error.errno or 0) from error
        try:
            for address, length in ranges.tolist():
                if os.preadv(descriptor, [buffer[:length]], address) != length:
                    raise self._failure("read", address, errno.EFAULT)
                buffer = buffer[length:]
        except OSError as error:
            raise self._failure("read", 0, error.errno or 0) from error
        finally:
            os.close(descriptor)

    def write_from(self, ranges: Ranges, buffer: bytearray | memoryview | NDArray[np.uint8]) -> None:
        """Write ``buffer`` to the ranges, one after the other. The mappings must be writable."""
        self._transfer(abi.process_vm_writev, "write", ranges, address_of(buffer))

    def write_pages_from(self, extents: Ranges, buffer: bytes | bytearray | memoryview | NDArray[np.uint8]) -> None:
        """Write the pages of a set, rows ``[start, end)``, in order. The mappings must be writable."""
        ranges = extents.copy()
        ranges[:, 1] -= ranges[:, 0]
        self.write_from(ranges, np.frombuffer(buffer, np.uint8))

    def write_side_by_side(self, extents: Ranges, buffer: NDArray[np.uint8], threads: int) -> None:
        """As `write_pages_from`, by several threads where there is enough for them."""

        def write(numbered: tuple[int, Ranges]) -> None:
            number, piece = numbered
            Memory(self.pid).write_pages_from(piece, buffer[number * PIECE :])

        pieces = enumerate(page_set.cut(extents, PIECE))
        for _ in parallel.in_order(write, pieces, threads if len(buffer) > PIECE else 1):
            pass

    def write(self, address: int, content: bytes) -> None:
        """Write ``content`` to a writable mapping."""
        if content:
            self.write_from(ranges_of([(address, len(content))]), bytearray(content))

    def write_each(self, contents: list[tuple[int, bytes]]) -> None:
        """Write many pieces, each at its address, all at once."""
        if contents:
            ranges = ranges_of([(address, len(content)) for address, content in contents])
            self.write_from(ranges, bytearray(b"".join(content for _, content in contents)))

    def poke(self, address: int, content: bytes) -> None:
        """Write in spite of the protection, through ``/proc/PID/mem`` (FOLL_FORCE).

        Raises:
            ProcessGoneError: the process has ended.
            CaptureError: it is not mapped, or the kernel forbids it (``proc_mem.force_override=never``).
        """
        try:
            descriptor = os.open(f"/proc/{self.pid}/mem", os.O_WRONLY | os.O_CLOEXEC)
        except OSError as error:
            raise self._failure("write", address, error.errno or 0) from error
        try:
            written = os.pwrite(descriptor, content, address)
        except OSError as error:
            raise self._failure("write", address, error.errno or 0) from error
        finally:
            os.close(descriptor)
        if written != len(content):
            raise self._failure("write", address + written, errno.EFAULT)

    def _transfer(self, call: object, verb: str, ranges: Ranges, local: int) -> None:
        lengths = ranges[:, 1]
        for first in range(0, len(ranges), abi.IOV_MAX):
            group = np.ascontiguousarray(ranges[first : first + abi.IOV_MAX])
            want = int(lengths[first : first + abi.IOV_MAX].sum())
            if want > MAX_TRANSFER:
                self._transfer_long(call, verb, group, local)
            else:
                self._transfer_group(call, verb, group, local, want)
            local += want

    def _transfer_long(self, call: object, verb: str, group: Ranges, local: int) -> None:
        for address, length in group.tolist():
            for offset in range(0, length, MAX_TRANSFER):
                size = min(MAX_TRANSFER, length - offset)
                self._transfer_group(call, verb, ranges_of([(address + offset, size)]), local + offset, size)
            local += length

    def _transfer_group(self, call: object, verb: str, group: Ranges, local: int, want: int) -> None:
        self._local.base, self._local.length = local, want
        remote = int(group.ctypes.data)
        got = call(self.pid, ctypes.addressof(self._local), 1, remote, len(group), 0)  # type: ignore[operator]
        if got != want:
            failed = ctypes.get_errno() if got < 0 else errno.EFAULT
            raise self._failure(verb, self._first_unread(group, max(got, 0)), failed)

    @staticmethod
    def _first_unread(group: Ranges, done: int) -> int:
        for address, length in group.tolist():
            if done < length:
                return int(address + done)
            done -= length
        return 0

    def _failure(self, verb: str, address: int, number: int) -> CaptureError:
        if number in (errno.ESRCH, errno.ENOENT):
            return ProcessGoneError(f"cannot {verb} memory of pid {self.pid}: it has ended")
        advice = "give the keeper the right to trace it (CAP_SYS_PTRACE)" if number == errno.EPERM else "capture it again"
        return CaptureError(f"cannot {verb} memory of pid {self.pid} at {address:#x}: {os.strerror(number)}; {advice}")


class Place:
    """One range of a process's memory that is read and written again and again: how to ask for it is worked out once."""

    def __init__(self, memory: Memory, address: int, size: int) -> None:
        self._memory = memory
        self._address = address
        self._buffer = bytearray(size)
        self._remote = abi.IoVec(address, size)
        self._local = abi.IoVec(address_of(self._buffer), size)
        self._order = (memory.pid, ctypes.addressof(self._local), 1, ctypes.addressof(self._remote), 1, 0)

    def read(self) -> bytes:
        """All of it. Raises as `Memory.read`."""
        if abi.process_vm_readv(*self._order) == len(self._buffer):
            return bytes(self._buffer)
        return self._memory.read(self._address, len(self._buffer))

    def write(self, content: bytes) -> None:
        """Fill it; the content is as long. Raises as `Memory.write`."""
        self._buffer[:] = content
        if abi.process_vm_writev(*self._order) != len(content):
            self._memory.write(self._address, content)
