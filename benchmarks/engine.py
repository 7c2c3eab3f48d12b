"""The engine by itself: freeze time of a base and of deltas, size and time of a capture, time of a restore and of a takeover."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks import machine
from benchmarks.figures import Figure
from benchmarks.running import running
from checkpoint.keeper import messages
from checkpoint.linux.spawn import vessel
from checkpoint.linux.spawn.vessel import Birth
from failover.cli.keeper_client import Keeper

SIZES_MB = (10, 100, 500, 1000)
CASES: tuple[tuple[int, int, int], ...] = (
    *((megabytes, dirty_kb, 30) for megabytes in (10, 500) for dirty_kb in (40, 400, 2000)),
    (100, 40, 30),
    (100, 400, 1000),
    (100, 2000, 30),
    (1000, 4000, 100),
)
"""MB resident, KB written each `PERIOD_S`, snapshots. So many in one case that its 99th percentile says something."""
ROOM = 3
"""Times its size that a program's image may take in memory, read, encoded and written."""
QUICK_CASES = ((10, 400, 20), (100, 400, 20))

PERIOD_S = 0.05
"""Between two snapshots, and between two writings of the program: each delta carries what was written once, or twice."""


def freeze(quick: bool, directory: Path) -> list[Figure]:
    """The delay that the program feels: how long it stands still for the first base and for each delta."""
    found = []
    for megabytes, dirty_kb, count in QUICK_CASES if quick else CASES:
        found += _freeze_of(megabytes, dirty_kb, count, directory)
    return found


def _freeze_of(megabytes: int, dirty_kb: int, count: int, directory: Path) -> list[Figure]:
    case = f"{megabytes} MB, {dirty_kb} KB written each 50 ms"
    freezes: list[float] = []
    walls: list[float] = []
    dirty: list[float] = []
    with resident(megabytes, dirty_kb, directory) as pid, Keeper.spawn() as keeper:
        keeper.ask(messages.Protect(pid, "/benchmark"), messages.Protected)
        base = capture(keeper, base=True, sequence=1).told
        for sequence in range(2, count + 2):
            time.sleep(PERIOD_S)
            taken = capture(keeper, base=False, sequence=sequence)
            freezes.append(taken.told.freeze_us / 1000)
            walls.append(taken.wall_ms)
            dirty.append(taken.told.dirty_bytes / 1e6)
        keeper.ask(messages.Release(), messages.Released)
    return [
        Figure("freeze of the first base", case, "ms", (base.freeze_us / 1000,)),
        Figure("freeze of a delta", case, "ms", tuple(freezes)),
        Figure("capture of a delta, encoded", case, "ms", tuple(walls)),
        Figure("pages in a delta", case, "MB", tuple(dirty)),
    ]


@contextmanager
def resident(megabytes: int, dirty_kb: int, directory: Path, *, by_chance: bool = False) -> Iterator[int]:
    """The measured program; yields its PID once it has all its memory.

    Args:
        by_chance: what it writes does not compress.
    """
    with running("resident", megabytes, dirty_kb, int(by_chance), directory=directory) as program:
        yield program.pid


@dataclass(frozen=True, slots=True)
class Taken:
    """One snapshot.

    Attributes:
        told: by the keeper.
        wall_ms: milliseconds from asking to having it encoded.
        size: encoded, in bytes.
    """

    told: messages.Captured
    wall_ms: float
    size: int


def capture(keeper: Keeper, base: bool, sequence: int) -> Taken:
    """One snapshot, acknowledged at once."""
    began = time.perf_counter()
    captured, (content,) = keeper.ask(messages.Capture(base=base, generation=1, sequence=sequence), messages.Captured)
    wall_ms = (time.perf_counter() - began) * 1000
    size = os.fstat(content).st_size
    os.close(content)
    keeper.tell(messages.Acknowledge(captured.position))
    return Taken(captured, wall_ms, size)


def restore(quick: bool, directory: Path) -> list[Figure]:
    """From an encoded base in memory to the program running: whole, and where a ready copy has its memory already."""
    found = []
    for megabytes in SIZES_MB[: 2 if quick else None]:
        found += _restores_of(megabytes, 3 if quick else 8, directory)
    return found


def _restores_of(megabytes: int, count: int, directory: Path) -> list[Figure]:
    with resident(megabytes, 40, directory) as pid, Keeper.spawn() as keeper:
        keeper.ask(messages.Protect(pid, "/benchmark"), messages.Protected)
        _, (content,) = keeper.ask(messages.Capture(base=True, generation=1, sequence=1, hold=True), messages.Captured)
        os.kill(pid, signal.SIGKILL)
    whole = tuple(_restored_once(content, pid, megabytes) for _ in range(count))
    ready, again = zip(*(_taken_over_once(content, pid) for _ in range(count)), strict=True)
    os.close(content)
    case = f"{megabytes} MB"
    return [
        Figure("restore", case, "ms", whole),
        Figure("takeover from a ready copy", case, "ms", ready),
        Figure("… and protected again", case, "ms", again),
    ]


def _taken_over_once(content: int, pid: int) -> tuple[float, float]:
    """From the order to the program running, and to its being protected again; what the copy took before is its memory's."""
    with Keeper.spawn() as keeper:
        born = vessel.spawn_vessel(Birth(pid))
        try:
            laid, _ = keeper.ask(messages.Lay(born.pid, "/benchmark"), messages.Laid, (content,))
            began_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
            keeper.ask(messages.Finish(messages.Restore(born.pid, "/benchmark"), laid.position), messages.Restored)
            resumed, _ = keeper.ask(messages.Resume(), messages.Resumed)
            return (resumed.let_go_ns - began_ns) / 1e6, (time.clock_gettime_ns(time.CLOCK_BOOTTIME) - began_ns) / 1e6
        finally:
            vessel.discard(born)


def _restored_once(content: int, pid: int, megabytes: int) -> float:
    with Keeper.spawn() as keeper:
        wait_until_ready(keeper)
        machine.touch_memory(ROOM * megabytes)
        began_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        born = vessel.spawn_vessel(Birth(pid))
        try:
            keeper.ask(messages.Restore(born.pid, "/benchmark"), messages.Restored, (content,))
            resumed, _ = keeper.ask(messages.Resume(), messages.Resumed)
            return (resumed.let_go_ns - began_ns) / 1e6
        finally:
            vessel.discard(born)


def wait_until_ready(keeper: Keeper) -> None:
    """A standby's keeper runs already when it is needed: the interpreter's start is not part of a restore."""
    keeper.ask(messages.Probe(os.getpid()), messages.Probed)
