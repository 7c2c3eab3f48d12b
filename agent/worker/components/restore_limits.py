"""Limits the rights of a restored snapshot to those of its owner (`checkpoint.snapshot.credentials`).

An agent of root restores with root's rights: it sets what a snapshot asks for. Priorities and limits come back as they were: root
gives them to ordinary programs while they run (chrt, prlimit, RealtimeKit), and a client that hands snapshots in counts as root.
"""

from __future__ import annotations

import os

from agent.system.permissions import ROOT
from checkpoint.errors import MismatchError
from checkpoint.linux.spawn.inherited_limits import Inheritance
from checkpoint.model import Snapshot
from checkpoint.snapshot import credentials
from checkpoint.snapshot.credentials import Owner


def check_rights(name: str, outline: Snapshot, owner: int, started: Inheritance | None) -> None:
    """Let a snapshot come back with the rights of its owner, and no more: all threads of all of its processes.

    Args:
        started: its inheritance when it was started; None: not known, it may have one group and call it by all four of its names.

    Raises:
        MismatchError: it has become another user or group, as a set-user-id or set-group-id program does; or it has filters of
            seccomp(2) that a set-user-id program would run under, or a root directory of its own, whose files that would trust,
            or securebits. Priorities and limits are as they were: root may have given them to it while it ran.
        FormatError: it does not tell them as we know it.
    """
    theirs = bound_of(owner, started)
    if theirs is not None and (reason := credentials.refusal(credentials.beyond(outline, theirs), theirs)):
        raise MismatchError(f"cannot restore {name}: {reason}", (reason,))


def bound_of(owner: int, started: Inheritance | None) -> Owner | None:
    """Whose rights bound a component, also at each capture; None: it may have any, or there is nothing to be gained.

    Root may; and where we are not root, the kernel lets us have no more than our own user's.

    Args:
        started: as for `check_rights`.
    """
    if owner == ROOT or os.geteuid() != ROOT:
        return None
    return Owner(owner) if started is None else Owner(owner, started.gid, (started.gid, *started.groups))
