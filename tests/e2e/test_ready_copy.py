"""Two robots: the standby holds the newest checkpoint's memory ready in a stopped process; a takeover resumes that process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_takeover import numbers, start_counting
from tests.e2e.test_trees import HANDING_ON
from tests.e2e.test_verbs_protect import COUNT

CHAIN_ALONE = '[components."/demo/robot1/count"]\nready_copy = false\n'


def copy_at(robot: RobotMachine) -> dict[str, Any]:
    """What its status says of the ready copy."""
    return robots.component(robot, "count").get("ready_copy") or {}


def until_ready(standby: RobotMachine) -> dict[str, Any]:
    robots.until(lambda: copy_at(standby).get("ready"), "a ready copy")
    return copy_at(standby)


def count_goes_on(robot: RobotMachine) -> None:
    robots.until_taken_over(robot)
    before = len(numbers(robots.output(robot, "count")))
    robots.until(lambda: len(numbers(robots.output(robot, "count"))) > before + 20, "the count to go on")
    counted = numbers(robots.output(robot, "count"))
    assert counted == list(range(len(counted)))


def test_a_takeover_lets_the_ready_copy_go(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        start_counting(first, 1_000_000)
        until_ready(second)
        robots.until(lambda: copy_at(second).get("size", 0) > 1_000_000, "the copy to have an interpreter's megabytes")
        shown = copy_at(second)
        robots.until(lambda: copy_at(second)["position"] != shown["position"], "the copy to be brought on")
        robots.until(lambda: "robot2, ready" in robots.failover(first, "status").stdout, "the primary to know")
        assert "ready copy at robot2" in robots.failover(second, "status").stdout
        first.cut_power()
        count_goes_on(second)
        robots.until(
            lambda: "taking the ready copy" in robots.failover(second, "why", "count").stdout, "the event log to tell of it"
        )


@pytest.mark.root
def test_a_program_of_several_processes_goes_on_from_its_ready_copy(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", HANDING_ON)
        robots.until_protected(first)
        shown = until_ready(second)
        assert shown["size"] > 1_000_000, "two interpreters have some megabytes"
        robots.until(lambda: copy_at(second)["position"] != shown["position"], "the copy to be brought on")
        robots.until(lambda: "robot2, ready" in robots.failover(first, "status").stdout, "the primary to know")
        assert "ready copy at robot2" in robots.failover(second, "status").stdout
        robots.counts_on_elsewhere(first, second, 30)
        told = robots.failover(second, "why", "count").stdout
        assert "taking the ready copy" in told
        assert "its descriptors, timers and registers" in told, "and it was not restored from its chain instead"


def test_where_it_is_not_wanted_the_checkpoints_alone_are_kept_and_a_takeover_uses_them(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, CHAIN_ALONE) as (first, second):
        start_counting(first, 1_000_000)
        robots.until(lambda: robots.checkpoints(second, "count") >= 5, "checkpoints at robot2")
        assert not copy_at(second)["ready"]
        assert "ready_copy = false" in copy_at(second)["why"]
        first.cut_power()
        count_goes_on(second)


@pytest.mark.root
def test_where_its_pid_is_taken_there_is_none_and_status_says_so(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, own_pids=False, own_network=False) as (first, second):
        program = subprocess.Popen([sys.executable, "-S", "-c", COUNT], stdout=subprocess.DEVNULL, start_new_session=True)
        try:
            protected = robots.failover(first, "protect", str(program.pid), "--name", "count")
            assert protected.returncode == 0, protected
            reason = f"pid {program.pid}, by which it knows itself, is not free here"
            robots.until(lambda: copy_at(second).get("why") == reason, "the reason")
            assert reason in robots.failover(second, "status").stdout
        finally:
            program.kill()
            program.wait()
