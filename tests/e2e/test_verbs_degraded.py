"""Protection that is not whole: `failover status` names each way it can fail, at either robot, and each heals by itself."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

CHANGING = """
import os, sys, time
flag, number, held = sys.argv[1], 0, None

while True:
    print(number, flush=True)
    number += 1
    time.sleep(0.01)
    if os.path.exists(flag) and held is None:
        held = os.pidfd_open(1)
    elif held is not None and not os.path.exists(flag):
        os.close(held)
        held = None
"""
"""Counts, and holds another process by a pidfd, which is not kept, for as long as a file exists."""

STOPPING = '[components."/demo/robot1/count"]\non_unsupported = "stop_protecting"\n'

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Pair]:
    with robots.two_robots(tmp_path, getattr(request, "param", "")) as both:
        yield both


@pytest.fixture
def flag(pair: Pair, tmp_path: Path) -> Path:
    """A protected program at robot1 that holds what is not kept while this file exists."""
    return start(pair, tmp_path)


def start(pair: Pair, tmp_path: Path) -> Path:
    path = tmp_path / "flag"
    robots.run(pair[0], "count", "/usr/bin/python3", "-S", "-c", CHANGING, str(path))
    robots.until_protected(pair[0])
    return path


def test_what_a_program_turned_into_is_named_and_it_recovers(pair: Pair, flag: Path) -> None:
    named = "is a pidfd"
    flag.touch()
    for robot in pair:
        shown = robots.until_status(robot, 1, "degraded", "not captured: ", named, "the last checkpoint is")
        assert shown.count(named) <= 2, "each robot says it once"
    flag.unlink()
    for robot in pair:
        robots.until_status(robot, 0)
    robots.until_protected(pair[0])


def is_old(pair: Pair) -> bool:
    """Whether the newest checkpoint at robot2 is the one whose age robot1 tells, and is old by robot2's measure, too."""
    shown, kept = (robots.component(robot, "count") for robot in pair)
    return bool(shown["lag_ms"] > 5_000 and shown["standby_sequence"] == kept["sequence"])


def test_a_takeover_from_an_old_checkpoint_says_what_was_lost(pair: Pair, flag: Path) -> None:
    first, second = pair
    flag.touch()
    robots.until(lambda: robots.component(first, "count").get("state") == "degraded", "robot1 to notice")
    robots.until(lambda: is_old(pair), "the checkpoint to grow old")
    first.cut_power()
    robots.until_taken_over(second)
    robots.until_status(second, 1, "it resumed at robot2 from its last checkpoint and lost ", " s of its work")
    told = robots.failover(second, "why", "count").stdout
    assert "s of its work" in told, told
    counted = robots.numbers(second)
    assert counted == list(range(len(counted)))


@pytest.mark.parametrize("pair", [STOPPING], indirect=True, ids=["stop_protecting"])
def test_protection_that_was_given_up_is_said_and_nothing_is_taken_over(pair: Pair, flag: Path) -> None:
    first, second = pair
    flag.touch()
    robots.until_status(first, 1, "not protected any more", "a pidfd", "to protect it again: failover release, then protect")
    robots.until(lambda: robots.component(second, "count").get("standby") == "", "robot2 to forget its checkpoints")
    flag.unlink()
    shown = robots.component(first, "count")
    assert (shown["protection"], "no robot keeps a checkpoint" in shown["promise"]) == ("stopped", True)
    released = robots.failover(first, "release", "count")
    assert released.returncode == 0, released
    robots.until(lambda: robots.failover(second, "status").returncode == 0, "nothing to be amiss any more")
    again = robots.failover(first, "protect", str(shown["pid"]), "--name", "count")
    assert again.returncode == 0, again
    robots.until_protected(first)

    def says_of_its_output_alone() -> bool:
        notes = robots.component(first, "count")["notes"]
        return len(notes) == 2 and all("does not move along" in note for note in notes)

    robots.until(says_of_its_output_alone, "no note but of its output: neither that captures are slow")


def worker_of(robot: RobotMachine) -> int:
    return robots.host_pid(robot, robot.status()["lanes_pid"])


@contextlib.contextmanager
def full_disk(robot: RobotMachine) -> Iterator[None]:
    """Nothing that the robot's agent writes gets beyond a file's first byte: what a full disk is to it, without root."""
    worker = robots.host_pid(robot, robot.status()["lanes_pid"])
    before = resource.prlimit(worker, resource.RLIMIT_FSIZE)
    resource.prlimit(worker, resource.RLIMIT_FSIZE, (1, before[1]))
    yield
    resource.prlimit(worker, resource.RLIMIT_FSIZE, before)


def test_a_standby_that_cannot_write_is_named_at_both_robots(pair: Pair, flag: Path) -> None:
    with full_disk(pair[1]):
        for robot in pair:
            robots.until_status(robot, 1, "degraded", "snapshots do not arrive", "was not stored at robot2")
    for robot in pair:
        robots.until_status(robot, 0)


def test_a_primary_that_cannot_write_is_named_at_both_robots(pair: Pair, flag: Path) -> None:
    with full_disk(pair[0]):
        for robot in pair:
            robots.until_status(robot, 1, "degraded", "not captured: ", "the last checkpoint is")
    for robot in pair:
        robots.until_status(robot, 0)


def test_a_standby_that_falls_silent_leaves_its_primary_unprotected_and_said_so(pair: Pair, flag: Path) -> None:
    first, second = pair
    for pid in second.processes():
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGSTOP)
    shown = robots.until_status(first, 1, "dead", "running, unprotected")
    assert "hears no other robot" in shown
    before = len(robots.output(first, "count"))
    robots.until(lambda: len(robots.output(first, "count")) > before, "the program to run on")


def test_an_agent_that_is_to_run_without_real_time_priority_is_nothing_to_worry_about(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, "realtime = false\n") as (first, _):
        shown = first.status()
        assert not shown["realtime"]
        assert shown["notes"] == [], "it is as the operator wants it"
        checked = robots.failover(first, "check").stdout
        assert "the agent does not ask for it: agent.toml says realtime = false" in " ".join(checked.split())
