"""Whether this machine has what a snapshot needs, found before anything is started.

Everything that is wrong is found at once, so that it can be put right at once.
"""

from __future__ import annotations

import os

from checkpoint.arch import x86_64
from checkpoint.engine import RestoreOptions
from checkpoint.errors import MismatchError
from checkpoint.linux import abi
from checkpoint.model import Snapshot


def require(state: Snapshot, options: RestoreOptions) -> None:
    """Refuse a snapshot that cannot come back here.

    Raises:
        MismatchError: with one reason for each difference.
    """
    reasons = mismatches(state, options)
    if reasons:
        listed = "; ".join(reasons)
        raise MismatchError(f"cannot restore {state.component} here: {listed}", reasons)


def mismatches(state: Snapshot, options: RestoreOptions) -> tuple[str, ...]:
    """Everything in which this machine differs from what the snapshot needs, one sentence each."""
    machine = state.machine
    if machine.architecture != os.uname().machine or machine.architecture != x86_64.NAME:
        return (f"it was taken on {machine.architecture}, this machine is {os.uname().machine}: restore it on such a machine",)
    reasons = []
    if machine.page_size != abi.PAGE_SIZE:
        reasons.append(f"its pages are {machine.page_size} bytes, this kernel's {abi.PAGE_SIZE}: boot a kernel with the same")
    if len(state.threads) != 1:
        reasons.append(f"it has {len(state.threads)} threads: only single-threaded programs are supported so far")
    return tuple(reasons)
