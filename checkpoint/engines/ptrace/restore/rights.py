"""Become the user that the program ran as, with its groups, capabilities and securebits; and whose rights open files until then.

Sources: credentials(7), capabilities(7), ptrace(2).
"""

from __future__ import annotations

import signal
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from msgspec.structs import replace

from checkpoint.engine import RestoreOptions
from checkpoint.engines.ptrace.restore.vessel import (
    CAP_BPF,
    CAP_PERFMON,
    CAP_SETGID,
    CAP_SETPCAP,
    CAP_SETUID,
    CAP_SYS_PTRACE,
    CAP_SYS_RAWIO,
    CAP_SYSLOG,
    Vessel,
)
from checkpoint.linux import abi
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Credentials, ProcessState

OPENING: Final = sum(1 << one for one in (CAP_SYS_RAWIO, CAP_SYS_PTRACE, CAP_SYSLOG, CAP_PERFMON, CAP_BPF))
"""Capabilities that open what a file system uid alone would not."""

PR_CAPBSET_DROP: Final = 24
PR_CAP_AMBIENT: Final = 47
PR_CAP_AMBIENT_RAISE: Final = 2
PR_CAP_AMBIENT_CLEAR_ALL: Final = 4
SECBIT_KEEP_CAPS: Final = 1 << 4
NO_ID: Final = 0xFFFFFFFF
_CAPABILITY_VERSION_3: Final = 0x20080522


def own_eyes(table: CallTable, process: ProcessState, vessel: Vessel) -> None:
    """From here on open files as the program's user, since he may have put other files in their place: see `RestoreOptions`.

    Other rights by which views of the kernel and of other processes open are laid down until `adopt`, too.

    Sources: capabilities(7), "Effect of user ID changes on capabilities": those for files go with a file system uid other than 0;
    ptrace(2), "Ptrace access mode checking".
    """
    if not (vessel.may(CAP_SETUID) and vessel.may(CAP_SETGID)):
        return
    theirs, (inheritable, permitted, effective, _, _) = process.credentials, vessel.credentials.capabilities
    _set_capabilities(table, effective & ~OPENING, permitted, inheritable)
    groups = table.place(struct.pack(f"<{len(theirs.groups)}I", *theirs.groups))
    table.call("set the groups", "setgroups", len(theirs.groups), groups)
    table.call("set the filesystem's gid", "setfsgid", theirs.gids[3])
    _see_as(table, process)


def _see_as(table: CallTable, process: ProcessState) -> None:
    table.call("set the filesystem's uid", "setfsuid", process.credentials.uids[3])
    table.call("end with the parent, still", "prctl", abi.PR_SET_PDEATHSIG, signal.SIGKILL)  # a change of user takes it back


@contextmanager
def our_eyes(table: CallTable, process: ProcessState, vessel: Vessel, options: RestoreOptions) -> Iterator[None]:
    """After `own_eyes`, have the calls that the body adds open files as the vessel again: files that no user can replace."""
    is_switched = options.own_eyes and vessel.may(CAP_SETUID) and vessel.may(CAP_SETGID)
    if is_switched:
        table.call("set the filesystem's uid to ours", "setfsuid", vessel.credentials.uids[3])
    yield
    if is_switched:
        _see_as(table, process)


def adopt(table: CallTable, process: ProcessState, vessel: Vessel, *, ordinary: bool = False) -> tuple[str, ...]:
    """Become the user that the program ran as, with its capabilities: notes for what the vessel has no right to become.

    Everything that needs rights must stand before this in the table.

    Args:
        ordinary: it is not root's, and gets no inheritable capability: files may turn one into a right (capabilities(7)).
    """
    theirs, ours = process.credentials, vessel.credentials
    notes: list[str] = []
    if ordinary and (inheritable := theirs.capabilities[0]):
        theirs = replace(theirs, capabilities=(0, *theirs.capabilities[1:]))
        notes.append(f"inheritable capabilities {inheritable:#x} are not kept: only a program of root gets them")
    same_user = (theirs.uids, theirs.gids, set(theirs.groups)) == (ours.uids, ours.gids, set(ours.groups))
    if not same_user and vessel.may(CAP_SETUID) and vessel.may(CAP_SETGID):
        _bounding_set(table, theirs, vessel)
        _become_user(table, theirs, ours)
    elif not same_user:
        notes.append(f"runs as uid {ours.uids[1]} gid {ours.gids[1]}; it was uid {theirs.uids[1]} gid {theirs.gids[1]}")
    else:
        _bounding_set(table, theirs, vessel)
    notes += _capabilities(table, theirs, ours)
    if theirs.no_new_privs:
        table.call("forbid new privileges", "prctl", abi.PR_SET_NO_NEW_PRIVS, 1)
    if not theirs.securebits & ~SECBIT_KEEP_CAPS:
        table.attempt("", "prctl", abi.PR_SET_KEEPCAPS, int(process.keep_caps))
    return tuple(notes)


def _bounding_set(table: CallTable, theirs: Credentials, vessel: Vessel) -> None:
    lacking = vessel.credentials.capabilities[3] & ~theirs.capabilities[3]
    if not vessel.may(CAP_SETPCAP):
        return
    for capability in range(64):
        if lacking >> capability & 1:
            table.attempt("", "prctl", PR_CAPBSET_DROP, capability)


def _become_user(table: CallTable, theirs: Credentials, ours: Credentials) -> None:
    table.call("keep capabilities over the change of user", "prctl", abi.PR_SET_KEEPCAPS, 1)
    groups = table.place(struct.pack(f"<{len(theirs.groups)}I", *theirs.groups))
    table.call("set the groups", "setgroups", len(theirs.groups), groups)
    table.call(f"become gid {theirs.gids[1]}", "setresgid", *theirs.gids[:3])
    _set_file_id(table, "setfsgid", theirs.gids)  # before the user, whose change takes the right to
    table.call(f"become uid {theirs.uids[1]}", "setresuid", *theirs.uids[:3])
    if theirs.uids[3] not in theirs.uids[:3]:
        _set_capabilities(table, ours.capabilities[1], ours.capabilities[1], ours.capabilities[0])  # the change took them
    _set_file_id(table, "setfsuid", theirs.uids)


def _set_file_id(table: CallTable, name: str, ids: tuple[int, int, int, int]) -> None:
    """Set the id by which files are opened, where it is not the effective one: the call does not tell whether it did.

    Source: setfsuid(2), "Bugs": asked for what cannot be, it answers with the id in force.
    """
    if ids[3] != ids[1]:
        table.call("", name, ids[3])
        table.call(f"have files opened by id {ids[3]} ({name})", name, NO_ID, least=ids[3], most=ids[3])


def _set_capabilities(table: CallTable, effective: int, permitted: int, inheritable: int) -> None:
    sets = (effective, permitted, inheritable)
    low, high = [word & 0xFFFFFFFF for word in sets], [word >> 32 for word in sets]
    header = table.place(struct.pack("<Ii", _CAPABILITY_VERSION_3, 0))
    table.call("set the capabilities", "capset", header, table.place(struct.pack("<6I", *low, *high)))


def _capabilities(table: CallTable, theirs: Credentials, ours: Credentials) -> list[str]:
    """Capabilities, and what securebits forbid afterwards; raised to all that there are in between, where something needs it."""
    inheritable, permitted, effective, _, ambient = theirs.capabilities
    have = ours.capabilities[1]
    is_same = theirs.capabilities == ours.capabilities and theirs.uids == ours.uids
    if not is_same:
        table.attempt("", "prctl", PR_CAP_AMBIENT, PR_CAP_AMBIENT_CLEAR_ALL)
        kept = inheritable & (have | ours.capabilities[0])
        _set_capabilities(table, have, have, kept)
        for capability in range(64):
            if ambient >> capability & 1:
                table.attempt("an ambient capability is not kept", "prctl", PR_CAP_AMBIENT, PR_CAP_AMBIENT_RAISE, capability)
    if theirs.securebits & ~SECBIT_KEEP_CAPS:
        table.attempt("securebits are not kept", "prctl", abi.PR_SET_SECUREBITS, theirs.securebits)
    if not is_same:
        _set_capabilities(table, effective & have, permitted & have, kept)
    if permitted & ~have:
        return [f"capabilities {permitted & ~have:#x} of the program are not kept: failover does not have them"]
    return []
