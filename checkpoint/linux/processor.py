"""What this processor says of itself, asked by an instruction of our own (CPUID), for /proc/cpuinfo does not tell it.

Source: Intel SDM volume 2, CPUID; mmap(2).
"""

from __future__ import annotations

import ctypes
import functools
import mmap
import os
from pathlib import Path

import numpy as np

from checkpoint.arch import extended as arch


@functools.cache
def xstate_layout() -> arch.Layout:
    """Where the components of a thread's extended state lie; () where there are none, or the system forbids code of our own."""
    if "xsave" not in features():
        return ()
    try:
        return _asked()
    except OSError:
        return ()


def _asked() -> arch.Layout:
    """Put the instructions into a page that nobody can write, and run them.

    Raises:
        OSError: the system does not allow that.
    """
    file = os.memfd_create("instructions", os.MFD_CLOEXEC)
    try:
        os.write(file, arch.ASK + arch.ASK_ENABLED)
        page = mmap.mmap(file, 0, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ | mmap.PROT_EXEC)
    finally:
        os.close(file)
    words = (ctypes.c_uint32 * 4)()
    place = int(np.frombuffer(page, np.uint8).ctypes.data)
    instructions = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32)(place)
    enabled = ctypes.CFUNCTYPE(ctypes.c_uint64)(place + len(arch.ASK))

    def ask(leaf: int, subleaf: int) -> tuple[int, int, int, int]:
        instructions(ctypes.addressof(words), leaf, subleaf)
        first, second, third, fourth = words
        return first, second, third, fourth

    return arch.read_layout(ask, enabled())


@functools.cache
def features() -> tuple[str, ...]:
    """The flags of /proc/cpuinfo, in alphabetical order."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("flags"):
            return tuple(sorted(line.partition(":")[2].split()))
    return ()
