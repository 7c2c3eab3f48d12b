"""What a snapshot may come back with: the rights of its owner, and what the owner was started with, and no more.

An agent of root restores with root's rights; what a snapshot asks for is set. What its owner could not have got by itself where
it was started is refused: somebody may have made it up. Where nobody told what a program was started with (it was protected by
its PID), its limits and its priority are its own word.

Source: capabilities(7), on securebits; setrlimit(2), on RLIMIT_RTPRIO and RLIMIT_NICE; sched(7).
"""

from __future__ import annotations

import os
import resource
from collections.abc import Iterator
from typing import Final

from checkpoint import rights
from checkpoint.errors import MismatchError
from checkpoint.linux.inheritance import Inheritance
from checkpoint.model import Credentials, Member, Snapshot, ThreadState

ROOT: Final = 0
SECBIT_KEEP_CAPS: Final = 1 << 4
"""The one of the securebits that anybody may set; execve(2) takes it back."""
SCHED_DEADLINE: Final = 6
REAL_TIME: Final = (os.SCHED_FIFO, os.SCHED_RR)
RLIMIT_NICE: Final = 13
RLIMIT_RTPRIO: Final = 14
"""The module `resource` does not name them."""
LEAST_NICE_FROM: Final = 20
"""RLIMIT_NICE counts down from here."""


def check_rights(name: str, outline: Snapshot, owner: int, started: Inheritance | None) -> None:
    """Let a snapshot come back with the rights of its owner, and no more: all threads of all of its processes.

    Args:
        started: what it was started with; None: not known, it may have one group and call it by all four of its names.

    Raises:
        MismatchError: it has become another user or group, as a set-user-id or set-group-id program does; or it has filters of
            seccomp(2) that a set-user-id program would run under, or a root directory of its own, whose files that would trust,
            or securebits; or it has more of the machine than what it was started with allows.
        FormatError: it does not tell them as we know it.
    """
    if owner == ROOT or os.geteuid() != ROOT:
        return  # root may; where we are not root, there is nothing to be gained
    groups = frozenset((started.gid, *started.groups)) if started is not None else None
    if not all(_are_no_more(one, owner, groups) for one in rights.everybodys(outline)):
        reason = f"it runs with other rights than those of its owner, uid {owner}"
    elif rights.could_gain(outline):
        reason = "it is under a seccomp filter, but may gain rights by what it executes (no_new_privs is off)"
    elif {one.process.root_directory for one in _processes(outline)} != {"/"}:
        reason = "it has a root directory of its own (chroot), by whose files it may gain rights"
    elif any(one.securebits & ~SECBIT_KEEP_CAPS for one in rights.everybodys(outline)):
        reason = "it has securebits, under which a set-user-id program may keep rights that it gives up"
    elif started is not None and (more := next(_beyond(outline, started), "")):
        reason = f"{more}, which is more than what uid {owner} started it with allows"
    else:
        return
    reason += ": only a program of root may; start it as root"
    raise MismatchError(f"cannot restore {name}: {reason}", (reason,))


def _processes(outline: Snapshot) -> tuple[Snapshot | Member, ...]:
    return outline, *outline.members


def _are_no_more(theirs: Credentials, owner: int, groups: frozenset[int] | None) -> bool:
    _, permitted, effective, _, ambient = theirs.capabilities
    if set(theirs.uids) != {owner} or permitted | effective | ambient:
        return False
    return len(set(theirs.gids)) == 1 if groups is None else groups.issuperset((*theirs.gids, *theirs.groups))


def _beyond(outline: Snapshot, started: Inheritance) -> Iterator[str]:
    """What the program has of the machine that it could not have got without somebody else's help."""
    for one in _processes(outline):
        for number, (_, hard) in one.process.limits.items():
            if number in started.limits and _unbounded(hard) > _unbounded(started.limits[number][1]):
                yield f"its limit {number} (RLIMIT) is {'none' if hard == resource.RLIM_INFINITY else hard}"
        for thread in one.threads:
            yield from _beyond_priority(thread, started)
        yield from _beyond_deadlines(one, started)


def _beyond_priority(thread: ThreadState, started: Inheritance) -> Iterator[str]:
    policy = thread.policy & ~os.SCHED_RESET_ON_FORK
    named = f"its thread {thread.tid} ({thread.name})"
    if policy == SCHED_DEADLINE and started.policy != SCHED_DEADLINE:
        yield f"{named} is scheduled by deadlines"
    allowed = _allowed(started, RLIMIT_RTPRIO)
    if policy in REAL_TIME and thread.priority > max(allowed, started.priority if started.policy in REAL_TIME else 0):
        yield f"{named} has the real-time priority {thread.priority}"
    if thread.nice < _least_nice(started):
        yield f"{named} has the nice value {thread.nice}"


def _beyond_deadlines(one: Snapshot | Member, started: Inheritance) -> Iterator[str]:
    """The same of what is told of deadlines and slices, which is set whatever else is said of a thread."""
    for tid, policy, nice in rights.slices(one.resources):
        if policy == SCHED_DEADLINE and started.policy != SCHED_DEADLINE:
            yield f"its thread {tid} is scheduled by deadlines"
        if nice < _least_nice(started):
            yield f"its thread {tid} has the nice value {nice}"


def _least_nice(started: Inheritance) -> float:
    return min(LEAST_NICE_FROM - _allowed(started, RLIMIT_NICE), started.nice)


def _allowed(started: Inheritance, number: int) -> float:
    """How far a program could go by itself."""
    return _unbounded(started.limits[number][1]) if number in started.limits else float("inf")


def _unbounded(limit: int) -> float:
    """A limit as the kernel takes it: any negative number is about the largest there is."""
    return float("inf") if limit < 0 else limit
