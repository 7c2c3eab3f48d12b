"""Release a thread inside the system call in which it was stopped, where registers alone do not show the call.

On a processor where a stop inside a call shows a thread that is about to make it (`FORGETS_CALLS`), the kernel knows during that
stop which call it was, and ends it with EINTR if a handler runs. The kernel forgets this when the tracer has led the thread away
and given its registers back, and it never knew it of a restored thread. A signal that is pending by then would run its handler
before the call, and the call would wait for the signal for ever afterwards. So the tracer brings such a thread to the point where
the call begins, and releases it there: the call begins with the signal pending, and the kernel decides again.

A signal that comes on the way shows itself by a stop of its own. The kernel puts it back into its queue if it is blocked by then.
*Killed between that and the call:* the thread continues with every signal blocked. This window is some ten µs, and only then.

A thread that is released where a call begins starts the call as if a signal had come. Then the kernel makes most calls again by
itself. The calls of `ENDED_BY_A_STOP` would end with EINTR, and the kernel continues a sleep by restart_syscall(2), which a
filter may forbid. Such a call is not begun: the tracer brings the thread to the end of the call, with a result that says that the
call is to be made again unless a handler runs. Only the kernel reads that result.

Source: ptrace(2), "Syscall-stops"; kernel/ptrace.c, __ptrace_unlink(); kernel/signal.c, ptrace_signal();
arch/arm64/kernel/signal.c, do_signal(), and syscall.c, el0_svc_common(): no call is made where its number is -1 by then.
"""

from __future__ import annotations

import signal
import struct
from typing import Final

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import Registers
from checkpoint.errors import CaptureError
from checkpoint.linux import abi
from checkpoint.linux.trace.tracee import Stop, Tracee

_NUMBER: Final = struct.Struct("<i")
PATIENCE_S: Final = 10.0
"""How long a thread may take for the one instruction, whose signals are blocked meanwhile."""


def enter(tracee: Tracee) -> None:
    """Bring a thread that stands before a call to where that begins; other ones, and those of a stopped process, stay.

    Raises:
        ProcessGoneError: it has ended.
        CaptureError: it has not come there in time, and runs.
    """
    registers = arch.decode_registers(tracee.registers())
    if tracee.stopped_by or not is_before_a_call(tracee, registers):
        return
    tracee.mark_calls()
    stop = _step(tracee)
    while stop.event and stop.signal == signal.SIGTRAP:  # it had been asked to stop twice
        stop = _step(tracee)
    if stop.is_delivery:
        mask = tracee.signal_mask()
        tracee.set_signal_mask(abi.ALL_SIGNALS)
        while stop.is_delivery:
            stop = _step(tracee, stop.signal)
        tracee.set_signal_mask(mask)
    if _suffers_from_a_stop(registers, is_confined=tracee.is_confined):
        _leave_as_stopped(tracee, registers)


def _suffers_from_a_stop(registers: Registers, *, is_confined: bool) -> bool:
    """Whether the next call is such a one: a socket's, if it bears a mark, for only those with a timeout are marked."""
    name = arch.SYSCALL_NAMES.get(registers[arch.NUMBER] & 0xFFFFFFFF, "")
    is_marked = bool(registers[arch.ARGUMENTS[0]] >> 32)
    may_be_forbidden = is_confined and name in arch.RESTART_BLOCK_USERS
    return name in arch.ENDED_BY_A_STOP or (name in arch.SOCKET_TIMEOUT and is_marked) or may_be_forbidden


def _leave_as_stopped(tracee: Tracee, registers: Registers) -> None:
    """Bring a thread from the beginning of a call to its end, as if it had been stopped in it.

    Killed after any of these, it makes the call.

    Args:
        registers: those before the call.
    """
    assert arch.CALL_SET is not None
    tracee.set_register_set(arch.CALL_SET, _NUMBER.pack(-1))
    tracee.set_registers(arch.encode_registers(registers))
    _step(tracee)
    tracee.set_register_set(arch.CALL_SET, _NUMBER.pack(registers[arch.NUMBER] & 0x7FFFFFFF))
    behind = registers[arch.INSTRUCTION_POINTER] + len(arch.SYSCALL)
    stopped = {**registers, arch.RESULT: arch.ERESTARTNOHAND, arch.INSTRUCTION_POINTER: behind}
    tracee.set_registers(arch.encode_registers(stopped))


def _step(tracee: Tracee, number: int = 0) -> Stop:
    tracee.request("continue", abi.PTRACE_SYSCALL, 0, number)
    return tracee.wait(PATIENCE_S)


def is_before_a_call(tracee: Tracee, registers: Registers) -> bool:
    """Whether the next instruction makes a call."""
    try:
        return tracee.memory.read(registers[arch.INSTRUCTION_POINTER], len(arch.SYSCALL)) == arch.SYSCALL
    except CaptureError:  # it will fault there
        return False
