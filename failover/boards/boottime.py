"""The clock of the board: CLOCK_BOOTTIME of the initial time namespace, the one that a robot's processes share.

A protected program may live in a time namespace of its own, so that its clocks go on after a takeover; they may differ from the
machine's by years. Only this file and the closures of `failover.core.board.banks` read the clock for stamps.

Source: time_namespaces(7), /proc/PID/timens_offsets.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Final

CLOCK: Final = time.clock_gettime_ns
_OFFSETS: Final = Path("/proc/self/timens_offsets")
_NS_PER_S: Final = 1_000_000_000


def skew_ns(clock: str = "boottime") -> int:
    """What this process's CLOCK_BOOTTIME, or "monotonic", is ahead of the machine's; 0 on a kernel without time namespaces.

    To be read again after a restore: the program may be in another namespace.
    """
    try:
        rows = [line.split() for line in _OFFSETS.read_text().splitlines()]
    except OSError:
        return 0
    return next((int(row[1]) * _NS_PER_S + int(row[2]) for row in rows if row[0] == clock), 0)


def now_ns(skew: int) -> int:
    """The machine's CLOCK_BOOTTIME."""
    return CLOCK(time.CLOCK_BOOTTIME) - skew


def now_monotonic_ns() -> int:
    """This process's CLOCK_MONOTONIC."""
    return CLOCK(time.CLOCK_MONOTONIC)


def machine_ns() -> int:
    """The machine's CLOCK_MONOTONIC, which the schedule goes by."""
    return CLOCK(time.CLOCK_MONOTONIC) - skew_ns("monotonic")


def boot_id() -> bytes:
    """Sixteen bytes that name this boot of the kernel."""
    return bytes.fromhex(Path("/proc/sys/kernel/random/boot_id").read_text().strip().replace("-", ""))
