"""What no snapshot carries is prepared by the operator's own commands, told which robot this is now, which epoch, and why."""

from __future__ import annotations

import json
import pwd
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_deaths import COUNT

pytestmark = pytest.mark.root

NOTE = """#!/bin/sh
[ -e "$1/refuse-$FAILOVER_ROBOT" ] && { echo "no wheels here"; exit 3; }
[ -e "$1/hang-$FAILOVER_ROBOT" ] && sleep 1000
cat >"$1/part.$$" <<END
{"hook": "$FAILOVER_HOOK", "robot": "$FAILOVER_ROBOT", "epoch": "$FAILOVER_EPOCH", "why": "$FAILOVER_WHY",
 "from": "$FAILOVER_FROM", "age": "$FAILOVER_AGE_MS", "component": "$FAILOVER_COMPONENT", "uid": "$(id -u)"}
END
cat "$1/part.$$" | tr -d '\\n' >>"$1/told"; echo >>"$1/told"
"""

Pair = tuple[RobotMachine, RobotMachine]


@contextmanager
def pair_with(directory: Path, *settings: str) -> Iterator[Pair]:
    """Two robots whose hooks note what they were told; ``settings`` for the component besides."""
    note = directory / "note"
    note.write_text(NOTE)
    note.chmod(0o755)
    hooks = [f'{key} = ["{note}", "{directory}"]' for key in ("before_start", "on_resume")]
    lines = ['[components."/demo/robot1/count"]', *hooks, *settings, ""]
    with robots.two_robots(directory, "\n".join(lines)) as both:
        yield both


def told(directory: Path) -> list[dict[str, Any]]:
    """What the hooks were told so far, in order."""
    path = directory / "told"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def move(robot: RobotMachine, order: str) -> None:
    """Have the component moved; on a busy machine its last snapshot may be called off, and is tried again."""
    robots.until(lambda: robots.failover(robot, order, "count").returncode == 0, f"a {order}")


def essence(line: dict[str, Any]) -> tuple[str, ...]:
    return tuple(line[key] for key in ("hook", "robot", "why", "from"))


def test_hooks_are_told_which_robot_this_is_and_why(tmp_path: Path) -> None:
    with pair_with(tmp_path) as (first, second):
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
        robots.until_protected(first)
        move(first, "handover")
        robots.until_protected(second)
        move(second, "failback")
        robots.until_protected(first)
        first.cut_power()
        robots.until(lambda: len(told(tmp_path)) == 7, "the hooks after the takeover")
        lines = told(tmp_path)
        assert [essence(line) for line in lines] == [
            ("before_start", "robot1", "started", ""),
            ("before_start", "robot2", "handed over", "robot1"),
            ("on_resume", "robot2", "handed over", "robot1"),
            ("before_start", "robot1", "handed over", "robot2"),
            ("on_resume", "robot1", "handed over", "robot2"),
            ("before_start", "robot2", "taken over", lines[-1]["from"]),
            ("on_resume", "robot2", "taken over", lines[-1]["from"]),
        ]
        epochs = [int(line["epoch"]) for line in lines]
        assert epochs == sorted(epochs)
        assert epochs[-1] == robots.component(second, "count")["epoch"]
        assert all(line["component"] == "/demo/robot1/count" for line in lines)


def test_a_hook_that_fails_is_told_and_the_program_runs(tmp_path: Path) -> None:
    with pair_with(tmp_path, "hook_s = 1") as (first, second):
        for kind in ("refuse", "hang"):
            (tmp_path / f"{kind}-robot2").touch()
            if kind == "refuse":
                robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
            robots.until_protected(first)
            move(first, "handover")
            expected = "exit status 3" if kind == "refuse" else "took longer than 1 s"
            robots.until(
                lambda said=expected: any(said in note for note in robots.component(second, "count")["notes"]),  # type: ignore[misc]
                "what went wrong",
            )
            robots.until_protected(second)
            move(second, "failback")
            (tmp_path / f"{kind}-robot2").unlink()


def test_a_program_that_must_be_prepared_does_not_run_where_it_is_not(tmp_path: Path) -> None:
    with pair_with(tmp_path, "must_prepare = true") as (first, second):
        (tmp_path / "refuse-robot2").touch()
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
        robots.until_protected(first)
        first.cut_power()
        robots.until(
            lambda: any("does not run here unprepared" in note for note in robots.component(second, "count")["notes"]),
            "robot2 to say why not",
        )
        assert robots.component(second, "count")["state"] != "running"
        (tmp_path / "refuse-robot2").unlink()
        robots.until(lambda: robots.component(second, "count")["state"] == "running", "another try")


@pytest.fixture
def open_to_all() -> Iterator[Path]:
    """A directory that every user may write to: pytest's own are closed."""
    with tempfile.TemporaryDirectory(prefix="failover-hook-") as directory:
        Path(directory).chmod(0o777)
        yield Path(directory)


def test_a_hook_that_comes_with_the_program_runs_as_its_user(tmp_path: Path, open_to_all: Path) -> None:
    note = open_to_all / "note"
    note.write_text(NOTE)
    note.chmod(0o755)
    nobody = pwd.getpwnam("nobody")
    with robots.two_robots(tmp_path) as (first, second):
        options = ("--detach", "--name", "count", "--user", nobody.pw_name, "--on-resume", f"{note} '{open_to_all}'")
        ran = robots.failover(first, "run", *options, "--", "/usr/bin/python3", "-S", "-c", COUNT)
        assert ran.returncode == 0, ran
        robots.until_protected(first)
        move(first, "handover")
        (line,) = robots.until(lambda: told(open_to_all), "the hook to be run")
        assert essence(line) == ("on_resume", "robot2", "handed over", "robot1")
        assert line["uid"] == str(nobody.pw_uid)
        assert robots.component(second, "count")["role"] == "primary"
