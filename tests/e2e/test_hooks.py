"""The operator's own commands prepare what no snapshot carries, told which robot this is now, which epoch, and why."""

from __future__ import annotations

import json
import os
import pwd
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from agent.hook_kinds import KINDS
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_deaths import COUNT

pytestmark = pytest.mark.root

NOTE = """#!/bin/sh
[ -e "$1/refuse-$FAILOVER_ROBOT" ] && { echo "no wheels here"; exit 3; }
[ -e "$1/hang-$FAILOVER_ROBOT" ] && sleep 1000
cat >"$1/part.$$" <<END
{"hook": "$FAILOVER_HOOK", "robot": "$FAILOVER_ROBOT", "epoch": "$FAILOVER_EPOCH", "why": "$FAILOVER_WHY",
 "generation": "$FAILOVER_GENERATION", "pid": "$FAILOVER_PID",
 "from": "$FAILOVER_FROM", "age": "$FAILOVER_AGE_MS", "component": "$FAILOVER_COMPONENT", "uid": "$(id -u)"}
END
printf '%s\\n' "$(tr -d '\\n' <"$1/part.$$")" >>"$1/told"  # in one write: two hooks may run at once
"""

Pair = tuple[RobotMachine, RobotMachine]


@contextmanager
def pair_with(directory: Path, *settings: str) -> Iterator[Pair]:
    """Two robots whose hooks note what they were told; ``settings`` for the component besides."""
    note = directory / "note"
    note.write_text(NOTE)
    note.chmod(0o755)
    hooks = [f'{key} = ["{note}", "{directory}"]' for key in KINDS]
    lines = ['[components."/demo/robot1/count".hooks]', *hooks, *settings, ""]
    with robots.two_robots(directory, "\n".join(lines)) as both:
        yield both


def told(directory: Path) -> list[dict[str, Any]]:
    """What the hooks were told so far, in order."""
    path = directory / "told"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def move(robot: RobotMachine, order: str, name: str = "count") -> None:
    """Have the component moved; on a busy machine its last snapshot may be called off, and is tried again."""
    robots.until(lambda: robots.failover(robot, order, name).returncode == 0, f"a {order}")


def around(lines: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Without those that came before captures."""
    return [line for line in lines if line["hook"] != "before_capture"]


def essence(line: dict[str, Any]) -> tuple[str, ...]:
    return tuple(line[key] for key in ("hook", "robot", "why", "from"))


def test_hooks_are_told_which_robot_this_is_and_why(tmp_path: Path) -> None:
    with pair_with(tmp_path) as (first, second):
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
        robots.until_protected(first)
        move(first, "handover")
        robots.until_protected(second)
        robots.until(lambda: len(around(told(tmp_path))) == 3, "the hook after the handover, which nothing waits for")
        move(second, "failback")
        robots.until_protected(first)
        robots.until(lambda: len(around(told(tmp_path))) == 5, "the hook after the way back")
        first.cut_power()
        robots.until(lambda: len(around(told(tmp_path))) == 7, "the hooks after the takeover")
        lines = around(told(tmp_path))
        assert [essence(line) for line in lines] == [
            ("before_start", "robot1", "started", ""),
            ("before_resume", "robot2", "handed over", "robot1"),
            ("after_resume", "robot2", "handed over", "robot1"),
            ("before_resume", "robot1", "handed over", "robot2"),
            ("after_resume", "robot1", "handed over", "robot2"),
            ("before_resume", "robot2", "taken over", lines[-1]["from"]),
            ("after_resume", "robot2", "taken over", lines[-1]["from"]),
        ]
        captures = [line for line in told(tmp_path) if line["hook"] == "before_capture"]
        assert {(line["robot"], line["why"], line["from"]) for line in captures} == {
            ("robot1", "captured", ""),
            ("robot2", "captured", ""),
        }
        generations = {(line["robot"], line["epoch"]): line["generation"] for line in lines}
        assert len(set(generations.values())) == len(generations)
        assert all(line["generation"] == generations[line["robot"], line["epoch"]] for line in captures)
        assert [bool(line["pid"]) for line in lines] == [line["hook"] == "after_resume" for line in lines]
        assert all(line["pid"] for line in captures)
        assert int(lines[-1]["pid"]) == robots.component(second, "count")["pid"]
        epochs = [int(line["epoch"]) for line in lines]
        assert epochs == sorted(epochs)
        assert epochs[-1] == robots.component(second, "count")["epoch"]
        assert all(line["component"] == "/demo/robot1/count" for line in lines)


def test_a_hook_that_fails_is_told_and_the_program_runs(tmp_path: Path) -> None:
    with pair_with(tmp_path, "limit_s = 1") as (first, second):
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


def test_a_program_that_crashes_where_it_cannot_be_prepared_again_resumes_at_the_other_robot(tmp_path: Path) -> None:
    with pair_with(tmp_path, "must_prepare = true") as (first, second):
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
        robots.until_protected(first)
        (tmp_path / "refuse-robot1").touch()
        os.kill(robots.host_pid(first, robots.component(first, "count")["pid"]), signal.SIGKILL)
        robots.until_protected(second)
        assert robots.component(second, "count")["standby"] == "robot1"
        story = robots.failover(first, "why", "count").stdout
        assert story.count("robot1 could not resume it: ") == 2, story


def test_a_snapshot_is_taken_whatever_becomes_of_the_hook_before_it_and_that_is_said(tmp_path: Path) -> None:
    with pair_with(tmp_path, "limit_s = 1") as (first, second):
        (tmp_path / "hang-robot1").touch()
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
        robots.until_protected(first)
        notes = robots.component(first, "count")["notes"]
        assert any("before_capture" in note and "took longer than 1 s" in note for note in notes), notes
        assert any("the checkpoint was taken without it" in note for note in notes), notes
        story = robots.failover(first, "why", "count").stdout
        assert "before_capture" in story
        (tmp_path / "hang-robot1").unlink()
        before = len(told(tmp_path))
        move(first, "handover")
        robots.until_protected(second)
        again = [line for line in told(tmp_path)[before:] if line["hook"] == "before_capture" and line["robot"] == "robot1"]
        assert again, "the last snapshot of a handover is prepared, however short ago the one before was"


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
        options = ("--detach", "--name", "count", "--user", nobody.pw_name, "--after-resume", f"{note} '{open_to_all}'")
        ran = robots.failover(first, "run", *options, "--", "/usr/bin/python3", "-S", "-c", COUNT)
        assert ran.returncode == 0, ran
        robots.until_protected(first)
        move(first, "handover")
        (line,) = robots.until(lambda: told(open_to_all), "the hook to be run")
        assert essence(line) == ("after_resume", "robot2", "handed over", "robot1")
        assert line["uid"] == str(nobody.pw_uid)
        assert robots.component(second, "count")["role"] == "primary"


HEARS = r"""
#include <signal.h>
#include <stdio.h>
#include <time.h>
static volatile sig_atomic_t told;
static volatile unsigned long turns, turns_then;
static void *volatile value;
static void hear(int number, siginfo_t *about, void *context) {
    told = number + 0 * (context != 0);
    value = about->si_value.sival_ptr;
    turns_then = turns;
}
int main(void) {
    struct sigaction action = {.sa_sigaction = hear, .sa_flags = SA_SIGINFO | SA_RESTART};
    sigaction(SIGUSR2, &action, NULL);
    for (puts("ready"), fflush(stdout);; turns++) {
        nanosleep(&(struct timespec){.tv_nsec = 1000000}, NULL);
        if (told) {
            printf("%d %lu %d\n", told, (unsigned long)value, turns - turns_then <= 1);
            fflush(stdout);
            told = 0;
        }
    }
}
"""


@pytest.mark.compiler
def test_a_program_is_told_by_a_signal_where_it_is_now(tmp_path: Path) -> None:
    (tmp_path / "hears.c").write_text(HEARS)
    subprocess.run(["cc", "-o", str(tmp_path / "hears"), str(tmp_path / "hears.c")], check=True)
    by_signal = {"after_resume": ["signal:SIGUSR2"]}
    with robots.two_robots(tmp_path) as (first, second):
        for name, argv in (("hears", [str(tmp_path / "hears")]), ("deaf", ["/bin/sleep", "1000"])):
            with first.control() as link:
                link.ask("run", argv=argv, name=name, env={}, cwd="/", wait=False, hooks=by_signal)
            robots.until_protected(first, name)
            move(first, "handover", name)
            robots.until_protected(second, name)
        here = robots.component(second, "hears")
        expected = ["ready", f"{int(signal.SIGUSR2)} {here['generation']} 1"]
        robots.until(lambda: robots.output(second, "hears").decode().splitlines() == expected, "what the program was told")
        assert here["generation"] // 64 == here["epoch"]
        notes = robots.component(second, "deaf")["notes"]
        assert any("neither handles nor blocks SIGUSR2" in note for note in notes), notes
        refused = robots.failover(first, "run", "--before-capture", "signal:SIGUSR2", "--", "/bin/true")
        assert refused.returncode == 1 and "only after_resume takes a signal" in refused.stderr, refused
