"""Restore names of unix sockets that are files: where they lie, and how a socket gets such a name again.

A name is the one that bind(2) was given, and stays so when the directory has changed or the file has another name or none. The
restore replaces the file that the socket's predecessor has left, but not one on which a process listens. A socket whose file is
gone (a *ghost*) is bound, and its file removed again; where it was bound by a relative name, this happens in a directory that is
made for it. The same holds for an absolute name that leads to another file by now, or that began at a root directory of its own:
that directory is its root for this time.

Facts that this module adds to unix sockets: ``path`` of its name, "" if that is no file's; ``mode`` and ``file_owner`` of that
file, mode -1 if it is gone; ``directory`` in which it was bound by a relative name, "" if it was not, or if that is the program's
own; ``root``: the root directory from which its absolute name leads, "" for the machine's; ``covered`` true where the file is
there, but a mount hides it (mode -1, too), or it was moved to another directory (``away``); ``moved`` true where it has another
name beside the one that it was bound to (`checkpoint.resources.sockets.renamed_paths`).

Source: unix(7), bind(2).
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import stat
import tempfile
import time
from collections.abc import Callable, Iterator
from typing import Final

from checkpoint.capability import Area, refused
from checkpoint.linux.net.unix_diag import ESTABLISHED, BoundFile, bound_file
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.call_table import AT_FDCWD, CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.open_file import OpenFile
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.sockets import renamed_paths
from checkpoint.resources.sockets.renamed_paths import leads_to

CAPABILITIES: Final = (
    refused(
        Area.SOCKETS,
        "a unix socket whose name a mount hides (except an accepted one), or whose name was given from a directory that "
        "the program has left (../name)",
        "let the program bind a name that stays; another name for its file must be in the same directory",
        "than it was bound in",
        "is a unix socket whose name a mount hides",
        "is a unix socket whose name is something else",
        "from a directory that it has left",
    ),
    refused(
        Area.THERE,
        "a unix socket's name that something else has, or a missing directory for it",
        "end the other program, or remove the file; make the directory",
        "the directory of the unix socket",
        "is something else here",
        "is another process's here",
    ),
)

DELETED: Final = " (deleted)"
LOOKS: Final = 3
"""After so many in vain it is a mount that hides a name."""
HIDDEN: Final = "failover-socket-"
"""How directories begin that are made for the while that a name takes."""
GONE: Final = -1
FREED_S: Final = 1.0
"""How long the kernel may take to find sockets that no process can reach any more."""
AT_EMPTY_PATH: Final = 0x1000
NOT_WAITING: Final = -1
"""Fact ``not_accepted`` of a socket whose connection does not wait to be accepted."""
REMOVE_DIRECTORY: Final = 0x200
"""AT_REMOVEDIR of unlinkat(2)."""


def observe(held: OpenFile, looked: socket.socket, name: bytes, file: BoundFile | None = None) -> dict[str, Fact]:
    """Where the file of a name lies.

    Args:
        name: as the kernel tells it, in full.
        file: as the kernel tells of it to any user.
    """
    if not name or name[:1] == b"\0":
        return {"path": "", "mode": GONE, "file_owner": [], "directory": "", "root": ""}
    told = os.fsdecode(name.rstrip(b"\0"))
    working, root = procfs.read_link(held.pid, "cwd"), procfs.read_link(held.pid, "root").rstrip("/")
    opened = bound_file(looked)
    if opened is None:  # we may not ask the socket: then the name counts, as the program would look for it now, and the number
        path, is_covered = root + told if os.path.isabs(told) else os.path.join(working, told), False
        path, about = renamed_paths.by_number(procfs.outlook(held.pid), path, file)
    else:
        try:
            path, about, is_covered = _place_of(held.pid, opened)
        finally:
            os.close(opened)
    is_there = about is not None and about.st_nlink > 0 and not is_covered
    mode, owner = (about.st_mode, [about.st_uid, about.st_gid]) if about is not None and is_there else (GONE, [])
    began = root if _began_at(root, told, path) and not _leads_to_it(held.pid, told, path, about) else ""
    is_known = opened is not None or file is not None
    is_moved = is_there and is_known and renamed_paths.has_moved(held.pid, told, path, about, began, working)
    bound = renamed_paths.beside(path, told) if is_moved else os.path.normpath(path)
    directory = "" if os.path.isabs(told) else bound.removesuffix(f"/{os.path.normpath(told)}") or "/"
    is_away = is_moved and not renamed_paths.lies_beside(held.pid, told, bound, began)
    if is_away:
        is_covered, is_moved, mode, owner = True, False, GONE, []
    return {
        "path": path,
        "mode": mode,
        "file_owner": list(owner),
        "directory": "" if directory == working else directory,
        "root": began,
        "covered": is_covered,
        "moved": is_moved,
        "away": is_away,
    }


def _place_of(pid: int, opened: int) -> tuple[str, os.stat_result, bool]:
    """Where a file lies, or lay if it is gone; and whether it lies below a mount.

    A program that runs may move or remove it while we look: then we look again.
    """
    for _ in range(LOOKS):
        path, about = os.readlink(f"/proc/self/fd/{opened}"), os.fstat(opened)
        if not about.st_nlink:
            return path.removesuffix(DELETED), about, False
        if leads_to(f"{procfs.outlook(pid)}{path}", about):
            return path, about, False
        if path.endswith(DELETED):
            other = renamed_paths.name_beside(procfs.outlook(pid), path, about.st_ino.__eq__, about.st_dev)
            if other:
                return other, about, False
    return path, about, True


def _began_at(root: str, told: str, path: str) -> bool:
    """Whether a whole name may have been given below a root directory, where its file lies; "" is the machine's."""
    return bool(root) and os.path.isabs(told) and path.startswith(root + "/")


def _leads_to_it(pid: int, told: str, path: str, about: os.stat_result | None) -> bool:
    """Whether it leads from the machine's root to its file: it was given before its process got another one."""
    return told == path or (about is not None and leads_to(f"{procfs.outlook(pid)}{told}", about))


def refuse(held: OpenFile) -> str | None:
    """Why a socket cannot be given its name again."""
    seen = held.observed
    path, told = str(seen["path"]), in_words(seen["name"])
    if not path:
        return None
    if seen["directory"] and ".." in told.split("/"):
        return (
            f"{held.name} is a unix socket with a name ({told}) from a directory that it has left: "
            "let the program bind a whole path"
        )
    if seen["mode"] == GONE and os.geteuid() and os.path.isabs(told) and _is_something_else(f"{procfs.outlook(held.pid)}{path}"):
        return f"{held.name} is a unix socket whose name is something else by now ({path}): bind another, or protect it as root"
    is_reached_by_name = seen["state"] != ESTABLISHED or seen["type"] == socket.SOCK_DGRAM
    if seen.get("away") and is_reached_by_name:
        what = f"{held.name} is a unix socket whose file was moved to another directory"
        return f"{what} than it was bound in (from {told} to {path}): let the program bind it there"
    if seen.get("covered") and is_reached_by_name:
        return f"{held.name} is a unix socket whose name a mount hides ({path}): let the program bind another one"
    return None


def in_words(name: Fact) -> str:
    """A name for people, and for open(2) where it is a path."""
    assert isinstance(name, bytes)
    return "@" + os.fsdecode(name[1:]) if name[:1] == b"\0" else os.fsdecode(name.rstrip(b"\0"))


def _is_something_else(path: str) -> bool:
    return os.path.lexists(path) and not stat.S_ISSOCK(os.lstat(path).st_mode)


def mismatches(held: Resource) -> Iterator[str]:
    """Why it could not have its name here."""
    path, name = str(held.facts["path"]), held.facts["name"]
    assert isinstance(name, bytes)
    path = in_words(name) if is_ghost(held) else path  # where that is bound for the while
    has_own = held.facts["type"] == socket.SOCK_DGRAM or held.facts["state"] != ESTABLISHED  # no accepted end has
    if not has_own and not held.facts.get("peer_is_ours", True) and held.facts["not_accepted"] == NOT_WAITING:
        return  # its peer is gone, or stays behind: it is given no name
    if name[:1] == b"\0" and has_own and not _is_free(name, number_of(held.facts["type"])):
        yield f"the abstract name {in_words(name)!r} of the unix socket {held.name} is another process's here: end that first"
    if not path or _is_hidden(held):
        return
    yield from _not_had(held, path)
    if renamed_paths.is_moved(held.facts) and (bound := renamed_paths.place_of(held.facts, in_words(name))) != path:
        yield from _not_had(held, bound)


def _not_had(held: Resource, path: str) -> Iterator[str]:
    if is_ghost(held) and not os.path.isdir(os.path.dirname(path)):
        return  # which is made for the while that it takes
    if not os.path.isdir(os.path.dirname(path)):
        yield f"the directory of the unix socket {path}, {held.name}, is missing here: make it"
    elif _is_something_else(path):
        yield f"{path}, the name of the unix socket {held.name}, is something else here: remove it"
    elif os.path.lexists(path) and is_answered(path):
        yield f"{path}, the name of the unix socket {held.name}, is another process's here: end that first"


def _is_free(name: bytes, kind: int) -> bool:
    """Whether an abstract name can be had.

    Sockets that were on their way to themselves keep theirs after the end of their program, until the kernel looks for such: each
    time that a socket is closed. Source: unix_gc() in net/unix/garbage.c.
    """
    deadline = time.monotonic() + FREED_S
    while True:
        with socket.socket(socket.AF_UNIX, kind) as tried:
            try:
                tried.bind(name)
            except OSError:
                if time.monotonic() > deadline:
                    return False
            else:
                return True
        time.sleep(FREED_S / 100)


def is_answered(path: str) -> bool:
    """Whether a process has the socket file open: the kernel refuses to connect to one that no process has any more."""
    for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM, socket.SOCK_SEQPACKET):
        with socket.socket(socket.AF_UNIX, kind) as asked:
            asked.setblocking(False)
            refused = asked.connect_ex(path)
            if refused in (0, errno.EAGAIN, errno.EPERM):  # EPERM: it hears only its own peer
                return True
    return False


def is_abandoned(path: str) -> bool:
    """Whether a name, a whole path, can be had for a moment: it is free, or of a socket that no process has any more.

    Names of senders are what these say, and may lead to anything.
    """
    if not os.path.isdir(os.path.dirname(path)):
        return False
    return not os.path.lexists(path) or (stat.S_ISSOCK(os.lstat(path).st_mode) and not is_answered(path))


def is_ghost(held: Resource) -> bool:
    """Whether its name is a file's that is gone."""
    return bool(held.facts["path"]) and number_of(held.facts["mode"]) == GONE


def _is_hidden(held: Resource) -> bool:
    """Whether its name leads us elsewhere: a ghost by a relative name, or by one that leads elsewhere from where we look.

    One that was so once stays so: it lay in a directory of ours, which does not tell where its name began.
    """
    told = in_words(held.facts["name"])
    is_elsewhere = bool(held.facts.get("covered") or _root_of(held)) or f"/{HIDDEN}" in str(held.facts["path"])
    return is_ghost(held) and (not os.path.isabs(told) or is_elsewhere or _is_something_else(told))


# --- Restore -----------------------------------------------------------------------------------------------------------


class Naming:
    """One restore of names, and how a socket is reached that has one.

    Attributes:
        closing: descriptors for the files of names that are gone, or lie elsewhere: to be closed when all is connected.
    """

    def __init__(self, table: CallTable, working_directory: str, away: Callable[[int], int]) -> None:
        """
        Args:
            away: moves a descriptor above all that are wanted, and tells where it is then.
        """
        self._table = table
        self._working = working_directory
        self._away = away
        self._files: dict[int, int] = {}

    @property
    def closing(self) -> tuple[int, ...]:
        return tuple(self._files.values())

    def bind(self, one: Resource, made: int) -> None:
        """Give a socket its name."""
        if not one.facts["path"]:
            self._bind(one, made)
        elif is_ghost(one):
            self._bind_ghost(one, made)
        else:
            self._bind_file(one, made)

    def address_of(self, one: Resource) -> bytes:
        """The address for connect(2) to reach a socket that has a name."""
        name, opened = one.facts["name"], self._files.get(number_of(one.facts["socket"]))
        assert isinstance(name, bytes)
        return packed(name if opened is None else b"/proc/self/fd/%d\0" % opened)

    def _keep(self, one: Resource, path: str) -> None:
        """Keep hold of a socket's file."""
        self._files[number_of(one.facts["socket"])] = self._away(self._table.open(path, os.O_PATH | os.O_CLOEXEC))

    def _bind(self, one: Resource, made: int) -> None:
        table, name = self._table, one.facts["name"]
        assert isinstance(name, bytes)
        address = packed(name)
        table.call(f"bind {one.name} to {in_words(name)!r}", "bind", made, table.place(address), len(address))

    def _bind_file(self, one: Resource, made: int) -> None:
        table, path, directory = self._table, str(one.facts["path"]), str(one.facts.get("directory", ""))
        place = table.place_path(path)
        table.attempt("", "unlinkat", AT_FDCWD, place, 0)
        root = _root_of(one)
        bound = table.place_path(renamed_paths.place_of(one.facts, in_words(one.facts["name"])))
        is_moved = renamed_paths.is_moved(one.facts)
        if is_moved:
            table.attempt("", "unlinkat", AT_FDCWD, bound, 0)
        with self._inside(directory), self._below(root):
            self._bind(one, made)
        if is_moved:
            table.call(f"give the unix socket its name {path}", "linkat", AT_FDCWD, bound, AT_FDCWD, place, 0)
            table.call("remove the name that it was bound to", "unlinkat", AT_FDCWD, bound, 0)
        made_file = table.open(path, os.O_PATH | os.O_NOFOLLOW | os.O_CLOEXEC)  # a link may have taken its place meanwhile
        owner = one.facts.get("file_owner")
        if isinstance(owner, list) and owner:
            lost = f"the name of the unix socket {path} belongs to the user that the program runs as"
            ids = number_of(owner[0]), number_of(owner[1])
            table.attempt(lost, "fchownat", made_file, table.place_path(""), *ids, AT_EMPTY_PATH)
        again = table.place_path(f"/proc/self/fd/{made_file}")
        table.call(f"set the mode of {path}", "fchmodat", AT_FDCWD, again, number_of(one.facts["mode"]) & 0o7777)
        table.close(made_file)
        if directory or root or is_moved:
            self._keep(one, path)

    def _bind_ghost(self, one: Resource, made: int) -> None:
        """Bind it, keep hold of its file, and remove that; directories that are made for it go again."""
        table, told = self._table, in_words(one.facts["name"])
        is_whole = os.path.isabs(told)
        root = tempfile.mkdtemp(prefix=HIDDEN) if _is_hidden(one) else ""
        if root:
            os.rmdir(root)  # its name is ours: the vessel makes it, with its program's rights
        if root and is_whole:
            directories, path = _led_through(root, told)
        else:
            path = os.path.join(root, told)
            directories = _missing([root] if root else [], os.path.dirname(path))
        for directory in directories:
            table.call(f"make the directory {directory}", "mkdirat", AT_FDCWD, table.place_path(directory), 0o700)
        if not root:
            table.attempt("", "unlinkat", AT_FDCWD, table.place_path(path), 0)
        with self._inside("" if is_whole else root), self._below(root if is_whole else ""):
            self._bind(one, made)
        self._keep(one, path)
        table.call(f"unlink {path}", "unlinkat", AT_FDCWD, table.place_path(path), 0)
        itself = f"/proc/self/fd/{self._files[number_of(one.facts['socket'])]}"  # no other process reaches it any more
        table.attempt("", "fchmodat", AT_FDCWD, table.place_path(itself), 0o777)  # earlier clients may connect to it again
        for directory in reversed(directories):
            table.attempt("", "unlinkat", AT_FDCWD, table.place_path(directory), REMOVE_DIRECTORY)

    @contextlib.contextmanager
    def _inside(self, directory: str) -> Iterator[None]:
        """Have the vessel in another directory for the body; "" for its own."""
        table = self._table
        if directory:
            table.call(f"enter {directory}", "chdir", table.place_path(directory))
        yield
        if directory:
            table.call(f"enter {self._working}", "chdir", table.place_path(self._working))

    @contextlib.contextmanager
    def _below(self, root: str) -> Iterator[None]:
        """Have the vessel see a root directory for the body, "" for its own; it works in the same directory meanwhile."""
        table = self._table
        if not root:
            yield
            return
        whole, here = (table.open(path, os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC) for path in ("/", "."))
        table.call(f"make {root} the root directory for a while", "chroot", table.place_path(root))
        yield
        table.call("leave the root directory", "fchdir", whole)
        table.call("leave the root directory", "chroot", table.place_path("."))
        table.call("enter the working directory again", "fchdir", here)
        table.close(whole)
        table.close(here)


def _root_of(one: Resource) -> str:
    """From where its whole name leads; snapshots of before do not tell."""
    return str(one.facts.get("root", ""))


def packed(name: bytes) -> bytes:
    """A name as bind(2) and connect(2) take it."""
    return socket.AF_UNIX.to_bytes(2, "little") + name


def _led_through(root: str, told: str) -> tuple[list[str], str]:
    """The directories that a whole name leads through below one that is its root, that first; and where it ends."""
    place, directories = [root], {root: None}
    *names, last = [name for name in told.split("/") if name not in ("", ".")]
    for name in names:
        if name != "..":
            place.append(name)
            directories["/".join(place)] = None
        elif len(place) > 1:  # nothing lies above a root
            place.pop()
    return list(directories), "/".join((*place, last))


def _missing(made: list[str], directory: str) -> list[str]:
    """Directories that lead to one and are not there, the outermost first; those in ``made`` are on their way."""
    missing: list[str] = []
    while directory and directory not in made and not os.path.isdir(directory):
        missing.append(directory)
        directory = os.path.dirname(directory)
    return made + missing[::-1]
