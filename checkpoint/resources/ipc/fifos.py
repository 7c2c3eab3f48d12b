"""Restore named pipes that no other program has open: opened by name, with their content; made where they are missing.

Facts: ``descriptors``; ``path``; ``flags`` of open(2); ``mode``; ``device`` and ``inode`` at the capture; ``capacity`` in bytes;
``content``: the bytes in it, with one descriptor of each named pipe, b"" with the others. If its name was deleted, ``deleted``
true, and ``uid`` and ``gid``. If a mount hides its path, ``mounted`` and ``handle`` (`checkpoint.resources.files.overmounted`).

Source: fifo(7), tee(2).
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import stat
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import CaptureError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptors import copy_of
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.files import overmounted, unlinked
from checkpoint.resources.ipc import pipes
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of

KIND: Final = "fifos"

CAPABILITIES: Final = (
    preserved(
        Area.PIPES,
        "named pipes (fifo) that no other process has open",
        "opened again with the data in them: by name, or without one if the name was deleted, or by handle if a mount "
        "covers it. Made where they are missing",
    ),
    refused(
        Area.PIPES,
        "a named pipe that another process has open, or whose name is gone",
        "protect the program after the other process has closed it; let it open a name that stays",
        "whose name is gone",
        "has open too",
    ),
    refused(
        Area.THERE,
        "a missing directory of a named pipe; another file under its name; a named pipe that a mount covers, on another machine",
        "make the directory; remove the other file",
        "is no named pipe here",
        "the directory of the named pipe",
        "is not on this machine: restore it where it was captured",
    ),
)

O_PATH: Final = 0o10000000
_AT_FDCWD: Final = -100
AT_EMPTY_PATH: Final = 0x1000


def is_fifo(one: Descriptor) -> bool:
    """Whether a descriptor is an open named pipe."""
    return stat.S_ISFIFO(one.mode) and one.target.startswith("/") and not one.flags & O_PATH


def observe(held: OpenFile, opened: Sequence[OpenFile]) -> Mapping[str, Fact]:
    """Its capacity, and its content if this is the one that tells; the content stays there.

    Raises:
        CaptureError: it cannot be looked into.
    """
    try:
        with copy_of(held.pid, held.first.number) as descriptor:
            capacity = fcntl.fcntl(descriptor, pipes.F_GETPIPE_SZ)
            content = _content(held, descriptor, capacity) if _tells(held, opened) else b""
    except OSError as error:
        raise CaptureError(f"cannot look into the named pipe {held.first.target}: {error.strerror}; try again") from error
    return {"capacity": capacity, "content": content}


def _tells(held: OpenFile, opened: Sequence[OpenFile]) -> bool:
    """Whether this open file is the first of its named pipe that can be read, or the first of all if none can."""
    same = [one for one in opened if (one.first.device, one.first.inode) == (held.first.device, held.first.inode)]
    return held is next((one for one in same if _reads(one.first)), same[0])


def _reads(one: Descriptor) -> bool:
    return one.flags & os.O_ACCMODE != os.O_WRONLY


def _content(held: OpenFile, descriptor: int, capacity: int) -> bytes:
    if _reads(held.first):
        return pipes.copy_of_content(descriptor, capacity)
    reader = os.open(f"/proc/{held.pid}/fd/{held.first.number}", os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        return pipes.copy_of_content(reader, capacity)
    finally:
        os.close(reader)


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """One open named pipe."""
    first = held.first
    if not is_fifo(first):
        return None
    facts: dict[str, Fact] = {
        "descriptors": held.numbers,
        "path": first.target,
        "flags": first.flags & ~os.O_CLOEXEC,
        "mode": first.mode,
        "device": first.device,
        "inode": first.inode,
        **held.observed,
    }
    if _is_nameless(held):
        facts |= {"deleted": True, "path": first.target.removesuffix(procfs.DELETED), "uid": first.uid, "gid": first.gid}
    elif place := _covered(held):
        facts |= {"mounted": place[0], "handle": place[1]}
    return Resource(KIND, held.name, facts)


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a named pipe cannot be kept."""
    first = held.first
    if not is_fifo(first):
        return None
    what = f"{held.name} is the named pipe {first.target}"
    if not (_is_nameless(held) or _leads_there(held) or _covered(held)):
        return f"{what}, whose name is gone: let the program open it by a name that stays"
    if other := other_holders.opener_of(held):
        return f"{what}, which pid {other} has open too: protect the program when that has closed it"
    return None


def _is_nameless(held: OpenFile) -> bool:
    return not held.first.links and held.first.target.endswith(procfs.DELETED)


def _covered(held: OpenFile) -> tuple[str, bytes] | None:
    """Where it is found nevertheless, if a mount covers its path."""
    if _leads_there(held):
        return None
    with contextlib.suppress(OSError):  # it has ended since
        return overmounted.place_of(held)
    return None


def _leads_there(held: OpenFile) -> bool:
    try:
        about = os.stat(f"{procfs.outlook(held.pid)}{held.first.target}")
    except OSError:
        return False
    return (about.st_dev, about.st_ino) == (held.first.device, held.first.inode)


def mismatches(held: Resource) -> Iterator[str]:
    """Why it could not be opened here: something else has its name, or there is no place for it."""
    path = str(held.facts["path"])
    if held.facts.get("deleted"):
        return
    if handle := held.facts.get("handle"):
        assert isinstance(handle, bytes)
        with overmounted.opened(str(held.facts["mounted"]), handle) as place:
            if not (place and stat.S_ISFIFO(os.stat(place).st_mode)):
                what = f"the named pipe {path}, open as {held.name}, which a mount covers,"
                yield f"{what} is not on this machine: restore it where it was captured"
        return
    if os.path.lexists(path):
        if not stat.S_ISFIFO(os.stat(path).st_mode):
            yield f"{path}, open as {held.name}, is no named pipe here: remove it"
    elif not os.path.isdir(os.path.dirname(path)):
        yield f"the directory of the named pipe {path}, open as {held.name}, is missing here: make it"


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open it as it was, without waiting for a process at its other end, and fill it."""
    path, content, hidden = str(held.facts["path"]), held.facts["content"], -1
    flags = number_of(held.facts["flags"]) & ~os.O_ASYNC  # open(2) with it sends no signals: `fd_signals` sets it
    if held.facts.get("deleted"):
        path = f"/proc/self/fd/{_nameless(table, held, rebuilding)}"
    elif held.facts.get("handle"):
        hidden = overmounted.open_again(table, held, O_PATH)
        path = f"/proc/self/fd/{hidden}"
    elif not os.path.lexists(path):
        _make(table, path, number_of(held.facts["mode"]))
    made = _open(table, held, path, flags, content)
    if hidden >= 0:
        table.close(hidden)
    return made


def _open(table: CallTable, held: Resource, path: str, flags: int, content: Fact) -> int:
    """Open it by a path that leads there, and fill it."""
    assert isinstance(content, bytes)
    if not content and flags & os.O_ACCMODE == os.O_RDONLY:
        # A reader that has never seen a writer waits; opened beside a writer of ours it would be told that this one hung up.
        made = table.open(path, flags | os.O_NONBLOCK)
        if not flags & os.O_NONBLOCK:
            table.call(f"set the flags of {held.name}", "fcntl", made, fcntl.F_SETFL, 0)
        return made
    both = table.open(path, os.O_RDWR)
    made = table.open(path, flags)
    capacity = number_of(held.facts["capacity"])
    if capacity != pipes.DEFAULT_CAPACITY:
        table.call(f"size the named pipe {path}", "fcntl", made, pipes.F_SETPIPE_SZ, capacity, least=capacity)
    if content:
        size = len(content)
        table.call(f"fill the named pipe {path}", "write", both, table.place(content), size, least=size, most=size)
    table.close(both)
    return made


def _nameless(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """A descriptor that leads to a named pipe without a name, made if this is its first open file."""
    key = key_of(held)
    if key not in rebuilding.objects:
        rebuilding.keep(table, key, make_nameless(table, held))
    return rebuilding.objects[key]


def make_nameless(table: CallTable, held: Resource) -> int:
    """Make a named pipe without a name, empty, to be opened through the number that this gives."""
    made = unlinked.make_node(table, str(held.facts["path"]), number_of(held.facts["mode"]))
    owner = number_of(held.facts["uid"]), number_of(held.facts["gid"])
    lost = f"the named pipe of {held.name} belongs to the user that the program runs as"
    table.attempt(lost, "fchownat", made, table.place_path(""), *owner, AT_EMPTY_PATH)
    return made


def key_of(held: Resource) -> tuple[int, int]:
    """Which named pipe it is: device and inode number where it was captured."""
    return number_of(held.facts["device"]), number_of(held.facts["inode"])


def _make(table: CallTable, path: str, mode: int) -> None:
    place = table.place_path(path)
    table.attempt("", "mknodat", _AT_FDCWD, place, stat.S_IFIFO | mode & 0o7777, 0)  # two descriptors of it make it once
    made = table.open(path, unlinked.O_PATH | os.O_NOFOLLOW)
    itself = table.place_path(f"/proc/self/fd/{made}")  # its name may be another's by now
    table.attempt("", "fchmodat", _AT_FDCWD, itself, mode & 0o7777)
    table.close(made)
