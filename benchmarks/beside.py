"""One more snapshot of a program that runs: how long it stands still, until it is whole, its size; ours beside others'."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, TypeVar

from benchmarks import alternatives, engine, machine
from benchmarks.alternatives import Alternative, Criu
from benchmarks.figures import OURS, Absent, Figure, Findings
from benchmarks.running import Running, running
from checkpoint.keeper import messages
from failover.cli.keeper_client import Keeper

SIZES_MB: Final = (10, 100, 500)
DIRTY_KB: Final = 400
MORE_OF_OURS: Final = 5
"""So many snapshots of ours for one of the others': a robot takes some each second, all day."""
NOBODY: Final = "nobody"
FIRST_BASE: Final = f"{OURS}, first base"

SEEN: Final = ("the program stands still (its own clock)", "until the snapshot is whole", "size of the snapshot")

NANOSECONDS_A_MILLISECOND: Final = 1_000_000

T = TypeVar("T")


@dataclass(slots=True)
class Observed:
    """Figures of one snapshot after another by the same maker."""

    stops_ms: list[float] = field(default_factory=list)
    walls_ms: list[float] = field(default_factory=list)
    sizes_mb: list[float] = field(default_factory=list)

    def figures(self, case: str, who: str) -> list[Figure]:
        """One figure for each of the three that was seen at all."""
        rows = zip(SEEN, ("ms", "ms", "MB"), (self.stops_ms, self.walls_ms, self.sizes_mb), strict=True)
        return [Figure(what, case, unit, tuple(values), who) for what, unit, values in rows if values]


def beside(quick: bool, directory: Path) -> Findings:
    """The same program under every maker of snapshots, one after the other."""
    with images() as place:
        present, absent = _present(place)
        figures: list[Figure] = []
        for megabytes in SIZES_MB[: 2 if quick else None]:
            figures += _of_size(megabytes, 3 if quick else 8, present, directory, place)
    return Findings(
        "One more snapshot, beside what a user would pick instead",
        f"A program with random memory of the given size writes {DIRTY_KB} KB of it anew each 50 ms and reads its clock without "
        "a pause; the longest time between two readings is what it felt. Ours is a delta, the others write the whole program "
        f"again each time. “{NOBODY}”: no snapshot at all, only the machine's own delays. The memory that an image takes "
        "has been in use just before, for every maker: on a virtual machine the first use of memory takes its host's time.",
        tuple(sorted(figures, key=lambda figure: SEEN.index(figure.benchmark))),
        absent,
    )


def _present(place: Path) -> tuple[list[Alternative], tuple[Absent, ...]]:
    """The alternatives that can be measured here, and those that cannot."""
    reasons = {}
    for one in alternatives.ALTERNATIVES:
        with fresh(place) as directory:
            reasons[one.name] = one.why_absent(directory)
    present = [one for one in alternatives.ALTERNATIVES if not reasons[one.name]]
    absent = tuple(Absent(name, reason) for name, reason in reasons.items() if reason)
    return present, absent


def _of_size(megabytes: int, count: int, present: list[Alternative], directory: Path, place: Path) -> list[Figure]:
    case = f"{megabytes} MB"
    with running("watching", megabytes, DIRTY_KB, directory=directory) as program:
        found = _nobody(program, count).figures(case, NOBODY)
        found += _ours(program, MORE_OF_OURS * count, megabytes)
        for one in present:
            found += _theirs(program, count, one, place, megabytes).figures(case, one.name)
    return found


def _nobody(program: Running, count: int) -> Observed:
    seen = Observed()
    for _ in range(count):
        _watched(program, seen, lambda: time.sleep(engine.PERIOD_S))
    seen.walls_ms.clear()
    return seen


def _ours(program: Running, count: int, megabytes: int) -> list[Figure]:
    first, further = Observed(), Observed()
    case = f"{megabytes} MB"
    with Keeper.spawn() as keeper:
        keeper.ask(messages.Protect(program.pid, "/benchmark"), messages.Protected)
        machine.touch_memory(engine.ROOM * megabytes)
        for sequence in range(1, count + 2):
            seen = further if sequence > 1 else first
            time.sleep(engine.PERIOD_S)
            captured = _watched(program, seen, lambda: engine.capture(keeper, base=sequence == 1, sequence=sequence).told)  # noqa: B023
            seen.sizes_mb.append(captured.size / 1e6)
        keeper.ask(messages.Release(), messages.Released)
    return further.figures(case, OURS) + first.figures(case, FIRST_BASE)


def _theirs(program: Running, count: int, maker: Alternative, place: Path, megabytes: int) -> Observed:
    seen = Observed()
    for _ in range(count):
        machine.touch_memory(engine.ROOM * megabytes)
        with fresh(place) as directory:
            _watched(program, seen, lambda: maker.snapshot(program.pid, directory))
            seen.sizes_mb.append(alternatives.size_of(directory) / 1e6)
    return seen


def _watched(program: Running, seen: Observed, act: Callable[[], T]) -> T:
    """Carry out one act and note how long it took, and the longest time that the program stood still meanwhile."""
    began_ns = time.monotonic_ns()
    result = act()
    ended_ns = time.monotonic_ns()
    stops = [longest for instant, longest in program.records_until(ended_ns) if instant > began_ns]
    seen.walls_ms.append((ended_ns - began_ns) / NANOSECONDS_A_MILLISECOND)
    seen.stops_ms.append(max(stops) / NANOSECONDS_A_MILLISECOND)
    return result


# --- Restore -----------------------------------------------------------------------------------------------------------


def restored_by_criu(quick: bool, directory: Path) -> tuple[list[Figure], tuple[Absent, ...]]:
    """CRIU's restore of the very program that `engine.restore` measures, until it runs."""
    criu = Criu()
    with images() as place:
        with fresh(place) as probe:
            reason = criu.why_absent(probe)
        if reason:
            return [], (Absent(criu.name, reason),)
        count = 3 if quick else 8
        sizes = SIZES_MB[: 2 if quick else None]
        return [_restore_by_criu(criu, megabytes, count, directory, place) for megabytes in sizes], ()


def _restore_by_criu(criu: Criu, megabytes: int, count: int, directory: Path, place: Path) -> Figure:
    times: list[float] = []
    with fresh(place) as image, engine.resident(megabytes, 40, directory) as pid:
        criu.dump_and_kill(pid, image)
        for _ in range(count):
            machine.touch_memory(engine.ROOM * megabytes)
            began = time.perf_counter()
            criu.restore(image)
            times.append((time.perf_counter() - began) * 1000)
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
    return Figure("restore", f"{megabytes} MB", "ms", tuple(times), criu.name)


@contextmanager
def images() -> Iterator[Path]:
    """A place for images, emptied afterwards."""
    with tempfile.TemporaryDirectory(prefix="failover-images-", dir=machine.images_place()) as place:
        yield Path(place)


@contextmanager
def fresh(place: Path) -> Iterator[Path]:
    """An empty directory for one image; removed at once, for images are large."""
    directory = Path(tempfile.mkdtemp(dir=place))
    try:
        yield directory
    finally:
        shutil.rmtree(directory, ignore_errors=True)
