"""A program that keeps its state is killed at any instant, with its robot or without: it resumes from a safe state.

Two robots and a program that commits without pause (`tests.e2e.voyage`), which tells a log of the test's own which commits were
said to be safe. Then the test kills: the program alone, at any act; the whole robot, which comes back later with its disk; a
keeper, a guard, a part of the agent, the agent. FAILOVER_KILLS=1000 kills so often, at instants that FAILOVER_SEED chooses.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import pytest
from msgspec.structs import replace

from failover.cli.demo.robots import RobotMachine, Stage
from tests.e2e import robots
from tests.e2e.ships_log import Resumption, ShipsLog
from tests.e2e.test_deaths import kill, revived

KILLS: Final = int(os.environ.get("FAILOVER_KILLS", "5"))
SEED: Final = os.environ.get("FAILOVER_SEED") or str(random.randrange(1 << 32))
STAGE_KILLS: Final = 40
"""So many on one pair of robots; then another: whoever has lived long must not be needed."""

PROGRAM: Final = Path(__file__).parent / "voyage.py"
SPREAD_S: Final = 0.25
"""Instants of death lie in here: a commit takes a millisecond or two, a capture begins every 0.1 s."""
HASTE: Final = 0.2
"""How often the program is killed again before anything more is safe."""

CYCLE: Final = ("program", "program", "robot", "other", "robot")
"""An agent resumes from the newest checkpoint after three crashes in a minute at most; one that comes back has forgotten them."""

OTHERS: Final = {
    "keeper": ("keeper",),
    "worker": ("worker",),
    "guard": ("guard",),
    "agent": ("main_loop", "worker"),
    "agent_and_keeper": ("main_loop", "worker", "keeper"),
}


@dataclass(slots=True)
class Voyage:
    """The robots, and the program on one of them."""

    stage: Stage
    log: ShipsLog
    dice: random.Random
    killed: Counter[str] = field(default_factory=Counter)
    in_commit: int = 0
    """How many of the programs that were killed had not come back from `commit`."""

    @property
    def pair(self) -> tuple[RobotMachine, RobotMachine]:
        first, second = self.stage.robots
        return first, second

    def primary(self) -> RobotMachine | None:
        """The robot that runs it, as it says itself."""
        for robot in self.pair:
            if robots.answers(robot) and robots.component(robot, "voyage").get("state") == "running":
                return robot
        return None

    def now(self) -> Resumption:
        """The newest life."""
        self.log.read()
        return self.log.resumptions[-1]

    def lives(self) -> int:
        """How many there were until now."""
        self.log.read()
        return len(self.log.resumptions)

    def acknowledged(self) -> int:
        """How often something was said to be safe to the newest life."""
        return self.log.acknowledged.get(self.now().life, 0)

    def until_safe(self) -> None:
        """Until something more of the newest life is safe."""
        before = self.acknowledged()
        robots.until(lambda: self.acknowledged() > before, "a commit to be safe")


@contextmanager
def voyage(directory: Path, dice: random.Random, *arguments: str) -> Iterator[Voyage]:
    """Two robots that share the loopback, so that one that was switched off can come back; the program runs at robot1.

    Args:
        arguments: of the program, besides its log.
    """
    directory.mkdir()

    with Stage(directory / "stage", replace(robots.means(), own_network=False)) as stage:
        stage.directory.mkdir()
        stage.start()
        try:
            for robot in stage.robots:
                robots.keep_on(robot)
            first, second = stage.robots
            robots.until(lambda: robots.connected(first) and robots.connected(second), "the robots to hear each other")
            going = Voyage(stage, ShipsLog(directory / "log"), dice)
            command = (sys.executable, str(PROGRAM), str(going.log.path), *arguments)
            robots.run(first, "voyage", *command, cwd=str(directory), engine="cooperative")
            robots.until(lambda: going.lives() and going.acknowledged(), "a commit to be safe")
            yield going
            for robot in stage.robots:
                assert not robots.mistake(robot), f"a mistake in the agent of {robot.name}:\n{robots.mistake(robot)}"
        finally:
            for robot in stage.robots:
                print(
                    f"--- {robot.name} said:", *robot.log.read_text(errors="replace").splitlines()[-robots.LOG_LINES :], sep="\n"
                )


def kill_program(going: Voyage, robot: RobotMachine) -> None:
    """Nothing but the program; its robot resumes it."""
    with another_life(going, "the program to be resumed in place") as before:
        os.kill(robots.host_pid(robot, robots.component(robot, "voyage")["pid"]), signal.SIGKILL)
    assert going.now().why == "restarted"
    assert going.now().epoch == (before.epoch or 1), "nobody took it over"


def cut_robot(going: Voyage, robot: RobotMachine) -> None:
    """All of the robot at one instant. It comes back when the other one has taken over."""
    assert not robots.mistake(robot), robots.mistake(robot)
    with another_life(going, "the other robot to take over") as before:
        robot.cut_power()
    assert (going.now().why, going.now().epoch) == ("taken-over", max(before.epoch, 1) + 1)
    come_back(going.stage, robot)


def come_back(stage: Stage, robot: RobotMachine) -> None:
    """Switch a robot on again whose power was cut: its disk is as it was."""
    again = stage.start_robot(robot.name)
    stage.robots[stage.robots.index(robot)] = again
    again.switch_on()
    again.control().close()
    robots.keep_on(again)


def kill_other(going: Voyage, robot: RobotMachine, way: str) -> None:
    """A part of what stands around the program."""
    before, lives = going.now(), going.lives()
    kill(robot, OTHERS[way])
    if "main_loop" in OTHERS[way]:
        robots.until(lambda: going.lives() > lives, "the other robot to take over")
        assert (going.now().why, going.now().epoch) == ("taken-over", max(before.epoch, 1) + 1)
    revived(robot, OTHERS[way])
    if way == "guard":
        robots.until(lambda: going.lives() > lives, "the program to be resumed")


@contextmanager
def another_life(going: Voyage, what: str) -> Iterator[Resumption]:
    """Do something to the newest life, which is given, and wait for the next; a commit that was broken off is counted."""
    before, lives = going.now(), going.lives()
    yield before
    robots.until(lambda: going.lives() > lives, what)
    going.in_commit += going.log.last_kind.get(before.life) == "b"


def kill_somebody(going: Voyage, kind: str) -> None:
    robot = robots.until(going.primary, "one robot to run it")
    if kind != "program" or going.dice.random() > HASTE:  # whoever takes over must have something
        going.until_safe()
    time.sleep(going.dice.uniform(0, SPREAD_S))  # not a wait for anything: the instant of the kill
    if kind == "program":
        kill_program(going, robot)
    elif kind == "robot":
        cut_robot(going, robot)
    else:
        kind = going.dice.choice(sorted(OTHERS))
        kill_other(going, robot, kind)
    going.killed[kind] += 1


def check_output(going: Voyage) -> None:
    """What was printed is what the newest life stands on: no gap, no repetition."""
    robot = robots.until(going.primary, "one robot to run it")
    going.until_safe()
    assert going.log.check_output(robots.output(robot, "voyage")) >= going.now().number


@pytest.mark.timeout(max(120, KILLS * 30))
def test_whatever_is_killed_the_state_is_the_last_one_that_was_safe_or_later(tmp_path: Path) -> None:
    print(f"FAILOVER_SEED={SEED}")
    dice = random.Random(SEED)
    killed, in_commit = Counter[str](), 0
    for first in range(0, KILLS, STAGE_KILLS):
        with voyage(tmp_path / str(first), dice) as going:
            for number in range(min(STAGE_KILLS, KILLS - first)):
                kill_somebody(going, CYCLE[number % len(CYCLE)])
                if number % len(CYCLE) == len(CYCLE) - 1:
                    check_output(going)
            check_output(going)
            killed, in_commit = killed + going.killed, in_commit + going.in_commit
            print(f"killed {killed.total()}: {dict(killed)}, {in_commit} in the middle of a commit; {going.lives()} lives")


RUNGS: Final = 50 if "FAILOVER_KILLS" in os.environ else 34
"""The cargo grows to 56 MB, and to 1.6 where only a short test was asked for."""


@pytest.mark.timeout(max(120, KILLS * 60))
def test_a_state_that_outgrows_its_memory_again_and_again_is_as_safe(tmp_path: Path) -> None:
    """It begins in a few kilobytes; each time it needs more room its commits go on in another, larger segment."""
    print(f"FAILOVER_SEED={SEED}")
    dice = random.Random(f"growing {SEED}")
    with voyage(tmp_path / "0", dice, str(RUNGS)) as going:
        for number in range(max(KILLS // 10, 2)):
            life, rung = going.now().number, dice.randrange(RUNGS)
            robots.until(lambda life=life, rung=rung: newest(going) >= life + rung, f"{rung} steps more")  # type: ignore[misc]
            kill_somebody(going, ("program", "robot")[number % 2])
        check_output(going)
        print(f"killed {going.killed.total()}: {dict(going.killed)}, {going.in_commit} in the middle of a commit")


def newest(going: Voyage) -> int:
    """Number of the last step of the newest life."""
    going.log.read()
    return going.log.newest()
