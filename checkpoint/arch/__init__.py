"""Processors as data: a file each, the same names in the same order; this machine's are `cpu`, `stubs`, `extended` and `levels`.

To add one: copy the files of ``x86_64``, replace every value from the processor's own manual and kernel headers, add its name
below, and run ``tests/checkpoint``; the tracees there say what is still wrong.
"""

from __future__ import annotations

import os
from typing import Final

from checkpoint.arch import x86_64 as cpu
from checkpoint.arch import x86_64_levels as levels
from checkpoint.arch import x86_64_stub as stubs
from checkpoint.arch import x86_64_xstate as extended
from checkpoint.errors import ProbeError

__all__ = ["SUPPORTED", "cpu", "extended", "levels", "require_supported", "stubs"]

SUPPORTED: Final = (cpu.NAME,)
"""As uname(2) calls them."""


def require_supported() -> None:
    """Check that this machine's processor is one that we have.

    Raises:
        ProbeError: it is not.
    """
    machine = os.uname().machine
    if machine not in SUPPORTED:
        raise ProbeError(
            f"cannot capture on {machine}: only {', '.join(SUPPORTED)} is supported so far; run it on such a machine"
        )
