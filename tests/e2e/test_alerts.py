"""An operator's commands tell of a takeover, a split, trouble and its end: each once, by an ordinary user's rights."""

from __future__ import annotations

import contextlib
import json
import pwd
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from failover.core.alerts import KINDS
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_deaths import COUNT, kill, revived

pytestmark = pytest.mark.root

TELL = """#!/bin/sh
told=$(cat)
printf '%s\\n' "{\\"stdin\\": $told, \\"alert\\": \\"$FAILOVER_ALERT\\", \\"component\\": \\"$FAILOVER_COMPONENT\\", \
\\"epoch\\": \\"$FAILOVER_EPOCH\\", \\"robot\\": \\"$FAILOVER_ROBOT\\", \\"uid\\": $(id -u), \
\\"names\\": \\"$(env | cut -d= -f1 | tr '\\n' ' ')\\"}" >>"$1/told"
"""

MISBEHAVES = """#!/bin/sh
sh -c 'while sleep 1; do :; done' "$0" &
touch "$1/began"
yes
"""
"""Writes without end, beside a child, and does not end."""

NAME = "/demo/robot1/count"


@pytest.fixture
def open_to_all() -> Iterator[Path]:
    """A directory in which any user may write."""
    with tempfile.TemporaryDirectory(prefix="failover-alerts-") as directory:
        Path(directory).chmod(0o777)
        for name, script in (("tell", TELL), ("misbehaves", MISBEHAVES)):
            path = Path(directory) / name
            path.write_text(script)
            path.chmod(0o755)
        yield Path(directory)


def settings(*lines: str) -> str:
    return "\n".join(("[alerts]", 'user = "nobody"', "degraded_after_s = 1", "recovered_after_s = 1", *lines, ""))


def told(directory: Path) -> list[dict[str, Any]]:
    """What the commands were told, in order."""
    path = directory / "told"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def of(directory: Path, robot: str, alert: str) -> list[dict[str, Any]]:
    return [one for one in told(directory) if (one["robot"], one["alert"]) == (robot, alert)]


def lose(first: RobotMachine, second: RobotMachine) -> None:
    """A program counts at the first robot, whose agent is killed; the second one takes it over."""
    for robot in (first, second):
        robots.keep_on(robot)
    robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
    robots.until_protected(first)
    kill(first, ("main_loop", "worker"))
    robots.until_taken_over(second)


def test_each_event_is_told_once_by_one_robot_also_over_a_restart_of_its_agent(tmp_path: Path, open_to_all: Path) -> None:
    commands = (f'on_{kind} = ["{open_to_all}/tell", "{open_to_all}"]' for kind in KINDS)
    with robots.two_robots(tmp_path, settings(*commands)) as (first, second):
        lose(first, second)
        robots.until(lambda: of(open_to_all, "robot2", "degraded"), "robot2 to tell that it has no standby")
        robots.stop_agent(second)
        robots.start_agent(second)
        robots.until(lambda: robots.answers(second), "the agent of robot2")
        robots.until(lambda: robots.component(second, "count").get("role") == "primary", "it to be found again")
        revived(first, ("main_loop", "worker"))
        robots.until(lambda: of(open_to_all, "robot2", "recovered"), "robot2 to tell that it has one again")
        robots.until(lambda: of(open_to_all, "robot1", "split"), "robot1 to tell that its copy lost")

        assert Counter((one["robot"], one["alert"]) for one in told(open_to_all) if one["alert"] != "degraded") - Counter(
            {("robot1", "recovered"): 1}  # of the time before the first checkpoint, on a busy machine
        ) == {("robot2", "takeover"): 1, ("robot2", "recovered"): 1, ("robot1", "split"): 1}
        assert len(of(open_to_all, "robot2", "degraded")) == 1

        (takeover,) = of(open_to_all, "robot2", "takeover")
        reason = takeover["stdin"]["reason"]
        assert "robot1 was silent for" in reason and "it resumes from checkpoint" in reason
        assert int(takeover["epoch"]) == robots.component(second, "count")["epoch"]
        assert "another robot ran it too, or instead" in of(open_to_all, "robot1", "split")[0]["stdin"]["reason"]
        for one in told(open_to_all):
            stdin = one["stdin"]
            assert one["component"] == stdin["component"] == NAME
            assert (one["alert"], one["robot"], int(one["epoch"])) == (stdin["alert"], stdin["robot"], stdin["epoch"])
            assert one["uid"] == pwd.getpwnam("nobody").pw_uid
            assert {name for name in one["names"].split() if not name.startswith("FAILOVER_")} <= {"PATH", "PWD", "OLDPWD", "_"}
        assert len({one["stdin"]["id"] for one in told(open_to_all)}) == len(told(open_to_all))
        assert "on_takeover" in robots.failover(second, "why", "count").stdout


def test_a_command_that_floods_and_hangs_or_is_missing_is_ended_and_told_and_disturbs_nothing(
    tmp_path: Path, open_to_all: Path
) -> None:
    takeover = f'on_takeover = ["{open_to_all}/misbehaves", "{open_to_all}"]'
    with robots.two_robots(tmp_path, settings("limit_s = 1", takeover, 'on_degraded = ["/no/such/command"]')) as (first, second):
        before = robots.until(lambda: second.status()["lanes_pid"], "its worker process")
        lose(first, second)

        def notes() -> str:
            return " ".join(second.status()["notes"])

        robots.until(lambda: "took longer than 1 s and was ended" in notes(), "what hangs to be ended")
        robots.until(lambda: "cannot be started: No such file or directory" in notes(), "what is missing to be told")
        assert (open_to_all / "began").exists()
        robots.until(lambda: not runs(open_to_all / "misbehaves"), "what hung to be gone, and its child")
        said = robots.failover(second, "why", "count").stdout
        assert "on_takeover" in said and "on_degraded" in said
        assert second.status()["lanes_pid"] == before, "the same worker process"
        counted = len(robots.numbers(second))
        robots.until(lambda: len(robots.numbers(second)) > counted + 20, "it to count on")


def runs(script: Path) -> bool:
    """Whether a process of this machine has the script on its command line, and is not the agent."""
    for place in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):
            if str(script).encode() in place.read_bytes():
                return True
    return False
