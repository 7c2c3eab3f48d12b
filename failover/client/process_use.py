"""What the processes of a component use of this machine: processor time and memory, by psutil."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator

import psutil
from msgspec import Struct


class Use(Struct, frozen=True):
    """What a program and its descendants use.

    Attributes:
        cpu: processor time as a share of one core: since the meter looked last, at its first look since the program began.
        memory: bytes of resident memory of all of them; what they share counts for each.
        processes: how many they are.
    """

    cpu: float
    memory: int
    processes: int


class Meter:
    """Looks at programs again and again."""

    def __init__(self) -> None:
        self._seen: dict[tuple[int, float], tuple[float, float]] = {}

    def of(self, pid: int) -> Use | None:
        """Of the program with this pid; None where it has ended, or is another user's whom we may not look at."""
        with contextlib.suppress(psutil.Error):
            first, now = psutil.Process(pid), time.time()
            shares, memory, count = 0.0, 0, 0
            for process in (first, *first.children(recursive=True)):
                for share, size in self._looked_at(process, now):
                    shares, memory, count = shares + share, memory + size, count + 1
            self._seen = {key: seen for key, seen in self._seen.items() if psutil.pid_exists(key[0])}
            return Use(shares, memory, count) if count else None
        return None

    def _looked_at(self, process: psutil.Process, now: float) -> Iterator[tuple[float, int]]:
        """Its share of a core and its memory; nothing of one that has ended meanwhile."""
        with contextlib.suppress(psutil.Error):
            with process.oneshot():
                times, born, memory = process.cpu_times(), process.create_time(), process.memory_info().rss
            used = times.user + times.system
            key = (process.pid, born)
            since, before = self._seen.get(key, (born, 0.0))
            self._seen[key] = (now, used)
            yield max(used - before, 0.0) / max(now - since, 1e-3), memory
