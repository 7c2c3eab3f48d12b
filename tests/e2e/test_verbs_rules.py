"""Settings of components in agent.toml, as real agents carry them out."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from checkpoint.program import cpu_baseline
from tests.e2e import robots
from tests.e2e.robots import RobotMachine

COUNT = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.01)\n"
TABLE = '[components."/demo/robot1/count"]\n'

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Pair]:
    with robots.two_robots(tmp_path, request.param) as both:
        robots.run(both[0], "count", "/usr/bin/python3", "-S", "-c", COUNT)
        yield both


def settings(text: str) -> pytest.MarkDecorator:
    """The lines that both robots' configurations get."""
    return pytest.mark.parametrize("pair", [text], indirect=True, ids=[text.strip().splitlines()[-1]])


def crash(robot: RobotMachine) -> None:
    os.kill(robots.host_pid(robot, robots.component(robot, "count")["pid"]), signal.SIGSEGV)


@settings(TABLE + 'prefer = "robot2"\n')
def test_failback_goes_to_the_robot_that_is_preferred(pair: Pair) -> None:
    robots.until_protected(pair[0])  # by itself it would go there after ten seconds
    moved = robots.failover(pair[0], "failback", "count")
    assert moved.returncode == 0, moved
    shown = robots.component(pair[1], "count")
    assert (shown["state"], shown["prefer"], shown["home"]) == ("running", "robot2", "robot1")


@settings(TABLE + 'on_crash = "leave"\n')
def test_a_crash_that_is_to_be_left_is_not_resumed(pair: Pair) -> None:
    robots.until_protected(pair[0])
    crash(pair[0])
    for robot in pair:
        robots.until(lambda at=robot: robots.component(at, "count").get("state") == "failed", "the failure to be known")  # type: ignore[misc]
        shown = robots.failover(robot, "status")
        assert (shown.returncode, "on_crash = leave" in shown.stdout) == (1, True), shown
    assert robots.component(pair[0], "count")["restores"] == 0


@settings(TABLE + 'on_loss = "hold"\n')
def test_a_component_that_is_to_be_held_is_not_taken_over(pair: Pair) -> None:
    first, second = pair
    robots.until_protected(first)
    first.cut_power()
    robots.until(lambda: second.status()["peers"][0]["state"] == "dead", "the loss to be noticed")
    held = robots.component(second, "count")
    assert (held["role"], held["state"], held["standby"]) == ("standby", "held", "robot2")
    assert robots.failover(second, "status").returncode == 1
    assert robots.output(second, "count").startswith(b"0\n1\n")
    taken = robots.failover(second, "handover", "count", "--to", "robot2")  # an operator may decide otherwise
    assert taken.returncode == 0, taken
    robots.until(lambda: robots.component(second, "count").get("state") == "running", "it to run at robot2")


@settings('when_alone = "freeze"\n')
def test_a_program_stands_still_while_its_robot_is_alone(pair: Pair) -> None:
    first, second = pair
    robots.until_protected(first)
    for pid in second.processes():
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
    robots.until(lambda: robots.component(first, "count").get("state") == "frozen", "it to stand still")
    shown = robots.failover(first, "status")
    assert (shown.returncode, "held still: no robot entrusted with it hears this robot" in shown.stdout) == (1, True), shown


@settings("snapshot_period_ms = 1000\n")
def test_snapshots_are_as_far_apart_as_the_operator_says(pair: Pair) -> None:
    robots.until_protected(pair[0])
    assert robots.component(pair[0], "count")["period_ms"] == 1000


@settings("portable = true\n")
def test_a_portable_program_stays_so_wherever_it_goes(pair: Pair) -> None:
    """What its libraries were told is a part of its memory."""
    robots.until_protected(pair[0])
    assert level(pair[0]) == "x86-64-v2"
    for name, wanted, found in (("v3", "--portable=x86-64-v3", "x86-64-v3"), ("plain", "--portable=no", "")):
        started = robots.failover(pair[0], "run", "--detach", wanted, "--name", f"/demo/robot1/{name}", "--", "/bin/sleep", "600")
        assert started.returncode == 0, started
        assert level(pair[0], name) == found
    assert robots.failover(pair[0], "handover", "count").returncode == 0
    robots.until(lambda: robots.component(pair[1], "count").get("role") == "primary", "it to run at robot2")
    assert level(pair[1]) == "x86-64-v2"


def level(robot: RobotMachine, name: str = "count") -> str:
    pid = robots.host_pid(robot, robots.component(robot, name)["pid"])
    return cpu_baseline.level_in(Path(f"/proc/{pid}/environ").read_bytes())
