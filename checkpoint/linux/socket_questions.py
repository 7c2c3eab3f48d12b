"""Everything that is asked about one socket as one table of system calls, and its answers as bytes that can be compared.

Nothing of an answer is understood here: the same bytes mean what they meant before. They come in two parts, for a program sets
one by itself, and the other changes with what comes from outside.

Source: getsockopt(2), poll(2), tcp(7), udp(7), unix(7).
"""

from __future__ import annotations

import select
import socket
import struct
import termios
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from checkpoint.linux.own_calls import FIRST_ARGUMENT, OwnCalls, row

Option = tuple[int, int, int]
"""Level, number and size of an option."""

OPTION_SIZE: Final = 64
NUMBER_SIZE: Final = 8
NAME_SIZE: Final = 128
STAT_SIZE: Final = 144
"""Bytes of struct stat of any processor, at most."""
SO_ATTACH_FILTER: Final = 26
SO_PEERNAME: Final = 28
SO_BUF_LOCK: Final = 72
_TCP_INFO_SIZE: Final = 216
_TCP_INFO_TOLD: Final = ((0, 1), (24, 32), (128, 136), (144, 148), (200, 216))
"""Of struct tcp_info: state; what a listener holds; bytes received, not sent yet, sent and sent again. The rest is times and
estimates."""
_CREDENTIALS_SIZE: Final = 12
_MCAST_MSFILTER: Final = 48
_GROUP_FILTER_SIZE: Final = 144
_POLL: Final = struct.Struct("<ihH")
POLLED: Final = select.POLLIN | select.POLLPRI | select.POLLRDHUP
_DATAGRAMS: Final = (socket.IPPROTO_UDP, 136)
_INTERNET: Final = (socket.AF_INET, socket.AF_INET6)

BUFFERS: Final = 2
"""Rows at the end of a table: the sizes of the buffers, which are asked for only where the program has chosen one."""
RESULT_AT: Final = 16
"""Where the result of the question for a number stands, after that and its length."""
SETTINGS, STATE, ASIDE = range(3)
"""Parts of the memory in which the answers stand; the last is not compared."""


@dataclass(frozen=True, slots=True)
class Subject:
    """What is asked of a socket follows from this.

    Attributes:
        options: those that a fresh one of its form has.
        groups: (interface, address as bind(2) takes one) of multicast groups that it may have joined.
    """

    family: int
    type: int
    protocol: int
    options: tuple[Option, ...]
    groups: tuple[tuple[int, bytes], ...] = ()


@dataclass(slots=True)
class _Plan:
    """Rows whose addresses are still offsets in one of the parts."""

    images: tuple[bytearray, bytearray, bytearray] = field(default_factory=lambda: (bytearray(), bytearray(), bytearray()))
    rows: list[tuple[int, ...]] = field(default_factory=list)
    moved: list[dict[int, int]] = field(default_factory=list)

    def room(self, part: int, content: bytes) -> int:
        """Its offset; every piece begins at a multiple of eight."""
        image = self.images[part]
        offset = len(image)
        image += content.ljust(-(-len(content) // 8) * 8, b"\0")
        return offset

    def ask(self, part: int, name: str, arguments: Sequence[int], offsets: dict[int, tuple[int, int]]) -> None:
        """One more call, its result told in a part; what its arguments point to, by place in the row: part and offset."""
        self.rows.append(row(name, *arguments))
        result = (part, self.room(part, bytes(8)))
        self.moved.append({place: _tagged(*where) for place, where in {**offsets, 7: result}.items()})

    def option(self, part: int, level: int, number: int, content: bytes, *, to: int | None = None) -> None:
        """Ask for an option; its content goes to another part where that is not to be compared as a whole."""
        kept = part if to is None else to
        value, length = self.room(kept, content), self.room(kept, len(content).to_bytes(8, "little"))
        self.ask(part, "getsockopt", (0, level, number, 0, 0), {4: (kept, value), 5: (kept, length)})

    def name(self, call: str) -> None:
        """Ask for an address."""
        value, length = self.room(STATE, bytes(NAME_SIZE)), self.room(STATE, NAME_SIZE.to_bytes(8, "little"))
        self.ask(STATE, call, (0, 0, 0), {2: (STATE, value), 3: (STATE, length)})


def _tagged(part: int, offset: int) -> int:
    return part << 32 | offset


@dataclass(frozen=True, slots=True, eq=False)
class Questions:
    """All that is asked of sockets of one kind.

    Attributes:
        words: the rows, with offsets instead of addresses.
        moved: where those are, 1 or 0.
        image: what the memory holds before.
        ends: where the parts end.
        buffers, info, polled: offsets of what is not compared as a whole; ``info`` -1 for none.
    """

    words: NDArray[np.uint64]
    moved: NDArray[np.uint64]
    image: NDArray[np.uint8]
    ends: tuple[int, int, int]
    buffers: slice
    locked: int
    info: int
    polled: int


@lru_cache(maxsize=64)
def questions(subject: Subject) -> Questions:
    """What is asked of such sockets."""
    plan = _Plan()
    plan.ask(SETTINGS, "fstat", (0, 0), {2: (SETTINGS, plan.room(SETTINGS, bytes(STAT_SIZE)))})
    buffers = ((socket.SOL_SOCKET, socket.SO_SNDBUF), (socket.SOL_SOCKET, socket.SO_RCVBUF))
    locked = len(plan.images[SETTINGS])
    plan.option(SETTINGS, socket.SOL_SOCKET, SO_BUF_LOCK, bytes(4))
    for level, number, size in subject.options:
        if (level, number) not in buffers:
            plan.option(SETTINGS, level, number, bytes(size))
    plan.ask(
        SETTINGS, "getsockopt", (0, socket.SOL_SOCKET, SO_ATTACH_FILTER, 0, 0), {5: (SETTINGS, plan.room(SETTINGS, bytes(8)))}
    )
    info = _ask_state(plan, subject)
    polled = plan.room(ASIDE, _POLL.pack(0, POLLED, 0))
    plan.ask(STATE, "poll", (0, 1, 0), {1: (ASIDE, polled)})  # its descriptor stands elsewhere
    first = len(plan.images[ASIDE])
    for level, number in buffers:
        plan.option(ASIDE, level, number, bytes(4))
    aside = slice(first, len(plan.images[ASIDE]))
    return _laid_out(plan, aside, locked, info, polled)


def _ask_state(plan: _Plan, subject: Subject) -> int:
    """What changes by itself; answers the offset of struct tcp_info."""
    info = -1
    if subject.family in _INTERNET:
        plan.name("getsockname")
    plan.name("getpeername")
    if subject.family == socket.AF_UNIX:
        plan.option(STATE, socket.SOL_SOCKET, socket.SO_PEERCRED, bytes(_CREDENTIALS_SIZE))
    if subject.protocol == socket.IPPROTO_TCP and subject.family in _INTERNET:
        info = len(plan.images[ASIDE])
        plan.option(STATE, socket.IPPROTO_TCP, socket.TCP_INFO, bytes(_TCP_INFO_SIZE), to=ASIDE)
        size = 28 if subject.family == socket.AF_INET6 else 16  # a longer one is refused
        plan.option(STATE, socket.SOL_SOCKET, SO_PEERNAME, bytes(size))
    if subject.type == socket.SOCK_STREAM:
        plan.ask(STATE, "ioctl", (0, termios.FIONREAD, 0), {3: (STATE, plan.room(STATE, bytes(4)))})
    for interface, address in subject.groups:
        is_six = int.from_bytes(address[:2], "little") == socket.AF_INET6
        level = socket.IPPROTO_IPV6 if is_six else socket.IPPROTO_IP  # a socket of AF_INET6 may be in groups of both
        asked = struct.pack("<I4x128sII", interface, address, 0, 0)
        plan.option(STATE, level, _MCAST_MSFILTER, asked)
    return info


def _laid_out(plan: _Plan, buffers: slice, locked: int, info: int, polled: int) -> Questions:
    starts = [0, len(plan.images[0]), len(plan.images[0]) + len(plan.images[1])]
    words = np.array(plan.rows, dtype=np.uint64)
    moved = np.zeros_like(words)
    for index, places in enumerate(plan.moved):
        for place, where in places.items():
            words[index, place] = starts[where >> 32] + (where & 0xFFFFFFFF)
            moved[index, place] = 1
    aside = starts[ASIDE]
    return Questions(
        words=words,
        moved=moved,
        image=np.frombuffer(b"".join(plan.images), dtype=np.uint8),
        ends=(starts[1], starts[2], starts[2] + len(plan.images[2])),
        buffers=slice(aside + buffers.start, aside + buffers.stop),
        locked=locked,
        info=aside + info if info >= 0 else -1,
        polled=aside + polled,
    )


class Asking:
    """The questions to sockets of one kind, with memory for the answers of the one that was asked last."""

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self._questions = questions(subject)
        self._memory = self._questions.image.copy()
        self._told = self._memory.data
        self._table = OwnCalls(len(self._questions.words))
        self._table.entries[:] = self._questions.words + self._questions.moved * np.uint64(self._memory.ctypes.data)
        self._always = len(self._table.entries) - BUFFERS
        self._descriptors = self._table.entries[: self._always - 1, FIRST_ARGUMENT]
        self._of_buffers = self._table.entries[self._always :, FIRST_ARGUMENT]
        self._polled = self._memory[self._questions.polled : self._questions.polled + 4].view(np.int32)

    def ask(self, descriptor: int) -> None:
        """Ask everything, through a descriptor of ours."""
        self._memory[:] = self._questions.image
        self._descriptors[:] = descriptor
        self._polled[0] = descriptor
        self._table.run(0, self._always)
        if self._has_chosen_buffers():
            self._of_buffers[:] = descriptor
            self._table.run(self._always)

    def _has_chosen_buffers(self) -> bool:
        """Whether the program has chosen the size of a buffer, or the kernel does not say; else it changes by itself."""
        place = self._questions.locked
        return bool(self._told[place] or self._told[place + RESULT_AT])

    @property
    def settings(self) -> bytes:
        """What the program has set."""
        told = bytes(self._told[: self._questions.ends[SETTINGS]])
        return told + bytes(self._told[self._questions.buffers]) if self._has_chosen_buffers() else told

    @property
    def state(self) -> bytes:
        """What has become of it otherwise; its last two bytes are what poll(2) says."""
        told, asked = self._told, self._questions
        seen = bytes(told[asked.polled + 6 : asked.polled + 8])
        state = bytes(told[asked.ends[SETTINGS] : asked.ends[STATE]])
        if asked.info < 0:
            return state + seen
        info = bytes(told[asked.info : asked.info + _TCP_INFO_SIZE])
        return state + b"".join([info[first:last] for first, last in _TCP_INFO_TOLD]) + seen


def events(state: bytes) -> int:
    """What poll(2) said."""
    return int.from_bytes(state[-2:], "little")


def sized(fresh: Mapping[tuple[int, int], bytes]) -> tuple[Option, ...]:
    """Options as `Subject` takes them, of what a fresh socket answers: a number stays one, and what is empty may be long."""
    return tuple(
        (int(level), int(number), NUMBER_SIZE if 0 < len(value) <= NUMBER_SIZE else OPTION_SIZE)
        for (level, number), value in fresh.items()
    )
