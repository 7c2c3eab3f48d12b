"""Make the C library's allocator return free memory, because a long-lived process would otherwise keep its peak.

By default glibc gives each thread memory of its own. After a large block was freed once, later blocks of its size come from this
memory, and a small block behind one keeps all of it. A hundred snapshots of a few megabytes left 380 MB of which 12 were in use.

Source: mallopt(3), malloc_trim(3). A C library that has neither keeps no memory for single threads (musl).
"""

from __future__ import annotations

import ctypes
from typing import Final

M_TRIM_THRESHOLD: Final = -1
M_MMAP_THRESHOLD: Final = -3
M_ARENA_MAX: Final = -8
"""malloc.h"""

ARENAS: Final = 2
"""Places from which small blocks come, for all threads together: the interpreter lets few of them work at once."""

LARGE_SIZE: Final = 1 << 20
"""Bytes of a block that is a mapping of its own, and goes back as soon as it is freed: of pages, mostly."""


def be_frugal() -> None:
    """For the rest of this process's life, and before it has threads."""
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "mallopt"):
        return
    libc.mallopt(M_ARENA_MAX, ARENAS)
    libc.mallopt(M_MMAP_THRESHOLD, LARGE_SIZE)
    libc.mallopt(M_TRIM_THRESHOLD, LARGE_SIZE)


def give_back() -> None:
    """Let the kernel have the free pages among the small blocks, too; other threads run meanwhile."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "malloc_trim"):
        libc.malloc_trim(0)
