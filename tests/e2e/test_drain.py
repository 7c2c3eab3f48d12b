"""A robot is drained before its maintenance: everything leaves it, and nothing new runs there until it is undrained."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.test_deaths import COUNT

pytestmark = pytest.mark.root


def test_a_drained_robot_is_empty_until_it_is_undrained(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        robots.keep_on(first)
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
        robots.until_protected(first)

        drained = robots.failover(second, "drain", "robot1")
        assert (drained.returncode, drained.stdout) == (0, "/demo/robot1/count runs at robot2\nrobot1 is drained\n"), drained
        robots.until_protected(second)
        refused = robots.failover(first, "run", "--detach", "--", sys.executable, "-c", "")
        assert refused.returncode == 1 and "robot1 is drained; failover undrain robot1 first" in refused.stderr
        assert "robot1 is drained; failover undrain robot1" in robots.failover(second, "handover", "count").stderr

        # its agent restarts, and it is drained all the same
        robots.stop_agent(first)
        robots.start_agent(first)
        robots.until(lambda: robots.answers(first) and robots.connected(first), "the agent to be back")
        assert "live, drained" in robots.until_status(first, 0, "robot1 (here)")
        robots.until(lambda: "live, drained" in robots.failover(second, "status").stdout, "robot2 to hear of it")

        undrained = robots.failover(second, "undrain", "robot1")
        assert undrained.returncode == 0 and "it may run components again" in undrained.stdout, undrained
        robots.until_protected(second)
        robots.until(lambda: robots.failover(second, "handover", "count").returncode == 0, "the way back")
        counted = robots.numbers(first)
        assert counted == list(range(len(counted)))
