"""Handle calls that the kernel continues from its restart block, if a stop hides them (`FORGETS_CALLS` of a processor).

On such a processor, a thread that was stopped in a relative sleep is about to make the same call. Only when it runs again does
the kernel put restart_syscall(2) in its place. If a tracer led it away meanwhile, it would sleep for its whole time once more. So
the tracer brings it to the point where the call begins, which shows which call it is. The call is not made, and the thread is
again at the point where it is about to make it.

All its signals are blocked on the way, because a signal would run its handler before the call. *Killed meanwhile:* the thread
continues with every signal blocked. This window is some ten µs, once for each sleep that is inspected, and only then.

Source: do_signal() in arch/arm64/kernel/signal.c; el0_svc_common() in syscall.c: no call is made where its number is -1 by then.
"""

from __future__ import annotations

import signal
import struct
from typing import Final

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import Registers
from checkpoint.linux import abi
from checkpoint.linux.trace.tracee import CALL_STOP, Tracee

PATIENCE_S: Final = 10.0
"""How long a thread may take for the one instruction, whose signals are blocked meanwhile."""
_NO_CALL: Final = struct.pack("<i", -1)


def shown(tracee: Tracee, registers: Registers) -> bytes:
    """The registers of a thread before a call, with the call by which the kernel goes on there; it stands so afterwards.

    Raises:
        ProcessGoneError: it has ended.
        CaptureError: it has not come there in time, and runs.
    """
    assert arch.CALL_SET is not None
    mask = tracee.signal_mask()
    tracee.set_signal_mask(abi.ALL_SIGNALS)
    tracee.is_as_found = False
    try:
        _step_to_the_call(tracee)
        there = arch.decode_registers(tracee.registers())
        found = arch.encode_registers({**registers, arch.NUMBER: there[arch.NUMBER]})
        tracee.set_register_set(arch.CALL_SET, _NO_CALL)
        tracee.set_registers(found)
        tracee.interrupt()
        tracee.cont()
        tracee.await_stop(PATIENCE_S)
    finally:
        tracee.set_signal_mask(mask)
    return found


def _step_to_the_call(tracee: Tracee) -> None:
    number = 0
    while True:
        tracee.request("continue", abi.PTRACE_SYSCALL, 0, number)
        stop = tracee.wait(PATIENCE_S)
        if not stop.event and stop.signal & ~CALL_STOP == signal.SIGTRAP:
            return
        number = stop.signal if stop.is_delivery else 0  # SIGSTOP, which cannot be blocked
