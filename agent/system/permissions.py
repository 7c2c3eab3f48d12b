"""Identifies the client of a control connection by what the kernel says, and decides its rights where there is no rights.toml.

Sources: unix(7) (SO_PEERCRED), socket(7), asm-generic/socket.h (SO_PEERGROUPS).
"""

from __future__ import annotations

import array
import contextlib
import grp
import os
import pwd
import select
import socket
import struct
from collections.abc import Mapping
from typing import Any, Final

from msgspec import Struct

from agent.errors import RefusedError
from agent.system.adopted_process import Guest
from checkpoint.errors import CheckpointError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.spawn.inherited_limits import Inheritance
from failover.core.event_log import decisions
from failover.core.rights.rules import Subject, without_rules
from failover.errors import RightsError

SO_PEERGROUPS: Final = 59
GROUPS_SIZE_MAX: Final = 1_024
"""Bytes that `socket.getsockopt` takes; a user in more than 256 groups gets those that the system's lists name."""

SCHED_DEADLINE: Final = 6
"""Needs more than a priority to be set, and no child inherits it."""

ROOT: Final = 0
NOBODY: Final = -1
"""For questions that a robot asks another one by itself: it may be told how things stand, and no more."""

_CREDENTIALS: Final = struct.Struct("3i")


class Caller(Struct, frozen=True):
    """One client.

    Attributes:
        uid, gid, groups: as they were when it connected.
        inheritance: the rights and limits that its children would inherit, as far as the agent can see them. It cannot see a
            client from another PID namespace: that one's programs get those of the guard, with no more than ordinary priorities.
    """

    uid: int
    gid: int
    groups: tuple[int, ...]
    inheritance: Inheritance


def may(uid: int, owner: int | None) -> bool:
    """The rule: root and the agent's own user may do everything, another user all that concerns his own components.

    Args:
        owner: whose the component is; None: it is not known.
    """
    return uid in (ROOT, os.geteuid()) or uid == owner


def asking(uid: int) -> int | None:
    """The user as the core's commands name him (``by``): None if he may give any order."""
    return None if may(uid, None) else uid


def check_right(uid: int, component: str, owner: int | None) -> None:
    """Let a user act on a component.

    Raises:
        RefusedError: it is another user's.
    """
    if not may(uid, owner):
        whose = f"belongs to uid {owner}" if owner is not None else "has no owner on record at this robot"
        raise RefusedError(f"{component} {whose}; its owner and root may give orders and read its output", "PermissionError")


def refusal_without_rules(uid: int, right: str, path: str, owners: Mapping[str, int | None]) -> str:
    """Why a user may not do something where there is no rights.toml; "" if he may.

    Args:
        owners: component → whose it is. A path of none of them is a robot, an item of the board or a driver.
    """
    owner = owners.get(path)
    try:
        if right in ("read", "operate") and path in owners:
            check_right(uid, path, owner)
            return ""
        decided = without_rules(
            Subject(f"uid:{uid}", uid=uid, is_owner=may(uid, owner), stands_above=may(uid, None)), right, path
        )
    except (RefusedError, RightsError) as refusal:
        return str(refusal)
    return "" if decided else decided.because


def without_output(told: Any) -> Any:
    """The same without the output of programs, in all of its sentences: for a user who may not read their output."""
    if isinstance(told, str):
        return decisions.without_output(told)
    if isinstance(told, Mapping):
        return {key: without_output(value) for key, value in told.items()}
    return [without_output(value) for value in told] if isinstance(told, list | tuple) else told


def uid_of(connection: socket.socket) -> int:
    """Whose the client is."""
    return int(_CREDENTIALS.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))[1])


def spoken_for(speaker: Caller, uid: int, page_uid: int, group: str) -> Caller:
    """The user for whom a client asks, as if that user had connected.

    Args:
        page_uid: of page_user in agent.toml; `NOBODY`: there is none. group: whose members may connect.

    Raises:
        RefusedError: this client may not speak for that user, or that user may not connect.
    """
    if not may(speaker.uid, None) and (speaker.uid == NOBODY or speaker.uid != page_uid):
        raise RefusedError(
            f"uid {speaker.uid} may not ask for other users: page_user in agent.toml names the only one who may",
            "PermissionError",
        )
    if may(uid, None) and uid != speaker.uid:
        raise RefusedError(
            f"uid {uid} is root or the agent's own user, for whom no process may ask; give the order by the command failover",
            "PermissionError",
        )
    if not may(uid, None) and not _is_member(uid, group):
        cure = f"add it to the group {group}" if group else 'name a group in agent.toml (group = "failover"), and add it there'
        raise RefusedError(f"uid {uid} may not use the agent's socket, so no process may ask for it; {cure}", "PermissionError")
    return Caller(uid, NOBODY, (), Inheritance(uid, NOBODY))


def uid_named(user: str) -> int:
    """The number of a user's account; `NOBODY` where there is none."""
    try:
        return pwd.getpwnam(user).pw_uid
    except KeyError:
        return NOBODY


def _is_member(uid: int, group: str) -> bool:
    try:
        wanted, account = grp.getgrnam(group).gr_gid, pwd.getpwuid(uid)
    except KeyError:
        return False
    return wanted in os.getgrouplist(account.pw_name, account.pw_gid)


def caller_of(connection: socket.socket) -> Caller:
    """Ask the kernel which user and process connected."""
    pid, uid, gid = _CREDENTIALS.unpack(connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    seen = _seen(pid, uid)
    groups = _groups(connection, uid, gid)
    return Caller(uid, gid, groups, (seen or Inheritance(uid, gid)).as_user(uid, gid, groups))


def inheritance_for(caller: Caller, user: str) -> Inheritance:
    """The rights that a program inherits which this client wants to run.

    Args:
        user: name or number of the user that it is to run as; "" for the client's own.

    Raises:
        RefusedError: there is no such user, or it is not permitted.
    """
    ours = os.geteuid()
    if ours != ROOT and caller.uid not in (ROOT, ours):
        raise RefusedError(f"this agent does not run as root: it runs programs of uid {ours} alone", "PermissionError")
    wanted = _as_user(caller, user) if user else caller.inheritance
    if ours == ROOT:
        return wanted
    if user and wanted.uid != ours:
        raise RefusedError(f"this agent does not run as root: it runs programs of uid {ours} alone", "PermissionError")
    return wanted.as_user(ours, os.getegid(), tuple(os.getgroups()))


def guest_of(pid: int, caller: Caller) -> Guest:
    """A running process that a user wants protected, held by a pidfd: later questions go to the same process.

    A process that the system keeps from its own user (a set-user-id program, one that is not dumpable) is root's.
    Its rights are those that it has now; they bound each capture (`agent.worker.components.restore_limits`), for it may execute
    anything.

    Raises:
        RefusedError: there is no such process, or it is not the caller's: all of its users and groups must be.
    """
    gone = RefusedError(f"cannot protect pid {pid}: No such process", "ProcessGoneError")
    try:
        guest = Guest(pid)
    except (OSError, ValueError, OverflowError):
        raise gone from None
    try:
        owner, status = os.stat(f"/proc/{pid}/fd").st_uid, procfs.status(pid)  # /proc/PID itself is its user's, dumpable or not
        if guest.has_ended:
            raise gone
        if not may(caller.uid, None):
            _check_own(pid, caller, {owner, *status.uids}, {*status.gids, *status.groups})
    except (OSError, CheckpointError):
        guest.close()
        raise gone from None
    except RefusedError:
        guest.close()
        raise
    guest.rights = Inheritance(status.uids[0], status.gids[0], status.groups)
    return guest


def _check_own(pid: int, caller: Caller, uids: set[int], gids: set[int]) -> None:
    """Raises RefusedError: a process has a user or a group that the caller has not."""
    if uids != {caller.uid}:
        sentence = f"pid {pid} is not a process of uid {caller.uid}; its owner and root may protect it"
        raise RefusedError(sentence, "PermissionError")
    if others := sorted(gids - {caller.gid, *caller.groups}):
        told = f"pid {pid} runs with gid {', '.join(map(str, others))}, which uid {caller.uid} has not where it asks"
        raise RefusedError(f"{told}; give the order with that group (newgrp), or as root", "PermissionError")


def _as_user(caller: Caller, name: str) -> Inheritance:
    """The rights that a program inherits which is to run as another user."""
    if caller.uid != ROOT:
        raise RefusedError(f"only root may choose a user; uid {caller.uid} runs programs as itself", "PermissionError")
    from failover.config.accounts import account_of  # here: few orders choose a user

    try:
        found = account_of(name)
    except KeyError:
        raise RefusedError(f"this robot has no user {name!r}; see getent passwd") from None
    return caller.inheritance.as_user(found.pw_uid, found.pw_gid, tuple(os.getgrouplist(found.pw_name, found.pw_gid)))


def _seen(pid: int, uid: int) -> Inheritance | None:
    """The rights that the client's children would inherit; None where they cannot be seen, or it has another user by now."""
    try:
        pidfd = os.pidfd_open(pid)
    except (OSError, ValueError):
        return None
    try:
        found = _inheritance_of(pid)
    except (OSError, CheckpointError):
        return None
    finally:
        watch = select.poll()
        watch.register(pidfd, select.POLLIN)
        over = bool(watch.poll(0))
        os.close(pidfd)
    return found if found.uid == uid and not over else None


def _inheritance_of(pid: int) -> Inheritance:
    status, stat = procfs.status(pid), procfs.stat(pid)
    kept = os.sched_getscheduler(pid)
    reset, policy = bool(kept & os.SCHED_RESET_ON_FORK), kept & ~os.SCHED_RESET_ON_FORK
    realtime = policy in (os.SCHED_FIFO, os.SCHED_RR)
    plain = policy == SCHED_DEADLINE or (reset and realtime)
    return Inheritance(
        uid=status.uids[1],
        gid=status.gids[1],
        groups=status.groups,
        bounding=status.capabilities[3],
        no_new_privs=status.no_new_privs,
        limits=procfs.parse_limits(procfs.read_text(pid, "limits")),
        nice=max(stat.nice, 0) if reset else stat.nice,
        policy=os.SCHED_OTHER if plain else policy,
        priority=os.sched_getparam(pid).sched_priority if realtime and not plain else 0,
        affinity=tuple(sorted(os.sched_getaffinity(pid))),
        io_priority=abi.io_priority(pid),
        oom_score_adj=int(procfs.read_text(pid, "oom_score_adj")),
    )


def _groups(connection: socket.socket, uid: int, gid: int) -> tuple[int, ...]:
    """The supplementary groups of the peer as it connected; where the kernel does not tell them, those of its user."""
    found = array.array("I")
    try:
        found.frombytes(connection.getsockopt(socket.SOL_SOCKET, SO_PEERGROUPS, GROUPS_SIZE_MAX))
    except OSError:
        with contextlib.suppress(KeyError):
            found.extend(os.getgrouplist(pwd.getpwuid(uid).pw_name, gid))
    return tuple(found)
