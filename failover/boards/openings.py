"""Which tasks of a schedule a process runs, as the kernel tells it: the process that runs a task holds a lock on its row.

Source: proc_pid_fdinfo(5), "lock:"; SCHEDULE.md.
"""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from msgspec import Struct

from failover.boards import SCHEDULE_NAME
from failover.core.schedule.layout import ROW_LOCKS
from failover.core.schedule.terms import TASKS_MAX

PROCESSES_MAX = 1_000
"""Of one program that are looked at."""


class Opening(Struct, frozen=True):
    """An open file of a process that is its schedule, and the rows that the process runs there."""

    pid: int
    path: str
    rows: tuple[int, ...]


def openings_of(pid: int) -> list[Opening]:
    """The schedules of which a process runs rows."""
    found: list[Opening] = []
    try:
        names = os.listdir(f"/proc/{pid}/fd")
    except OSError:  # it has ended
        return found
    for name in names:
        path = f"/proc/{pid}/fd/{name}"
        with contextlib.suppress(OSError):  # it was closed meanwhile
            if os.readlink(path).removesuffix(" (deleted)").endswith(f"/{SCHEDULE_NAME}"):
                rows = held_rows(Path(f"/proc/{pid}/fdinfo/{name}").read_text())
                if rows:
                    found.append(Opening(pid, path, rows))
    return found


def held_rows(fdinfo: str) -> tuple[int, ...]:
    """The rows whose locks an opening holds.

    Args:
        fdinfo: as "lock:\\t1: OFDLCK ADVISORY  WRITE -1 00:1a:77 2199023255552 2199023255552", among other lines.
    """
    rows: set[int] = set()
    for line in fdinfo.splitlines():
        words = line.split()
        if line.startswith("lock:") and "WRITE" in words and words[-2].isdigit() and words[-1].isdigit():
            first, last = int(words[-2]) - ROW_LOCKS, int(words[-1]) - ROW_LOCKS
            rows.update(range(max(first, 0), min(last, TASKS_MAX - 1) + 1))
    return tuple(sorted(rows))


def rows_of(pid: int, file: tuple[int, int]) -> set[int]:
    """The rows of one schedule that a process and its descendants run, as far as this user may look.

    Args:
        file: device and inode of the schedule.
    """
    found: set[int] = set()
    waiting = [pid]
    for _ in range(PROCESSES_MAX):
        if not waiting:
            break
        one = waiting.pop()
        for opening in openings_of(one):
            with contextlib.suppress(OSError):
                status = os.stat(opening.path)
                found.update(opening.rows if (status.st_dev, status.st_ino) == file else ())
        with contextlib.suppress(OSError):
            for thread in os.listdir(f"/proc/{one}/task"):
                waiting += map(int, Path(f"/proc/{one}/task/{thread}/children").read_text().split())
    return found
