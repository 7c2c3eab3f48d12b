"""Find the call that a stop has just ended with EINTR, where the registers do not show it (`FORGETS_CALLS` of a processor).

On such a processor the result has replaced the first argument, and the kernel does not report the number of the call any more.
But the kernel still knows the argument, and reports it for any call number that the tracer sets for the thread. So for a moment
the tracer sets the number by which the program made the call; this number is still in a register.

Newer kernels (6.12.117, not 6.12.95) report the result there instead. So the tracer also reads the state of each thread just
before it stops the thread. A thread was in a call if it was waiting in that call then, and has come out of the same call, with
the same stack and all other arguments.

One case looks alike and is not: a thread that has just returned from the handler of a signal that had ended the call. The
argument shows this case: it is that of the return from a handler, and hardly ever fits the call.

Source: syscall_get_arguments() in asm/syscall.h and system_call_set() in ptrace.c of arch/arm64; proc_pid_syscall(5).
"""

from __future__ import annotations

import ctypes
import errno
import struct
from typing import Final

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import Registers
from checkpoint.errors import CaptureError, CheckpointError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.tracee import Tracee

_NUMBER: Final = struct.Struct("<i")
_WORDS: Final = 9
"""Words of /proc/PID/syscall for a thread that waits in a call: number, six arguments, stack and instruction pointer."""
EPOLL: Final = "anon_inode:[eventpoll]"
"""The name of a descriptor of epoll_create(2) in /proc/PID/fd."""


def look(tracee: Tracee) -> None:
    """Note in what a thread waits that is about to be stopped; one that runs, has ended or may not be looked at is in nothing."""
    try:
        tracee.waited_in = procfs.read_text(tracee.pid, "syscall")
    except CheckpointError:
        tracee.waited_in = ""


def told(tracee: Tracee, registers: Registers) -> Registers:
    """The registers with what they do not say of a call that has just ended with EINTR; as they are if it is not that.

    Args:
        tracee: stands where it has come to by itself, if anything is to be found out.

    Raises:
        ProcessGoneError: it has ended.
    """
    if not tracee.is_as_found or ctypes.c_int64(registers[arch.RESULT]).value != -errno.EINTR:
        return registers
    number = registers[arch.NUMBER] & 0xFFFFFFFF
    name = arch.SYSCALL_NAMES.get(number, "")
    if name not in arch.ENDED_BY_A_STOP and name not in arch.SOCKET_TIMEOUT:
        return registers
    before = registers[arch.INSTRUCTION_POINTER] - len(arch.SYSCALL)
    if not _holds(tracee, before, arch.SYSCALL):
        return registers
    first = _first_argument(tracee, number)
    if first == registers[arch.RESULT]:
        first = _first_before(tracee, number, registers)
    if first is None:
        return registers
    found = arch.recalled(registers, number, first)
    return found if _fits(tracee, name, found[arch.ENDED_ARGUMENTS[0]]) else registers


def _first_argument(tracee: Tracee, number: int) -> int | None:
    """The first argument of the last call of a thread, unsigned; None where the kernel does not tell."""
    assert arch.CALL_SET is not None
    known = tracee.register_set(arch.CALL_SET)
    tracee.set_register_set(arch.CALL_SET, _NUMBER.pack(number))
    try:
        words = procfs.read_text(tracee.pid, "syscall").split()
    finally:
        tracee.set_register_set(arch.CALL_SET, known)
    return int(words[1], 16) if len(words) > 2 and words[0] == str(number) else None


def _first_before(tracee: Tracee, number: int, registers: Registers) -> int | None:
    """The first argument of the call that it waited in before the stop; None if that was another one."""
    words = tracee.waited_in.split()
    if len(words) != _WORDS or words[0] != str(number):
        return None
    first, *others = (int(word, 16) for word in words[1:])
    same = (*arch.ARGUMENTS[1:], arch.STACK_POINTER, arch.INSTRUCTION_POINTER)
    return first if others == [registers[name] for name in same] else None


def _fits(tracee: Tracee, name: str, first: int) -> bool:
    """Whether a call can have had this first argument, without its mark."""
    if name.startswith("epoll"):
        try:
            return procfs.read_link(tracee.pid, f"fd/{first}") == EPOLL
        except CheckpointError:
            return False
    return name != "rt_sigtimedwait" or _holds(tracee, first)


def _holds(tracee: Tracee, address: int, content: bytes = b"") -> bool:
    """Whether there is such content at an address; without one, whether there is memory."""
    try:
        return tracee.memory.read(address, len(content) or 1).startswith(content)
    except CaptureError:
        return False
