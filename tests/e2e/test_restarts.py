"""Programs that agent.toml declares end: they are started anew as their tables say, and what has failed is told."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from failover.cli.demo.robots import RobotMachine, Stage
from tests.e2e import robots

FRAGILE = """
import os, time
print("begins", flush=True)
while not os.path.exists({sign!r}):
    time.sleep(0.02)
os.unlink({sign!r})
raise RuntimeError("no map")
"""
SETTINGS = """
[tasks."/lab/robot1/fragile"]
command = {fragile}
restart = "always"

[tasks."/lab/robot1/hopeless"]
command = ["/bin/sh", "-c", "echo no camera >&2; exit 3"]
restart_limit = 2

[tasks."/lab/robot1/once"]
command = ["/bin/sh", "-c", "exit 4"]
restart = "never"

[tasks."/lab/robot1/done"]
command = ["/bin/true"]
"""

AT_ROBOT1 = """
[tasks."/lab/robot1/tour"]
command = ["/bin/sh", "-c", "while [ ! -e {sign} ]; do sleep 0.05; done"]
"""


def begun(robot: RobotMachine) -> int:
    return robots.output(robot, "fragile").count(b"begins")


def state_of(robot: RobotMachine, name: str) -> str:
    return str(robots.component(robot, name).get("state"))


@pytest.mark.root
def test_declared_programs_are_started_anew_as_their_tables_say_and_a_stop_is_a_stop(tmp_path: Path) -> None:
    sign = tmp_path / "die"
    program = json.dumps([sys.executable, "-c", FRAGILE.format(sign=str(sign))])
    with robots.two_robots(tmp_path, SETTINGS.format(fragile=program)) as both:
        robots.until(lambda: any(robots.component(robot, "fragile").get("pid") for robot in both), "fragile to begin")
        first = min(both, key=lambda robot: robots.component(robot, "fragile").get("role") != "primary")

        # what fails again and again has failed, what may not be started anew has, and exit status 0 is an end
        robots.until_status(first, 1, "failed (exit 3)", "failed (exit 4)", "ended (exit 0)", "started anew 2 times in 60 s")
        assert [robots.component(first, name)["exit_status"] for name in ("hopeless", "once")] == [3 << 8, 4 << 8]
        notes = " ".join(robots.component(first, "hopeless")["notes"])
        assert "failover start /lab/robot1/hopeless" in notes
        assert notes.endswith("it said: no camera")
        assert robots.output(first, "hopeless", 2) == b"no camera\n", "each start has its output for itself"

        # an uncaught exception: begun anew, protected again
        robots.until_protected(first, "fragile")
        sign.touch()
        robots.until(lambda: robots.component(first, "fragile").get("restarts") == 1, "its second start")
        robots.until(lambda: begun(first) == 1, "its own output")
        robots.until_protected(first, "fragile")
        why = robots.failover(first, "why", "fragile").stdout
        assert "starts it anew in 0.1 s: it ended with exit status 1; it said: RuntimeError: no map" in " ".join(why.split())

        # an operator's stop stays one; his start is one
        stopped = robots.failover(first, "stop", "fragile")
        assert stopped.returncode == 0, stopped.stderr
        assert state_of(first, "fragile") == "ended"
        started = robots.failover(first, "start", "fragile")
        assert started.returncode == 0, started.stderr
        robots.until(lambda: begun(first) == 1, "its start by an operator")
        assert state_of(first, "fragile") == "running"
        again = robots.failover(first, "start", "fragile")
        assert again.returncode == 1
        assert "it runs here" in again.stderr


@pytest.mark.root
def test_the_robot_that_declares_a_program_starts_it_where_it_ended_at_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sign, configuration = tmp_path / "over", Stage.configuration

    def at_one(stage: Stage, name: str, directory: Path) -> str:
        return configuration(stage, name, directory) + (AT_ROBOT1.format(sign=sign) if name == "robot1" else "")

    monkeypatch.setattr(Stage, "configuration", at_one)
    with robots.two_robots(tmp_path) as (first, second):
        robots.until_protected(first, "tour")
        assert robots.failover(first, "handover", "tour").returncode == 0
        robots.until_taken_over(second, "tour")
        sign.touch()
        robots.until(lambda: state_of(second, "tour") == state_of(first, "tour") == "ended", "its end")
        refused = robots.failover(second, "start", "tour")
        assert refused.returncode == 1
        assert "robot2 does not declare it" in refused.stderr and "ask at a robot that does" in refused.stderr
        assert state_of(second, "tour") == "ended"
        sign.unlink()
        started = robots.failover(first, "start", "tour")
        assert started.returncode == 0, started.stderr
        assert state_of(first, "tour") == "running"
