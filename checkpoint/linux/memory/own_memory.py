"""Memory of our own process with write tracking by the kernel: for state that a program changes in place.

It uses asynchronous write protection and one scan (`checkpoint.linux.memory.write_protect`), where the kernel has both. Elsewhere
the written pages are unknown, and the caller compares. The soft-dirty bit is not used here: clearing it would clear it for the
whole process.
"""

from __future__ import annotations

import ctypes
import mmap
import os
from typing import Final

import numpy as np
from msgspec import Struct, field

from checkpoint.arch import number_of
from checkpoint.errors import CheckpointError
from checkpoint.linux import abi, batch_syscalls
from checkpoint.linux.memory.pagemap import PageScanner
from checkpoint.linux.memory.tracker import NONE
from checkpoint.linux.memory.write_protect import enable_write_protection
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words
from checkpoint.runtime.lazy_numpy import NDArray
from checkpoint.sentences import in_words

SEGMENT_PAGE: Final = 4096
"""Only kernels with pages of this size tell in the segment's pages."""


class Allocation(Struct, eq=False):
    """One piece of live memory.

    Attributes:
        content: all of it, whole pages; zeros at first.
        owner: the name under which it was last kept.
        is_followed: the kernel tells which pages are written.
        is_known: every page written since it was last kept is in ``written``; otherwise it must be compared.
        written: numbers of its pages written since then.
    """

    content: NDArray[np.uint8]
    owner: str = ""
    is_followed: bool = True
    is_known: bool = True
    written: Words = field(default_factory=lambda: NONE[:, 0])

    @property
    def address(self) -> int:
        """Where it begins."""
        return int(self.content.ctypes.data)

    def take(self, owner: str) -> NDArray[np.uint64] | None:
        """The pages written since ``owner`` took them last, None where they must be compared; they are its own from now on."""
        is_known = self.is_known and self.owner in ("", owner)
        written, self.written = self.written, NONE[:, 0]
        self.owner, self.is_known = owner, self.is_followed
        return written if is_known else None


class LiveMemory:
    """Arrays whose written pages are known. One thread at a time.

    Attributes:
        note: "" or why the written pages are not known, so that every commit compares.
    """

    def __init__(self) -> None:
        self.note = ""
        self._allocations: dict[int, Allocation] = {}
        self._ranges: Words = NONE
        self._faults = -1
        self._scanner: PageScanner | None = None

    def array(self, shape: tuple[int, ...], dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
        """An array of zeros in memory of its own, whole pages."""
        count = int(np.prod(shape, dtype=np.int64))
        size = max(-(-count * dtype.itemsize // abi.PAGE_SIZE), 1) * abi.PAGE_SIZE
        memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        memory.madvise(mmap.MADV_NOHUGEPAGE)  # a huge page would be split at its first write after every commit
        made = Allocation(np.frombuffer(memory, dtype=np.uint8))
        self._follow(made)
        self._allocations[made.address] = made
        return np.frombuffer(memory, dtype=dtype, count=count).reshape(shape)

    def at(self, address: int) -> Allocation | None:
        """The live memory that begins at an address."""
        return self._allocations.get(address)

    def look(self) -> None:
        """Find what was written since the last look, and begin anew."""
        if self._scanner is None or not len(self._ranges):
            return
        try:
            written = self._scanner.written(self._ranges)
        except CheckpointError as error:
            self._give_up(in_words(error))
            return
        if not len(written):
            return
        for address, held in self._allocations.items():
            end = address + len(held.content)
            low = np.searchsorted(written[:, 1], np.uint64(address), side="right")
            high = np.searchsorted(written[:, 0], np.uint64(end), side="left")
            if low < high:
                inside = np.clip(written[low:high], np.uint64(address), np.uint64(end))
                numbers = (page_set.addresses_of(inside, abi.PAGE_SIZE) - np.uint64(address)) // np.uint64(abi.PAGE_SIZE)
                held.written = np.union1d(held.written, numbers) if len(held.written) else numbers

    def distrust(self) -> None:
        """Something was cut off between a look and its use: compare everything once."""
        for held in self._allocations.values():
            held.is_known = False

    def close(self) -> None:
        """Give descriptors back; the arrays stay."""
        if self._scanner is not None:
            self._scanner.close()
            self._scanner = None
        if self._faults >= 0:
            os.close(self._faults)
            self._faults = -1

    def _follow(self, made: Allocation) -> None:
        if not self._allocations and not self.note:
            self._open()
        made.is_followed = made.is_known = self._scanner is not None
        if self._scanner is None:
            return
        start, end = made.address, made.address + len(made.content)
        order = abi.UffdRegister(start, end - start, abi.UFFDIO_REGISTER_MODE_WP, 0)
        if abi.ioctl(self._faults, abi.UFFDIO_REGISTER, ctypes.addressof(order)) != 0:
            made.is_followed = made.is_known = False
            self._give_up(f"the kernel does not follow this memory: {os.strerror(ctypes.get_errno())}")
            return
        mine = np.array([[start, end]], dtype=np.uint64)
        self._scanner.written(mine)  # protects it
        self._ranges = page_set.union(self._ranges, mine)

    def _open(self) -> None:
        """Ask the kernel for its ways, and say what is missing."""
        number = number_of("userfaultfd")
        if number is None or abi.PAGE_SIZE != SEGMENT_PAGE:
            self.note = (
                f"written pages are compared: not known how to ask on {os.uname().machine}, pages of {abi.PAGE_SIZE} bytes"
            )
            return
        flags = abi.O_CLOEXEC | abi.O_NONBLOCK | abi.UFFD_USER_MODE_ONLY
        self._faults = abi.userfaultfd(number, flags)
        if self._faults < 0:
            self.note = f"written pages are compared: userfaultfd: {os.strerror(ctypes.get_errno())}"
            return
        try:
            enable_write_protection(self._faults)
            scanner = PageScanner(os.getpid(), batch_syscalls.one_by_one)
            scanner.is_protected(0, abi.PAGE_SIZE)
        except (OSError, CheckpointError) as error:
            self._give_up(in_words(error))
            return
        self._scanner = scanner

    def _give_up(self, why: str) -> None:
        """From now on everything is compared."""
        self.note = f"written pages are compared: {why}"
        self.close()
        for held in self._allocations.values():
            held.is_followed = held.is_known = False
