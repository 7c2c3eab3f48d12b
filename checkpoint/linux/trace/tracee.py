"""One traced thread: stop, inspect, change, release. The only module that uses python-ptrace.

Every call on one `Tracee` must come from the thread that seized it: the kernel knows tracers by thread. A tracer that dies
releases everything; a thread that was only stopped runs on.

Source: ptrace(2).
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import signal
import time
from collections.abc import Callable
from typing import Final

from msgspec import Struct
from ptrace.binding.func import ptrace as _ptrace
from ptrace.error import PtraceError

from checkpoint.arch import extended
from checkpoint.errors import CaptureError, CheckpointError, ProbeError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.cpu_of_thread import Whereabouts
from checkpoint.linux.spawn import cpuid
from checkpoint.linux.trace.stop_events import sleep_until_report
from checkpoint.model import Rseq

PLAIN_STOP: Final = abi.PTRACE_EVENT_STOP << 16 | signal.SIGTRAP << 8 | 0x7F
"""Wait status of a thread that was asked to stop, and stands for no other reason. Source: wait(2), ptrace(2)."""
CALL_STOP: Final = 0x80
"""In the signal of a stop at a system call (PTRACE_O_TRACESYSGOOD)."""
REGISTERS_SIZE: Final = 4096
"""Bytes offered for the general registers: more than any processor has."""
STATE_SETS: Final = cpuid.state_sets()
"""The register sets of the extended state. The last one may come short."""
LOST_SIZE: Final = dict(STATE_SETS).get(extended.LOST_IN_CALLS or 0, 0)
"""Bytes offered for the one of which system calls take a part; 0: there is none."""
SET_SIZE: Final = max(size for _, size in STATE_SETS)
"""Bytes offered for one at most."""
STOP_TIMEOUT_S: Final = 2.0
"""How long a thread may take to stop: a disk that sleeps answers within this, a dead network file system does not."""
SPIN_S: Final = 0.001
"""How long we look for the stops of many before we look at each singly."""
YIELDING_S: Final = 0.0001
"""How long we look without sleeping: a thread stops within 0.1 ms when nothing holds it. For one that is to run where we do we
sleep at once: if we have precedence it waits for that (`checkpoint.linux.realtime_boost`)."""
REST_S: Final = 0.00005
PEEK_COUNT: Final = 64
"""Pending signals asked for in one call."""
PENDING_LIMIT: Final = 4096
"""Pending signals that we carry; RLIMIT_SIGPENDING is far above only for floods of queued signals."""


class Stop(Struct, frozen=True):
    """Why a thread stands still.

    Attributes:
        event: the PTRACE_EVENT_* number, 0 for a stop before the delivery of ``signal``.
        signal: SIGTRAP for a plain interrupt, the stopping signal for a group stop, else the signal to be delivered.
    """

    event: int
    signal: int

    @property
    def is_delivery(self) -> bool:
        """Whether a signal was taken from the queue and waits to be handed back by `Tracee.cont`."""
        return self.event == 0 and not self.signal & CALL_STOP

    @property
    def is_within_a_call(self) -> bool:
        """Whether it is one of those that are asked for by options (PTRACE_O_TRACEEXEC), of which the call is not over yet."""
        return self.event not in (0, abi.PTRACE_EVENT_STOP)


def _is_dead(pid: int) -> bool:
    """Whether a process has ended, reaped or not."""
    try:
        return procfs.status(pid).state in "ZX"
    except CheckpointError:
        return True


def no_stop(tid: int, waited_s: float) -> CaptureError:
    """The message about a thread that does not stop: it sleeps in the kernel, or is ready to run and gets no processor."""
    why = "it waits inside the kernel for a device or a file system; capture it again when that answers"
    with contextlib.suppress(CheckpointError):
        if procfs.status(tid).state == "R":
            why = "the machine leaves it no processor; capture it again when the load is less"
    return CaptureError(f"pid {tid} did not stop within {waited_s:.2g} s: {why}")


def rest(waited_s: float, *, is_here: bool = False) -> None:
    """Leave the processor to others before a thread is looked at again that we have waited for so long already.

    Args:
        is_here: it is to run where we do.
    """
    if waited_s < YIELDING_S and not is_here:
        os.sched_yield()
    else:
        sleep_until_report(REST_S if waited_s < SPIN_S else 2 * REST_S)


class Tracee:
    """One thread of another process, from `seize` to `detach`.

    Attributes:
        is_as_found: it stands where the program has come to by itself: we have not set its registers since.
        left_alone: the registers that it gives itself back if we die while it makes calls of ours; empty: those it stood with.
        waited_in: its /proc/TID/syscall just before it was stopped, where it is looked at (`interrupted_syscalls`); "" otherwise.
        whereabouts: tells where it runs, of one that is stopped again and again.
        stopped_by: the signal that had stopped its process when it stopped for us last (SIGSTOP, job control); 0: it ran.

    Args:
        pid: the thread's id; for the first thread of a process that of the process.
        memory: its process's, if the caller has it already.
    """

    def __init__(self, pid: int, memory: Memory | None = None) -> None:
        self.pid = pid
        self.memory = memory or Memory(pid)
        self.is_as_found = True
        self.left_alone = b""
        self.waited_in = ""
        self._options = 0
        self.stopped_by = 0
        self._registers = ctypes.create_string_buffer(REGISTERS_SIZE)
        self._xstate = ctypes.create_string_buffer(SET_SIZE)
        self._iov = abi.IoVec()
        self.whereabouts: Whereabouts | None = None
        self._mask = ctypes.c_uint64()
        self._signals: ctypes.Array[ctypes.c_char] | None = None

    def request(self, what: str, request: int, address: int = 0, value: int = 0) -> int:
        """Make one raw ptrace(2) request.

        Args:
            what: the request in words, for the error message.

        Raises:
            ProcessGoneError: there is no such thread any more, or it is not stopped for us.
            ProbeError: we have no right to trace it.
            CaptureError: anything else.
        """
        try:
            return int(_ptrace(request, self.pid, address, value))
        except PtraceError as error:
            raise self._failure(what, error.errno or 0) from error

    def _failure(self, what: str, number: int) -> CheckpointError:
        on = f"cannot {what} pid {self.pid}"
        if number == errno.ESRCH or _is_dead(self.pid):
            return ProcessGoneError(f"{on}: it has ended, or is not stopped")
        if number == errno.EPERM:
            return ProbeError(
                f"{on}: not permitted; it is traced already, belongs to another user, or kernel.yama.ptrace_scope forbids it: "
                "give the keeper CAP_SYS_PTRACE, see systemd/failover-agent.service"
            )
        return CaptureError(f"{on}: {os.strerror(number)}; capture it again")

    def is_here(self) -> bool:
        """Whether it is known that it is to run on the processor that we run on."""
        return self.whereabouts is not None and self.whereabouts.are_ours()

    # Stopping and letting go

    def seize(self, options: int = 0) -> None:
        """Become its tracer without disturbing it.

        Raises:
            ProbeError: not permitted, or another process traces it.
            CaptureError: it did not stop in time for an earlier look of ours, and is not let go of yet.
        """
        try:
            self.request("seize", abi.PTRACE_SEIZE, 0, options)
        except ProbeError as error:
            if procfs.status(self.pid).tracer != os.getpid():
                raise
            raise CaptureError(
                f"{error}: failover traces it since an earlier capture, until it stops; capture it again"
            ) from error
        self.is_as_found = True
        self._options = options & abi.PTRACE_O_SUSPEND_SECCOMP

    def child(self, pid: int, memory: Memory | None = None) -> Tracee:
        """One that it has given birth to, which is ours with the same options."""
        child = Tracee(pid, memory)
        child._options = self._options
        return child

    def may_outlive_us(self) -> None:
        """Have it not be killed when we die, nor stop for us in ways that were asked for; filters that are suspended stay so."""
        self.request("let go of", abi.PTRACE_SETOPTIONS, 0, self._options)

    def interrupt(self) -> None:
        """Ask it to stop; `wait` tells when it has."""
        self.request("interrupt", abi.PTRACE_INTERRUPT)

    def interrupt_if_ours(self) -> bool:
        """As `interrupt`, of the thread that has this id now; False when we do not trace it.

        A thread that executes another program has its process's id from then on, and its tracer traces it under that id.
        """
        try:
            _ptrace(abi.PTRACE_INTERRUPT, self.pid, 0, 0)
        except PtraceError as error:
            return bool(error.errno != errno.ESRCH)
        return True

    def freeze(self, timeout_s: float = STOP_TIMEOUT_S) -> Stop:
        """Stop it and return once it stands; a signal on its way is delivered first, and a call of which it tells is finished.

        A program that stood still before it was seized (SIGSTOP) has reported that already, and is not interrupted once more.

        Raises:
            ProcessGoneError: it ended instead.
            CaptureError: it did not stop in time; it stops as soon as it can, call `freeze` again or `release`.
        """
        return self.ask_to_stop() or self.await_stop(timeout_s)

    def ask_to_stop(self) -> Stop | None:
        """The first half of `freeze`: where it stands already; None when `await_stop` must follow."""
        stood = self._standing()
        if stood is not None and not stood.is_delivery and not stood.is_within_a_call:
            return stood
        self.interrupt()
        if stood is not None:
            self.cont(0 if stood.is_within_a_call else stood.signal)  # a signal came just after it was seized
        return None

    def await_stop(self, timeout_s: float = STOP_TIMEOUT_S) -> Stop:
        """The second half of `freeze`."""
        while True:
            stop = self.wait(timeout_s)
            if stop.is_delivery:
                self.cont(stop.signal)
            elif stop.is_within_a_call:
                self.interrupt()  # any stop but a signal's is an answer to the one before
                self.cont()
            else:
                return stop

    def wait(self, timeout_s: float = STOP_TIMEOUT_S) -> Stop:
        """Wait for its next stop.

        Raises:
            ProcessGoneError: it ended.
            CaptureError: it did not stop in time.
        """
        began = time.perf_counter()
        while True:
            try:
                pid, status = os.waitpid(self.pid, abi.WALL | os.WNOHANG)
            except ChildProcessError as error:
                raise self._gone() from error
            if pid:
                return self.stop_of(status)
            waited = time.perf_counter() - began
            if waited > timeout_s:
                raise no_stop(self.pid, timeout_s)
            rest(waited)

    def run_on(self, is_done: Callable[[], bool], lengthen: Callable[[], None]) -> None:
        """Have a SIGSTOP take effect that came while it runs for us (it cannot be blocked), and let it run on all the same.

        Args:
            is_done: it has done what it was to do: then it stays where it stands, for it would go on by itself.
            lengthen: have it wait for us as long as any thread of a stopped program.

        Raises:
            ProcessGoneError: it has ended.
        """
        stop = self.peek()
        if stop is None or stop.is_within_a_call or (stop.is_delivery and stop.signal != signal.SIGSTOP) or is_done():
            return
        if stop.signal != signal.SIGTRAP:  # else its process was continued
            lengthen()
        self.reported()
        self.cont(stop.signal if stop.is_delivery else 0)

    def has_stopped(self) -> bool:
        """Whether it stands now, as `await_stop` would find it. Raises as `_standing`."""
        stop = self._standing()
        return stop is not None and self._stays(stop)

    def stands_by(self, status: int) -> bool:
        """As `has_stopped`, of one of which a wait status has told already."""
        return self._stays(self.stop_of(status))

    def _stays(self, stop: Stop) -> bool:
        """Whether it stands for us; where it is for a signal to be delivered, that is."""
        if stop.is_delivery:
            self.cont(stop.signal)
        return not stop.is_delivery

    def _standing(self) -> Stop | None:
        """As `reported`, without taking note of its end: it may be our child, for which another part of this process waits."""
        return self.reported() if self.peek() is not None else None

    def peek(self) -> Stop | None:
        """The stop that it has reported already, if any: `reported` tells it once more.

        Raises:
            ProcessGoneError: it has ended, or we are not its tracer any more.
        """
        options = os.WEXITED | os.WSTOPPED | os.WNOHANG | os.WNOWAIT | abi.WALL
        try:
            found = os.waitid(os.P_PID, self.pid, options)
        except ChildProcessError as error:
            raise self._gone() from error
        if found is None:
            return None
        if found.si_code in abi.ENDS:
            raise self._gone()
        return Stop(event=found.si_status >> 8, signal=found.si_status & 0xFF)

    def is_dead(self) -> bool:
        """Whether it has ended, reaped or not."""
        return _is_dead(self.pid)

    def reported(self) -> Stop | None:
        """The stop that it has reported already, if any.

        Raises:
            ProcessGoneError: it has ended, or we are not its tracer any more.
        """
        try:
            pid, status = os.waitpid(self.pid, abi.WALL | os.WNOHANG)
        except ChildProcessError as error:
            raise self._gone() from error
        return self.stop_of(status) if pid else None

    def _gone(self) -> ProcessGoneError:
        return ProcessGoneError(f"pid {self.pid} ended while failover examined it")

    def stop_of(self, status: int) -> Stop:
        """The stop that a wait status of it tells of.

        Raises:
            ProcessGoneError: it tells of its end.
        """
        if not os.WIFSTOPPED(status):
            raise self._gone()
        stop = Stop(event=status >> 16, signal=os.WSTOPSIG(status))
        if stop.event == abi.PTRACE_EVENT_STOP:
            self.stopped_by = stop.signal if stop.signal != signal.SIGTRAP else 0
        return stop

    def cont(self, number: int = 0) -> None:
        """Let it run, still traced; signal ``number`` is delivered first unless 0."""
        self.request("continue", abi.PTRACE_CONT, 0, number)

    def detach(self, number: int = 0) -> None:
        """Let it go for good; it must be stopped."""
        self.request("detach from", abi.PTRACE_DETACH, 0, number)

    # Registers

    def registers(self) -> bytes:
        """Read the general registers (NT_PRSTATUS)."""
        return self._getregset("read registers of", abi.NT_PRSTATUS, self._registers)

    def set_registers(self, content: bytes) -> None:
        """Write the general registers."""
        self.is_as_found = False
        self._setregset("write registers of", abi.NT_PRSTATUS, content, self._registers)

    def xstate(self) -> bytes:
        """Read what it has besides the general registers: all of `STATE_SETS`, one after the other."""
        return b"".join(self._getregset("read vector registers of", kind, self._xstate, size) for kind, size in STATE_SETS)

    def lost_in_calls(self) -> bytes:
        """The registers that calls of ours would take from it, for `give_back_lost`; empty: none."""
        if not LOST_SIZE or extended.LOST_IN_CALLS is None:
            return b""
        content = self._getregset("read vector registers of", extended.LOST_IN_CALLS, self._xstate, LOST_SIZE)
        return content if extended.is_lost_in_calls(content) else b""

    def give_back_lost(self, content: bytes) -> None:
        """Write what `lost_in_calls` has read."""
        if content and extended.LOST_IN_CALLS is not None:
            self._setregset("write vector registers of", extended.LOST_IN_CALLS, content, self._xstate)

    def register_set(self, kind: int) -> bytes:
        """Read another register set.

        Raises:
            CaptureError: it has none of this kind.
        """
        return self._getregset("read registers of", kind, self._xstate)

    def set_register_set(self, kind: int, content: bytes) -> None:
        """Write another register set."""
        self._setregset("write registers of", kind, content, self._xstate)

    def set_xstate(self, content: bytes) -> None:
        """Write what `xstate` reads."""
        for kind, part in extended.parts(content, cpuid.xstate_layout()):
            self._setregset("write vector registers of", kind, part, self._xstate)

    def _getregset(self, what: str, kind: int, buffer: ctypes.Array[ctypes.c_char], size: int = 0) -> bytes:
        self._iov.base, self._iov.length = ctypes.addressof(buffer), size or len(buffer)
        self.request(what, abi.PTRACE_GETREGSET, kind, ctypes.addressof(self._iov))
        return ctypes.string_at(buffer, self._iov.length)

    def _setregset(self, what: str, kind: int, content: bytes, buffer: ctypes.Array[ctypes.c_char]) -> None:
        ctypes.memmove(buffer, content, len(content))
        self._iov.base, self._iov.length = ctypes.addressof(buffer), len(content)
        self.request(what, abi.PTRACE_SETREGSET, kind, ctypes.addressof(self._iov))

    # Signals

    def signal_mask(self) -> int:
        """Read the mask that is in force once the present system call is over (sigsuspend's own is temporary)."""
        self.request("read the signal mask of", abi.PTRACE_GETSIGMASK, abi.SIGSET_SIZE, ctypes.addressof(self._mask))
        return self._mask.value

    def set_signal_mask(self, mask: int) -> None:
        """Set the mask; a temporary one (sigsuspend, ppoll) is forgotten, its call must be made again."""
        self._mask.value = mask
        self.request("set the signal mask of", abi.PTRACE_SETSIGMASK, abi.SIGSET_SIZE, ctypes.addressof(self._mask))

    def pending(self, *, shared: bool) -> tuple[bytes, ...]:
        """Read the queued signals, each a whole siginfo, oldest first; they stay queued.

        Args:
            shared: those sent to the process; otherwise those sent to this very thread.

        Raises:
            CaptureError: more than `PENDING_LIMIT` are queued.
        """
        found: list[bytes] = []
        if self._signals is None:
            self._signals = ctypes.create_string_buffer(PEEK_COUNT * abi.SIGINFO_SIZE)
        buffer = self._signals
        flags = abi.PTRACE_PEEKSIGINFO_SHARED if shared else 0
        while len(found) <= PENDING_LIMIT:
            order = abi.PeekSiginfo(len(found), flags, PEEK_COUNT)
            count = self.request(
                "read pending signals of", abi.PTRACE_PEEKSIGINFO, ctypes.addressof(order), ctypes.addressof(buffer)
            )
            raw = ctypes.string_at(buffer, count * abi.SIGINFO_SIZE)
            found += [raw[i * abi.SIGINFO_SIZE : (i + 1) * abi.SIGINFO_SIZE] for i in range(count)]
            if not count:  # fewer than were asked for need not be all: the kernel breaks off when a signal waits for us
                return tuple(found)
        raise CaptureError(f"pid {self.pid} has more than {PENDING_LIMIT} signals queued; capture it when it has taken them")

    # Seccomp

    def suspend_filters(self) -> None:
        """Have no seccomp filter, nor strict mode, judge its calls until it is let go: that ends by itself then."""
        self.request("suspend the seccomp filters of", abi.PTRACE_SETOPTIONS, 0, abi.PTRACE_O_SUSPEND_SECCOMP)
        self._options = abi.PTRACE_O_SUSPEND_SECCOMP

    @property
    def is_confined(self) -> bool:
        """Whether its filters judge its calls again when it is let go."""
        return bool(self._options)

    def mark_calls(self) -> None:
        """Have its stops at the beginning and the end of calls be marked (`CALL_STOP`); filters that are suspended stay so."""
        self.request("set options of", abi.PTRACE_SETOPTIONS, 0, abi.PTRACE_O_TRACESYSGOOD | self._options)

    def filter_at(self, number: int) -> tuple[bytes, int] | None:
        """One of its seccomp filters: instructions (struct sock_filter), and flags as far as the kernel tells them.

        Args:
            number: 0 is the oldest.

        Returns:
            None where it has no such one.

        Raises:
            CaptureError: EMEDIUMTYPE: the kernel has only its translation.
        """
        try:
            count = int(_ptrace(abi.PTRACE_SECCOMP_GET_FILTER, self.pid, number, 0))
        except PtraceError as error:
            if error.errno in (errno.ENOENT, errno.EINVAL):
                return None
            raise self._failure("read a seccomp filter of", error.errno or 0) from error
        content = ctypes.create_string_buffer(count * abi.SOCK_FILTER_SIZE)
        self.request("read a seccomp filter of", abi.PTRACE_SECCOMP_GET_FILTER, number, ctypes.addressof(content))
        about = (ctypes.c_uint64 * 2)(number, 0)
        with contextlib.suppress(PtraceError):  # Linux 4.16 tells
            _ptrace(abi.PTRACE_SECCOMP_GET_METADATA, self.pid, ctypes.sizeof(about), ctypes.addressof(about))
        return content.raw, int(about[1])

    def dispatches_calls(self) -> bool:
        """Whether its system calls may end in a signal handler of its own (PR_SET_SYSCALL_USER_DISPATCH)."""
        told = (ctypes.c_uint64 * 4)()  # mode, offset, length, selector
        request = abi.PTRACE_GET_SYSCALL_USER_DISPATCH_CONFIG
        with contextlib.suppress(PtraceError):  # Linux 6.4 tells
            _ptrace(request, self.pid, ctypes.sizeof(told), ctypes.addressof(told))
        return bool(told[0])

    def rseq(self) -> Rseq | None:
        """Read its restartable-sequences registration; None without one, or where the kernel cannot tell."""
        found = abi.RseqConfiguration()
        try:
            _ptrace(abi.PTRACE_GET_RSEQ_CONFIGURATION, self.pid, ctypes.sizeof(found), ctypes.addressof(found))
        except PtraceError as error:
            if error.errno == errno.EIO:
                return None
            raise self._failure("read the rseq area of", error.errno or 0) from error
        if not found.address:
            return None
        return Rseq(found.address, found.size, found.signature, found.flags)
