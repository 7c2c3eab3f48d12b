"""The whole: from the power cut of a robot to the next output of its programs at the other one."""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from benchmarks.figures import Figure
from benchmarks.running import BenchmarkError
from failover.cli.demo.robots import RobotMachine, Stage, means

CUTS = {1: 5, 2: 4, 4: 3}
"""Programs that are taken over at once, and how often the power is cut for it."""

QUICK_CUTS = {1: 2}

COUNTING: Final = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.01)\n"
"""Prints every 10 ms."""

KEEPING: Final = """
import time
import failover
count = failover.resume("count", default={"i": 0})
while True:
    print(count["i"], flush=True)
    count["i"] += 1
    failover.commit()
    time.sleep(0.01)
"""
"""The same, and keeps its state itself."""

SLOW_IMPORT: Final = """
import time
began = time.monotonic()
import numpy
while time.monotonic() - began < 0.5:
    numpy.linalg.svd(numpy.ones((200, 200)))
"""
"""numpy, and as much work again as makes half a second of it, as a larger library does while it is imported."""

KEPT_CUTS = 3
QUICK_KEPT_CUTS = 1
COLD: Final = '[components."/demo/robot1/count0"]\nwarm = false\n'

SNAPSHOTS = 15
PATIENCE_S = 60.0
IN_FLIGHT_S = 0.03
"""A snapshot that was on its way at the cut may still lengthen the standby's log so much later."""


def outage(quick: bool, directory: Path) -> list[Figure]:
    """Cut a robot's power again and again, with one, two and four programs running there."""
    return [outages(story, directory) for story in (*_from_memory(quick), *_from_kept_states(quick))]


@dataclass(frozen=True, slots=True)
class Story:
    """One case: which program runs there, and how often.

    Attributes:
        count: of programs at once.
        settings: lines added to both robots' configurations.
        warm: their standby waits for them with their programs started.
    """

    case: str
    argv: tuple[str, ...]
    count: int
    cuts: int
    settings: str = ""
    engine: str = "ptrace"
    warm: bool = False


def _from_memory(quick: bool) -> list[Story]:
    """Programs that know nothing of it."""
    argv = ("/usr/bin/python3", "-S", "-c", COUNTING)
    return [Story(f"{count} at once", argv, count, cuts) for count, cuts in (QUICK_CUTS if quick else CUTS).items()]


def _from_kept_states(quick: bool) -> list[Story]:
    """Programs that keep their state themselves: as a takeover finds them, started in advance or not."""
    cuts = QUICK_KEPT_CUTS if quick else KEPT_CUTS
    stories = []
    for what, script in (("a counter", KEEPING), ("an import of 0.5 s", SLOW_IMPORT + KEEPING)):
        argv = (sys.executable, "-c", script)
        stories.append(Story(f"keeps its state, {what}, warm", argv, 1, cuts, engine="cooperative", warm=True))
        stories.append(Story(f"keeps its state, {what}, cold", argv, 1, cuts, COLD, engine="cooperative"))
    return stories


def outages(story: Story, directory: Path) -> Figure:
    found: list[float] = []
    for number in range(story.cuts):
        with Stage(directory / f"outage-{story.case.replace(' ', '-')}-{number}", means(), story.settings) as stage:
            stage.directory.mkdir()
            stage.start()
            found += _one_cut(stage, story)
    return Figure("power cut to next output", story.case, "ms", tuple(found))


def _one_cut(stage: Stage, story: Story) -> list[float]:
    """Milliseconds from the cut to the first byte that each program writes at the standby."""
    primary, standby = stage.robots
    count = story.count
    for number in range(count):
        with primary.control() as link:
            link.ask("run", argv=list(story.argv), name=f"count{number}", cwd="/", wait=False, engine=story.engine)
    _wait_for_standby(standby, story)
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


def _wait_for_standby(standby: RobotMachine, story: Story) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        components = standby.status()["components"]
        ready = [(one["snapshots"] or 0) >= SNAPSHOTS and bool(one["warm"]) == story.warm for one in components]
        if len(ready) == story.count and all(ready):
            return
        time.sleep(0.02)
    raise BenchmarkError(
        f"{story.case}: {standby.name} did not get {SNAPSHOTS} snapshots of each program: {standby.last_words()}"
    )
