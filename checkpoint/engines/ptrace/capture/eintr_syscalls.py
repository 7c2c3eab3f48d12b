"""Make calls again that the kernel ends with EINTR at every stop, so that the live program does not notice and timeouts hold.

Such calls are epoll_wait and its like, sigtimedwait, semtimedop, and calls on a socket with a timeout. The kernel does not say
how much of their time was left, and their arguments belong to the program. So the capture makes the call again with its whole
timeout, and remembers when that timeout ends. At a stop inside such a call::

    marked as the capture left it, its time not over   made again, with the same mark
    marked as the capture left it, its time over       it has timed out: that is its result
    any other                                          first seen: its time begins now; made again, with a mark of its own

The mark is in unused bits of the call's number or of its first argument (`arch.CALL_NUMBER_BITS`). Only the kernel and the tracer
can see it: the program sets the whole register for each call that it makes, and finds the result there. So a mark proves that
this is the same call that the tracer made again, and that it has not returned since. No call times out too early, because it
began before the tracer saw it. It may time out late, by less than its timeout and by less than the time between three captures. A
signal handler that runs ends the call with EINTR, as usual. If the tracer dies, it leaves a system call that times out by itself.
Only if it dies in the middle of a stop, before it has made the call again, does the EINTR of that stop remain.

Programs that make such a call again themselves, with the rest of its time, are more exact than the tracer. Of their calls this
module makes only those without a timeout again (`makes_calls_again`).

Where there is no space for a mark, the tracer recognises a call by the registers that the program cannot have lost. This does not
prove that the call has not returned and been made once more. So when its time is over, it ends with EINTR, once.

Source: signal(7), "Interruption of system calls and library functions by stop signals"; arch/x86/entry/entry_64.S, which takes
the lower half of a call's number, sign-extended (since Linux 5.14; probed).
"""

from __future__ import annotations

import ctypes
import errno
import functools
import os
import re
import secrets
import socket
import struct
import time
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import MILLISECONDS, SOCKET, Registers, Timeout
from checkpoint.errors import CaptureError
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptors import copy_of

NS_PER_S: Final = 1_000_000_000
NS_PER_MS: Final = 1_000_000
NS_PER_US: Final = 1_000
_CHANGED_BY_A_CALL: Final = frozenset((arch.RESULT, arch.CALL_NUMBER, *arch.LOST_IN_A_CALL))


_MAKES_CALLS_AGAIN: Final = re.compile(r"(python|pypy)[0-9.]*[dt]?|node(js)?")
"""Names of interpreters in which every call that EINTR has ended is made again: PEP 475 (CPython 3.5), libuv's uv__io_poll."""


def makes_calls_again(pid: int) -> bool:
    """Whether a process runs one of those interpreters: EINTR does not harm it, and its timeouts stay exact."""
    return bool(_MAKES_CALLS_AGAIN.fullmatch(os.path.basename(procfs.read_link(pid, "exe"))))


class Wait(Struct, frozen=True):
    """A call that was made again.

    Attributes:
        mark: by which it is known; 0 where there is no room for one.
        place: the registers that the program cannot have lost.
        deadline_ns: of CLOCK_MONOTONIC: when its time is over; never before it really is.
        seen_ns: when it was last stopped.
    """

    mark: int
    place: tuple[int, ...]
    deadline_ns: int
    seen_ns: int


@functools.cache
def has_room_for_marks() -> bool:
    """Whether this kernel makes a call whose number has a mark, where that is the place of marks."""
    if not arch.CALL_NUMBER_BITS:
        return True
    libc = ctypes.CDLL(None)
    libc.syscall.restype = ctypes.c_long
    return int(libc.syscall(ctypes.c_long(arch.marked(arch.SYSCALLS["getpid"], 1)))) == os.getpid()


class Waiting:
    """Follows one thread from stop to stop."""

    def __init__(self, memory: Memory, *, makes_again: bool = False) -> None:
        """
        Args:
            makes_again: the program itself does so, see `makes_calls_again`.
        """
        self._memory = memory
        self._makes_again = makes_again
        self._wait: Wait | None = None

    def is_disturbed(self, result: int) -> bool:
        """Whether `undisturbed` has anything to do, for a call with this result."""
        return result == -errno.EINTR or self._wait is not None

    def undisturbed(self, registers: Registers) -> Registers:
        """The registers that the live program gets back: without what our stop alone has brought about.

        Args:
            registers: with what `checkpoint.linux.trace.interrupted_syscalls` finds out, where they do not say enough themselves.
        """
        before, self._wait = self._wait, None
        if ctypes.c_int64(registers[arch.RESULT]).value != -errno.EINTR:
            return registers
        name = arch.SYSCALL_NAMES.get(arch.call_number(registers), "")
        timeout = arch.ENDED_BY_A_STOP.get(name, arch.SOCKET_TIMEOUT.get(name))
        if timeout is None:
            return arch.made_again(registers, 0) if name in arch.ENDED_BY_A_STOP else registers
        asked_ns = self._asked_ns(registers, timeout)
        if asked_ns is None:
            return registers
        if asked_ns < 0:
            return arch.made_again(registers, 0)
        if self._makes_again:
            return registers
        decided, self._wait = decide(registers, before, asked_ns, timeout.at_end, time.monotonic_ns())
        return decided

    def _asked_ns(self, registers: Registers, timeout: Timeout) -> int | None:
        """How long the call was told to wait, negative for ever; None if that cannot be known."""
        argument = registers[arch.ENDED_ARGUMENTS[timeout.argument]]
        if timeout.form == MILLISECONDS:
            return ctypes.c_int32(argument & 0xFFFFFFFF).value * NS_PER_MS
        if timeout.form == SOCKET:
            return _socket_timeout_ns(self._memory.pid, ctypes.c_int32(argument & 0xFFFFFFFF).value, timeout.option)
        if not argument:
            return -1
        try:
            seconds, rest_ns = struct.unpack("<qq", self._memory.read(argument, 16))
        except CaptureError:  # another thread has unmapped it since
            return None
        return int(seconds * NS_PER_S + rest_ns)


def _socket_timeout_ns(pid: int, number: int, option: int) -> int | None:
    """The timeout of a socket, None if it has none, or is none."""
    try:
        with copy_of(pid, number) as copied, socket.socket(fileno=os.dup(copied)) as looked:
            seconds, rest_us = struct.unpack("<qq", looked.getsockopt(socket.SOL_SOCKET, option, 16))
    except OSError:
        return None
    return int(seconds * NS_PER_S + rest_us * NS_PER_US) or None


def decide(registers: Registers, before: Wait | None, asked_ns: int, at_end: int, now_ns: int) -> tuple[Registers, Wait | None]:
    """Decide about a call with a timeout that a stop has ended: see the table above.

    Args:
        before: the last call of this thread that was made again.
        at_end: what the call returns when its time is over.
    """
    place = tuple(word for name, word in registers.items() if name not in _CHANGED_BY_A_CALL)
    mark = arch.mark_of(registers)
    is_known = before is not None and before.place == place and before.mark == mark
    if before is None or not is_known or (not mark and now_ns - before.seen_ns >= asked_ns):
        fresh = _fresh_mark() if has_room_for_marks() and arch.has_room_for_mark(registers) else 0
        return arch.made_again(registers, fresh), Wait(fresh, place, now_ns + asked_ns, now_ns)
    if now_ns < before.deadline_ns:
        return arch.made_again(registers, mark), replace(before, seen_ns=now_ns)
    return ({**registers, arch.RESULT: at_end, arch.CALL_NUMBER: arch.NO_CALL} if mark else registers), None


def _fresh_mark() -> int:
    return 1 + secrets.randbelow(arch.MARK_LIMIT - 1)
