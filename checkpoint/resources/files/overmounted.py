"""Restore files and directories whose path is hidden by a mount: opened again by their handle.

The handle leads to the same file of the same file system, so such a program stays on its machine.

Facts: ``descriptors``; ``path``, by which it was opened; ``mounted``: where its file system is mounted; ``handle``: struct
file_handle; ``flags`` of open(2); ``offset`` and ``size`` in bytes, ``mode``, ``inode`` and ``mtime_ns`` at the capture.

Source: name_to_handle_at(2), open_by_handle_at(2), which takes CAP_DAC_READ_SEARCH; proc_pid_mountinfo(5).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import stat
from collections.abc import Iterable, Iterator
from typing import Final

from checkpoint.capability import Area, by_rule, refused
from checkpoint.errors import ProcessGoneError
from checkpoint.linux.procfs import mounts, procfs
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Resource
from checkpoint.resources.files import other_writers, regular
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of

KIND: Final = "covered_files"

CAPABILITIES: Final = (
    by_rule(
        Area.FILES,
        "files over whose path something was mounted",
        "like other files, on the same machine, for root, and where their file system has handles",
    ),
    refused(
        Area.THERE,
        "a file that a mount covers, on another machine or after a change",
        "run the program where it was captured",
        "{} is not on this machine: restore it where it was captured",
        "{} has another content by now",
        "{} is opened again for root alone",
        "{} is held open for writing by pid {}: end that first",
    ),
)

AT_FDCWD: Final = -100
AT_SYMLINK_FOLLOW: Final = 0x400
HANDLE_SIZE: Final = 128
"""MAX_HANDLE_SZ of linux/fcntl.h."""
O_PATH: Final = 0o10000000
REOPENED: Final = (
    os.O_ACCMODE | os.O_APPEND | os.O_NONBLOCK | os.O_DSYNC | os.O_SYNC | os.O_DIRECT | os.O_NOATIME | os.O_DIRECTORY
)

_libc = ctypes.CDLL(None, use_errno=True)


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The facts to open it again."""
    first, found = held.first, None
    with contextlib.suppress(ProcessGoneError, OSError):  # it has ended since it was stopped, or in a look at a running one
        found = place_of(held) if _may_be(held) else None
    if found is None:
        return None
    return Resource(
        KIND,
        held.name,
        {
            "descriptors": held.numbers,
            "path": first.target,
            "mounted": found[0],
            "handle": found[1],
            "flags": first.flags & ~os.O_CLOEXEC,
            "offset": first.offset,
            "size": first.size,
            "mode": first.mode,
            "inode": first.inode,
            "mtime_ns": first.mtime_ns,
        },
    )


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Refuse nothing here: a file without a handle counts as any other file to which no path leads."""
    return None


def _may_be(held: OpenFile) -> bool:
    first = held.first
    is_kind = stat.S_ISREG(first.mode) or stat.S_ISDIR(first.mode)
    if not is_kind or first.flags & O_PATH or not first.links or not first.target.startswith("/"):
        return False
    return not regular.is_deleted(first) and not regular.is_found(held)


def place_of(held: OpenFile) -> tuple[str, bytes] | None:
    """Where the file system of what a mount covers is mounted, and its handle, by which it is really found.

    None where it has none, and where no mount covers its path: one that is not found there has just been deleted or replaced.
    """
    number, of_process = held.first.text.partition("mnt_id:")[2].split("\n")[0].strip(), mounts.mounts_of(held.pid)
    mounted = _mount_point(of_process, number)
    if not mounted or mounts.innermost(of_process, held.first.target) == number:
        return None
    handle = (ctypes.c_char * (8 + HANDLE_SIZE)).from_buffer_copy(HANDLE_SIZE.to_bytes(4, "little") + bytes(4 + HANDLE_SIZE))
    path, mount = f"/proc/{held.pid}/fd/{held.first.number}".encode(), ctypes.c_int()
    if _libc.name_to_handle_at(AT_FDCWD, path, handle, ctypes.byref(mount), AT_SYMLINK_FOLLOW):
        return None
    size = int.from_bytes(handle.raw[:4], "little")
    told = handle.raw[: 8 + size]
    with opened(f"{procfs.outlook(held.pid)}{mounted}", told) as place:
        if place and os.stat(place).st_ino == held.first.inode and os.readlink(place) == held.first.target:
            return mounted, told
    return None


def _mount_point(of_process: Iterable[mounts.Mount], number: str) -> str:
    """Where the mount with a number of mountinfo lies; "" where the process has none such."""
    return next((one.point for one in of_process if one.number == number), "")


@contextlib.contextmanager
def opened(mounted: str, handle: bytes) -> Iterator[str]:
    """A path of ours that leads to what a handle stands for, for the body; "" where it does not stand for anything."""
    found = -1
    try:
        mount = os.open(mounted, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            found = _libc.open_by_handle_at(mount, handle, O_PATH | os.O_CLOEXEC)
        finally:
            os.close(mount)
    except OSError:  # it is not mounted here
        found = -1
    try:
        yield f"/proc/self/fd/{found}" if found >= 0 else ""
    finally:
        if found >= 0:
            os.close(found)


def refuse_user(held: Resource) -> str:
    """Why it is not for a program that opens its files with the rights of an ordinary user."""
    what = f"{held.facts['path']!s}, open as {held.name}, which a mount covers,"
    return f"{what} is opened again for root alone: let the program open it by a path that leads there"


def mismatches(held: Resource) -> Iterator[str]:
    """Why it is not here as it was; one that was written at its end may have grown, and is cut back."""
    facts, handle = held.facts, held.facts["handle"]
    assert isinstance(handle, bytes)
    what = f"{facts['path']!s}, open as {held.name}, which a mount covers,"
    with opened(str(facts["mounted"]), handle) as place:
        about = os.stat(place) if place else None
        if about is None or about.st_ino != facts["inode"] or stat.S_IFMT(about.st_mode) != stat.S_IFMT(number_of(facts["mode"])):
            yield f"{what} is not on this machine: restore it where it was captured"
        elif stat.S_ISREG(about.st_mode) and _differs(held, about):
            yield f"{what} has another content by now: end the program with the capture"
        elif (
            stat.S_ISREG(about.st_mode)
            and _is_written(held)
            and (pid := other_writers.writer_of(place, other_writers.family(os.getpid())))
        ):
            yield f"{what} is held open for writing by pid {pid}: end that first"


def _is_written(held: Resource) -> bool:
    return number_of(held.facts["flags"]) & os.O_ACCMODE != os.O_RDONLY


def _grows(held: Resource) -> bool:
    is_at_its_end = held.facts["offset"] == held.facts["size"] or bool(number_of(held.facts["flags"]) & os.O_APPEND)
    return _is_written(held) and is_at_its_end


def _differs(held: Resource, about: os.stat_result) -> bool:
    if _grows(held):
        return about.st_size < number_of(held.facts["size"])
    return (about.st_size, about.st_mtime_ns) != (held.facts["size"], held.facts["mtime_ns"])


def open_again(table: CallTable, held: Resource, flags: int) -> int:
    """Add the calls that open by its handle what has one."""
    facts, handle = held.facts, held.facts["handle"]
    assert isinstance(handle, bytes)
    mount = table.open(str(facts["mounted"]), os.O_RDONLY | os.O_DIRECTORY)
    made = table.obtain(f"open {facts['path']!s} by its handle", "open_by_handle_at", mount, table.place(handle), flags)
    table.close(mount)
    return made


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open it by its handle."""
    facts = held.facts
    made = open_again(table, held, number_of(facts["flags"]) & REOPENED)
    if _grows(held):
        size = number_of(facts["size"])
        table.call(f"cut {facts['path']!s} back to {size} bytes", "ftruncate", made, size)
    if offset := number_of(facts["offset"]):
        table.call(f"set the offset of {held.name}", "lseek", made, offset, os.SEEK_SET, least=offset, most=offset)
    return made
