"""Unix sockets: pairs of which the program has both ends, its connections with itself, listeners, and sockets for datagrams.

What waits in them comes back, in the same messages. A listener is bound to its name again: the file that its predecessor has left
is replaced, one that somebody listens to is not. A socket for datagrams that was connected to a name outside (``/dev/log``) is
connected to that name again.

Facts besides those of every socket: ``state`` of `checkpoint.linux.unix_sockets`; ``name``; ``peer``: inode number of its
other end, 0 when that is gone; ``peer_name``; ``backlog``; ``shutdown``; ``path`` of its name, "" if that is no file's;
``mode`` of that file, -1 if it is gone; ``waiting``: connections not accepted yet; ``passed``: of each message in the
queue the descriptors that came with it, as numbers of the program's own, -1 for one that it has closed; no list if none has any;
``too_long``: the queue; ``sources``: whether a message has a sender with a name.

Source: unix(7).
"""

from __future__ import annotations

import errno
import os
import socket
import stat
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import CaptureError
from checkpoint.linux import abi, procfs
from checkpoint.linux.call_table import CallTable
from checkpoint.linux.unix_sockets import ESTABLISHED, LISTENING, unix_socket
from checkpoint.model import Fact, Resource
from checkpoint.resources import Opened, OpenFile, Surroundings, elsewhere, sockets
from checkpoint.resources.rebuilding import number_of

KIND: Final = "unix_sockets"

CAPABILITIES: Final = (
    preserved(
        Area.SOCKETS,
        "unix sockets that the program keeps to itself",
        "pairs and connections with what waits in them, descriptors on their way included",
    ),
    preserved(
        Area.SOCKETS,
        "unix listeners, and unix sockets for datagrams",
        "bound to their names again, or connected to the names that they were connected to",
    ),
    refused(
        Area.SOCKETS,
        "a unix socket that is connected to another process",
        "open it for a moment and close it again: captures are taken in between",
        "connected to another process",
        "connected to a socket of another process",
    ),
    refused(
        Area.SOCKETS,
        "a unix socket with descriptors on their way that the program has closed, named senders, or over 4 MiB that wait",
        "it is kept as soon as the program has taken them",
        "with descriptors on their way",
        "MiB wait: it is kept as soon as",
        "with messages of a sender that has a name",
    ),
    refused(
        Area.SOCKETS,
        "a unix listener where a connection waits",
        "it is kept as soon as the program has accepted it",
        "where a connection waits to be accepted",
    ),
    refused(
        Area.SOCKETS,
        "a unix socket whose directory is gone, or whose name is something else by now",
        "let the program bind a name that stays",
        "is a unix socket whose directory is gone",
        "is a unix socket whose name is something else",
    ),
    refused(
        Area.THERE,
        "something else has the name of a unix socket, or there is no place for it",
        "end or remove what is there; make the directory",
        "the directory of the unix socket",
        "is something else here",
        "is another process's here",
    ),
)

_AT_FDCWD: Final = -100
BOTH_DIRECTIONS: Final = 3
_SHUTDOWN_HOW: Final = {1: socket.SHUT_RD, 2: socket.SHUT_WR, 3: socket.SHUT_RDWR}


def observe(held: OpenFile, looked: socket.socket, opened: Opened, noted: sockets.Noted | None) -> dict[str, Fact]:
    """Its state, its peer and what waits in it.

    Args:
        noted: see `sockets.queue_of`.

    Raises:
        OSError: it cannot be looked into.
        CaptureError: the kernel does not tell.
    """
    told = unix_socket(held.first.inode)
    if told is None:
        raise CaptureError(f"cannot ask the kernel about the unix socket {held.name} (sock_diag): load the module unix_diag")
    facts = sockets.general_facts(held.first, looked)
    has_queue = told.state == ESTABLISHED or told.type == socket.SOCK_DGRAM
    identify = partial(_number_of, held.pid, opened)
    queue = sockets.queue_of(looked, held.first.number, noted, identify) if has_queue else sockets.NOTHING
    path = _path_of(held.pid, told.name)
    return facts | {
        "state": told.state,
        "name": told.name,
        "peer": told.peer,
        "peer_is_ours": told.peer in opened.inodes or told.peer in held.kin.sockets,
        "peer_name": _peer_name(looked),
        "backlog": told.backlog,
        "shutdown": told.shutdown,
        "path": path,
        "mode": _mode_of(held.pid, path),
        "waiting": told.waiting,
        "queue": list(queue.messages),
        "passed": [list(numbers) for numbers in queue.passed] if any(queue.passed) else [],
        "too_long": queue.too_long,
        "sources": told.type == socket.SOCK_DGRAM and any(queue.sources),
    }


def _number_of(pid: int, opened: Sequence[OpenFile], ours: int) -> int:
    """Which of the program's descriptors leads to the same open file as one of ours, which was on its way to it."""
    about = os.fstat(ours)
    for one in opened:
        is_alike = (one.first.device, one.first.inode) == (about.st_dev, about.st_ino)
        if is_alike and abi.kcmp(pid, os.getpid(), abi.KCMP_FILE, one.first.number, ours) == 0:
            return one.first.number
    return sockets.UNKNOWN


def _peer_name(looked: socket.socket) -> bytes:
    try:
        name = looked.getpeername()
    except OSError:
        return b""
    return name if isinstance(name, bytes) else os.fsencode(name)


def _path_of(pid: int, name: bytes) -> str:
    """Where the file of a name lies, as the process sees it; "" for a name without a file."""
    if not name or name[:1] == b"\0":
        return ""
    return os.path.join(procfs.read_link(pid, "cwd"), os.fsdecode(name.rstrip(b"\0")))


def _mode_of(pid: int, path: str) -> int:
    """Mode of the socket at a path, as the process sees it; -1 where there is none."""
    if not path:
        return -1
    try:
        about = os.stat(f"/proc/{pid}/root{path}")
    except OSError:
        return -1
    return about.st_mode if stat.S_ISSOCK(about.st_mode) else -1


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The socket as it was observed."""
    if held.observed.get("family") != socket.AF_UNIX:
        return None
    return Resource(KIND, held.name, {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, **held.observed})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a unix socket cannot be kept."""
    seen = held.observed
    if seen.get("family") != socket.AF_UNIX:
        return None
    what = f"{held.name} is a unix socket"
    if _leads_outside(seen) and seen["type"] != socket.SOCK_DGRAM:
        return f"{what} connected to another process, which stays behind: protect the program while it has no such connection"
    if seen["peer"] and not seen["peer_is_ours"] and not seen["peer_name"]:
        return f"{what} connected to a socket of another process that has no name: protect the program while it has none"
    if any(isinstance(numbers, list) and sockets.UNKNOWN in numbers for numbers in _list(seen["passed"])):
        return (
            f"{what} with descriptors on their way in it (SCM_RIGHTS) that the program has closed already: it is kept as soon as "
            "they are received"
        )
    if seen["waiting"]:
        return f"{what} where a connection waits to be accepted: it is kept as soon as the program has accepted it"
    if seen["too_long"]:
        return f"{what} in which more than {sockets.QUEUE_LIMIT >> 20} MiB wait: it is kept as soon as they are read"
    if seen["sources"]:
        return f"{what} with messages of a sender that has a name, which is not kept: it is kept as soon as they are read"
    return _refuse_name(held) or sockets.refuse_filter(held) or elsewhere.refuse(held, "a unix socket")


def _refuse_name(held: OpenFile) -> str | None:
    """Why a socket cannot be given its name again: there is no place for it, as the process sees it."""
    path = str(held.observed["path"])
    place = f"/proc/{held.pid}/root{path}"
    if not path:
        return None
    if not os.path.isdir(os.path.dirname(place)):
        return f"{held.name} is a unix socket whose directory is gone ({path}): let the program open it where it stays"
    if os.path.lexists(place) and not stat.S_ISSOCK(os.lstat(place).st_mode):
        return f"{held.name} is a unix socket whose name is something else by now ({path}): let the program bind another one"
    return None


def _leads_outside(seen: Mapping[str, Fact]) -> bool:
    """Whether its other end is another process's.

    An end that has gone has shut both directions down; one without a number waits to be accepted.
    """
    if seen["peer"]:
        return not seen["peer_is_ours"]
    return seen["state"] == ESTABLISHED and seen["shutdown"] != BOTH_DIRECTIONS


def mismatches(held: Resource) -> Iterator[str]:
    """Why a listener could not have its name here."""
    path = str(held.facts["path"])
    if not path:
        return
    if not os.path.isdir(os.path.dirname(path)):
        yield f"the directory of the unix socket {path}, {held.name}, is missing here: make it"
    elif os.path.lexists(path) and not stat.S_ISSOCK(os.lstat(path).st_mode):
        yield f"{path}, the name of the unix socket {held.name}, is something else here: remove it"
    elif os.path.lexists(path) and is_answered(path):
        yield f"{path}, the name of the unix socket {held.name}, is another process's here: end that first"


def is_answered(path: str) -> bool:
    """Whether a process has the socket file open: connecting to one that nobody has any more is refused by the kernel."""
    for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM, socket.SOCK_SEQPACKET):
        with socket.socket(socket.AF_UNIX, kind) as asked:
            asked.setblocking(False)
            refused = asked.connect_ex(path)
            if refused in (0, errno.EAGAIN):
                return True
    return False


# --- Restore -----------------------------------------------------------------------------------------------------------


def _list(fact: Fact) -> list[Fact]:
    assert isinstance(fact, list)
    return fact


def _of(held: Resource, name: str) -> int:
    return number_of(held.facts[name])


def _name_of(held: Resource) -> bytes:
    name = held.facts["name"]
    assert isinstance(name, bytes)
    return name


class Work:
    """One restore of unix sockets: those with a name first, then connections, then what waits in them."""

    def __init__(self, table: CallTable, held: Sequence[Resource], first: int) -> None:
        self._table = table
        self._held = {_of(one, "socket"): one for one in held}
        self._next = first
        self._made: dict[int, int] = {}
        self._closing: list[int] = []
        self._others: dict[int, int] = {}

    @property
    def end(self) -> int:
        """The first number after those that they stand at."""
        return self._next

    def run(self) -> dict[int, int]:
        """Make them all."""
        for inode, one in self._held.items():
            if self._stands_alone(one):
                self._made[inode] = self._away(self._alone(one))
        for inode, one in self._held.items():
            if inode not in self._made:
                self._others |= self._connect(one)
        for one in self._held.values():
            self._connect_datagrams(one)
        return self._made

    def fill(self) -> None:
        """Send what waits in them, and shut down what is; descriptors that are on their way are there by now."""
        table = self._table
        for one in self._held.values():
            if one.facts["queue"]:
                sockets.fill(table, one, self._sender_to(one, self._others), self._held.get(_of(one, "peer")))
        for inode, one in self._held.items():
            if how := _of(one, "shutdown"):
                table.attempt("", "shutdown", self._made[inode], _SHUTDOWN_HOW[how])
            sockets.set_flags(table, one, self._made[inode])
        for number in self._closing:
            table.close(number)

    def _away(self, made: int) -> int:
        """Move a descriptor above all that are wanted."""
        number, self._next = self._next, self._next + 1
        self._table.duplicate(made, number, os.O_CLOEXEC)
        self._table.close(made)
        return number

    def _is_pair(self, one: Resource) -> bool:
        """Whether both ends are the program's and know each other."""
        other = self._held.get(_of(one, "peer"))
        return other is not None and _of(other, "peer") == _of(one, "socket") and not (_name_of(one) or _name_of(other))

    def _stands_alone(self, one: Resource) -> bool:
        """Whether it is no end of a connection: it may be connected to a name for all that."""
        if _of(one, "state") != ESTABLISHED:
            return True
        has_name = bool(_name_of(one) or one.facts["peer_name"])
        return _of(one, "type") == socket.SOCK_DGRAM and has_name and not self._is_pair(one)

    def _alone(self, one: Resource) -> int:
        made = sockets.make(self._table, one)
        if _name_of(one):
            self._bind(one, made)
        if _of(one, "state") == LISTENING:
            self._table.call(f"listen at {one.name}", "listen", made, _of(one, "backlog"))
        return made

    def _bind(self, one: Resource, made: int) -> None:
        table, name = self._table, _name_of(one)
        address = socket.AF_UNIX.to_bytes(2, "little") + name
        path = name.rstrip(b"\0")
        if name[:1] != b"\0":
            table.attempt("", "unlinkat", _AT_FDCWD, table.place(path + b"\0"), 0)
        table.call(f"bind {one.name} to {os.fsdecode(path)!r}", "bind", made, table.place(address), len(address))
        mode = _of(one, "mode")
        if name[:1] != b"\0" and mode >= 0:
            table.call(f"set the mode of {os.fsdecode(path)}", "fchmodat", _AT_FDCWD, table.place(path + b"\0"), mode & 0o7777)
        elif name[:1] != b"\0":
            table.attempt("", "unlinkat", _AT_FDCWD, table.place(path + b"\0"), 0)

    def _connect(self, one: Resource) -> dict[int, int]:
        """Make a connection: where its other end is gone, the number that stands for that end, by the socket's."""
        other = self._held.get(_of(one, "peer"))
        if other is None:
            ours, theirs = (self._away(number) for number in self._pair(one))
            self._made[_of(one, "socket")] = ours
            sockets.set_options(self._table, one, ours)
            self._closing.append(theirs)
            return {_of(one, "socket"): theirs}
        named = next((end for end in (one, other) if _name_of(end)), None)
        ends = self._pair(one) if named is None else self._through_listener(named, other if named is one else one)
        order = (one, other) if named is None or named is one else (other, one)
        for end, number in zip(order, ends, strict=True):
            self._made[_of(end, "socket")] = self._away(number)
        for end in order:
            sockets.set_options(self._table, end, self._made[_of(end, "socket")])
        return {}

    def _pair(self, one: Resource) -> tuple[int, int]:
        kind = _of(one, "type") | socket.SOCK_CLOEXEC
        place = self._table.place(bytes(8))
        return self._table.obtain_pair(f"make the sockets of {one.name}", "socketpair", socket.AF_UNIX, kind, 0, place)

    def _through_listener(self, named: Resource, client: Resource) -> tuple[int, int]:
        """Connect to a listener of that name and accept: (the accepted end, the client's)."""
        table, address = self._table, socket.AF_UNIX.to_bytes(2, "little") + _name_of(named)
        listener = next(
            (
                self._made[inode]
                for inode, one in self._held.items()
                if _of(one, "state") == LISTENING and _name_of(one) == _name_of(named)
            ),
            None,
        )
        lent = listener if listener is not None else self._temporary_listener(named)
        connecting = sockets.make(table, client)
        if _name_of(client):
            self._bind(client, connecting)
        table.call(f"connect {client.name}", "connect", connecting, table.place(address), len(address))
        accepted = table.obtain(f"accept the connection of {named.name}", "accept4", lent, 0, 0, socket.SOCK_CLOEXEC)
        if listener is None:
            table.close(lent)
        return accepted, connecting

    def _temporary_listener(self, named: Resource) -> int:
        table = self._table
        form = (socket.AF_UNIX, _of(named, "type") | socket.SOCK_CLOEXEC, 0)
        lent = table.obtain(f"make a listener for {named.name}", "socket", *form)
        self._bind(named, lent)
        table.call(f"listen for {named.name}", "listen", lent, 1)
        return lent

    def _connect_datagrams(self, one: Resource) -> None:
        """Connect a socket for datagrams to the name that it was connected to."""
        name = one.facts["peer_name"]
        if _of(one, "type") != socket.SOCK_DGRAM or not name or self._is_pair(one):
            return
        assert isinstance(name, bytes)
        address = socket.AF_UNIX.to_bytes(2, "little") + name
        lost = f"{one.name} is not connected to {os.fsdecode(name)!r}, where nobody receives here"
        self._table.attempt(lost, "connect", self._made[_of(one, "socket")], self._table.place(address), len(address))

    def _sender_to(self, one: Resource, others: Mapping[int, int]) -> int:
        """A descriptor whose messages arrive at a socket."""
        inode, peer = _of(one, "socket"), _of(one, "peer")
        if inode in others:
            return others[inode]
        if peer in self._made and _of(self._held[peer], "peer") == inode:
            return self._made[peer]
        table, address = self._table, socket.AF_UNIX.to_bytes(2, "little") + _name_of(one)
        sender = table.obtain(
            f"make a sender for {one.name}", "socket", socket.AF_UNIX, _of(one, "type") | socket.SOCK_CLOEXEC, 0
        )
        table.call(f"reach {one.name}", "connect", sender, table.place(address), len(address))
        self._closing.append(sender)
        return sender
