"""What this processor says of itself, asked by an instruction of our own (CPUID), for /proc/cpuinfo does not tell it.

Source: Intel SDM volume 2, CPUID; mmap(2).
"""

from __future__ import annotations

import contextlib
import functools
import mmap
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from checkpoint.arch import cpu, extended


@functools.cache
def xstate_layout() -> extended.Layout:
    """Where the components of a thread's extended state lie; () where there are none, or the system forbids code of our own."""
    with contextlib.ExitStack() as pages:
        try:
            return extended.layout_here(features, lambda code: pages.enter_context(_instructions(code)))
        except OSError:
            return ()


@functools.cache
def state_sets() -> tuple[tuple[int, int], ...]:
    """The register sets that make up a thread's extended state, in order: number, and the bytes to offer for it."""
    return extended.sets(features)


@contextlib.contextmanager
def _instructions(code: bytes) -> Iterator[int]:
    """The address of instructions in a page that nobody can write, for as long as they are needed.

    Raises:
        OSError: the system does not allow that.
    """
    file = os.memfd_create("instructions", os.MFD_CLOEXEC)
    try:
        os.write(file, code)
        page = mmap.mmap(file, 0, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ | mmap.PROT_EXEC)
    finally:
        os.close(file)
    yield int(np.frombuffer(page, np.uint8).ctypes.data)


@functools.cache
def features() -> tuple[str, ...]:
    """What /proc/cpuinfo says that the processor has, in alphabetical order."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith(cpu.FEATURES_LINE):
            return tuple(sorted(line.partition(":")[2].split()))
    return ()
