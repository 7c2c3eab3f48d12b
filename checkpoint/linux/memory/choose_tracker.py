"""Choose how to find the pages of a process written since the last scan: three ways, chosen by probing features.

* `checkpoint.linux.memory.write_protect.PagemapTracker`: userfaultfd and PAGEMAP_SCAN. Costs next to nothing.
* `SoftDirtyTracker`: the soft-dirty bit, where the kernel has it.
* `checkpoint.linux.memory.digest_tracker.DigestTracker`: reads every page and compares digests.

Source: Documentation/admin-guide/mm/soft-dirty.rst.
"""

from __future__ import annotations

import ctypes
import os
import struct
from collections.abc import Sequence

from checkpoint.errors import ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.memory.digest_tracker import DigestTracker
from checkpoint.linux.memory.pagemap import SOFT_DIRTY, PagemapFile, PageScanner, existence
from checkpoint.linux.memory.tracker import NONE, Scan, extents_of
from checkpoint.linux.memory.write_protect import PagemapTracker
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words


class SoftDirtyTracker:
    """The soft-dirty bit: cleared for the whole process, set by the kernel with the first write and in every new mapping."""

    name = "soft-dirty"
    cost = "it stands still while failover reads the entries of all its pages"
    sees_every_write = True
    scans_running = False

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._pagemap = PagemapFile(pid)
        self._existed: Words = NONE

    @property
    def watched(self) -> Words:
        """See `Tracker.watched`."""
        return NONE

    def arm(self, lines: Sequence[MapsLine]) -> None:
        """See `Tracker.arm`."""
        self._clear()
        self._existed = self.existing(lines)

    def scan(self, lines: Sequence[MapsLine], *, changed: bool, everywhere: bool = False) -> Scan:
        """See `Tracker.scan`."""
        existing = self.existing(lines)
        dirty = self._pagemap.soft_dirty(extents_of(lines))
        gone = page_set.difference(self._existed, existing)
        fresh = page_set.difference(existing, self._existed)
        self._existed = existing
        self._clear()
        return Scan(page_set.union(page_set.intersection(dirty, existing), fresh), gone)

    def rehearse(self) -> None:
        """See `Tracker.rehearse`: it would take as long as the scan."""

    def confirm(self) -> bool:
        """See `Tracker.confirm`."""
        return True

    def backlog(self, lines: Sequence[MapsLine], limit: int, *, changed: bool) -> int:
        """See `Tracker.backlog`."""
        raise NotImplementedError("clearing is a step of its own: writes before it would be lost")

    def catch_up(self, lines: Sequence[MapsLine], *, changed: bool) -> Scan:
        """See `Tracker.catch_up`."""
        raise NotImplementedError("clearing is a step of its own: writes before it would be lost")

    def existing(self, lines: Sequence[MapsLine]) -> Words:
        """See `Tracker.existing`."""
        return self._pagemap.existing(extents_of(lines))

    def close(self) -> None:
        """See `Tracker.close`."""
        self._pagemap.close()

    def _clear(self) -> None:
        try:
            descriptor = os.open(f"/proc/{self._pid}/clear_refs", os.O_WRONLY | os.O_CLOEXEC)
        except FileNotFoundError as error:
            raise ProcessGoneError(f"cannot reset the soft-dirty bits of pid {self._pid}: it has ended") from error
        try:
            os.write(descriptor, b"4")
        finally:
            os.close(descriptor)


def best_tracking() -> str:
    """How written pages are found on this machine: "pagemap", "soft-dirty" or "digest"."""
    found = existence(os.getpid())
    found.close()
    if isinstance(found, PageScanner):
        return PagemapTracker.name
    return SoftDirtyTracker.name if has_soft_dirty() else DigestTracker.name


def has_soft_dirty() -> bool:
    """Whether this kernel sets the bit: a page that we have just written must have it."""
    probe = bytearray(abi.PAGE_SIZE * 2)
    address = ctypes.addressof(ctypes.c_char.from_buffer(probe))
    with open("/proc/self/pagemap", "rb", buffering=0) as pagemap:
        pagemap.seek(address // abi.PAGE_SIZE * 8)
        (entry,) = struct.unpack("<Q", pagemap.read(8))
    return bool(entry & int(SOFT_DIRTY))
