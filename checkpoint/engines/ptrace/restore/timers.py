"""Restore the alarms of setitimer(2) and the timers of timer_create(2), by calls inside the vessel."""

from __future__ import annotations

import ctypes
import struct
import time
from collections.abc import Iterable, Sequence
from typing import Final

from msgspec.structs import replace

from checkpoint.engines.ptrace.restore.signals import timer_of
from checkpoint.engines.ptrace.restore.vessel import Vessel
from checkpoint.errors import RestoreError
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import IntervalTimer, PosixTimer, ProcessState, ThreadState

PR_TIMER_CREATE_RESTORE_IDS: Final = 77
PR_TIMER_CREATE_RESTORE_IDS_GET: Final = 2
TIMER_ID_LIMIT: Final = 1024
"""Largest timer number that is reached by creating and deleting timers, on kernels that cannot be told the number."""

_NS_PER_US: Final = 1000
_US_PER_S: Final = 1_000_000
_NS_PER_S: Final = 1_000_000_000

CLOCK_MONOTONIC_COARSE: Final = 6
"""Its resolution is the kernel's tick."""

_CPU_TIME_CLOCKS: Final = (2, 3)
"""CLOCK_PROCESS_CPUTIME_ID and CLOCK_THREAD_CPUTIME_ID; a negative clock counts some process's CPU time too."""

_WORD_MAX: Final = (1 << 64) - 1


def interval_timers(table: CallTable, timers: Iterable[IntervalTimer], elapsed_ns: int) -> None:
    """Arm the alarms of setitimer(2) again. Real time went on meanwhile; the program's CPU time did not.

    The kernel adds a tick to a CPU time that it is given, and tells it when asked. Source: set_cpu_itimer, kernel/time/itimer.c.
    """
    tick_us = round(time.clock_getres(CLOCK_MONOTONIC_COARSE) * _US_PER_S)
    for timer in timers:
        value_us = timer.value_us
        if timer.which == 0 and value_us:
            value_us = max(value_us - elapsed_ns // _NS_PER_US, 1)
        elif value_us:
            value_us = max(value_us - tick_us, 1)
        packed = struct.pack("<4q", *divmod(timer.interval_us, _US_PER_S), *divmod(value_us, _US_PER_S))
        table.call(f"arm interval timer {timer.which}", "setitimer", timer.which, table.place(packed), 0)


def posix_timers(
    table: CallTable, process: ProcessState, threads: Sequence[ThreadState], vessel: Vessel, elapsed_ns: int
) -> None:
    """Make the timers of timer_create(2) again, with the numbers that they had, and arm them.

    A kernel that does not let us say the number (before Linux 6.15) counts up to it; what comes before is deleted.
    """
    timers, inner_pid = process.posix_timers, vessel.inner_pid
    if not timers:
        return
    chosen_ids = timer_numbers_can_be_chosen()
    highest = max(timer.timer_id for timer in timers)
    if not chosen_ids and highest > TIMER_ID_LIMIT:
        raise RestoreError(
            f"cannot restore: it has a timer number {highest}, and this kernel counts up to it; use Linux 6.15 or later"
        )
    overdue = {timer_of(siginfo) for pending in (process.pending, *(one.pending for one in threads)) for siginfo in pending}
    others = {one.tid for one in threads[1:]}
    if chosen_ids:
        table.call("choose timer numbers", "prctl", PR_TIMER_CREATE_RESTORE_IDS, 1)
    next_id = 0
    for timer in sorted(timers, key=lambda timer: timer.timer_id):
        while not chosen_ids and next_id < timer.timer_id:
            _create_timer(table, PosixTimer(next_id, 1, 1, 0, 0, 0, 0, 0), inner_pid)
            table.call(f"delete timer {next_id}", "timer_delete", next_id)
            next_id += 1
        known = replace(timer, clock=_clock_here(timer.clock, process.pid, inner_pid))
        _create_timer(table, known, timer.tid if timer.tid in others else inner_pid)
        next_id = timer.timer_id + 1
    if chosen_ids:
        table.call("stop choosing timer numbers", "prctl", PR_TIMER_CREATE_RESTORE_IDS, 0)
    for timer in timers:
        if timer.value_ns:
            left_ns = 1 if timer.interval_ns and timer.timer_id in overdue else _left_of(timer, elapsed_ns)
            packed = struct.pack("<4q", *divmod(timer.interval_ns, _NS_PER_S), *divmod(left_ns, _NS_PER_S))
            table.call(f"arm timer {timer.timer_id}", "timer_settime", timer.timer_id, 0, table.place(packed), 0)


def _clock_here(clock: int, pid: int, inner_pid: int) -> int:
    """The number of a clock that may count the processor time of the process itself, by a PID that is another one here.

    Source: linux/posix-timers_types.h: the complement of the PID, shifted by three bits.
    """
    return clock - (~pid << 3) + (~inner_pid << 3) if clock < 0 and ~(clock >> 3) == pid else clock


def timer_numbers_can_be_chosen() -> bool:
    """Whether the kernel lets timer numbers be chosen (Linux 6.15); asking changes nothing."""
    return bool(ctypes.CDLL(None).prctl(PR_TIMER_CREATE_RESTORE_IDS, PR_TIMER_CREATE_RESTORE_IDS_GET, 0, 0, 0) >= 0)


def _create_timer(table: CallTable, timer: PosixTimer, tid: int) -> None:
    """Make one timer; ``tid`` is the thread that it signals, if it signals one."""
    event = struct.pack("<Qiii", timer.value & _WORD_MAX, timer.signal, timer.notify, tid).ljust(64, b"\0")
    number = table.place(struct.pack("<i", timer.timer_id))
    table.call(f"create timer {timer.timer_id}", "timer_create", timer.clock, table.place(event), number)


def _left_of(timer: PosixTimer, elapsed_ns: int) -> int:
    if timer.clock in _CPU_TIME_CLOCKS or timer.clock < 0:
        return timer.value_ns
    return max(timer.value_ns - elapsed_ns, 1)
