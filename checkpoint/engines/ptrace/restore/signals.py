"""Restore what signals do, and those that were pending, by calls inside the vessel.

Every signal is blocked there until the program has its own mask. Sources: rt_sigaction(2), rt_sigqueueinfo(2).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from typing import Final

from checkpoint.linux import abi
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import ProcessState, SignalAction, ThreadState

_SIGTRAP: Final = 5
_UNCHANGEABLE: Final = (9, 19)
"""SIGKILL and SIGSTOP."""

SI_TIMER: Final = -2


def signal_actions(table: CallTable, actions: Iterable[SignalAction]) -> None:
    """Set what every signal does, but SIGTRAP: the table's own end resets that one, see `trap_action`."""
    for action in actions:
        if action.signal not in (*_UNCHANGEABLE, _SIGTRAP):
            what = f"set the action of signal {action.signal}"
            table.call(what, "rt_sigaction", action.signal, table.place(packed_action(action)), 0, abi.SIGSET_SIZE)


def packed_action(action: SignalAction) -> bytes:
    """The kernel's struct sigaction."""
    return struct.pack("<4Q", action.handler, action.flags, action.restorer, action.mask)


def trap_action(actions: Iterable[SignalAction]) -> SignalAction:
    """The action of SIGTRAP in the program."""
    return next((action for action in actions if action.signal == _SIGTRAP), SignalAction(_SIGTRAP, 0, 0, 0, 0))


def pending_signals(table: CallTable, process: ProcessState, inner_pid: int) -> None:
    """Queue the pending signals of the process: every signal is blocked in the vessel, so they wait for the program.

    The signal of a periodic timer is queued by the timer itself, which `posix_timers` lets expire at once; SIGTRAP, by which
    tables end, by `pending_traps`.
    """
    for number, siginfo in _of_tables(process, process.pending):
        table.call(f"queue signal {number}", "rt_sigqueueinfo", inner_pid, number, table.place(siginfo))


def pending_of_thread(table: CallTable, process: ProcessState, thread: ThreadState, inner_pid: int, tid: int) -> None:
    """Queue the pending signals of one thread; it alone may do so.

    Source: do_rt_tgsigqueueinfo() in kernel/signal.c: a thread may send a signal as if by the kernel to itself alone.
    """
    for number, siginfo in _of_tables(process, thread.pending):
        table.call(f"queue signal {number}", "rt_tgsigqueueinfo", inner_pid, tid, number, table.place(siginfo))


def _of_tables(process: ProcessState, pending: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
    return ((number, siginfo) for number, siginfo in _not_of_periodic_timers(process, pending) if number != _SIGTRAP)


def pending_traps(process: ProcessState, pending: Iterable[bytes]) -> Iterator[bytes]:
    """Each SIGTRAP that was pending: queued when no table is run any more, the mask as it was."""
    return (siginfo for number, siginfo in _not_of_periodic_timers(process, pending) if number == _SIGTRAP)


def _not_of_periodic_timers(process: ProcessState, pending: Iterable[bytes]) -> Iterator[tuple[int, bytes]]:
    periodic = {timer.timer_id for timer in process.posix_timers if timer.interval_ns}
    for siginfo in pending:
        if timer_of(siginfo) not in periodic:
            yield struct.unpack_from("<i", siginfo)[0], siginfo


def timer_of(siginfo: bytes) -> int | None:
    """Number of the POSIX timer that sent a signal; None when something else did."""
    _, _, code, _, timer_id = struct.unpack_from("<5i", siginfo)
    return int(timer_id) if code == SI_TIMER else None
