"""The agent's only clock, and its real-time rights. Instants are integer nanoseconds of CLOCK_BOOTTIME, this machine's own.

CLOCK_MONOTONIC stands still while a machine sleeps. A lease counted by it would continue after an hour's sleep where it stood,
while another robot runs the component. By CLOCK_BOOTTIME the hour is a stall like any other, and the lease is over.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Final

from msgspec import Struct, field

from agent.system import syscalls

BOOT_ID: Final = Path("/proc/sys/kernel/random/boot_id")

WAITED_NS_MAX: Final = 1_000_000_000
"""A datagram that seems to have waited for longer tells more of a calendar that was set than of its arrival."""

MAIN_LOOP_PRIORITY: Final = 60
"""SCHED_FIFO priority of the main loop: above the interrupt threads of a PREEMPT_RT kernel (50), below its watchdogs (99)."""


class Laps(Struct):
    """How long each stage of something took: for the log, and for an engineer who wants to shorten it."""

    last_ns: int = field(default_factory=time.monotonic_ns)
    stages: list[tuple[str, int]] = field(default_factory=list)

    def lap(self, stage: str, ago_ns: int = 0) -> None:
        """The stage of that name ends now, or ended so long ago; the next one begins there."""
        end = max(time.monotonic_ns() - ago_ns, self.last_ns)
        self.stages.append((stage, end - self.last_ns))
        self.last_ns = end

    def __str__(self) -> str:
        return ", ".join(f"{stage} {took_ns / 1e6:.1f} ms" for stage, took_ns in self.stages)


def now_ns() -> int:
    """The instant, for the core and for leases."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def wall_ns(instant_ns: int) -> int:
    """An instant of our clock by this machine's calendar, in nanoseconds since 1970; for a person's eyes only."""
    return time.time_ns() - (now_ns() - instant_ns)


def now_and_arrival_ns(wall_ns: int) -> tuple[int, int]:
    """Now; and when a datagram came that the kernel stamped with this instant of the calendar (0: it did not).

    Where it seems to have waited longer than `WAITED_NS_MAX`, or not to have come yet, the calendar was set: then it came now. It
    is never told too early, and by at most as much too late as passes between two readings of a clock.
    """
    if not wall_ns:
        now = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        return now, now
    ago_ns = time.time_ns() - wall_ns
    now = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
    return now, now - ago_ns if 0 <= ago_ns <= WAITED_NS_MAX else now


def kernel_boot() -> str:
    """A name for this boot of the kernel: our clock begins anew with it. Source: random(4)."""
    try:
        return BOOT_ID.read_text().strip()
    except OSError:
        return ""


def become_realtime() -> tuple[str, ...]:
    """Run this process ahead of ordinary ones and keep its memory resident; what is not permitted comes back as sentences.

    Source: sched(7), mlockall(2).
    """
    notes: list[str] = []
    try:
        if (priority := syscalls.become_realtime(MAIN_LOOP_PRIORITY)) < MAIN_LOOP_PRIORITY:
            notes.append(
                f"beats run at real-time priority {priority}: what has a higher one may delay them; "
                f"allow {MAIN_LOOP_PRIORITY} (LimitRTPRIO, ulimit -r)"
            )
    except OSError as error:
        notes.append(
            f"beats run at normal priority: the system refused SCHED_FIFO ({error.strerror}); "
            "under load a live robot may be taken for "
            "dead; give the agent CAP_SYS_NICE or a LimitRTPRIO, see systemd/failover-agent.service"
        )
    try:
        syscalls.lock_memory()
    except OSError as error:
        notes.append(f"the main loop's memory can be swapped out: {error.strerror}; give the agent CAP_IPC_LOCK")
    return tuple(notes)


def age_ns(descriptor: int) -> int:
    """How long ago a file was written, by this machine's calendar; never negative."""
    return max(0, time.time_ns() - os.fstat(descriptor).st_mtime_ns)
