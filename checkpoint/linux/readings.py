"""What the kernel tells of threads that stand still: of many in one go, kept as bytes until somebody has the time to read them.

What the table of calls cannot bring (pending signals, more processors than it has room for) is asked once more, singly; so
is what failed, and that says why.

Source: ptrace(2), seccomp_get_filter() in kernel/seccomp.c, get_robust_list(2), sched_getaffinity(2), proc_pid_stat(5).
"""

from __future__ import annotations

import errno
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from checkpoint.linux import abi, procfs
from checkpoint.linux.own_calls import OwnCalls, row
from checkpoint.linux.tracee import REGISTERS_SIZE, XSTATE_SIZE, Tracee
from checkpoint.model import Rseq

TEXT_SIZE: Final = 4096
"""Room for one file of /proc; one that fills it is read again, as long as it is."""
PEEKED: Final = 1
"""Room for so many pending signals: whether there are any. A thread that has some is asked again."""
PROCESSORS_SIZE: Final = 128
"""Bytes of a set of processors: a bit for each of 1,024."""

_RSEQ: Final = struct.Struct("<QIIII")
_PAIR: Final = struct.Struct("<QQ")
_WORD: Final = 8


class _Layout:
    """Offsets of what the calls about one thread write, in one area of memory."""

    registers_iov = 0
    xstate_iov = 16
    order = 32
    mask = 48
    robust = 56
    rseq = 72
    processors = 96
    pending = processors + PROCESSORS_SIZE
    text = pending + PEEKED * abi.SIGINFO_SIZE
    registers = text + TEXT_SIZE
    xstate = registers + REGISTERS_SIZE
    size = xstate + XSTATE_SIZE


CALLS: Final = 11
"""About each thread."""
REGISTERS, MASK, RSEQ, PENDING, XSTATE, FILTER, ROBUST, PROCESSORS, IO_PRIORITY, POLICY, TEXT = range(CALLS)
NO_FILE: Final = -1


@dataclass(frozen=True, slots=True)
class Reading:
    """What was told of one thread.

    Attributes:
        registers, xstate: as `Tracee.registers` and `Tracee.xstate` give them.
        pending: signals sent to this very thread, each a whole siginfo.
        stat_text: its /proc/PID/task/TID/stat; empty where it was not asked for.
        robust_list: head address and length.
        policy: with SCHED_RESET_ON_FORK, as sched_setscheduler(2) takes it.
        processors: that it may run on, a bit each.
        io_priority: as ioprio_set(2) takes it.
        is_filtered: a filter of seccomp(2) judges its calls, as far as the kernel tells us: that takes CAP_SYS_ADMIN.
    """

    registers: bytes
    mask: int
    rseq: Rseq | None
    pending: tuple[bytes, ...]
    xstate: bytes
    stat_text: bytes
    robust_list: tuple[int, int]
    policy: int
    processors: bytes
    io_priority: int
    is_filtered: bool

    @property
    def affinity(self) -> tuple[int, ...]:
        """Numbers of the processors."""
        every = int.from_bytes(self.processors, "little")
        return tuple(number for number in range(every.bit_length()) if every >> number & 1)


class Readings:
    """Asks about the threads of one process, again and again. Every call from the thread that traces them."""

    def __init__(self) -> None:
        self._grow(1)

    def _grow(self, capacity: int) -> None:
        self._capacity = capacity
        self._memory = np.zeros(capacity * _Layout.size, dtype=np.uint8)
        self._view = self._memory.data
        self._words = self._memory.view(np.uint64).reshape(capacity, -1)
        self._results = np.zeros((capacity, CALLS), dtype=np.int64)
        base, answers = int(self._memory.ctypes.data), int(self._results.ctypes.data)
        rows: list[tuple[int, ...]] = []
        for index in range(capacity):
            area, answer = base + index * _Layout.size, answers + index * CALLS * _WORD
            rows += [(*made[:-1], answer + place * _WORD) for place, made in enumerate(_calls_about(area))]
            self._words[index, _Layout.registers_iov // _WORD] = area + _Layout.registers
            self._words[index, _Layout.xstate_iov // _WORD] = area + _Layout.xstate
            order = abi.PeekSiginfo(0, 0, PEEKED)
            self._view[index * _Layout.size + _Layout.order :][: len(bytes(order))] = bytes(order)
        self._calls = OwnCalls(rows)
        self._rows = self._calls.entries.reshape(capacity, CALLS, -1)
        self._about: tuple[list[int], list[int]] = ([], [])

    def read(self, tracees: Sequence[Tracee], stats: Sequence[int]) -> list[Reading]:
        """Ask about these; they stand still.

        Args:
            stats: for each a descriptor of its stat file; `NO_FILE` if that is not wanted.

        Raises:
            ProcessGoneError: one of them has been killed.
        """
        count = len(tracees)
        if count > self._capacity:
            self._grow(-(-count // 16) * 16)
        about = [tracee.pid for tracee in tracees], list(stats)
        if about != self._about:
            self._address(*about)
            self._about = about
        self._words[:count, _Layout.registers_iov // _WORD + 1] = REGISTERS_SIZE
        self._words[:count, _Layout.xstate_iov // _WORD + 1] = XSTATE_SIZE
        self._calls.run(0, count * CALLS)
        results = self._results[:count].tolist()
        return [self._reading(index, tracee, results[index], stats[index]) for index, tracee in enumerate(tracees)]

    def _address(self, tids: list[int], stats: list[int]) -> None:
        """Fill in whom the calls are about."""
        rows, ids = self._rows[: len(tids)], np.array(tids, dtype=np.uint64)
        rows[:, : FILTER + 1, 2] = ids[:, None]
        rows[:, IO_PRIORITY, 2] = ids
        for place in (ROBUST, PROCESSORS, POLICY):
            rows[:, place, 1] = ids
        rows[:, TEXT, 1] = np.array(stats, dtype=np.int64).view(np.uint64)

    def _reading(self, index: int, tracee: Tracee, results: list[int], stat: int) -> Reading:
        at, view = index * _Layout.size, self._view
        return Reading(
            registers=self._registers(index, _Layout.registers_iov) if results[REGISTERS] == 0 else tracee.registers(),
            mask=int(self._words[index, _Layout.mask // _WORD]) if results[MASK] == 0 else tracee.signal_mask(),
            rseq=self._rseq(at) if results[RSEQ] > 0 else tracee.rseq(),
            pending=tracee.pending(shared=False) if results[PENDING] else (),
            xstate=self._registers(index, _Layout.xstate_iov) if results[XSTATE] == 0 else tracee.xstate(),
            stat_text=self._text(at, results[TEXT], stat),
            robust_list=_PAIR.unpack_from(view, at + _Layout.robust) if results[ROBUST] == 0 else abi.robust_list(tracee.pid),
            policy=results[POLICY] if results[POLICY] >= 0 else os.sched_getscheduler(tracee.pid),
            processors=self._processors(at, tracee.pid, results[PROCESSORS]),
            io_priority=max(results[IO_PRIORITY], 0),
            is_filtered=results[FILTER] >= 0 or results[FILTER] == -errno.EMEDIUMTYPE,
        )

    def _registers(self, index: int, iov: int) -> bytes:
        """As many bytes as the kernel has written."""
        place = index * _Layout.size + (_Layout.registers if iov == _Layout.registers_iov else _Layout.xstate)
        return bytes(self._view[place : place + int(self._words[index, iov // _WORD + 1])])

    def _rseq(self, at: int) -> Rseq | None:
        address, size, signature, flags, _ = _RSEQ.unpack_from(self._view, at + _Layout.rseq)
        return Rseq(address, size, signature, flags) if address else None

    def _text(self, at: int, result: int, stat: int) -> bytes:
        if 0 <= result < TEXT_SIZE:
            return bytes(self._view[at + _Layout.text :][:result])
        return b"" if stat == NO_FILE or result < 0 else os.pread(stat, procfs.READ_SIZE, 0)

    def _processors(self, at: int, tid: int, result: int) -> bytes:
        if result > 0:
            return bytes(self._view[at + _Layout.processors :][:result])
        every = sum(1 << number for number in os.sched_getaffinity(tid))
        return every.to_bytes(-(-every.bit_length() // 8), "little")


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
        row("ptrace", abi.PTRACE_GETREGSET, 0, abi.NT_X86_XSTATE, area + _Layout.xstate_iov),
        row("ptrace", abi.PTRACE_SECCOMP_GET_FILTER, 0, 0, 0),  # the oldest one's length
        row("get_robust_list", 0, area + _Layout.robust, area + _Layout.robust + _WORD),
        row("sched_getaffinity", 0, PROCESSORS_SIZE, area + _Layout.processors),
        row("ioprio_get", abi.IOPRIO_WHO_PROCESS, 0),
        row("sched_getscheduler", 0),
        row("pread64", 0, area + _Layout.text, TEXT_SIZE, 0),
    ]
