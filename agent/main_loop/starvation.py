"""Tells whether a silent process could have run: how much of a time it ran, slept, or waited for a processor.

A process that waits for a processor does not hang; another process in its place would wait, too.
Source: proc_pid_schedstat (Documentation/scheduler/sched-stats.rst), proc_pid_stat(5).
"""

from __future__ import annotations

import os

from msgspec import Struct

RUNNABLE = "R"


class Turns(Struct, frozen=True):
    """One look at a process.

    Attributes:
        ran_ns, waited_ns: of all its threads since they began: on a processor, and waiting for one.
        is_ready: a thread runs, or would run if it had a processor.
    """

    ran_ns: int
    waited_ns: int
    is_ready: bool


def look(pid: int) -> Turns | None:
    """The process as it is now; None where the kernel does not tell."""
    ran_ns = waited_ns = 0
    is_ready = False
    try:
        for thread in os.listdir(f"/proc/{pid}/task"):
            with open(f"/proc/{pid}/task/{thread}/schedstat", encoding="ascii") as file:
                ran, waited, _ = file.read().split()
            with open(f"/proc/{pid}/task/{thread}/stat", encoding="utf-8", errors="replace") as file:
                is_ready |= file.read().rpartition(")")[2].split()[0] == RUNNABLE
            ran_ns, waited_ns = ran_ns + int(ran), waited_ns + int(waited)
    except (OSError, ValueError):
        return None
    return Turns(ran_ns, waited_ns, is_ready)


def had_ns(before: Turns | None, now: Turns | None, passed_ns: int) -> int:
    """How much of the time between two looks the process had: it ran then, or wanted no processor.

    A wait is added to `waited_ns` when it ends, so one that still goes on is told by `is_ready` alone.
    """
    if before is None or now is None:
        return passed_ns
    ran_ns = min(max(now.ran_ns - before.ran_ns, 0), passed_ns)
    waited_ns = passed_ns if before.is_ready and now.is_ready else max(now.waited_ns - before.waited_ns, 0)
    return max(passed_ns - waited_ns, ran_ns)
