"""With whose rights a snapshot may come back: those of its owner, and no more.

An agent of root restores with root's rights; what a snapshot asks for is set. Priorities and limits come back as they were: root
gives them to ordinary programs while they run (chrt, prlimit, RealtimeKit), and who hands snapshots in counts as root.

Source: capabilities(7), on securebits.
"""

from __future__ import annotations

import os
from typing import Final

from agent.caller import ROOT
from checkpoint import rights
from checkpoint.errors import MismatchError
from checkpoint.linux.inheritance import Inheritance
from checkpoint.model import Credentials, Snapshot

SECBIT_KEEP_CAPS: Final = 1 << 4
"""The one of the securebits that anybody may set; execve(2) takes it back."""


def check_rights(name: str, outline: Snapshot, owner: int, started: Inheritance | None) -> None:
    """Let a snapshot come back with the rights of its owner, and no more: all threads of all of its processes.

    Args:
        started: what it was started with; None: not known, it may have one group and call it by all four of its names.

    Raises:
        MismatchError: it has become another user or group, as a set-user-id or set-group-id program does; or it has filters of
            seccomp(2) that a set-user-id program would run under, or a root directory of its own, whose files that would trust,
            or securebits. Priorities and limits are as they were: root may have given them to it while it ran.
        FormatError: it does not tell them as we know it.
    """
    if owner == ROOT or os.geteuid() != ROOT:
        return  # root may; where we are not root, there is nothing to be gained
    groups = frozenset((started.gid, *started.groups)) if started is not None else None
    if not all(_are_no_more(one, owner, groups) for one in rights.everybodys(outline)):
        reason = f"it runs with other rights than those of its owner, uid {owner}"
    elif rights.could_gain(outline):
        reason = "it is under a seccomp filter, but may gain rights by what it executes (no_new_privs is off)"
    elif {one.process.root_directory for one in outline.processes} != {"/"}:
        reason = "it has a root directory of its own (chroot), by whose files it may gain rights"
    elif any(one.securebits & ~SECBIT_KEEP_CAPS for one in rights.everybodys(outline)):
        reason = "it has securebits, under which a set-user-id program may keep rights that it gives up"
    else:
        return
    reason += ": only a program of root may; start it as root"
    raise MismatchError(f"cannot restore {name}: {reason}", (reason,))


def _are_no_more(theirs: Credentials, owner: int, groups: frozenset[int] | None) -> bool:
    _, permitted, effective, _, ambient = theirs.capabilities
    if set(theirs.uids) != {owner} or permitted | effective | ambient:
        return False
    return len(set(theirs.gids)) == 1 if groups is None else groups.issuperset((*theirs.gids, *theirs.groups))
