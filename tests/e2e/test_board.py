"""The board of two real robots: a program of the one puts, a program of the other gets, through their agents."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from failover.boards.board import Board
from failover.boards.directory import agents_place
from failover.cli.demo.robots import Stage
from failover.config import team
from failover.config.team import Team
from failover.core.beat_pace import URGENT_GAP_NS
from failover.core.board.ages import UNBOUNDED_NS
from failover.errors import NeverWrittenError
from tests.e2e import robots
from tests.e2e.robots import RobotMachine

TEAM = f"boards{os.getpid()}"
"""A name of its own: the boards of a team lie where all robots of this machine see them."""

ITEMS = """
[board.items.ball]
type = { x = "f8", y = "f8" }

[board.items.map]
type = "msgpack"
size = 4096
period = 3

[board.items.alarm]
type = "u8"
period = 60000
urgent = true
"""


@pytest.fixture
def pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    with two_with_boards(tmp_path, monkeypatch) as both:
        yield both


@contextmanager
def two_with_boards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, settings: str = "", name: str = TEAM
) -> Iterator[tuple[RobotMachine, RobotMachine]]:
    written = team.write

    def write(directory: Path, members: Team) -> None:
        written(directory, replace(members, team=name))
        with (directory / team.TEAM_FILE).open("a") as file:
            file.write(ITEMS)

    monkeypatch.setattr(team, "write", write)
    try:
        with robots.two_robots(tmp_path, settings) as both:
            yield both
    finally:
        for robot in ("robot1", "robot2"):
            shutil.rmtree(agents_place(name, robot), ignore_errors=True)


def test_what_a_program_puts_at_one_robot_a_program_gets_at_the_other(pair: tuple[RobotMachine, RobotMachine]) -> None:
    with Board(pair[0].socket.parent / "board", "there") as there, Board(pair[1].socket.parent / "board", "here") as here:
        assert (there.robot, here.robot) == ("robot1", "robot2")
        ball, large, alarm = (there.item(name) for name in ("ball", "map", "alarm"))
        large.put(list(range(1000)))
        last = 0
        for number in range(1, 30):
            put_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
            ball.put({"x": float(number), "y": 0.0}, at=put_ns)
            reading = here.item("ball").wait("robot1", after=last, timeout=60)
            now_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
            while reading.value["x"] != number:
                reading = here.item("ball").wait("robot1", after=reading.number, timeout=60)
                now_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
            last = reading.number
            assert reading.age_ns <= now_ns - put_ns
            assert reading.age_max_ns == UNBOUNDED_NS or reading.age_max_ns >= 0
        assert reading.age_max_ns < UNBOUNDED_NS
        robots.until(lambda: has(here, "map", list(range(1000))), "a value of several parts")
        for number in range(5):  # its round comes in 20 minutes
            alarm.put(number)
            robots.until(lambda number=number: has(here, "alarm", number), "an urgent value")
        assert here.robots()["robot1"].state == "run"
        robots.stop_agent(pair[0])
        robots.until(lambda: here.robots()["robot1"].state == "not", "robot1 to be missed")


def test_a_program_that_wakes_the_main_loop_all_the_time_costs_it_two_turns_in_each_gap(
    pair: tuple[RobotMachine, RobotMachine],
) -> None:
    with Board(board_of(pair[0]), "hostile") as there, Board(board_of(pair[1]), "here") as here:
        alarm = there.item("alarm")
        alarm.put(0)
        robots.until(lambda: has(here, "alarm", 0), "the first urgent value")
        file, pid = there.own_source("alarm").file, robots.host_pid(pair[0], int(pair[0].status()["pid"]))
        before, begin_s = sleeps_of(pid), time.monotonic()
        while time.monotonic() < begin_s + FLOOD_S:
            file.touch()
        sleeps, passed_s = sleeps_of(pid) - before, time.monotonic() - begin_s
        usual = 1_000 * passed_s  # heartbeats and frames of both, and the worker process, which speaks more on a busy machine
        assert sleeps < 2 * passed_s * 1e9 / URGENT_GAP_NS + usual
        alarm.put(1)
        robots.until(lambda: has(here, "alarm", 1), "an urgent value after the flood")


def sleeps_of(pid: int) -> int:
    """How often the first thread of a process has gone to sleep. Source: proc_pid_status(5)."""
    status = Path(f"/proc/{pid}/task/{pid}/status").read_text()
    return int(next(line for line in status.splitlines() if line.startswith("voluntary_ctxt_switches")).split()[1])


FLOOD_S = 2.0
SPAN_S = float(os.environ.get("FAILOVER_AGES_S", "5"))
"""How long ages are watched; more of it: FAILOVER_AGES_S=600."""


@pytest.mark.root
def test_ages_of_robots_whose_clocks_are_years_apart_lie_between_their_bounds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The agent of robot2 has a clock three years ahead; this test sees all by one clock."""
    usual = Stage.command

    def command(stage: Stage, name: str, config: Path) -> list[str]:
        ahead = ["unshare", "--time", "--boottime", str(3 * 365 * 86_400), "--"] if name == "robot2" else []
        return [*ahead, *usual(stage, name, config)]

    monkeypatch.setattr(Stage, "command", command)
    with (
        two_with_boards(tmp_path, monkeypatch) as pair,
        Board(board_of(pair[0]), "a") as one,
        Board(board_of(pair[1]), "b") as two,
    ):
        robots.until(lambda: is_bounded(one, two) and is_bounded(two, one), "a round trip each way")
        end_ns = clock() + int(SPAN_S * 1e9)
        put: dict[float, int] = {}
        looks = 0
        while clock() < end_ns:
            for robot, (by, to) in (("robot1", (one, two)), ("robot2", (two, one))):
                number = float(len(put) + 1)
                put[number] = clock()
                by.item("ball").put({"x": number, "y": 0.0}, at=put[number])
                before_ns = clock()
                reading = to.item("ball").get(robot)
                after_ns = clock()
                if reading.value["x"] in put:
                    looks += 1
                    assert reading.age_ns <= after_ns - put[reading.value["x"]]
                    assert reading.age_max_ns >= before_ns - put[reading.value["x"]]
            time.sleep(0.007)
        assert looks > 100


def clock() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def board_of(robot: RobotMachine) -> Path:
    return robot.socket.parent / "board"


def is_bounded(here: Board, there: Board) -> bool:
    there.item("ball").put({"x": -1.0, "y": 0.0})
    try:
        return here.item("ball").get(there.robot).age_max_ns < UNBOUNDED_NS
    except NeverWrittenError:
        return False


def has(board: Board, item: str, value: object) -> bool:
    try:
        return bool(board.item(item).get("robot1").value == value)
    except NeverWrittenError:
        return False
