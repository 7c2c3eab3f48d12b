"""Restore open files of /proc and /sys at their positions. Files of the process itself lead to the restored process.

They are views of the kernel: a read returns the kernel's present state. Files that act on the machine when they are written to
are refused, and so are files of other processes.

Facts: ``descriptors``; ``path``, with ``{pid}`` in place of the process's own number, and numbers of others as the program knows
them; ``flags`` of open(2); ``offset``; for a process that has ended ``ended`` (see
`checkpoint.resources.process.exited_processes`), and ``{ended}`` for its number.

Source: proc(5), sysfs(5).
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Container, Iterator
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of

KIND: Final = "kernel_files"

CAPABILITIES: Final = (
    preserved(
        Area.FILES,
        "files of /proc and /sys that are read",
        "opened again where they stood. A file about the program itself is about the restored program; a file about an "
        "ended process is about no process",
    ),
    refused(
        Area.FILES,
        "the kernel’s log and debugging files",
        "let the program close them",
        "a part of this machine's kernel that cannot be opened again",
    ),
    refused(
        Area.FILES,
        "files of /proc about single threads, or about other programs that live",
        "let the program close them after reading",
        "of one of its threads: let the program close it",
        "a view of another process",
    ),
    refused(
        Area.FILES,
        "files of /proc and /sys that are open for writing",
        "let the program open them only while it writes",
        "by which it acts on this machine",
    ),
    refused(
        Area.THERE,
        "a file of /proc or /sys that the other kernel lacks",
        "boot the same kernel, or attach the device that the file shows",
        "is not offered by this kernel",
    ),
)

PLACES: Final = ("/proc", "/sys")
ON_DISK: Final = "files"
"""The kind of `checkpoint.resources.files.regular`."""
UNREADABLE: Final = ("/proc/kmsg", "/sys/kernel/debug", "/sys/kernel/tracing", "/sys/fs/bpf", "/proc/sys/fs/binfmt_misc")
"""Files that are used up by being read, or are no view at all."""
OWN: Final = "/proc/{pid}"
ENDED: Final = "/proc/{ended}"
O_PATH: Final = 0o10000000

INIT: Final = 1
"""Every machine has one, and every PID namespace."""

_OF_A_PROCESS: Final = re.compile(r"/proc/(\d+)(/.*)?")
_OF_ITS_OWN: Final = re.compile(r"/(fd|fdinfo|map_files|task|ns)/(?!\{)")
"""Files of a process that another one may not have."""
_OF_A_THREAD: Final = re.compile(r"/task/\d+")


def is_kernels(one: Descriptor) -> bool:
    """Whether a descriptor is a file or directory of /proc or /sys."""
    is_file = stat.S_ISREG(one.mode) or stat.S_ISDIR(one.mode)
    return is_file and any(f"{one.target}/".startswith(f"{place}/") for place in PLACES)


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """Where it is and how far it was read."""
    if not is_kernels(held.first):
        return None
    flags, path = held.first.flags & ~os.O_CLOEXEC, _path_of(held)
    facts: dict[str, Fact] = {"descriptors": held.numbers, "path": path, "flags": flags, "offset": held.first.offset}
    if path.startswith(ENDED) and (match := _OF_A_PROCESS.match(held.first.target)):
        facts["ended"] = int(match[1])
    return Resource(KIND, held.name, facts)


def _path_of(held: OpenFile) -> str:
    """Its path, with ``{pid}`` for the program's own number, ``{ended}`` for that of a process that has ended."""
    target = held.first.target
    match = _OF_A_PROCESS.fullmatch(target.removesuffix(procfs.DELETED))
    if match is None:
        return target
    if _has_ended(held, match[1]):
        return ENDED + (match[2] or "").replace(f"/task/{match[1]}", "/task/{ended}")
    if int(match[1]) != procfs.status(held.pid).tgids[-1]:
        return target
    return OWN + target.removeprefix(f"/proc/{match[1]}").replace(f"/task/{match[1]}", "/task/{pid}")


def _has_ended(held: OpenFile, number: str) -> bool:
    """Whether the process that its file tells of has ended: another may have got the number, but the file's name is gone then."""
    place = f"{procfs.outlook(held.pid)}/proc"
    is_named = not held.first.target.endswith(procfs.DELETED) and os.path.exists(f"{place}/{number}")
    return not is_named and os.path.exists(f"{place}/self")


def _known_numbers(held: OpenFile) -> Iterator[int]:
    """The pids of the component's other processes, as it knows them; none for a shared file, which is made before their birth."""
    return (procfs.status(pid).pids[-1] for pid in held.kin.pids if not held.description)


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why it cannot be opened again."""
    if not is_kernels(held.first):
        return None
    path, what = _path_of(held), f"{held.name} is {held.first.target}"
    is_lost = path.endswith(procfs.DELETED) and not path.startswith(ENDED)
    if is_lost or any(f"{path}/".startswith(f"{place}/") for place in UNREADABLE):
        return f"{what}, a part of this machine's kernel that cannot be opened again as it was: let the program close it"
    if path.startswith(ENDED) and not held.description and not _OF_ITS_OWN.search(path) and _is_only_read(held):
        return None
    if path.startswith(OWN):
        return f"{what}, of one of its threads: let the program close it" if _OF_A_THREAD.search(path) else None
    match = _OF_A_PROCESS.fullmatch(path)
    if path.startswith(ENDED) or (match and int(match[1]) not in (INIT, *_known_numbers(held))):
        return f"{what}, a view of another process: let the program close it after reading"
    if not _is_only_read(held):
        return f"{what}, open for writing, by which it acts on this machine's kernel: let the program open it only to write"
    return None


def left_by_ended(directory: str) -> str:
    """A directory in /proc of a process that has ended, with ``{ended}`` for its number; "" if a path is none."""
    match = _OF_A_PROCESS.fullmatch(directory.removesuffix(procfs.DELETED))
    if match is None or not directory.endswith(procfs.DELETED) or _OF_ITS_OWN.search(f"{match[2] or ''}/"):
        return ""
    return ENDED + (match[2] or "")


def of_ended(path: str, pid: int) -> str:
    """The same of a process that lives."""
    return path.replace(ENDED, f"/proc/{pid}").replace("{ended}", str(pid))


def _is_only_read(held: OpenFile) -> bool:
    return _only_reads(held.first.flags)


def _only_reads(flags: int) -> bool:
    return flags & os.O_ACCMODE == os.O_RDONLY or bool(flags & O_PATH)


def mismatches(held: Resource) -> Iterator[str]:
    """Why it is not here."""
    path, flags = str(held.facts["path"]), number_of(held.facts["flags"])
    if not (path.startswith((OWN, ENDED)) or _only_reads(flags)):  # none is captured so: `refuse`
        yield f"{path}, {held.name}, is open for writing, by which it acts on this machine's kernel: open it only to write"
    if not (path.startswith((OWN, ENDED)) or _OF_A_PROCESS.fullmatch(path) or os.path.exists(path)):
        yield f"{path}, open as {held.name}, is not offered by this kernel: boot the same one, or attach what it shows"


def refuse_user(held: Resource, known: Container[int], *, isolated: bool) -> Iterator[str]:
    """Why a program of an ordinary user cannot have it, where we have more rights than that user: they would open it, too.

    Args:
        known: numbers of the processes of its component.
        isolated: number 1 is of its own PIDs.
    """
    path = os.path.normpath(str(held.facts.get("path", "")))
    is_opened = held.kind == ON_DISK and not number_of(held.facts.get("flags", 0)) & O_PATH
    if is_opened and any(f"{path}/".startswith(f"{place}/") for place in PLACES):
        yield f"{path}, open as {held.name}, is a part of this machine's kernel that cannot be opened again as a file on a disk"
    match = _OF_A_PROCESS.fullmatch(path)
    if match and int(match[1]) not in known and not (isolated and int(match[1]) == INIT):
        yield f"{path}, open as {held.name}, is a view of another process: let the program close it after reading"


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open it again."""
    if held.facts.get("ended"):
        return rebuilding.ended(table, held)
    path = str(held.facts["path"]).replace("{pid}", str(rebuilding.inner_pid))
    flags, offset = number_of(held.facts["flags"]), number_of(held.facts["offset"])
    made = table.open(path, flags)
    if offset and not flags & O_PATH:
        table.attempt(f"{held.name} ({path}) is read from its beginning", "lseek", made, offset, os.SEEK_SET)
    return made
