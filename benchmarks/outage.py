"""The whole: from the power cut of a robot to the next output of its programs at the other one."""

from __future__ import annotations

import time
from pathlib import Path

from benchmarks.figures import Figure
from benchmarks.running import BenchmarkError
from failover.cli.demo.robots import RobotMachine, Stage, means

CUTS = {1: 5, 2: 4, 4: 3}
"""Programs that are taken over at once, and how often the power is cut for it."""

QUICK_CUTS = {1: 2}

COUNTING = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.01)\n"
"""Prints every 10 ms."""

SNAPSHOTS = 15
PATIENCE_S = 60.0
IN_FLIGHT_S = 0.03
"""A snapshot that was on its way at the cut may still lengthen the standby's log so much later."""


def outage(quick: bool, directory: Path) -> list[Figure]:
    """Cut a robot's power again and again, with one, two and four programs running there."""
    return [_outages(count, cuts, directory) for count, cuts in (QUICK_CUTS if quick else CUTS).items()]


def _outages(count: int, cuts: int, directory: Path) -> Figure:
    found: list[float] = []
    for number in range(cuts):
        with Stage(directory / f"outage-{count}-{number}", means()) as stage:
            stage.directory.mkdir()
            stage.start()
            found += _one_cut(stage, count)
    return Figure("power cut to next output", f"{count} at once", "ms", tuple(found))


def _one_cut(stage: Stage, count: int) -> list[float]:
    """Milliseconds from the cut to the first byte that each program writes at the standby."""
    primary, standby = stage.robots
    for number in range(count):
        with primary.control() as link:
            link.ask("run", argv=["/usr/bin/python3", "-S", "-c", COUNTING], name=f"count{number}", cwd="/", wait=False)
    _wait_for_snapshots(standby, count)
    cut = time.monotonic()
    primary.cut_power()
    logs = sorted((standby.directory / "state" / "logs").glob("*/stdout.log"))
    sizes = {log: log.stat().st_size for log in logs}
    first: dict[Path, float] = {}
    while len(first) < count:
        now = time.monotonic()
        if now > cut + PATIENCE_S:
            raise BenchmarkError(
                f"{count - len(first)} of {count} programs did not go on at {standby.name}: {standby.last_words()}"
            )
        for log in logs:
            size = log.stat().st_size
            if size > sizes[log] and now > cut + IN_FLIGHT_S:
                first.setdefault(log, now)
            sizes[log] = size
        time.sleep(0.0005)
    return [(instant - cut) * 1e3 for instant in first.values()]


def _wait_for_snapshots(standby: RobotMachine, count: int) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        components = standby.status()["components"]
        if len(components) == count and all((one["snapshots"] or 0) >= SNAPSHOTS for one in components):
            return
        time.sleep(0.02)
    raise BenchmarkError(f"no {SNAPSHOTS} snapshots of each program came to {standby.name}: {standby.last_words()}")
