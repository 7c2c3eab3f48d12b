"""Processors as data: one file each, the same names in the same order.

To add one: copy ``x86_64.py``, replace every value from the processor's own manual and kernel headers, add its name to
`architecture`, and run ``tests/checkpoint``; the tracees there say what is still wrong.
"""

from __future__ import annotations

import os

from checkpoint.arch import x86_64
from checkpoint.errors import ProbeError


def require_supported() -> None:
    """Check that this machine's processor is one that we have.

    Raises:
        ProbeError: it is not.
    """
    machine = os.uname().machine
    if machine != x86_64.NAME:
        raise ProbeError(f"cannot capture on {machine}: only {x86_64.NAME} is supported so far; run it on such a machine")
