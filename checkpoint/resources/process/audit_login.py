"""The login of a process in the kernel's audit system: the user (loginuid) and the number of the session.

A process may set its login itself, and needs no right while it has none; the kernel then chooses a new session number. Each
thread has its own login, but the snapshot records only the first thread's: the vessel sets it before the other threads are
created.

Facts: ``descriptors`` (none); ``user`` of the login, ``session`` its number, -1 where that is not set. A process without a login
has no such resource.

Source: proc_pid_loginuid(5), pam_loginuid(8); audit_set_loginuid() in kernel/audit.c, proc_loginuid_write() in fs/proc/base.c.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Final

from checkpoint.capability import Area, by_rule
from checkpoint.errors import CheckpointError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.particulars import Afresh, Told
from checkpoint.linux.trace.call_table import AT_FDCWD, CallTable
from checkpoint.model import Resource
from checkpoint.resources.restore_context import number_of

KIND: Final = "logins"
CAPABILITIES: Final = (
    by_rule(
        Area.PROCESS,
        "the login of a program (loginuid, sessionid of the kernel's audit)",
        "the user of its login (all threads get the first thread's), if no login is set at the other robot, or with "
        "CAP_AUDIT_CONTROL; the session number is new",
        "the user of its login (loginuid",
        "the number of its audit session",
    ),
)
NOBODY: Final = -1
"""No user has logged in; also where the kernel has no audit."""
NO_OTHERS: Final = nullcontext()
_UNSET: Final = 0xFFFF_FFFF


def login_of(pid: int) -> tuple[int, int]:
    """The user of its login and the number of its audit session, `NOBODY` for each that is not set."""
    return _login_in(Afresh(pid))


def _login_in(facts: Told) -> tuple[int, int]:
    return _number_in(facts, "loginuid"), _number_in(facts, "sessionid")


def _number_in(facts: Told, name: str) -> int:
    try:
        number = int(facts.read(name))
    except (CheckpointError, ValueError):
        return NOBODY
    return NOBODY if number == _UNSET else number


def describe(facts: Told) -> tuple[Resource, ...]:
    """The login of a process; nothing if it belongs to none."""
    user, session = _login_in(facts)
    if (user, session) == (NOBODY, NOBODY):
        return ()
    return (Resource(KIND, "login", {"descriptors": [], "user": user, "session": session}),)


def rebuild(
    table: CallTable, resources: Iterable[Resource], vessel_pid: int, eyes: AbstractContextManager[None] = NO_OTHERS
) -> list[str]:
    """Add the calls by which a vessel says whose login it is, where that is another one; answers with notes.

    Args:
        vessel_pid: as we see it.
        eyes: for its body, the vessel may open its own files of /proc.
    """
    told = [held.facts for held in resources if held.kind == KIND]
    user, session = (number_of(told[0]["user"]), number_of(told[0]["session"])) if told else (NOBODY, NOBODY)
    vessel_user, vessel_session = login_of(vessel_pid)
    notes = []
    if user != vessel_user:
        notes = _say(table, user, vessel_pid, eyes)
    elif session == vessel_session:
        return []
    return notes if session == NOBODY else [*notes, f"the number of its audit session is not kept: it was {session}"]


def _say(table: CallTable, user: int, vessel_pid: int, eyes: AbstractContextManager[None]) -> list[str]:
    wanted = "unset" if user == NOBODY else str(user)
    reason = f"the user of its login (loginuid {wanted}) is not kept: that takes CAP_AUDIT_CONTROL here"
    if not _has_file(vessel_pid):
        return [reason]
    number, word = table.lowest_descriptor(), str(user & _UNSET).encode()
    with eyes:
        table.attempt("", "openat", AT_FDCWD, table.place_path("/proc/self/loginuid"), os.O_WRONLY | os.O_CLOEXEC, 0)
    table.attempt(reason, "write", number, table.place(word), len(word))
    table.attempt("", "close", number)
    return []


def _has_file(pid: int) -> bool:
    """Whether it finds its own; it may have no /proc."""
    try:
        inner = procfs.status(pid).pids[-1]
        return Path(f"{procfs.outlook(pid)}/proc/{inner}/loginuid").exists()
    except (CheckpointError, OSError):
        return False
