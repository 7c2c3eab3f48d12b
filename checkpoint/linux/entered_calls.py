"""Letting a thread go inside the call that it stood in, where registers alone do not say that it stands in one.

Where a stop inside a call shows a thread that is about to make it (`FORGETS_CALLS` of a processor), the kernel knows during that
stop which call it was, and ends it with EINTR if a handler runs. That is forgotten when the thread has been led away and given
its registers back, and of a restored one it was never known: a signal that is there by then would run its handler before the
call, which would wait for it for ever afterwards. So such a thread is brought to where the call begins, and let go there: the
call begins with the signal pending, and the kernel decides again.

A signal that comes on the way shows itself by a stop of its own. It is put back into its queue, which the kernel does when it is
blocked by then. *Killed between that and the call:* the thread goes on with every signal blocked; some ten µs, and only then.

Source: ptrace(2), "Syscall-stops"; kernel/signal.c, ptrace_signal(); arch/arm64/kernel/signal.c, do_signal().
"""

from __future__ import annotations

import signal
from typing import Final

from checkpoint.arch import cpu as arch
from checkpoint.errors import CaptureError
from checkpoint.linux import abi
from checkpoint.linux.tracee import Stop, Tracee

PATIENCE_S: Final = 10.0
"""How long a thread may take for the one instruction, whose signals are blocked meanwhile."""


def enter(tracee: Tracee) -> None:
    """Bring a thread that stands before a call to where that begins; other ones, and those of a stopped process, stay.

    Raises:
        ProcessGoneError: it has ended.
        CaptureError: it has not come there in time, and runs.
    """
    if tracee.stopped_by or not _is_before_a_call(tracee):
        return
    tracee.request("set options of", abi.PTRACE_SETOPTIONS, 0, abi.PTRACE_O_TRACESYSGOOD)
    stop = _step(tracee)
    while stop.event and stop.signal == signal.SIGTRAP:  # it had been asked to stop twice
        stop = _step(tracee)
    if not stop.is_delivery:
        return
    mask = tracee.signal_mask()
    tracee.set_signal_mask(abi.ALL_SIGNALS)
    while stop.is_delivery:
        stop = _step(tracee, stop.signal)
    tracee.set_signal_mask(mask)


def _step(tracee: Tracee, number: int = 0) -> Stop:
    tracee.request("continue", abi.PTRACE_SYSCALL, 0, number)
    return tracee.wait(PATIENCE_S)


def _is_before_a_call(tracee: Tracee) -> bool:
    pointer, _, _ = arch.stand_of(tracee.registers())
    try:
        return tracee.memory.read(pointer, len(arch.SYSCALL)) == arch.SYSCALL
    except CaptureError:  # it will fault there
        return False
