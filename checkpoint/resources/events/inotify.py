"""Restore the watches of inotify(7) under the numbers that they had, each on the same path.

Events that the program has not read yet are not kept. While there are any, nothing is captured; the next capture waits until the
program has read them. Another process can see them only by taking them (read(2) is the only way in, and the kernel reports only
how many bytes there are). A restore could put them back only by making them happen. That would touch the program's files, and
other watchers would hear it. A watch of another file under the same number would have to end, which is an event, too
(IN_IGNORED). The program does not hear of events on the files between the capture and the restore.

Facts: ``descriptors``; ``flags`` of fcntl(2); ``watches``: a list of [number, path, mask]; the path of a file without a name that
the program has open is /proc/self/fd/N.

Source: inotify_fdinfo() in fs/notify/fdinfo.c; open_by_handle_at(2).
"""

from __future__ import annotations

import array
import ctypes
import fcntl
import os
import re
import termios
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import CaptureError
from checkpoint.linux.procfs import mounts, procfs
from checkpoint.linux.procfs.descriptors import copy_of
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of
from checkpoint.sentences import AS_SOON_AS

KIND: Final = "watches"

CAPABILITIES: Final = (
    preserved(
        Area.PIPES,
        "watches of files (inotify)",
        "each on the same path under its number; events between the checkpoint and the restore are lost",
    ),
    refused(
        Area.PIPES,
        "an inotify instance with unread events",
        f"wait: {AS_SOON_AS} the program has read them",
        "with events that the program has not read yet",
    ),
    refused(
        Area.PIPES,
        "an inotify watch of a nameless file that is not open, of a file outside the program's root directory, or with a "
        "number above 10,000",
        "remove the watch, or open another instance",
        "is of a file that no path leads to",
        "outside its root directory",
        "whose watch has number",
    ),
    refused(Area.THERE, "a missing file that the program watches (inotify)", "make the file", "which the program watches by"),
)

TARGET: Final = "anon_inode:inotify"

IN_DELETE_SELF: Final = 0x400
IN_DONT_FOLLOW: Final = 0x02000000
KEPT_MASK: Final = 0x00000FFF | 0x04000000 | 0x80000000
"""IN_ALL_EVENTS, IN_EXCL_UNLINK and IN_ONESHOT."""
OPENED: Final = "/proc/self/fd/"
NUMBER_MAX: Final = 10_000
"""Greatest number of a watch: the kernel counts up, so the ones before are made and removed."""
EVENT_SIZE: Final = 16
"""Bytes of an event without a name."""
EVENTS_AT_ONCE: Final = 1024
"""Removed watches after which the queue is emptied: it holds 16,384 (fs.inotify.max_queued_events) unless made smaller."""
PATHS_KNOWN: Final = 4096

_WATCH: Final = re.compile(
    r"inotify wd:([0-9a-f]+) ino:([0-9a-f]+) sdev:([0-9a-f]+) mask:([0-9a-f]+) .*fhandle-type:([0-9a-f]+) f_handle:([0-9a-f]+)"
)
_libc = ctypes.CDLL(None, use_errno=True)


def observe(held: OpenFile, opened: Sequence[OpenFile]) -> Mapping[str, Fact]:
    """How many bytes of events were not read, and which watches are of files that the program has open."""
    waiting = array.array("i", [0])
    try:
        with copy_of(held.pid, held.first.number) as descriptor:
            fcntl.ioctl(descriptor, termios.FIONREAD, waiting)
    except OSError as error:
        raise CaptureError(f"cannot look into the inotify instance {held.name}: {error.strerror}; try again") from error
    numbers: dict[tuple[int, str], int] = {}
    for one in opened:
        numbers.setdefault((one.first.inode, _major_minor(one.first.device)), one.first.number)
    watched = (
        (int(match[1], 16), (int(match[2], 16), _kernels(int(match[3], 16)))) for match in _WATCH.finditer(held.first.text)
    )
    return {"unread": waiting[0], "opened": [[number, numbers[place]] for number, place in watched if place in numbers]}


def _major_minor(device: int) -> str:
    return f"{os.major(device)}:{os.minor(device)}"


def _kernels(device: int) -> str:
    """The number of a device as the kernel packs it, 12 bits and 20."""
    return f"{device >> 20}:{device & 0xFFFFF}"


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """Its watches."""
    if held.first.target != TARGET:
        return None
    watches: list[Fact] = [[number, path, mask] for number, path, mask in _watches(held)]
    flags = held.first.flags & ~os.O_CLOEXEC
    return Resource(KIND, held.name, {"descriptors": held.numbers, "flags": flags, "watches": watches})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why an inotify instance cannot be kept."""
    if held.first.target != TARGET:
        return None
    what = f"{held.name} is an inotify instance"
    if held.observed.get("unread"):
        return f"{what} with events that the program has not read yet: {AS_SOON_AS} the program has read them"
    for number, path, _ in _watches(held):
        if not path:
            return f"{what} whose watch {number} is of a file that no path leads to: let the program remove that watch"
        if number > NUMBER_MAX:
            return f"{what} whose watch has number {number}; the limit is {NUMBER_MAX}: let the program open another instance"
        if not _is_below(procfs.read_link(held.pid, "root"), path):
            return f"{what} whose watch {number} is of {path}, outside its root directory: let the program remove that watch"
    return other_holders.refuse(held, "an inotify instance")


def _is_below(root: str, path: str) -> bool:
    """Whether a program with this root directory has a name for a path of ours."""
    return root == "/" or path == root or path.startswith(root + "/")


def _watches(held: OpenFile) -> Iterator[tuple[int, str, int]]:
    """(number, path, mask), numbers ascending; the path "" where it is not known."""
    found = sorted((int(match[1], 16), match) for match in _WATCH.finditer(held.first.text))
    opened = dict(_pairs(held.observed.get("opened", [])))
    for number, match in found:
        device, inode, kind = (int(match[index], 16) for index in (3, 2, 5))
        path = _path_of(held.pid, device, inode, kind, match[6])
        if not path and number in opened:
            path = f"{OPENED}{opened[number]}"
        yield number, path, int(match[4], 16) & KEPT_MASK


def _pairs(fact: Fact) -> Iterator[tuple[int, int]]:
    for pair in fact if isinstance(fact, list) else ():
        assert isinstance(pair, list)
        yield number_of(pair[0]), number_of(pair[1])


def _path_of(pid: int, device: int, inode: int, kind: int, handle: str) -> str:
    try:
        return _known_path(pid, device, inode, kind, handle)
    except LookupError:
        return ""


@lru_cache(maxsize=PATHS_KNOWN)
def _known_path(pid: int, device: int, inode: int, kind: int, handle: str) -> str:
    """A path, as the process sees it, that leads to a file.

    Args:
        device: as the kernel packs it, 12 bits and 20.

    Raises:
        LookupError: none was found.
    """
    major_minor = _kernels(device)
    for path in (*_by_handle(pid, major_minor, kind, bytes.fromhex(handle)), *_near(pid)):
        try:
            about = os.lstat(f"{procfs.outlook(pid)}{path}")
        except OSError:
            continue
        if about.st_ino == inode and _major_minor(about.st_dev) == major_minor:
            return path
    raise LookupError(inode)


def _near(pid: int) -> Iterator[str]:
    """Where a watched directory often is: where the process works and above."""
    directory = procfs.read_link(pid, "cwd")
    while True:
        yield directory
        if directory == "/":
            return
        directory = os.path.dirname(directory)


def _by_handle(pid: int, device: str, kind: int, handle: bytes) -> Iterator[str]:
    """Paths that a file handle leads to; nothing where the file system has none, or we lack CAP_DAC_READ_SEARCH."""
    packed = len(handle).to_bytes(4, "little") + kind.to_bytes(4, "little") + handle
    for place in (one.point for one in mounts.mounts_of(pid) if one.device == device):
        try:
            mount = os.open(f"{procfs.outlook(pid)}{place}", os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            continue
        try:
            found = _libc.open_by_handle_at(mount, packed, os.O_PATH | os.O_CLOEXEC)
            if found >= 0:
                yield os.readlink(f"/proc/self/fd/{found}")
                os.close(found)
        finally:
            os.close(mount)


def mismatches(held: Resource) -> Iterator[str]:
    """Paths that are not there."""
    for _, path, _ in _listed(held):
        if not (path.startswith(OPENED) or os.path.lexists(path)):
            yield f"{path}, which the program watches by {held.name} (inotify), is missing here: make it"


def _listed(held: Resource) -> Iterator[tuple[int, str, int]]:
    watches = held.facts["watches"]
    assert isinstance(watches, list)
    for one in watches:
        assert isinstance(one, list)
        yield number_of(one[0]), str(one[1]), number_of(one[2])


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Make it again; `settle` adds its watches last of all, so that it hears nothing of the restore itself."""
    return table.obtain(
        f"make the inotify instance of {held.name}", "inotify_init1", number_of(held.facts["flags"]) & os.O_NONBLOCK
    )


def settle(table: CallTable, held: Resource, descriptor: int, root: str) -> None:
    """Add its watches under their numbers; those in between are added and removed, and the word about that is read away.

    Args:
        root: the program's root directory, which it has by now.
    """
    last, unread, buffer = 0, 0, 0
    for number, path, mask in _listed(held):
        inside = path if root == "/" else path.removeprefix(root) or "/"
        place, what = table.place_path(inside), f"watch {path} by {held.name}"
        for between in range(last + 1, number):
            buffer = buffer or table.place(bytes(EVENT_SIZE * EVENTS_AT_ONCE))
            table.call(what, "inotify_add_watch", descriptor, place, IN_DELETE_SELF, least=between, most=between)
            table.call(what, "inotify_rm_watch", descriptor, between)
            unread += 1
            if unread == EVENTS_AT_ONCE:
                _read_away(table, descriptor, buffer, unread)
                unread = 0
        whole_mask = mask if path.startswith(OPENED) else mask | IN_DONT_FOLLOW
        table.call(what, "inotify_add_watch", descriptor, place, whole_mask, least=number, most=number)
        last = number
    if unread:
        _read_away(table, descriptor, buffer, unread)


def _read_away(table: CallTable, descriptor: int, buffer: int, count: int) -> None:
    table.call("read what a watch says of its end", "read", descriptor, buffer, count * EVENT_SIZE, least=EVENT_SIZE)
