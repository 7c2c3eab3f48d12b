"""Give a child the rights, limits and priorities of the process that asked for it, just before its execve.

A program that a service starts on request must not get the service's rights, limits and priorities, but those of the requester.

Sources: execve(2), credentials(7), capabilities(7), setrlimit(2), sched(7), ioprio_set(2), proc_pid_oom_score_adj(5).
"""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from checkpoint.linux import abi
from checkpoint.linux.spawn import namespaces

PR_CAPBSET_READ: Final = 23
PR_CAPBSET_DROP: Final = 24
PR_SET_NO_NEW_PRIVS: Final = 38
CAPABILITIES_MAX: Final = 64
EVERY_CAPABILITY: Final = (1 << CAPABILITIES_MAX) - 1


class Inheritance(Struct, frozen=True):
    """The state that execve(2) does not change, besides environment, directory, umask and descriptors, which a client sends.

    Attributes:
        groups: the supplementary ones.
        bounding: set of capabilities, bit N for capability N: those that a program of root may have at most.
        limits: RLIMIT number → (soft, hard); -1 is infinity. Numbers that are missing stay as they are.
        affinity: processors; empty: any.
    """

    uid: int
    gid: int
    groups: tuple[int, ...] = ()
    bounding: int = EVERY_CAPABILITY
    no_new_privs: bool = False
    limits: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    nice: int = 0
    policy: int = os.SCHED_OTHER
    priority: int = 0
    affinity: tuple[int, ...] = ()
    io_priority: int = 0
    oom_score_adj: int = 0

    def as_user(self, uid: int, gid: int, groups: tuple[int, ...]) -> Inheritance:
        """The same for another user."""
        return replace(self, uid=uid, gid=gid, groups=groups)


def of_owner(uid: int, gid: int, groups: tuple[int, ...]) -> Inheritance:
    """The inheritance of another user's program that root starts by hand: none of root's priorities, nor a right to any."""
    return Inheritance(
        uid,
        gid,
        groups,
        limits={resource.RLIMIT_NICE: (0, 0), resource.RLIMIT_RTPRIO: (0, 0)},
        nice=max(os.getpriority(os.PRIO_PROCESS, 0), 0),
        oom_score_adj=max(int(Path("/proc/self/oom_score_adj").read_text()), 0),
    )


def take_on(inheritance: Inheritance, *, restorable: bool = False) -> None:
    """Become what it says, for good: in a child, just before its execve.

    Without rights of our own we stay the user that we are, and limits stay below our own hard ones.

    Args:
        restorable: keep the one right that a restore takes, see `namespaces.become`.

    Raises:
        OSError: it names what could not be taken on.
    """
    _set_oom_score(inheritance.oom_score_adj)
    _set_scheduling(inheritance)
    for number, (soft, hard) in inheritance.limits.items():
        _set_limit(number, soft, hard)
    if os.geteuid() == 0:
        _drop_capabilities(inheritance.bounding)
        if restorable:
            namespaces.become(inheritance.uid, inheritance.gid, inheritance.groups)
        else:
            _become(inheritance)
    if inheritance.no_new_privs:
        namespaces.prctl(PR_SET_NO_NEW_PRIVS, 1)


def _set_oom_score(score: int) -> None:
    """Raising it is always permitted. Source: proc_pid_oom_score_adj(5)."""
    with contextlib.suppress(PermissionError):
        Path("/proc/self/oom_score_adj").write_text(str(score))


def _set_scheduling(inheritance: Inheritance) -> None:
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, inheritance.nice)
    if inheritance.policy != os.sched_getscheduler(0):
        with contextlib.suppress(PermissionError):
            os.sched_setscheduler(0, inheritance.policy, os.sched_param(inheritance.priority))
    if inheritance.affinity:
        with contextlib.suppress(OSError):  # processors that were there before, and are not in this machine's cpuset
            os.sched_setaffinity(0, inheritance.affinity)
    with contextlib.suppress(OSError):
        abi.set_io_priority(inheritance.io_priority)


def _set_limit(number: int, soft: int, hard: int) -> None:
    """As high as it is, or as we may: raising a hard one needs CAP_SYS_RESOURCE."""
    try:
        resource.setrlimit(number, (soft, hard))
    except (ValueError, OSError):
        ceiling = resource.getrlimit(number)[1]
        resource.setrlimit(number, (_lesser(soft, ceiling), _lesser(hard, ceiling)))


def _lesser(one: int, other: int) -> int:
    """The lesser of two limits."""
    finite = [limit for limit in (one, other) if limit != resource.RLIM_INFINITY]
    return min(finite, default=resource.RLIM_INFINITY)


def _drop_capabilities(bounding: int) -> None:
    """Have no more capabilities in reach than the bounding set says. A kernel knows fewer than 64."""
    for capability in range(CAPABILITIES_MAX):
        with contextlib.suppress(OSError):
            if not bounding >> capability & 1 and namespaces.prctl(PR_CAPBSET_READ, capability):
                namespaces.prctl(PR_CAPBSET_DROP, capability)


def _become(inheritance: Inheritance) -> None:
    uids, gids = (inheritance.uid,) * 3, (inheritance.gid,) * 3
    if (os.getresuid(), os.getresgid(), sorted(os.getgroups())) == (uids, gids, sorted(inheritance.groups)):
        return  # a container's root may have no right to change them
    try:
        os.setgroups(inheritance.groups)
        os.setresgid(*gids)
        os.setresuid(*uids)
    except OSError as error:
        raise OSError(error.errno, f"cannot become user {inheritance.uid}: {error.strerror}") from error
