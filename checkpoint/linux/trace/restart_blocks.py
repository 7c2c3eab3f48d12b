"""Calls that the kernel goes on with from what it remembers, where a stop shows nothing of it (`FORGETS_CALLS` of a processor).

A thread that was stopped in a relative sleep is about to make the same call there, and only when it runs again does the kernel
put restart_syscall(2) in its place. Led away meanwhile it would sleep for its whole time once more. So it is brought to where the
call begins, which shows which one that is; the call is not made, and the thread stands where it stood, about to make that one.

All its signals are blocked on the way: one that came would run its handler before the call. *Killed meanwhile:* the thread goes
on with every signal blocked; some ten µs, once for each sleep that is looked at, and only then.

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
