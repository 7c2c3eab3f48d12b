"""Query everything about one socket by one table of system calls, with answers as bytes that can be compared.

This module does not decode an answer: the same bytes mean the same state as before. The answers come in two parts, because only
the program sets one part, and the other changes with what comes from outside.

Source: getsockopt(2), poll(2), tcp(7), udp(7), unix(7).
"""

from __future__ import annotations

import select
import socket
import struct
import termios
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from msgspec import Struct, field

from checkpoint.linux.batch_syscalls import FIRST_ARGUMENT, ROW, OwnCalls, row
from checkpoint.linux.syscall_thread import SecondThread
from checkpoint.runtime.lazy_numpy import NDArray

Option = tuple[int, int, int]
"""Level, number and size of an option."""
Told = tuple[bytes, bytes]
"""A socket's settings by the program, and its other state; the last two bytes are the events of poll(2)."""

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
"""Parts of struct tcp_info: state; connections that a listener holds; bytes received, not sent yet, sent and sent again. The
rest is times and estimates."""
_CREDENTIALS_SIZE: Final = 12
_MCAST_MSFILTER: Final = 48
_POLL: Final = struct.Struct("<ihH")
POLLED: Final = select.POLLIN | select.POLLPRI | select.POLLRDHUP
_INTERNET: Final = (socket.AF_INET, socket.AF_INET6)

WORTH_SHARING: Final = 16
"""As many sockets of a kind are asked by two threads: to wake the second takes as long as to ask two or three."""
BUFFERS: Final = 2
"""Rows at the end of a table: the sizes of the buffers, which are asked for only where the program has chosen one."""
RESULT_AT: Final = 16
"""Where the result of the question for a number stands, after that and its length."""
SETTINGS, STATE, ASIDE = range(3)
"""Parts of the memory in which the answers stand; the last is not compared."""


class Subject(Struct, frozen=True):
    """The questions to a socket follow from this.

    Attributes:
        options: those that a fresh one of its form has.
        groups: (interface, address as bind(2) takes one) of multicast groups that it may have joined.
    """

    family: int
    type: int
    protocol: int
    options: tuple[Option, ...]
    groups: tuple[tuple[int, bytes], ...] = ()


class _Plan(Struct):
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


class Questions(Struct, frozen=True, eq=False):
    """All questions to sockets of one kind.

    Attributes:
        words: the rows, with offsets instead of addresses.
        moved: where those are, 1 or 0.
        image: what the memory holds before.
        ends: where the parts end.
        buffers, info, polled: offsets of answers that are not compared as a whole, from `ends[STATE]` on; ``info`` -1 for none.
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
    """The questions to such sockets."""
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
    at_once = plan.room(ASIDE, bytes(16))
    polled = plan.room(ASIDE, _POLL.pack(0, POLLED, 0))
    plan.ask(STATE, "ppoll", (0, 1, 0, 0, 0), {1: (ASIDE, polled), 3: (ASIDE, at_once)})  # its descriptor stands elsewhere
    first = len(plan.images[ASIDE])
    for level, number in buffers:
        plan.option(ASIDE, level, number, bytes(4))
    aside = slice(first, len(plan.images[ASIDE]))
    return _laid_out(plan, aside, locked, info, polled)


def _ask_state(plan: _Plan, subject: Subject) -> int:
    """Plan the questions about state that changes by itself; answers the offset of struct tcp_info."""
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
    return Questions(
        words=words,
        moved=moved,
        image=np.frombuffer(b"".join(plan.images), dtype=np.uint8),
        ends=(starts[1], starts[2], starts[2] + len(plan.images[2])),
        buffers=buffers,
        locked=locked,
        info=info,
        polled=polled,
    )


class _Sheet:
    """Questions to so many sockets of one kind, and memory for their answers.

    Attributes:
        memory: (capacity, bytes) settings and states, in the order of those that are asked.
        aside: (capacity, bytes) the answers that are not compared as a whole.
        table: the calls, those about one socket after the other.
        of_buffers: the same of `BUFFERS`.

    Invariant: the memory of `_used` and all later ones is as it must be before they are asked.
    """

    def __init__(self, asked: Questions, capacity: int) -> None:
        compared = asked.ends[STATE]
        self._image, self._image_aside = asked.image[:compared], asked.image[compared:]
        self._always = always = len(asked.words) - BUFFERS
        self.memory: NDArray[np.uint8] = np.zeros((capacity, compared), dtype=np.uint8)
        self.aside: NDArray[np.uint8] = np.zeros((capacity, len(self._image_aside)), dtype=np.uint8)
        places = np.arange(capacity, dtype=np.uint64)[:, None, None]
        starts = np.uint64(self.memory.ctypes.data) + places * np.uint64(compared)
        starts_aside = np.uint64(self.aside.ctypes.data - compared) + places * np.uint64(len(self._image_aside))
        is_aside = asked.words >= compared
        words = asked.words + asked.moved * np.where(is_aside, starts_aside, starts)
        self.table, self.of_buffers = OwnCalls(capacity * always), OwnCalls(capacity * BUFFERS)
        self.table.entries[:] = words[:, :always].reshape(-1, ROW)
        self.of_buffers.entries[:] = words[:, always:].reshape(-1, ROW)
        self._descriptors = self.table.entries.reshape(capacity, always, ROW)[:, :-1, FIRST_ARGUMENT]
        self._descriptors_of_buffers = self.of_buffers.entries.reshape(capacity, BUFFERS, ROW)[:, :, FIRST_ARGUMENT]
        self._used = capacity
        self._addressed = np.full(capacity, -1, dtype=np.int64)
        self._polled = self.aside.reshape(-1).view(np.int32).reshape(capacity, -1)[:, asked.polled // 4]

    def forget(self) -> None:
        """Forget all answers, so that it need not be done when it is asked."""
        self._forget(0, self._used)
        self._used = 0

    def _forget(self, first: int, last: int) -> None:
        self.memory[first:last] = self._image
        self.aside[first:last] = self._image_aside
        self._polled[first:last] = self._addressed[first:last]

    def address(self, first: int, descriptors: NDArray[np.int64]) -> None:
        """Have the questions from the first place on go to these."""
        last = first + len(descriptors)
        if first < self._used:
            self._forget(first, last)
        self._used = max(self._used, last)
        if not (self._addressed[first:last] == descriptors).all():  # copies of the same have the same numbers, as a rule
            self._addressed[first:last] = self._polled[first:last] = descriptors
            self._descriptors[first:last] = descriptors[:, None]

    def ask(self, first: int, descriptors: NDArray[np.int64]) -> None:
        """Ask them."""
        self.address(first, descriptors)
        self.table.run(first * self._always, (first + len(descriptors)) * self._always)

    def take_over(self, first: int, other: _Sheet, count: int) -> None:
        """Have from a place on what so many have answered that were asked by another sheet, the last one first."""
        last = first + count
        self._used = max(self._used, last)
        self.memory[first:last] = other.memory[:count][::-1]
        self.aside[first:last] = other.aside[:count][::-1]

    def ask_of_buffers(self, index: int, descriptor: int) -> None:
        """Ask one more of one."""
        self._descriptors_of_buffers[index] = descriptor
        self.of_buffers.run(index * BUFFERS, (index + 1) * BUFFERS)


class Asking:
    """The questions to sockets of one kind, with memory for the answers of those that were asked last."""

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self._questions = questions(subject)
        self._always = len(self._questions.words) - BUFFERS
        self._capacity = self._capacity_of_second = self._more = 0
        self._chosen: list[int] = []
        self.reserve(1)

    def reserve(self, capacity: int, *, is_shared: bool = False) -> None:
        """Have room for the answers of so many at once.

        Args:
            is_shared: a second thread may ask some of them.
        """
        if capacity > self._capacity:
            self._capacity, self._sheet = capacity, _Sheet(self._questions, capacity)
        share = capacity // 2 if is_shared and capacity >= WORTH_SHARING else 0
        if share > self._capacity_of_second:
            self._capacity_of_second, self._sheet_of_second = share, _Sheet(self._questions, share)

    def prepare(self, second: SecondThread | None = None) -> None:
        """Do what need not be done while it is waited for the answers."""
        self._sheet.forget()
        if second is not None and second.is_at_rest() and self._capacity_of_second:
            self._sheet_of_second.forget()

    def ask(self, descriptor: int) -> Told:
        """Ask everything, through a descriptor of ours."""
        return self.ask_each([descriptor])[0]

    def ask_each(self, descriptors: Sequence[int], second: SecondThread | None = None) -> list[Told]:
        """The same of many, in one go; see `hear`."""
        return self.told(self.hear(descriptors, second))

    def hear(self, descriptors: Sequence[int], second: SecondThread | None = None) -> bytes:
        """All that many answer: the same bytes, of the same sockets in the same order, mean that each has answered the same.

        Args:
            second: asks up to half of them, as far as there is memory for that.
        """
        count, numbers = len(descriptors), np.array(descriptors, dtype=np.int64)
        self.reserve(count)
        if second is None or count < WORTH_SHARING or not self._ask_with(second, numbers):
            self._sheet.ask(0, numbers)
        self._chosen = self._have_chosen_buffers(count)
        for index in self._chosen:
            self._sheet.ask_of_buffers(index, descriptors[index])
        return self._heard(count)

    def _ask_with(self, second: SecondThread, numbers: NDArray[np.int64]) -> bool:
        """Ask from the front while a second thread asks from the back; we also ask what it has not finished by then.

        False, and nothing was asked, where that thread is busy still.
        """
        count, ours, theirs = len(numbers), self._sheet, self._sheet_of_second
        share = min(count // 2, self._capacity_of_second)
        if not second.is_at_rest():
            return False
        theirs.address(0, numbers[: count - share - 1 : -1])
        second.begin(theirs.table, share * self._always, theirs)
        try:
            asked, more = 0, count - share
            while more:
                ours.ask(asked, numbers[asked : asked + more])
                asked += more
                left = count - asked - second.made() // self._always
                more = max(1, left // 4) if left > 0 else 0
        finally:
            second.stop()
        ours.take_over(asked, theirs, count - asked)
        return True

    def _have_chosen_buffers(self, count: int) -> list[int]:
        """Where the program has chosen the size of a buffer, or the kernel does not say; else it changes by itself."""
        locked, place = self._sheet.memory[:count], self._questions.locked
        found: list[int] = np.flatnonzero(locked[:, place] | locked[:, place + RESULT_AT]).tolist()
        return found

    def _heard(self, count: int) -> bytes:
        """Settings and state of each, what else tells of the state of each, and the sizes of buffers of which they were asked."""
        asked, aside = self._questions, self._sheet.aside[:count]
        more = [aside[:, asked.polled + 6 : asked.polled + 8]]
        if asked.info >= 0:
            more = [aside[:, asked.info + first : asked.info + last] for first, last in _TCP_INFO_TOLD] + more
        self._more = sum(part.shape[1] for part in more)
        buffers = aside[self._chosen, asked.buffers].tobytes() if self._chosen else b""
        joined = np.concatenate(more, axis=1) if len(more) > 1 else more[0]
        return b"".join((self._sheet.memory[:count].tobytes(), joined.tobytes(), buffers))

    def told(self, heard: bytes) -> list[Told]:
        """Of each, from the last answers: its settings, and its state."""
        (end, size, _), more, buffers = self._questions.ends, self._more, self._questions.buffers
        each = buffers.stop - buffers.start
        of_buffers = len(heard) - each * len(self._chosen)
        count = of_buffers // (size + more)
        found = [
            (heard[at : at + end], heard[at + end : at + size] + heard[rest : rest + more])
            for at, rest in zip(range(0, count * size, size), range(count * size, of_buffers, more), strict=True)
        ]
        for index, at in zip(self._chosen, range(of_buffers, len(heard), each), strict=True):
            settings, state = found[index]
            found[index] = settings + heard[at : at + each], state
        return found


def events(state: bytes) -> int:
    """The events of poll(2)."""
    return int.from_bytes(state[-2:], "little")


def sized(fresh: Mapping[tuple[int, int], bytes]) -> tuple[Option, ...]:
    """Options as `Subject` takes them, from a fresh socket's answers: a number stays one, and an empty option may become long."""
    return tuple(
        (int(level), int(number), NUMBER_SIZE if 0 < len(value) <= NUMBER_SIZE else OPTION_SIZE)
        for (level, number), value in fresh.items()
    )
