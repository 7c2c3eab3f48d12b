"""Send many threads to the desks of the borrowed pages and fetch them back at once.

These are steps 2 to 5 of `checkpoint.linux.trace.remote_syscalls`. This module handles only the normal case. It leaves all other
cases to the code that does the same with one thread after the other; that code says why a step failed.
"""

from __future__ import annotations

import array
import os
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from checkpoint.arch import cpu as arch
from checkpoint.linux import abi
from checkpoint.linux.batch_syscalls import FIRST_ARGUMENT, ROW, OwnCalls, row
from checkpoint.linux.trace.tracee import PLAIN_STOP, SPIN_S, Tracee, rest

WORD: Final = 8
REGISTERS_ROOM: Final = 512
START, LOOK, INTERRUPT, STAND, GIVE_BACK = range(5)
"""Groups of calls, each made about all threads in one go."""
CALLS: Final = (3, 1, 1, 2, 2)
"""Calls of each group about one thread."""


_POINTER: Final = arch.REGISTER_NAMES.index(arch.INSTRUCTION_POINTER)
"""Its place among the registers, in words."""


class _Layout:
    """Offsets of what belongs to one thread."""

    there_iov = 0
    back_iov = 16
    found_iov = 32
    mask = 48
    every_signal = 56
    status = 64
    siginfo = 72
    there = siginfo + abi.SIGINFO_SIZE
    back = there + REGISTERS_ROOM
    found = back + REGISTERS_ROOM
    size = found + REGISTERS_ROOM
    registers = ((there_iov, there), (back_iov, back), (found_iov, found))


class Round:
    """The calls for up to so many threads at once. Every call from the thread that traces them."""

    def __init__(self, capacity: int) -> None:
        self._memory = np.zeros((capacity, _Layout.size), dtype=np.uint8)
        self._words = self._memory.view(np.uint64)
        base = int(self._memory.ctypes.data)
        places = [base + index * _Layout.size for index in range(capacity)]
        by_thread = [_calls_about(place) for place in places]
        rows = [made for group in range(len(CALLS)) for calls in by_thread for made in calls[group]]
        self._results = array.array("q", bytes(WORD * len(rows)))
        answers = self._results.buffer_info()[0]
        self._calls = OwnCalls([(*made[:-1], answers + index * WORD) for index, made in enumerate(rows)])
        self._firsts = [capacity * sum(CALLS[:group]) for group in range(len(CALLS))]
        self._tids: list[int] = []
        for index, place in enumerate(places):
            for iov, buffer in _Layout.registers:
                self._words[index, iov // WORD] = place + buffer
                self._words[index, iov // WORD + 1] = arch.REGISTERS_SIZE
        self._words[:, _Layout.every_signal // WORD] = abi.ALL_SIGNALS

    def start(self, tracees: Sequence[Tracee], codes: Sequence[int], registers: Sequence[bytes], masks: Sequence[int]) -> bool:
        """Have each run the code at its place; False when one did not take it: it has been killed.

        Args:
            registers, masks: that each stands with; `give_back` sets them again.
        """
        self._address([tracee.pid for tracee in tracees])
        for tracee in tracees:
            tracee.is_as_found = False
        count = len(tracees)
        found = np.frombuffer(b"".join(registers), dtype=np.uint8).reshape(count, arch.REGISTERS_SIZE)
        self._memory[:count, _Layout.back : _Layout.back + arch.REGISTERS_SIZE] = found
        self._memory[:count, _Layout.there : _Layout.there + arch.REGISTERS_SIZE] = found
        self._words[:count, _Layout.there // WORD + _POINTER] = np.array(codes, dtype=np.uint64)
        for place, word in arch.OUTSIDE_OF_CALLS:
            self._words[:count, _Layout.there // WORD + place] = word
        for place, bit in arch.STEPPING:  # our code would end the program: every signal is blocked, and this one forced
            self._words[:count, _Layout.there // WORD + place] &= ~np.uint64(bit)
        self._words[:count, _Layout.mask // WORD] = np.array(masks, dtype=np.uint64)
        return not any(self._run(START))

    def ask_to_stop(self) -> list[bool] | None:
        """Ask all started threads to stop; answers which take it; None when one stands already, and none was asked."""
        pids = self._memory[: len(self._tids), _Layout.siginfo + abi.SIGINFO_PID : _Layout.siginfo + abi.SIGINFO_PID + 4]
        if any(self._run(LOOK)) or pids.any():
            return None
        return [result == 0 for result in self._run(INTERRUPT)]

    def await_stops(self, tracees: Sequence[Tracee], asked: Sequence[bool]) -> list[bool]:
        """Wait for a moment for the stops of the asked threads; answers which stand."""
        stand = [False] * len(tracees)
        began = now = time.perf_counter()
        waiting = [index for index, was_asked in enumerate(asked) if was_asked]
        is_here = False
        while waiting and now - began < SPIN_S:
            results = self._run(STAND)[::2]
            for index in [index for index in waiting if results[index] == tracees[index].pid]:
                status = int(self._words[index, _Layout.status // WORD]) & 0xFFFFFFFF
                if status == PLAIN_STOP:
                    tracees[index].stopped_by, stand[index] = 0, True
                    waiting.remove(index)
                elif not os.WIFSTOPPED(status):
                    waiting.remove(index)  # it has ended
                elif (stop := tracees[index].stop_of(status)).is_delivery:
                    tracees[index].cont(stop.signal)
                else:
                    stand[index] = True
                    waiting.remove(index)
            if waiting:
                is_here = is_here or (now == began and len(waiting) == 1 and tracees[waiting[0]].is_here())
                rest(now - began, is_here=is_here)
                now = time.perf_counter()
        return stand

    def give_back(self, is_ours: Callable[[int], bool]) -> bool:
        """Set all started threads where they stood; they stand. False when one was killed, or has left our code by itself."""
        if any(self._results[self._firsts[STAND] + 1 :][: 2 * len(self._tids) : 2]):
            return False
        if not all(map(is_ours, self._words[: len(self._tids), _Layout.found // WORD + _POINTER].tolist())):
            return False
        return not any(self._run(GIVE_BACK))

    def rehearse(self, tid: int) -> None:
        """Make all of the calls about ourselves: we are not traced, nor our own child, so the kernel refuses each.

        Args:
            tid: the thread that the next ones are about.
        """
        self._address([threading.get_native_id()])
        for group in range(len(CALLS)):
            self._run(group)
        self._address([tid])

    def _address(self, tids: list[int]) -> None:
        """Fill in the threads that the calls are about."""
        if tids == self._tids:
            return
        self._tids = tids
        ids = np.array(tids, dtype=np.uint64)
        for group, count in enumerate(CALLS):
            first = self._firsts[group]
            rows = self._calls.entries[first : first + count * len(tids)].reshape(len(tids), count, ROW)
            if group == STAND:
                rows[:, 0, FIRST_ARGUMENT] = ids
                rows[:, 1:, FIRST_ARGUMENT + 1] = ids[:, None]
            else:
                rows[:, :, FIRST_ARGUMENT + 1] = ids[:, None]

    def _run(self, group: int) -> array.array[int]:
        """Make one group of calls: the results, those about one thread together."""
        first = self._firsts[group]
        last = first + CALLS[group] * len(self._tids)
        self._calls.run(first, last)
        return self._results[first:last]


def _calls_about(area: int) -> tuple[tuple[tuple[int, ...], ...], ...]:
    """The calls about one thread, by group; its id is still to be filled in.

    Args:
        area: what belongs to it.
    """
    looked = os.WEXITED | os.WSTOPPED | os.WNOHANG | os.WNOWAIT | abi.WALL
    return (
        (
            row("ptrace", abi.PTRACE_SETREGSET, 0, abi.NT_PRSTATUS, area + _Layout.there_iov),
            row("ptrace", abi.PTRACE_SETSIGMASK, 0, abi.SIGSET_SIZE, area + _Layout.every_signal),
            row("ptrace", abi.PTRACE_CONT, 0, 0, 0),
        ),
        (row("waitid", os.P_PID, 0, area + _Layout.siginfo, looked, 0),),
        (row("ptrace", abi.PTRACE_INTERRUPT, 0, 0, 0),),
        (
            row("wait4", 0, area + _Layout.status, abi.WALL | os.WNOHANG, 0),
            row("ptrace", abi.PTRACE_GETREGSET, 0, abi.NT_PRSTATUS, area + _Layout.found_iov),
        ),
        (
            row("ptrace", abi.PTRACE_SETSIGMASK, 0, abi.SIGSET_SIZE, area + _Layout.mask),
            row("ptrace", abi.PTRACE_SETREGSET, 0, abi.NT_PRSTATUS, area + _Layout.back_iov),
        ),
    )
