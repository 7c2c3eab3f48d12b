"""Restore pseudo-terminals of which the program has the master: both ends, their settings, window size and modes.

A slave gets the number that it had (`/dev/pts/3`) where that is free, else another one, and a note says so. A session gets its
controlling terminal again, with the same group in the foreground. Bytes that wait at either end are not kept yet, so the capture
keeps such a terminal only after they are read. A line that is being typed, and not ended, cannot be queried: it is lost.

A slave whose master belongs to another program, such as a login, is a standard stream or refused.

Facts: ``descriptors``; ``flags`` of open(2); ``terminal``: number of the slave; ``end``: `MASTER` or `SLAVE`; ``waiting``: bytes;
``hung_up``: no process has the other end any more; ``exclusive``; ``settings``: struct termios2; ``window``: struct winsize; of a
slave ``discipline``, and ``mode``, ``uid`` and ``gid`` of its file; of a master ``locked``, ``packets``, ``session`` and
``foreground``: as the program itself knows these groups, 0 for none.

Source: pty(7), ioctl_tty(2), ioctl_pipe(2); drivers/tty/pty.c, n_tty_poll() in drivers/tty/n_tty.c.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import select
import stat
import struct
import termios
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final

from msgspec import Struct

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import CaptureError, CheckpointError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptors import copy_of
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources import other_holders
from checkpoint.resources.ipc import standard_streams
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import number_of
from checkpoint.sentences import AS_SOON_AS

KIND: Final = "terminals"

CAPABILITIES: Final = (
    preserved(
        Area.TERMINALS,
        "pseudo-terminals of which the program has the master",
        "both ends with settings, window size, modes and controlling session, under the same name (/dev/pts/3) if it is "
        "free; a line that is being typed is lost",
    ),
    refused(
        Area.TERMINALS,
        "a pseudo-terminal with data that waits to be read, or with a line discipline of another kind",
        f"wait: {AS_SOON_AS} the data is read; let the program use the ordinary line discipline",
        "with {} bytes that wait in it",
        "with line discipline",
    ),
    refused(
        Area.TERMINALS,
        "a pseudo-terminal whose other end another process has open",
        "protect the program after the other process has closed it",
        "a pseudo-terminal that pid",
    ),
)

MASTER: Final = "master"
SLAVE: Final = "slave"
_MULTIPLEXER: Final = os.makedev(5, 2)
_OWN: Final = os.makedev(5, 0)
"""/dev/tty, which leads to the controlling terminal."""
_SLAVE_MAJORS: Final = range(136, 144)
_INDEX: Final = re.compile(rb"^tty-index:\t(\d+)$", re.MULTILINE)

TCGETS2: Final = 0x802C542A
TCSETS2: Final = 0x402C542B
SETTINGS_SIZE: Final = 44
TIOCGPTN: Final = 0x80045430
TIOCSPTLCK: Final = 0x40045431
TIOCGPKT: Final = 0x80045438
TIOCGPTLCK: Final = 0x80045439
TIOCGEXCL: Final = 0x80045440
TIOCGPTPEER: Final = 0x5441
TIOCGSID: Final = 0x5429
WINDOW_SIZE: Final = 8
N_TTY: Final = 0
FUTEX_CMP_REQUEUE: Final = 4
FUTEX_PRIVATE: Final = 128
FILLERS_MAX: Final = 256
"""Terminals that are opened for a moment to get at a certain number."""


def is_terminal(one: Descriptor) -> bool:
    """Whether a descriptor is an end of a pseudo-terminal, by any name."""
    return stat.S_ISCHR(one.mode) and (one.rdev in (_MULTIPLEXER, _OWN) or os.major(one.rdev) in _SLAVE_MAJORS)


def observe(held: OpenFile, opened: Sequence[OpenFile]) -> Mapping[str, Fact]:
    """The settings of a terminal whose master the program has; of others nothing.

    Raises:
        CaptureError: it cannot be looked into.
    """
    if held.first.rdev == _MULTIPLEXER:
        return _asked(held, _master_number(held.first), MASTER)
    number = _slave_number(held)
    if number is not None and (number in held.kin.terminals or number in masters(opened) or _is_hung_up(held)):
        return _asked(held, number, SLAVE)
    return {}


def masters(opened: Iterable[OpenFile]) -> frozenset[int]:
    """The numbers of all terminals of which one of these is the master."""
    return frozenset(number for one in opened if (number := _master_number(one.first)) is not None)


def _master_number(one: Descriptor) -> int | None:
    found = _INDEX.search(one.told) if one.rdev == _MULTIPLEXER else None
    return int(found[1]) if found else None


def _slave_number(held: OpenFile) -> int | None:
    """The number of a slave; that of the controlling terminal for /dev/tty."""
    device = held.first.rdev
    if device == _OWN:
        packed = int(procfs.read_text(held.pid, "stat").rpartition(")")[2].split()[4])
        device = os.makedev(packed >> 8 & 0xFFF, packed & 0xFF | packed >> 12 & 0xFFF00)
    if os.major(device) not in _SLAVE_MAJORS:
        return None
    return os.minor(device)


def _is_hung_up(held: OpenFile) -> bool:
    """Whether it is a slave without a master; a standard stream stays one."""
    if any(one.number in standard_streams.STANDARD for one in held.descriptors):
        return False
    with contextlib.suppress(OSError), copy_of(held.pid, held.first.number) as terminal:
        return _has_hung_up(terminal)
    return False


def _has_hung_up(terminal: int) -> bool:
    """Whether the other end is open nowhere. Being asked, the kernel first delivers what is still on its way."""
    poll = select.poll()
    poll.register(terminal, select.POLLIN)
    return bool(dict(poll.poll(0)).get(terminal, 0) & select.POLLHUP)


def _asked(held: OpenFile, number: int | None, end: str) -> dict[str, Fact]:
    try:
        with copy_of(held.pid, held.first.number) as terminal:
            return {"terminal": number, "end": end, **_facts_of(held, terminal, end)}
    except OSError as error:
        raise CaptureError(
            f"cannot look into the terminal {held.name} ({held.first.target}): {error.strerror}; try again"
        ) from error


def _facts_of(held: OpenFile, terminal: int, end: str) -> dict[str, Fact]:
    has_hung_up = _has_hung_up(terminal)
    if end == SLAVE and has_hung_up:  # every other question is answered by EIO
        return {"hung_up": True, "waiting": 0, "mode": held.first.mode}
    facts: dict[str, Fact] = {
        "hung_up": has_hung_up,
        "waiting": _word(terminal, termios.FIONREAD),
        "exclusive": _word(terminal, TIOCGEXCL),
        "settings": fcntl.ioctl(terminal, TCGETS2, bytes(SETTINGS_SIZE)),
        "window": fcntl.ioctl(terminal, termios.TIOCGWINSZ, bytes(WINDOW_SIZE)),
    }
    if end == SLAVE:
        about = os.fstat(terminal)
        return facts | {
            "mode": about.st_mode,
            "uid": about.st_uid,
            "gid": about.st_gid,
            "discipline": _word(terminal, termios.TIOCGETD),
        }
    return facts | {
        "locked": _word(terminal, TIOCGPTLCK),
        "packets": _word(terminal, TIOCGPKT),
        "session": _group(terminal, TIOCGSID),
        "foreground": _group(terminal, termios.TIOCGPGRP),
    }


def _word(terminal: int, question: int) -> int:
    return int.from_bytes(fcntl.ioctl(terminal, question, bytes(4)), "little")


def _group(terminal: int, question: int) -> int:
    """A session or process group, by the number that it has in its own PID namespace; 0 for none, or one without its leader."""
    try:
        return procfs.status(_word(terminal, question)).pids[-1]
    except (OSError, CheckpointError):
        return 0


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The end as it was observed."""
    if "terminal" not in held.observed:
        return None
    facts: dict[str, Fact] = {"descriptors": held.numbers, "flags": held.first.flags & ~os.O_CLOEXEC, **held.observed}
    return Resource(KIND, held.name, facts)


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a terminal cannot be made again."""
    seen = held.observed
    if "terminal" not in seen:
        return None
    number, waiting, discipline = (number_of(seen.get(name, N_TTY)) for name in ("terminal", "waiting", "discipline"))
    if waiting:
        return f"{held.name} is a pseudo-terminal with {waiting} bytes that wait in it: {AS_SOON_AS} the program has read them"
    if discipline != N_TTY:
        return f"{held.name} is a pseudo-terminal with line discipline {discipline}: only the ordinary one (N_TTY) is kept"
    if not seen["hung_up"] and (other := _other_opener(held, number)):
        return f"{held.name} is a pseudo-terminal that pid {other} has open too: protect the program when that has closed it"
    return other_holders.refuse(held, "a pseudo-terminal")


def _other_opener(held: OpenFile, number: int) -> int | None:
    """Another process that has the slave open; terminals of other mounts (devpts) have the same names."""
    try:
        about = os.stat(f"{procfs.outlook(held.pid)}/dev/pts/{number}")
    except OSError:
        return None
    name = held.first.target if held.observed["end"] == SLAVE else f"/dev/pts/{number}"
    return other_holders.opener_at(held, name, (about.st_dev, about.st_ino))


# --- Restore -----------------------------------------------------------------------------------------------------------


def prepare(table: CallTable, held: Sequence[Resource], first: int, vessel_pid: int) -> dict[int, int]:
    """Make all of them at numbers from ``first`` on: the descriptor of each, by the resource's id().

    Args:
        vessel_pid: the process that makes them; it may have terminals of its own.
    """
    return _Work(table, first, _numbers_in_use(vessel_pid)).run(held) if held else {}


class _Work:
    """One restore of terminals, in ascending order of their numbers: a new one gets the least that is free.

    Attributes:
        next: the number to which the next descriptor is moved.
    """

    def __init__(self, table: CallTable, first: int, taken: Iterable[int]) -> None:
        self._table = table
        self._first = first
        self._made: dict[int, int] = {}
        self._taken = set(taken)
        self._fillers: list[int] = []

    def run(self, held: Sequence[Resource]) -> dict[int, int]:
        """Make them all."""
        for number in sorted({number_of(one.facts["terminal"]) for one in held}):
            self._make(number, [one for one in held if one.facts["terminal"] == number])
        for filler in self._fillers:
            self._table.close(filler)
        return self._made

    def _open(self) -> int:
        return self._away(self._table.open("/dev/ptmx", os.O_RDWR | os.O_NOCTTY))

    def _away(self, made: int) -> int:
        """Move a descriptor above all that are wanted."""
        number, self._first = self._first, self._first + 1
        self._table.duplicate(made, number, os.O_CLOEXEC)
        self._table.close(made)
        return number

    def _open_numbered(self, number: int) -> int:
        """Open a new one that gets this number, unless it is taken: as many before as there are lesser ones free."""
        lesser = [free for free in range(number) if free not in self._taken]
        if number not in self._taken and len(lesser) <= FILLERS_MAX:
            self._fillers += [self._open() for _ in lesser]
            self._taken |= {*lesser, number}
        else:
            self._taken.add(next(free for free in range(len(self._taken) + 1) if free not in self._taken))
        return self._open()

    def _make(self, number: int, ends: Sequence[Resource]) -> None:
        table, lent = self._table, self._open_numbered(number)
        masters = [one for one in ends if one.facts["end"] == MASTER]
        slaves = [one for one in ends if one.facts["end"] == SLAVE]
        self._tell_number(number, lent, ends[0])
        self._ioctl(ends[0], lent, TIOCSPTLCK, bytes(4))
        for one in slaves:
            self._made[id(one)] = self._slave(one, lent)
        for one in masters[:1]:
            if one.facts["hung_up"] and not slaves:
                table.close(self._slave(one, lent))
            self._made[id(one)] = lent
            self._set(one, lent)
        if not masters:
            table.close(lent)
        for one in slaves:
            if one.facts.get("exclusive"):
                self._ioctl(one, self._made[id(one)], termios.TIOCEXCL)

    def _tell_number(self, number: int, master: int, one: Resource) -> None:
        """Have it said when the number is another one: FUTEX_CMP_REQUEUE compares a word in memory, and wakes no thread."""
        place = self._table.place(bytes(8))
        self._table.call(f"ask for the number of {one.name}", "ioctl", master, TIOCGPTN, place)
        lost = f"the pseudo-terminal /dev/pts/{number} ({one.name}) has another number here"
        self._table.attempt(lost, "futex", place, FUTEX_CMP_REQUEUE | FUTEX_PRIVATE, 0, 0, place + 4, number)

    def _slave(self, one: Resource, master: int) -> int:
        flags = number_of(one.facts["flags"]) & (os.O_ACCMODE | os.O_NONBLOCK | os.O_APPEND)
        what = f"open the pseudo-terminal of {one.name}"
        made = self._away(self._table.obtain(what, "ioctl", master, TIOCGPTPEER, flags | os.O_NOCTTY))
        if "uid" in one.facts:
            self._table.attempt("", "fchown", made, number_of(one.facts["uid"]), number_of(one.facts["gid"]))
            self._table.attempt("", "fchmod", made, number_of(one.facts["mode"]) & 0o7777)
        return made

    def _set(self, one: Resource, master: int) -> None:
        """Settings and modes of a terminal, by its master."""
        settings, window = one.facts["settings"], one.facts["window"]
        assert isinstance(settings, bytes) and isinstance(window, bytes)
        self._ioctl(one, master, TCSETS2, settings)
        self._ioctl(one, master, termios.TIOCSWINSZ, window)
        for fact, order in (("packets", termios.TIOCPKT), ("locked", TIOCSPTLCK)):
            if one.facts[fact]:
                self._ioctl(one, master, order, number_of(one.facts[fact]).to_bytes(4, "little"))
        if one.facts["exclusive"]:
            self._ioctl(one, master, termios.TIOCEXCL)
        if number_of(one.facts["flags"]) & os.O_NONBLOCK:
            self._table.call(f"set the flags of {one.name}", "fcntl", master, fcntl.F_SETFL, os.O_NONBLOCK)

    def _ioctl(self, one: Resource, terminal: int, order: int, argument: bytes = b"") -> None:
        place = self._table.place(argument) if argument else 0
        self._table.call(f"set up the terminal {one.name} (ioctl {order:#x})", "ioctl", terminal, order, place)


def _numbers_in_use(pid: int) -> Iterator[int]:
    with contextlib.suppress(OSError):
        yield from (int(name) for name in os.listdir(f"{procfs.outlook(pid)}/dev/pts") if name.isdigit())


class Controlling(Struct, frozen=True):
    """The controlling terminal of a session.

    Attributes:
        slave: a descriptor of it; None where it is open nowhere any more.
        master: one of its other end, where that is open.
        foreground: the process group in its foreground, 0 for none.
    """

    slave: int | None
    master: int | None
    foreground: int


def controlling(made: Mapping[int, Resource]) -> dict[int, Controlling]:
    """The controlling terminal of each session that has one, by the session's leader.

    Args:
        made: ends of terminals, by a descriptor of each.
    """
    ends = {number: one for number, one in made.items() if one.kind == KIND}
    slaves = {number_of(one.facts["terminal"]): number for number, one in ends.items() if one.facts["end"] == SLAVE}
    masters = {number_of(one.facts["terminal"]): number for number, one in ends.items() if one.facts["end"] != SLAVE}
    found = {}
    for facts in (one.facts for one in ends.values() if one.facts.get("session")):
        terminal = number_of(facts["terminal"])
        found[number_of(facts["session"])] = Controlling(
            slaves.get(terminal), masters.get(terminal), number_of(facts["foreground"])
        )
    return found


def settle(table: CallTable, held: Sequence[Resource], pid: int) -> None:
    """Make a terminal the controlling one of the session that this process leads.

    Args:
        pid: as the program itself knows it.
    """
    ends = [one for one in held if one.kind == KIND]
    led = {number_of(one.facts["terminal"]): one for one in ends if one.facts.get("session") == pid}
    mine = [one for one in ends if one.facts["terminal"] in led]
    if not mine:
        return
    slave = next((one for one in mine if one.facts["end"] == SLAVE), mine[0])
    descriptors = slave.facts["descriptors"]
    assert isinstance(descriptors, list) and isinstance(descriptors[0], list)
    number = number_of(descriptors[0][0])
    is_closed = slave.facts["end"] != SLAVE
    if is_closed:  # it is a session's terminal also when it is open nowhere
        number = table.obtain(f"open the other end of {slave.name}", "ioctl", number, TIOCGPTPEER, os.O_RDWR | os.O_NOCTTY)
    table.call(f"take {slave.name} as the controlling terminal", "ioctl", number, termios.TIOCSCTTY, 0)
    foreground = number_of(led[number_of(slave.facts["terminal"])].facts["foreground"])
    if foreground not in (0, pid):
        place = table.place(struct.pack("<i", foreground))
        table.attempt(f"group {foreground} is not in the foreground of {slave.name}", "ioctl", number, termios.TIOCSPGRP, place)
    if is_closed:
        table.close(number)
