"""Inspect and suspend the seccomp(2) filters of a program, and decide whether a tracer may make calls inside it.

A filter judges the calls that a thread makes for the tracer like the thread's own, and kills for them. A tracer with
CAP_SYS_ADMIN may suspend the filter for as long as it holds the thread (`Tracee.suspend_filters`). The tracer asks for that when
the thread is already stopped, and the suspension ends when the tracer releases the thread: the filter judges every call of the
thread's own.

Source: seccomp(2); ptrace(2), PTRACE_O_SUSPEND_SECCOMP, PTRACE_SECCOMP_GET_FILTER; check_ptrace_options() in kernel/ptrace.c,
seccomp_get_filter() in kernel/seccomp.c.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import os
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from msgspec import Struct

from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.tasks import thread_count, thread_ids
from checkpoint.linux.spawn.bpf import returned_constants
from checkpoint.linux.trace.tracee import Tracee

STRICT: Final = 1
FILTERED: Final = 2
"""Modes, as /proc/PID/status says; 0 is none."""
FLAG_LOG: Final = 2
"""SECCOMP_FILTER_FLAG_LOG."""
ASKS_ANOTHER: Final = 0x7FC00000
"""SECCOMP_RET_USER_NOTIF."""
CAP_SYS_ADMIN: Final = 21
WHOLE_MACHINE: Final = ["0", "0", "4294967295"]
"""The words of uid_map in the first user namespace (user_namespaces(7))."""


class Filter(Struct, frozen=True):
    """One filter.

    Attributes:
        instructions: as given to seccomp(2), struct sock_filter after struct sock_filter.
        is_logged: SECCOMP_FILTER_FLAG_LOG.
    """

    instructions: bytes
    is_logged: bool = False


class Confinement(Struct, frozen=True):
    """The confinement of one thread; the filters are told oldest first."""

    is_strict: bool = False
    filters: tuple[Filter, ...] = ()

    def __bool__(self) -> bool:
        return self.is_strict or bool(self.filters)


FREE: Final = Confinement()
NO_MODES: Final[Mapping[int, int]] = MappingProxyType({})


def mode_in(status: bytes) -> int:
    """The mode, of an unparsed /proc/PID/status; 0 also where the kernel has no seccomp."""
    begin = status.find(b"\nSeccomp:\t")
    return 0 if begin < 0 else int(status[begin + len(b"\nSeccomp:\t") :].split(b"\n", 1)[0])


def modes(pid: int) -> Mapping[int, int]:
    """The modes of a process's threads besides the first, of those that have one."""
    if thread_count(pid) == 1:
        return NO_MODES
    found: dict[int, int] = {}
    for tid in thread_ids(pid):
        with contextlib.suppress(ProcessGoneError, ProbeError):  # it has ended
            found[tid] = mode_in(procfs.read_bytes(pid, f"task/{tid}/status"))
    return {tid: mode for tid, mode in found.items() if mode and tid != pid}


@functools.cache
def why_not() -> str:
    """Why we may not suspend filters; "" if we may."""
    ours = procfs.status(os.getpid())
    if ours.seccomp:
        return "failover runs under one itself: run it outside"
    is_first = procfs.read_text(os.getpid(), "uid_map").split() == WHOLE_MACHINE
    if not (is_first and ours.capabilities[2] >> CAP_SYS_ADMIN & 1):
        return "to suspend it takes CAP_SYS_ADMIN: run failover as root, or the program without the filter"
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ptrace(abi.PTRACE_SEIZE, os.getpid(), 0, abi.PTRACE_O_SUSPEND_SECCOMP)  # never succeeds: no process can trace itself
    if ctypes.get_errno() == errno.EINVAL:
        return "this kernel cannot suspend it: boot one with CONFIG_CHECKPOINT_RESTORE, or run the program without the filter"
    return ""


def newer(tracee: Tracee, number: int) -> tuple[Filter, ...]:
    """Its filters from the one with this number on; it stands still, and may be in another mode.

    Raises:
        CaptureError: the kernel does not tell one of them.
    """
    found: list[Filter] = []
    while (told := tracee.filter_at(number + len(found))) is not None:
        found.append(Filter(told[0], bool(told[1] & FLAG_LOG)))
    return tuple(found)


def asks_another(one: Filter) -> bool:
    """Whether it leaves some calls to the judgement of another process."""
    return any(value & 0xFFFF0000 == ASKS_ANOTHER for value in returned_constants(one.instructions))
