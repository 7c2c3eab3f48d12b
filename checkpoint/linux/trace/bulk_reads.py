"""Read kernel facts about many frozen threads at once, as bytes that are decoded later.

Facts that the table of calls cannot read (pending signals, more processors than it has space for) are asked once more, one by
one. So are questions that failed, and the second answer says why. All questions are asked while the threads are frozen. The
answers are decoded when a caller needs them, most of them after the threads have resumed.

Source: ptrace(2), seccomp_get_filter() in kernel/seccomp.c, get_robust_list(2), sched_getaffinity(2), proc_pid_stat(5).
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
import threading
import weakref
from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec import Struct

from checkpoint.linux import abi
from checkpoint.linux.batch_syscalls import OwnCalls, row
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.tracee import REGISTERS_SIZE, STATE_SETS, Tracee
from checkpoint.model import Rseq

TEXT_SIZE: Final = 4096
"""Room for one file of /proc; one that fills it is read again, as long as it is."""
PEEKED: Final = 1
"""Room for so many pending signals: whether there are any. A thread that has some is asked again."""
STEP: Final = 16
"""By so many threads at a time the tables grow."""
PROCESSORS_SIZE: Final = 128
"""Bytes of a set of processors: a bit for each of 1,024."""

_WORD: Final = 8
_RSEQ: Final = struct.Struct("<QIIII")
_INT: Final = struct.Struct("<i")
_PAIR: Final = struct.Struct("<QQ")
*FURTHER, (_STATE_SET, _STATE_SIZE) = STATE_SETS
"""The register sets of the extended state that come whole, and the last one, which may come short: number and size of each."""
_IOV_SIZE: Final = 16


class _Layout:
    """Offsets of what the calls about one thread write, in one area of memory."""

    registers_iov = 0
    xstate_iov = 16
    order = 32
    mask = 48
    robust = 56
    rseq = 72
    processors = 96
    priority = processors + PROCESSORS_SIZE
    pending = priority + _WORD
    text = pending + PEEKED * abi.SIGINFO_SIZE
    registers = text + TEXT_SIZE
    xstate = registers + REGISTERS_SIZE
    further = xstate + _STATE_SIZE
    size = further + len(FURTHER) * _IOV_SIZE + -(-sum(size for _, size in FURTHER) // _WORD) * _WORD


def _further_places() -> list[tuple[int, int, int]]:
    """The places of the further register sets: that of the kernel's pointer, that of the set, and its size."""
    places, place = [], _Layout.further + len(FURTHER) * _IOV_SIZE
    for index, (_, size) in enumerate(FURTHER):
        places.append((_Layout.further + index * _IOV_SIZE, place, size))
        place += size
    return places


_FURTHER_PLACES: Final = _further_places()
_REGISTERS_LENGTH: Final = _Layout.registers_iov // _WORD + 1
_XSTATE_LENGTH: Final = _Layout.xstate_iov // _WORD + 1
"""Places of the lengths that the kernel has written, in words."""

REGISTERS, MASK, RSEQ, PENDING, XSTATE, FILTER, ROBUST, PROCESSORS, IO_PRIORITY, POLICY, PRIORITY, NICE, TEXT = range(13)
CALLS: Final = TEXT + 1 + len(FURTHER)
"""About each thread; after those with a name those for the further register sets."""
NO_FILE: Final = -1
NICE_ORIGIN: Final = 20
"""getpriority(2) itself, of the kernel, answers with this less the nice value: a negative result is an error."""


class Reading(Struct, frozen=True):
    """The facts told of one thread.

    Attributes:
        registers, xstate: as `Tracee.registers` and `Tracee.xstate` give them.
        pending: signals sent to this very thread, each a whole siginfo.
        text: of a file of /proc that tells of it; empty where none was asked for.
        robust_list: head address and length.
        policy: with SCHED_RESET_ON_FORK, as sched_setscheduler(2) takes it.
        priority: in real time; 0 for an ordinary thread.
        processors: that it may run on, a bit each.
        io_priority: as ioprio_set(2) takes it.
        is_filtered: a filter of seccomp(2) judges its calls, as far as the kernel tells us: that takes CAP_SYS_ADMIN.
    """

    registers: bytes
    mask: int
    rseq: Rseq | None
    pending: tuple[bytes, ...]
    xstate: bytes
    text: bytes
    robust_list: tuple[int, int]
    policy: int
    priority: int
    nice: int
    processors: bytes
    io_priority: int
    is_filtered: bool

    @property
    def affinity(self) -> tuple[int, ...]:
        """Numbers of the processors."""
        every = int.from_bytes(self.processors, "little")
        return tuple(number for number in range(every.bit_length()) if every >> number & 1)


class Unread:
    """The facts told of one thread: those needed while it stands still, and all of them, which are read when wanted.

    Attributes:
        registers, mask, is_filtered: as in `Reading`.
        has_text: its file has answered: it is the thread for which that was opened.
    """

    __slots__ = ("_answers", "_index", "_reading", "_tracee", "has_text", "is_filtered", "mask", "registers")

    def __init__(self, answers: _Answers, index: int, tracee: Tracee, results: list[int]) -> None:
        self._answers: _Answers | None = answers
        self._index = index
        self._tracee = tracee
        self._reading: Reading | None = None
        self.has_text = results[TEXT] >= 0
        self.is_filtered = _is_filtered(results)
        if _is_complete(results):
            self.registers, self.mask = answers.registers(index), answers.mask(index)
        else:
            self.registers, self.mask = self.reading.registers, self.reading.mask

    @property
    def rseq(self) -> Rseq | None:
        """As in `Reading`, without reading the rest: asked of each thread that was stopped outside of calls."""
        return self.reading.rseq if self._answers is None else self._answers.rseq(self._index)

    @property
    def reading(self) -> Reading:
        """All of it; the thread need not stand still for that any more."""
        if self._reading is None:
            assert self._answers is not None
            self._reading, self._answers = self._answers.reading(self._index, self._tracee), None
        return self._reading


class _Area:
    """Tables of the calls about so many threads, and the memory that these write to."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._memory = np.zeros(capacity * _Layout.size, dtype=np.uint8)
        self.view = self._memory.data
        self._words = self._memory.view(np.uint64).reshape(capacity, -1)
        self.cells = self._memory.view(np.uint64).data
        self._results = np.zeros((capacity, CALLS), dtype=np.int64)
        base, answers = int(self._memory.ctypes.data), int(self._results.ctypes.data)
        rows: list[tuple[int, ...]] = []
        for index in range(capacity):
            area, answer = base + index * _Layout.size, answers + index * CALLS * _WORD
            rows += [(*made[:-1], answer + place * _WORD) for place, made in enumerate(_calls_about(area))]
            self._words[index, _Layout.registers_iov // _WORD] = area + _Layout.registers
            self._words[index, _Layout.xstate_iov // _WORD] = area + _Layout.xstate
            for iov, place, size in _FURTHER_PLACES:
                self._words[index, iov // _WORD : iov // _WORD + 2] = area + place, size
            order = abi.PeekSiginfo(0, 0, PEEKED)
            self.view[index * _Layout.size + _Layout.order :][: len(bytes(order))] = bytes(order)
        self._calls = OwnCalls(rows)
        self._rows = self._calls.entries.reshape(capacity, CALLS, -1)
        self._about: tuple[list[int], list[int]] = ([], [])

    def ask(self, tids: list[int], files: list[int]) -> list[list[int]]:
        """Make the calls about these: the results of each."""
        count = len(tids)
        self.address(tids, files)
        self._words[:count, _REGISTERS_LENGTH] = REGISTERS_SIZE
        self._words[:count, _XSTATE_LENGTH] = _STATE_SIZE
        self._calls.run(0, count * CALLS)
        found: list[list[int]] = self._results[:count].tolist()
        return found

    def address(self, tids: list[int], files: list[int]) -> None:
        """Fill in the threads that the calls are about."""
        if (tids, files) == self._about:
            return
        self._about = tids, files
        rows, ids = self._rows[: len(tids)], np.array(tids, dtype=np.uint64)
        rows[:, : FILTER + 1, 2] = ids[:, None]
        rows[:, TEXT + 1 :, 2] = ids[:, None]
        rows[:, IO_PRIORITY, 2] = ids
        rows[:, NICE, 2] = ids
        for place in (ROBUST, PROCESSORS, POLICY, PRIORITY):
            rows[:, place, 1] = ids
        rows[:, TEXT, 1] = np.array(files, dtype=np.int64).view(np.uint64)


class _Answers:
    """The facts told of all threads at once, as bytes. While this object is held, its memory is not written to again."""

    __slots__ = ("__weakref__", "_area", "_files", "_results")

    def __init__(self, area: _Area, results: list[list[int]], files: Sequence[int]) -> None:
        self._area = area
        self._results = results
        self._files = files

    def reading(self, index: int, tracee: Tracee) -> Reading:
        """All that was told of a thread.

        Args:
            tracee: is asked what has failed, and must stand still if anything has.

        Raises:
            ProcessGoneError: it has been killed.
        """
        at, view, results = index * _Layout.size, self._area.view, self._results[index]
        return Reading(
            registers=self.registers(index) if results[REGISTERS] == 0 else tracee.registers(),
            mask=self.mask(index) if results[MASK] == 0 else tracee.signal_mask(),
            rseq=self.rseq(index) if results[RSEQ] > 0 else tracee.rseq(),
            pending=tracee.pending(shared=False) if results[PENDING] else (),
            xstate=self._xstate(index) if not (results[XSTATE] or any(results[TEXT + 1 :])) else tracee.xstate(),
            text=self._text(at, results[TEXT], self._files[index]),
            robust_list=_PAIR.unpack_from(view, at + _Layout.robust) if results[ROBUST] == 0 else abi.robust_list(tracee.pid),
            policy=results[POLICY] if results[POLICY] >= 0 else os.sched_getscheduler(tracee.pid),
            priority=_INT.unpack_from(view, at + _Layout.priority)[0]
            if results[PRIORITY] == 0
            else os.sched_getparam(tracee.pid).sched_priority,
            nice=NICE_ORIGIN - results[NICE] if results[NICE] > 0 else os.getpriority(os.PRIO_PROCESS, tracee.pid),
            processors=self._processors(at, tracee.pid, results[PROCESSORS]),
            io_priority=max(results[IO_PRIORITY], 0),
            is_filtered=_is_filtered(results),
        )

    def registers(self, index: int) -> bytes:
        """As many bytes as the kernel has written."""
        begin = index * _Layout.size + _Layout.registers
        return bytes(self._area.view[begin : begin + self._word(index, _REGISTERS_LENGTH)])

    def mask(self, index: int) -> int:
        """The mask of blocked signals."""
        return self._word(index, _Layout.mask // _WORD)

    def rseq(self, index: int) -> Rseq | None:
        """Its registration for restartable sequences."""
        address, size, signature, flags, _ = _RSEQ.unpack_from(self._area.view, index * _Layout.size + _Layout.rseq)
        return Rseq(address, size, signature, flags) if address else None

    def _word(self, index: int, place: int) -> int:
        return self._area.cells[index * (_Layout.size // _WORD) + place]

    def _xstate(self, index: int) -> bytes:
        begin = index * _Layout.size + _Layout.xstate
        last, at = self._area.view[begin : begin + self._word(index, _XSTATE_LENGTH)], index * _Layout.size
        return b"".join([*(self._area.view[at + place :][:size] for _, place, size in _FURTHER_PLACES), last])

    def _text(self, at: int, result: int, file: int) -> bytes:
        if 0 <= result < TEXT_SIZE:
            return bytes(self._area.view[at + _Layout.text :][:result])
        return b"" if file == NO_FILE or result < 0 else os.pread(file, procfs.READ_SIZE, 0)

    def _processors(self, at: int, tid: int, result: int) -> bytes:
        if result > 0:
            return bytes(self._area.view[at + _Layout.processors :][:result])
        every = sum(1 << number for number in os.sched_getaffinity(tid))
        return every.to_bytes(-(-every.bit_length() // 8), "little")


def _is_complete(results: Sequence[int]) -> bool:
    """Whether the calls about a thread have brought all that was asked."""
    registers, mask, rseq, pending, xstate, _, robust, processors, _, policy, priority, nice, text, *further = results
    if registers or mask or pending or xstate or robust or priority or any(further):
        return False
    return rseq > 0 < processors and policy >= 0 < nice and text < TEXT_SIZE


def _is_filtered(results: Sequence[int]) -> bool:
    return results[FILTER] >= 0 or results[FILTER] == -errno.EMEDIUMTYPE


class Readings:
    """Asks about the threads of one process, again and again. Every call from the thread that traces them."""

    def __init__(self) -> None:
        self._area = _Area(1)
        self._given: weakref.ref[_Answers] | None = None

    def read(self, tracees: Sequence[Tracee], files: Sequence[int]) -> list[Unread]:
        """Ask about these; they stand still. Earlier answers stay as they were.

        Args:
            files: for each a descriptor of a file of /proc that tells of it; `NO_FILE` if none is wanted.

        Raises:
            ProcessGoneError: one of them has been killed.
        """
        if self._is_taken() or len(tracees) > self._area.capacity:
            self._area = _Area(max(self._area.capacity, 1 if len(tracees) == 1 else -(-len(tracees) // STEP) * STEP))
        results = self._area.ask([tracee.pid for tracee in tracees], list(files))
        answers = _Answers(self._area, results, files)
        self._given = weakref.ref(answers)
        return [Unread(answers, index, tracee, results[index]) for index, tracee in enumerate(tracees)]

    def _is_taken(self) -> bool:
        """Whether a caller still holds the last answers."""
        return self._given is not None and self._given() is not None

    def rehearse(self, tid: int, file: int) -> None:
        """Ask about our own thread, which is not traced, and forget the answers.

        Args:
            tid, file: what the next `read` is about, if there is but one thread.
        """
        if not self._is_taken():
            self._area.ask([threading.get_native_id()], [file])
            self._area.address([tid], [file])


class Waiting:
    """Tells, again and again, which signals wait for one thread and its process. Every call from the thread that traces it."""

    def __init__(self, tracee: Tracee) -> None:
        self._tracee = tracee
        self._orders = (abi.PeekSiginfo(0, 0, PEEKED), abi.PeekSiginfo(0, abi.PTRACE_PEEKSIGINFO_SHARED, PEEKED))
        self._found = np.zeros(abi.SIGINFO_SIZE, dtype=np.uint8)
        self._results = np.zeros(len(self._orders), dtype=np.int64)
        into, answers = int(self._found.ctypes.data), int(self._results.ctypes.data)
        self._calls = OwnCalls(
            [
                row("ptrace", abi.PTRACE_PEEKSIGINFO, tracee.pid, ctypes.addressof(order), into, to=answers + place * _WORD)
                for place, order in enumerate(self._orders)
            ]
        )

    def read(self) -> tuple[bytes, ...]:
        """The pending signals of the thread, then of the process. Raises as `Tracee.pending`; there are seldom any."""
        self._calls.run()
        if not self._results.any():
            return ()
        return (*self._tracee.pending(shared=False), *self._tracee.pending(shared=True))


def _calls_about(area: int) -> list[tuple[int, ...]]:
    """The calls about one thread, in the order of `CALLS`; its id is still to be filled in.

    Args:
        area: where they write.
    """
    return [
        row("ptrace", abi.PTRACE_GETREGSET, 0, abi.NT_PRSTATUS, area + _Layout.registers_iov),
        row("ptrace", abi.PTRACE_GETSIGMASK, 0, abi.SIGSET_SIZE, area + _Layout.mask),
        row("ptrace", abi.PTRACE_GET_RSEQ_CONFIGURATION, 0, _RSEQ.size, area + _Layout.rseq),
        row("ptrace", abi.PTRACE_PEEKSIGINFO, 0, area + _Layout.order, area + _Layout.pending),
        row("ptrace", abi.PTRACE_GETREGSET, 0, _STATE_SET, area + _Layout.xstate_iov),
        row("ptrace", abi.PTRACE_SECCOMP_GET_FILTER, 0, 0, 0),  # the oldest one's length
        row("get_robust_list", 0, area + _Layout.robust, area + _Layout.robust + _WORD),
        row("sched_getaffinity", 0, PROCESSORS_SIZE, area + _Layout.processors),
        row("ioprio_get", abi.IOPRIO_WHO_PROCESS, 0),
        row("sched_getscheduler", 0),
        row("sched_getparam", 0, area + _Layout.priority),
        row("getpriority", os.PRIO_PROCESS, 0),
        row("pread64", 0, area + _Layout.text, TEXT_SIZE, 0),
        *(
            row("ptrace", abi.PTRACE_GETREGSET, 0, kind, area + iov)
            for (kind, _), (iov, _, _) in zip(FURTHER, _FURTHER_PLACES, strict=True)
        ),
    ]
