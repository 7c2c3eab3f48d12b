"""Stop a child again that was stopped at the capture, before it is given anything: the kernel keeps the stop while we trace it.

The child goes through the stop as it once did. So its parent, which stands still, is sent the signal that it was sent then. The
restore drops this signal when it begins the parent (`checkpoint.engines.ptrace.restore.process_state.begin_member`), before it
gives the parent its own pending signals.

Source: ptrace(2), "Group-stop"; ptrace_signal(), do_signal_stop(), prepare_signal() in kernel/signal.c.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import Final

from checkpoint.errors import RestoreError
from checkpoint.linux import abi
from checkpoint.linux.trace import call_table
from checkpoint.linux.trace.tracee import Stop, Tracee

NOT_BY_TERMINAL: Final = signal.SIGSTOP
STOPS_AGAIN: Final = 16
"""Stops of another kind that may come before the one that is waited for."""


def stop(tracee: Tracee, number: int) -> None:
    """Stop a vessel that stands still for us by a signal.

    Signals of a terminal do not stop an orphaned process group; SIGSTOP does, and stands for them then.

    Raises:
        RestoreError: it cannot be stopped.
    """
    for asked in dict.fromkeys((number, NOT_BY_TERMINAL)):
        _send(tracee, NOT_BY_TERMINAL)
        tracee.set_signal_mask(_all_but(asked))
        tracee.interrupt()  # before, so that it stops once: by the signal, or because we asked
        tracee.cont(asked)
        stood = _next(tracee, is_wanted=lambda stop: not stop.is_delivery)
        tracee.set_signal_mask(_all_but())
        if stood.signal == asked:
            return
    raise RestoreError(f"cannot restore: process {tracee.pid} cannot be stopped again (signal {number})")


def go_on(tracee: Tracee) -> None:
    """Let a vessel that was stopped count as running again; it stands still for us."""
    tracee.set_signal_mask(_all_but(signal.SIGCONT))
    _send(tracee, signal.SIGCONT)
    tracee.interrupt()
    tracee.cont()
    _next(tracee, is_wanted=lambda stop: not stop.is_delivery)
    tracee.set_signal_mask(_all_but())


def _send(tracee: Tracee, number: int) -> None:
    """Have a signal wait to be delivered by us."""
    os.kill(tracee.pid, number)
    tracee.cont()
    _next(tracee, is_wanted=lambda stop: stop.is_delivery and stop.signal == number)


def _next(tracee: Tracee, *, is_wanted: Callable[[Stop], bool]) -> Stop:
    """Its next stop that is wanted; others are passed."""
    for _ in range(STOPS_AGAIN):
        stood = tracee.wait(call_table.RUN_TIMEOUT_S)
        if is_wanted(stood):
            return stood
        tracee.cont()
    raise RestoreError(f"cannot restore: process {tracee.pid} does not stop as it should")


def _all_but(*numbers: int) -> int:
    """Every signal but SIGTRAP, by which our tables end, and these."""
    return abi.ALL_SIGNALS & ~sum(1 << (number - 1) for number in {signal.SIGTRAP, *numbers})
