"""A standby starts again and cannot hear its healthy primary, or cannot authenticate it: it rewinds nothing.

The network of a robot that boots often comes late (STP, DHCP, Wi-Fi); an operator's keys and team files grow old. Each time the
primary never stops, and it loses not one number that it has counted.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from agent.worker.network.replication_link import new_keys
from failover.cli import main
from failover.config import team
from failover.config.team import Team
from failover.core.membership import UNREAD_NS
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_deaths import COUNT, numbers
from tests.e2e.test_epoch import IN_PYTHON, epoch, until_told
from tests.include import programs

pytestmark = [
    pytest.mark.root,  # an agent is started again inside its robot
    pytest.mark.skipif(not robots.has_cable(), reason="needs robots with networks of their own"),
]

GRACE_S = 3
"""After so long a robot that starts counts those as dead of which it has heard nothing. Source: `failover.core.types.Config`."""

MORE = 20

KEEPS_A_STATE = """
import time
import failover

failover.resume("token", default={"told": 0})
while True:
    print(failover.epoch(), flush=True)
    failover.commit()
    time.sleep(0.01)
"""

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path, "boot_patience_s = 60\n") as both:
        yield both


def protected_count(pair: Pair) -> int:
    """A counting program at the second robot, protected by the first, whose agent has ended then; its process."""
    first, second = pair
    robots.run(second, "count", "/usr/bin/python3", "-S", "-c", COUNT)
    robots.until_protected(second)
    robots.until(lambda: robots.checkpoints(first, "count") >= 3, "checkpoints at robot1")
    robots.keep_on(first)
    robots.stop_agent(first)
    return robots.host_pid(second, robots.component(second, "count")["pid"])


def until_it_lived(robot: RobotMachine, seconds: float) -> None:
    """Until the agent has been there for so long: long enough to have done what it must not do."""
    robots.until(lambda: robots.answers(robot), f"the agent of {robot.name}")
    since = time.monotonic()
    robots.until(lambda: time.monotonic() > since + seconds, f"{seconds} s of its life")


def expect_nothing_lost(pair: Pair, program: int) -> None:
    """The same process counts on, without a gap; both robots know, and the first one protects it again."""
    first, second = pair
    robots.until(lambda: robots.component(first, "count").get("primary") == "robot2", "robot1 to know who runs it")
    robots.until_protected(second)
    before = len(numbers(robots.output(second, "count")))
    robots.until(lambda: len(numbers(robots.output(first, "count"))) > before + MORE, "checkpoints to travel")
    for robot in pair:
        counted = numbers(robots.output(robot, "count"))
        assert counted == list(range(len(counted))), robot.name
    shown = robots.component(second, "count")
    assert robots.host_pid(second, shown["pid"]) == program, "it is the process that was there before"
    assert not shown.get("restores"), shown
    assert not list((second.directory / "state" / "lost").glob("*.snapshot")), "nothing of it was kept aside"


def waits(robot: RobotMachine, *words: str) -> str:
    """Its status says for what it waits, and what does not wait; it claims nothing."""
    told = robots.until_status(robot, 1, "waiting: ", "failover promote does not wait", *words)
    assert robots.component(robot, "count")["role"] == "standby", told
    return told


def test_a_standby_whose_network_comes_late_waits_and_rewinds_nothing(pair: Pair) -> None:
    first, _ = pair
    program = protected_count(pair)
    robots.cable(first, "down")
    robots.start_agent(first)
    until_it_lived(first, 2 * GRACE_S)
    waits(first, "robot2 may run it and was not heard since robot1 started", "robot1 claims it in ", "boot_patience_s")
    robots.cable(first, "up")
    expect_nothing_lost(pair, program)


def other_secret(first: RobotMachine, _: RobotMachine) -> Callable[[], None]:
    """Robot1's secret key is another one than its team knows it by."""
    path = team.secret_key_path(first.directory / "team", first.name)
    right = path.with_suffix(".right")
    path.rename(right)
    team.write_secret_key(first.directory / "team", first.name, new_keys()[1])
    return lambda: (right.rename(path), None)[1]


def without_robot2(first: RobotMachine, _: RobotMachine) -> Callable[[], None]:
    """Robot1's team file does not know robot2."""
    return _with_team(first, lambda members: Team(members.team, {"robot1": members.robots["robot1"]}))


def other_key_of_robot2(first: RobotMachine, _: RobotMachine) -> Callable[[], None]:
    """Robot1's team file has another key for robot2."""

    def old(members: Team) -> Team:
        robot2 = members.robots["robot2"]
        other = team.Robot(robot2.beats, robot2.bulk, robot2.role, new_keys()[0])
        return Team(members.team, {**members.robots, "robot2": other})

    return _with_team(first, old)


def _with_team(robot: RobotMachine, change: Callable[[Team], Team]) -> Callable[[], None]:
    directory = robot.directory / "team"
    right = team.read(directory)
    team.write(directory, change(right))
    return lambda: team.write(directory, right)


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("spoil", "at_first", "at_second"),
    [
        (
            other_secret,
            ("robot2 does not know this robot's key", "this robot's secret key does not belong to its public key in team.toml"),
            ("robot1 presents the key", "team.toml here has"),
        ),
        (
            other_key_of_robot2,
            ("robot2 presents the key", "team.toml here has"),
            ("robot1 does not know this robot's key",),
        ),
        (
            without_robot2,
            ("team.toml here does not know robot2", "a robot that it does not know sends to robot1"),
            ("robot1 does not know this robot's key",),
        ),
    ],
    ids=["another secret key", "another key in the team file", "an old team file"],
)
def test_a_standby_that_cannot_authenticate_its_primary_says_what_is_wrong_and_rewinds_nothing(
    tmp_path: Path,
    spoil: Callable[[RobotMachine, RobotMachine], Callable[[], None]],
    at_first: tuple[str, ...],
    at_second: tuple[str, ...],
) -> None:
    with robots.two_robots(tmp_path) as pair:  # with a short patience: what is received postpones the claim, not the boot
        first, second = pair
        program = protected_count(pair)
        mend = spoil(first, second)
        robots.start_agent(first)
        until_it_lived(first, UNREAD_NS / 1e9 + 2 * GRACE_S)
        waits(first, *at_first)
        robots.until_status(second, 1, *at_second)
        mend()
        robots.stop_agent(first)
        robots.start_agent(first)
        robots.until(lambda: robots.answers(first), "the agent of robot1")
        expect_nothing_lost(pair, program)


def test_after_its_patience_it_goes_on_and_at_reunion_the_copy_that_never_stopped_stays(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as pair:
        first, second = pair
        program = protected_count(pair)
        robots.cable(first, "down")
        robots.start_agent(first)
        robots.until(lambda: robots.answers(first), "the agent of robot1")
        robots.until_taken_over(first)
        robots.until(lambda: robots.component(first, "count")["state"].startswith("running"), "it to run at robot1, too")
        robots.cable(first, "up")
        expect_nothing_lost(pair, program)
        assert list((first.directory / "state" / "lost").glob("*.snapshot")), "what robot1's copy had become is kept aside"
        assert tells_of_the_lost_copy(first)
        assert main.main(["lost", "inspect", "count", "--state", str(first.directory / "state")]) == 0
        assert not tells_of_the_lost_copy(first), "a person has looked"
        told = robots.failover(second, "why", "count").stdout
        assert "robot2 keeps its copy, which never stopped acting" in told, told


def tells_of_the_lost_copy(robot: RobotMachine) -> bool:
    """Whether its status has a note of it."""
    return any("failover lost inspect" in note for note in robot.status()["notes"])


@pytest.mark.compiler
@pytest.mark.parametrize("kind", ["unprepared", "keeps a state", "keeps a state, in C"])
def test_the_copy_that_stays_finds_its_new_epoch_and_a_gateway_obeys_it(tmp_path: Path, kind: str) -> None:
    engine = "ptrace" if kind == "unprepared" else "auto"
    words = {
        "unprepared": lambda: (sys.executable, "-c", IN_PYTHON),
        "keeps a state": lambda: (sys.executable, "-c", KEEPS_A_STATE),
        "keeps a state, in C": lambda: (str(programs.program("token")),),
    }[kind]()
    with robots.two_robots(tmp_path) as pair:
        first, second = pair
        robots.run(second, "token", *words, env={"PYTHONPATH": os.getcwd()}, engine=engine)
        robots.until_protected(second, "token")
        until_told(second, second)
        robots.cable(first, "down")
        robots.until_taken_over(first, "token")
        until_told(first, first)
        others = epoch(first)
        robots.cable(first, "up")
        robots.until(lambda: robots.component(first, "token").get("primary") == "robot2", "robot1 to know who runs it")
        robots.until_protected(second, "token")
        until_told(second, second)
        told = list(dict.fromkeys(robots.numbers(second, "token")))
        assert told[-1] > others and told == sorted(told), told
        assert not robots.component(second, "token").get("restores")
