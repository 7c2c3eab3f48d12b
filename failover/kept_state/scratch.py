"""Scratch memory: it travels in no checkpoint, and holds zeros where the program resumes."""

from __future__ import annotations

import ctypes
import mmap
import os
import weakref
from typing import Final

from checkpoint.program.scratch_name import NAME
from checkpoint.sentences import in_words
from failover.errors import RequestError

MAP_FAILED: Final = ctypes.c_void_p(-1).value

_libc = ctypes.CDLL(None, use_errno=True)
_libc.mmap.restype = ctypes.c_void_p
_libc.mmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int, ctypes.c_int, ctypes.c_int, ctypes.c_long)
_libc.munmap.argtypes = (ctypes.c_void_p, ctypes.c_size_t)


def scratch(size: int) -> memoryview:
    """Memory for data that changes much and can be computed again: caches, buffers of frames.

    No checkpoint that is taken of this program from outside carries it, so it costs neither network nor freeze. Where the program
    goes on it is mapped as it was and holds zeros. It is shared with children, as a mapping with MAP_SHARED is::

        frames = numpy.frombuffer(failover.scratch(64 << 20), dtype=numpy.uint8)

    It is given back once nothing refers to it any more. Needs no agent.

    Args:
        size: bytes, rounded up to whole pages of the kernel.

    Raises:
        RequestError: of less than one byte, or more than there is.
    """
    if size < 1:
        raise RequestError(f"cannot give {size} bytes of scratch memory: ask for one at least")
    whole = -(-size // mmap.PAGESIZE) * mmap.PAGESIZE
    try:
        address = _mapped(whole)
    except (OSError, OverflowError, ctypes.ArgumentError) as error:
        raise RequestError(f"cannot give {size} bytes of scratch memory: {in_words(error)}") from error
    held = (ctypes.c_ubyte * whole).from_address(address)
    weakref.finalize(held, _libc.munmap, address, whole).atexit = False  # threads and exit handlers may use it to the end
    return memoryview(held).cast("B")[:size]


def _mapped(size: int) -> int:
    """A memory file of that name, mapped and closed: nothing but the mapping is left of it."""
    descriptor = os.memfd_create(NAME, os.MFD_CLOEXEC)
    try:
        os.ftruncate(descriptor, size)
        address = _libc.mmap(None, size, mmap.PROT_READ | mmap.PROT_WRITE, mmap.MAP_SHARED, descriptor, 0)
        if address is None or address == MAP_FAILED:
            raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
        return int(address)
    finally:
        os.close(descriptor)
