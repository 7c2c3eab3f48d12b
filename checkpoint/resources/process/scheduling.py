"""Thread settings that only sched_setattr(2) makes: runtime, deadline and period of SCHED_DEADLINE, and a custom slice.

The capture queries them from outside, after the program has resumed: only an administrator changes them from one moment to the
next.

Facts: ``descriptors`` (none); ``threads``: a list of [tid, policy, nice, runtime, deadline, period], times in nanoseconds; for
other policies than SCHED_DEADLINE the runtime is the slice, and the rest is 0.

Source: sched_setattr(2); Documentation/scheduler/sched-deadline.rst; __setparam_fair() in kernel/sched/syscalls.c.
"""

from __future__ import annotations

import ctypes
import os
import struct
from collections.abc import Iterable
from typing import Final

from checkpoint.arch import stubs
from checkpoint.capability import Area, preserved
from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.resources.restore_context import numbers_of_thread

KIND: Final = "deadlines"

CAPABILITIES: Final = (
    preserved(
        Area.THREADS,
        "deadline scheduling (SCHED_DEADLINE), and time slices of a thread",
        "set again as far as rights and the other machine's load allow; otherwise a note names the rest",
    ),
)

SCHED_DEADLINE: Final = 6
FAIR: Final = (os.SCHED_OTHER, os.SCHED_BATCH)
"""Policies that have slices."""
RESET_ON_FORK: Final = 1
ATTRIBUTES: Final = struct.Struct("<IIQiIQQQ")
"""struct sched_attr: size, policy, flags, nice, priority, runtime, deadline, period."""
_libc: Final = ctypes.CDLL(None, use_errno=True)


def describe(pid: int) -> tuple[Resource, ...]:
    """The threads of a process that have any of it."""
    ours = _asked(0)
    told: list[Fact] = []
    for tid in thread_ids(pid):
        theirs = _asked(tid)
        if theirs is None or ours is None:
            continue  # it has ended, or the kernel does not tell
        policy, nice, runtime, deadline, period = theirs
        if policy == SCHED_DEADLINE or (policy in FAIR and runtime != ours[2]):
            try:
                inner = procfs.parse_status(procfs.read_text(pid, f"task/{tid}/status")).pids[-1]
            except (ProcessGoneError, ProbeError):
                continue  # it has ended
            told.append([inner, policy, nice, runtime, deadline, period])
    return (Resource(KIND, "deadlines and slices", {"descriptors": [], "threads": told}),) if told else ()


def _asked(tid: int) -> tuple[int, int, int, int, int] | None:
    """(policy, nice, runtime, deadline, period) of a thread; 0 is the one that asks."""
    answer = ctypes.create_string_buffer(ATTRIBUTES.size)
    if _libc.syscall(stubs.SYSTEM_CALLS["sched_getattr"], tid, answer, ATTRIBUTES.size, 0) < 0:
        return None
    _, policy, _, nice, _, runtime, deadline, period = ATTRIBUTES.unpack(answer.raw)
    return policy, nice, runtime, deadline, period


def rebuild(table: CallTable, resources: Iterable[Resource], tid: int, reset_on_fork: bool) -> None:
    """Add the call by which a thread gets its own again, after everything that gives birth."""
    for policy, nice, runtime, deadline, period in numbers_of_thread(resources, KIND, tid):
        flags = RESET_ON_FORK if reset_on_fork else 0
        packed = ATTRIBUTES.pack(ATTRIBUTES.size, policy, flags, nice, 0, runtime, deadline, period)
        lost = f"the deadline or slice of thread {tid} is not kept"
        table.attempt(lost, "sched_setattr", 0, table.place(packed), 0)
