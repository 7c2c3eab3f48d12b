"""Remove a pending SIGSTOP from a stopped program, because it would stop a thread that makes a call for us.

The pending SIGSTOP has no effect any more: a stopped program takes no signal, and SIGCONT drops every pending SIGSTOP. It cannot
be blocked either, as all other signals are while the program makes calls for us. The program is stopped before and afterwards.

A race: SIGCONT comes after the tracer has seen a pending SIGSTOP. Then the program stops for the tracer once more, before it runs
any instruction of its own (TRAP_NOTIFY).

Source: signal(7); prepare_signal(), get_signal() in kernel/signal.c.
"""

from __future__ import annotations

import signal
from collections.abc import Iterable
from typing import Final

from checkpoint.linux import abi
from checkpoint.linux.trace.tracee import Tracee

TAKEN_MAX: Final = 8
"""How many a thread may be rid of at a time; two can wait for it, its own and its process's, more are sent meanwhile."""
_SIGSTOP: Final = int(signal.SIGSTOP).to_bytes(4, "little")


def take_away(tracees: Iterable[Tracee]) -> None:
    """Have none wait for these, threads of one process, each of which stands still.

    Raises:
        ProcessGoneError: it was killed meanwhile.
        CaptureError: one of them did not stand still again in time.
    """
    for tracee in tracees:
        for _ in range(TAKEN_MAX):
            if not _waits_for(tracee):
                break
            _take_one(tracee)


def _waits_for(tracee: Tracee) -> bool:
    return any(siginfo[:4] == _SIGSTOP for shared in (False, True) for siginfo in tracee.pending(shared=shared))


def _take_one(tracee: Tracee) -> None:
    mask = tracee.signal_mask()
    tracee.set_signal_mask(abi.ALL_SIGNALS)
    try:
        tracee.cont()
        stop = tracee.wait()
        if stop.is_delivery:
            tracee.interrupt()  # before it goes on: it does not leave the kernel
            tracee.cont(0 if stop.signal == signal.SIGSTOP else stop.signal)
            tracee.await_stop()
    finally:
        tracee.set_signal_mask(mask)
