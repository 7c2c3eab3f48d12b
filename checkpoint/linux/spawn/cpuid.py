"""Query the processor by an instruction of our own (CPUID), for facts that /proc/cpuinfo does not show.

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

from checkpoint import arch
from checkpoint.arch import cpu, extended
from checkpoint.errors import ProbeError
from checkpoint.linux.spawn.namespaces import prctl

_PR_SVE_SET_VL, _PR_SVE_GET_VL, _PR_SVE_VL_LEN_MASK = 50, 51, 0xFFFF
_ANY_VECTOR_SIZE = 8192
"""More than any processor has: the kernel takes the longest there is. Source: linux/prctl.h, asm/sigcontext.h (SVE_VL_MAX)."""


@functools.cache
def xstate_layout() -> extended.Layout:
    """Where the components of a thread's extended state lie; () where there are none, or the system forbids code of our own."""
    with contextlib.ExitStack() as pages:
        try:
            return extended.layout_here(features, vector_size, lambda code: pages.enter_context(_instructions(code)))
        except OSError:
            return ()


def why_unsupported() -> str:
    """Why unmodified programs cannot be kept on this machine's processor; "": they can."""
    if reason := arch.why_unsupported():
        return reason
    has = features() if extended.UNKEPT else ()
    if unkept := [called for name, called in extended.UNKEPT.items() if name in has]:
        return (
            f"the processor has {' and '.join(unkept)}, whose registers are not kept so far: boot with that parameter of the "
            "kernel, or have the program keep its state itself (docs/decorator.md)"
        )
    return ""


def require_supported(what: str) -> None:
    """Check that unmodified programs can be kept on this machine's processor.

    Args:
        what: was tried, for the message: "capture pid 412".

    Raises:
        ProbeError: they cannot.
    """
    if reason := why_unsupported():
        raise ProbeError(f"cannot {what}: {reason}")


@functools.cache
def state_sets() -> tuple[tuple[int, int], ...]:
    """The register sets that make up a thread's extended state, in order: number, and the bytes to offer for it."""
    return extended.sets(features, vector_size)


@functools.cache
def vector_size() -> int:
    """Bytes of the longest scalable vectors that this processor has; 0: it has none.

    Found by having our own thread use the longest for an instant, for nothing else tells it. Source: PR_SVE_SET_VL(2const).
    """
    try:
        ours = prctl(_PR_SVE_GET_VL)
        longest = prctl(_PR_SVE_SET_VL, _ANY_VECTOR_SIZE)
        prctl(_PR_SVE_SET_VL, ours)
    except OSError:
        return 0
    return longest & _PR_SVE_VL_LEN_MASK


@contextlib.contextmanager
def _instructions(code: bytes) -> Iterator[int]:
    """The address of instructions in a page that is not writable, for as long as they are needed.

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
    """The features of the processor by /proc/cpuinfo, in alphabetical order."""
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith(cpu.FEATURES_LINE):
            return tuple(sorted(line.partition(":")[2].split()))
    return ()
