"""Seize many threads of one process, ask them to stop, check that they did, and release them, each step at once for all.

This module handles only the normal case. It leaves all other cases to the code that does the same with one thread after the other
(`checkpoint.linux.trace.threads`, which lists the races); that code says why a step failed.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec import Struct

from checkpoint.linux import abi
from checkpoint.linux.batch_syscalls import FIRST_ARGUMENT, ROW, OwnCalls, row

SEIZE, LOOK, INTERRUPT, REPORT, DETACH = range(5)
"""Groups of calls, each made about all threads in one go."""
WHOM: Final = (1, 1, 1, 0, 1)
"""Which argument of a group's calls is the thread's id."""
STEP: Final = 16
"""By so many threads at a time the tables grow."""


class Report(Struct, frozen=True):
    """The answer of wait4(2) about one thread.

    Attributes:
        status: its wait status, of which note was taken by this; None: there is none.
        is_lost: the call failed: it is not ours, or there is no such thread any more.
    """

    status: int | None
    is_lost: bool


NOTHING: Final = Report(None, is_lost=False)
LOST: Final = Report(None, is_lost=True)


class Together:
    """The calls. Every one is made from the thread that traces, of ids that are not twice among those given."""

    def __init__(self) -> None:
        self._grow(STEP)

    def _grow(self, capacity: int) -> None:
        self._capacity = capacity
        self._siginfos = np.zeros((capacity, abi.SIGINFO_SIZE), dtype=np.uint8)
        self._found = self._siginfos[:, abi.SIGINFO_PID : abi.SIGINFO_PID + 4].view(np.int32)
        self._statuses = np.zeros(capacity, dtype=np.int32)
        self._results = np.zeros((len(WHOM), capacity), dtype=np.int64)
        looked = os.WEXITED | os.WSTOPPED | os.WNOHANG | os.WNOWAIT | abi.WALL
        siginfos, statuses = int(self._siginfos.ctypes.data), int(self._statuses.ctypes.data)
        threads = range(capacity)
        rows = [
            *(row("ptrace", abi.PTRACE_SEIZE, 0, 0, 0) for _ in threads),
            *(row("waitid", os.P_PID, 0, siginfos + index * abi.SIGINFO_SIZE, looked, 0) for index in threads),
            *(row("ptrace", abi.PTRACE_INTERRUPT, 0, 0, 0) for _ in threads),
            *(row("wait4", 0, statuses + index * self._statuses.itemsize, abi.WALL | os.WNOHANG, 0) for index in threads),
            *(row("ptrace", abi.PTRACE_DETACH, 0, 0, 0) for _ in threads),
        ]
        answers = int(self._results.ctypes.data)
        self._calls = OwnCalls([(*made[:-1], answers + index * self._results.itemsize) for index, made in enumerate(rows)])
        self._rows = self._calls.entries.reshape(len(WHOM), capacity, ROW)

    def seize(self, tids: Sequence[int]) -> list[bool]:
        """Become the tracer of these, without disturbing them: of which that worked. It may wait: other threads of ours go on."""
        return [result == 0 for result in self._run(SEIZE, tids, may_wait=True)]

    def ask_to_stop(self, tids: Sequence[int]) -> list[bool]:
        """Have these stop; answers which were asked. A thread that stands already, or has ended, is not asked."""
        looks = self._run(LOOK, tids)
        found = self._found[: len(tids), 0].tolist()
        moves = [result == 0 and not pid for result, pid in zip(looks, found, strict=True)]
        asked = iter(self._run(INTERRUPT, [tid for tid, is_moving in zip(tids, moves, strict=True) if is_moving]))
        return [is_moving and next(asked) == 0 for is_moving in moves]

    def reports(self, tids: Sequence[int]) -> list[Report]:
        """The reports of these. It takes note of ends, so a thread whose end another process must note may not be among them."""
        results = self._run(REPORT, tids)
        statuses = self._statuses[: len(tids)].tolist()
        return [
            Report(status & 0xFFFFFFFF, is_lost=False) if result > 0 else LOST if result else NOTHING
            for result, status in zip(results, statuses, strict=True)
        ]

    def let_go(self, tids: Sequence[int]) -> list[bool]:
        """Let go of these, which stand; answers for which that worked."""
        return [result == 0 for result in self._run(DETACH, tids)]

    def _run(self, group: int, tids: Sequence[int], *, may_wait: bool = False) -> list[int]:
        """Make one group of calls: the result of each."""
        count = len(tids)
        if count > self._capacity:
            self._grow(-(-count // STEP) * STEP)
        self._rows[group, :count, FIRST_ARGUMENT + WHOM[group]] = tids
        first = group * self._capacity
        self._calls.run(first, first + count, may_wait=may_wait)
        found: list[int] = self._results[group, :count].tolist()
        return found
