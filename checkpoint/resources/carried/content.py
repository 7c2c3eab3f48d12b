"""The content of one carried file when it was read: its pages, and the digest of each."""

from __future__ import annotations

import functools
import os
import stat
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from msgspec import Struct

from checkpoint.linux import abi
from checkpoint.linux.memory import digest_tracker
from checkpoint.pages import page_set
from checkpoint.pages.merge import Copy
from checkpoint.pages.page_set import PageMap, Words

Key = tuple[int, int]
"""Device and inode."""
Version = tuple[int, int, int, int, int]
"""Device, inode, size, time of modification, time of change: of one content of a file."""


class Content(Struct, frozen=True, dict=True, eq=False):
    """The content of one file when it was read.

    Attributes:
        place: number of its stretch of addresses.
        raw: its pages as they were read: addresses, and bytes in whole pages.
        is_settled: a later write would have changed its times. Through a mapping that was there then, it would not: only the
            first write to a clean page does (file_update_time() in the kernel's page_mkwrite).
    """

    version: Version
    place: int
    raw: Copy
    is_settled: bool
    attributes: tuple[tuple[str, bytes], ...]

    @functools.cached_property
    def filled(self) -> PageMap:
        """Where each page that is not all zero lies: (0, its place in ``raw``). Costs a pass over all."""
        addresses = page_set.addresses_of(self.raw.pages, abi.PAGE_SIZE)
        indexes = (
            np.flatnonzero(~page_set.zero_pages(self.raw.content, abi.PAGE_SIZE)) if len(addresses) else np.empty(0, np.intp)
        )
        words = np.zeros((len(indexes), 2), dtype=np.uint64)
        words[:, 1] = indexes
        return PageMap(addresses[indexes], words)

    @functools.cached_property
    def table(self) -> PageMap:
        """The digest of each page that is not all zero."""
        rows = np.frombuffer(self.raw.content, dtype=np.uint8).reshape(-1, abi.PAGE_SIZE)[self.filled.words[:, 1]]
        return PageMap(
            self.filled.addresses, page_set.digest_pages(rows.tobytes(), self.filled.addresses, abi.PAGE_SIZE).reshape(-1, 2)
        )


def version_of(about: os.stat_result) -> Version:
    """The version of the content of a file with this stat(2)."""
    return about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns


def held_size_of(about: os.stat_result) -> int:
    """Bytes that a file holds: a sparse one may look larger."""
    return min(about.st_size, about.st_blocks * 512) if stat.S_ISREG(about.st_mode) else 0


def pages_of(file: int, about: os.stat_result, start: int) -> Copy:
    """The content of a file, in whole pages, at its addresses; holes of a sparse one are left out."""
    page = abi.PAGE_SIZE
    end = -(-about.st_size // page) * page
    is_sparse = about.st_blocks * 512 < about.st_size
    extents = [(first, min(last, end)) for first, last in digest_tracker.filled_extents(file)] if is_sparse else [(0, end)]
    extents = [(first, last) for first, last in _merged(extents) if first < last]
    buffer = np.empty(sum(last - first for first, last in extents), dtype=np.uint8).data
    filled = 0
    for first, last in extents:
        target = buffer[filled : filled + last - first]
        got = _read_into(file, target, first)
        target[got:] = bytes(len(target) - got)
        filled += len(target)
    return Copy(np.array([(start + first, start + last) for first, last in extents], dtype=np.uint64).reshape(-1, 2), buffer)


def _read_into(file: int, target: memoryview, offset: int) -> int:
    """Fill a buffer as far as the file goes; bytes read."""
    got = 0
    while got < len(target) and (count := os.preadv(file, [target[got:]], offset + got)):
        got += count
    return got


def _merged(extents: Iterable[tuple[int, int]]) -> Iterator[tuple[int, int]]:
    """Extents rounded to pages may touch or share one."""
    begun: tuple[int, int] | None = None
    for first, last in extents:
        if begun is not None and first <= begun[1]:
            begun = begun[0], max(last, begun[1])
            continue
        if begun is not None:
            yield begun
        begun = first, last
    if begun is not None:
        yield begun


def attributes_of(file: int) -> tuple[tuple[str, bytes], ...]:
    """Extended attributes that belong to the file: its user's own, and access lists. Source: xattr(7)."""
    try:
        names = os.listxattr(file)
    except OSError:  # a file system without
        return ()
    kept = sorted(name for name in names if name.startswith(("user.", "system.posix_acl_")))
    return tuple((name, os.getxattr(file, name)) for name in kept)


def digests_of(contents: Sequence[Content]) -> PageMap:
    """The digests of all files' pages."""
    if not contents:
        return PageMap.empty()
    tables = [content.table for content in contents]
    return PageMap(np.concatenate([one.addresses for one in tables]), np.concatenate([one.words for one in tables]))


def places_of(contents: Sequence[Content]) -> Words:
    """Where each page of all files lies: (index of the file, index of the page in what was read)."""
    words = [content.filled.words + np.array((index, 0), dtype=np.uint64) for index, content in enumerate(contents)]
    return np.concatenate(words) if words else np.empty((0, 2), dtype=np.uint64)
