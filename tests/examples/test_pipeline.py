"""The pipeline of examples/, in two processes: its order, and its odometry and its mapper killed and started again."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from math import cos, sin
from pathlib import Path
from typing import NamedTuple

import pytest

from failover.schedule.overview import Seen, open_schedule, overview

EXAMPLE = Path(__file__).parents[2] / "examples" / "pipeline.py"
LIMIT_S = 120

pytestmark = pytest.mark.timeout(4 * LIMIT_S)  # five starts of Python, at worst on a machine that gives them little


class Line(NamedTuple):
    """What the mapper prints of one map."""

    number: int
    step: int
    x: float
    y: float
    older_ms: int


class Pipeline:
    """Where both programs run, and what they have printed in all their lives."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._running: list[subprocess.Popen[bytes]] = []

    def start(self, mode: str, life: int = 1) -> subprocess.Popen[bytes]:
        environment = {key: value for key, value in os.environ.items() if not key.startswith("FAILOVER_")}
        environment["FAILOVER_BOARD"] = str(self.folder / "board")
        with open(self.folder / f"{mode}{life}.printed", "wb") as printed, open(self.folder / f"{mode}{life}.said", "wb") as said:
            started = subprocess.Popen(
                [sys.executable, EXAMPLE, mode], cwd=self.folder, env=environment, stdout=printed, stderr=said
            )
        self._running.append(started)
        return started

    def kill_all(self) -> None:
        for one in self._running:
            one.kill()
            one.wait()

    def maps(self, life: int = 1) -> list[Line]:
        text = (self.folder / f"mapper{life}.printed").read_text()
        found = []
        for line in text.splitlines(keepends=True):
            if line.endswith("\n"):
                words = re.fullmatch(r"(\d+) step (\d+) at (\S+) (\S+), (\d+) ms older\n", line)
                assert words, line
                found.append(Line(int(words[1]), int(words[2]), float(words[3]), float(words[4]), int(words[5])))
        return found

    def resumed_after(self, mode: str, life: int) -> int:
        """The step or map after which a later life goes on; 0 until it has said so."""
        found = re.search(r"^goes on after \w+ (\d+), [\d.]+ s old$", self.said(mode, life), re.MULTILINE)
        return int(found[1]) if found else 0

    def said(self, mode: str, life: int) -> str:
        return (self.folder / f"{mode}{life}.said").read_text()

    def is_kept(self, mode: str) -> bool:
        return any(self.folder.glob(f"{mode}.state/@*/*.base"))

    def mapper_seen(self) -> Seen:
        file = open_schedule(self.folder / "board")
        try:
            return next(one for one in overview(file) if one.task == "mapper")
        finally:
            file.close()

    def until(self, condition: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + LIMIT_S
        while not condition():
            told = [path.read_text()[-2000:] for path in self.folder.glob("*.said")]
            assert time.monotonic() < end, f"waited {LIMIT_S} s in vain for {what}; {told}"
            time.sleep(0.01)

    def until_more_maps(self, more: int, life: int = 1) -> None:
        before = len(self.maps(life))
        self.until(lambda: len(self.maps(life)) >= before + more, f"{more} more maps")


@contextmanager
def pipeline(folder: Path) -> Iterator[Pipeline]:
    made = Pipeline(folder)
    try:
        yield made
    finally:
        made.kill_all()


def are_numbered_from(first: int, maps: list[Line]) -> bool:
    return [one.number for one in maps] == list(range(first, first + len(maps)))


def is_on_the_way(maps: list[Line]) -> bool:
    """Whether each pose is that of its step: all of it was kept together, and no step is left out or done twice."""
    places, x, y, heading = [(0.0, 0.0)], 0.0, 0.0, 0.0
    for _ in range(max(one.step for one in maps)):
        heading += 0.5 * 0.01
        x, y = x + 0.01 * cos(heading), y + 0.01 * sin(heading)
        places.append((x, y))
    return all(abs(one.x - places[one.step][0]) + abs(one.y - places[one.step][1]) < 0.002 for one in maps)


def test_each_map_is_drawn_from_the_pose_of_its_instant_however_late_that_is(tmp_path: Path) -> None:
    with pipeline(tmp_path) as both:
        both.start("mapper")  # waits for the first pose
        odometry = both.start("odometry")
        both.until_more_maps(10)
        odometry.send_signal(signal.SIGSTOP)
        both.until(
            lambda: (seen := both.mapper_seen()).state == "held" and seen.past_deadline_ns > 0,
            "the mapper to wait for an odometry that stands still, past its deadline",
        )
        odometry.send_signal(signal.SIGCONT)
        both.until_more_maps(10)
        maps = both.maps()
        assert [one for one in maps if one.older_ms] == []
        assert are_numbered_from(1, maps) and is_on_the_way(maps)


def test_each_program_is_killed_and_goes_on_with_its_state_and_the_other_one_goes_on_meanwhile(tmp_path: Path) -> None:
    with pipeline(tmp_path) as both:
        odometry, mapper = both.start("odometry"), both.start("mapper")
        both.until_more_maps(10)
        both.until(lambda: both.is_kept("odometry") and both.is_kept("mapper"), "their states")

        odometry.kill()
        odometry.wait()
        both.until(lambda: both.maps()[-1].older_ms > 0, "maps without an odometry")
        both.until_more_maps(3)
        alone = both.maps()[-1]
        both.start("odometry", life=2)
        both.until(lambda: both.maps()[-1].older_ms == 0, "the odometry to go on")
        resumed_after = both.resumed_after("odometry", 2)
        both.until_more_maps(10)
        assert mapper.poll() is None
        maps = both.maps()
        new = next(index for index, one in enumerate(maps) if one.number > alone.number and one.older_ms == 0)
        assert 0 < resumed_after <= alone.step, "a commit of the odometry that was killed"
        assert maps[new].step > resumed_after
        assert [one for one in maps[new:] if one.older_ms] == []
        assert are_numbered_from(1, maps) and is_on_the_way(maps)

        mapper.kill()
        mapper.wait()
        last = both.maps()[-1].number
        both.start("mapper", life=2)
        both.until_more_maps(5, life=2)
        resumed_after = both.resumed_after("mapper", 2)
        assert 0 < resumed_after <= last
        assert are_numbered_from(resumed_after + 1, both.maps(life=2))
        assert is_on_the_way(both.maps(life=2))
