"""A protected program in C finds the board of the robot on which it resumes; clocks years apart tell the same ages."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.engine import CaptureOrder
from checkpoint.model import Clocks, Snapshot
from failover.boards import boottime, directory
from failover.boards.board import Board, board
from failover.core.board.banks import put_carefully
from failover.core.board.items import Item
from failover.core.board.layout import OWN, PRIVATE, Wanted
from tests.checkpoint.round_trip import Program, captured_at_last, ended, protected, restored, start, transported
from tests.include.board_programs import place_for_board
from tests.include.programs import program

pytestmark = [pytest.mark.compiler, pytest.mark.root]

YEAR_S = 365 * 86400
NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
ROBOTS = ("robot1", "robot2")
ITEMS = ("map", "order")
LANGUAGES = pytest.mark.parametrize("language", ["c", "python"])
IN_PYTHON = Path(__file__).with_name("board_component.py")


@dataclass
class Robots:
    """Two robots with a board each, and the path by which a program finds that of the robot where it is."""

    path: Path
    places: tuple[Path, Path]
    boards: tuple[Board, Board]

    def is_robot(self, index: int) -> None:
        """From now on this machine is that robot; in one step, as a program that finds no board makes one of its own."""
        fresh = self.path.with_name("board.new")
        fresh.symlink_to(self.places[index])
        fresh.replace(self.path)


@pytest.fixture
def robots(tmp_path: Path) -> Iterator[Robots]:
    with place_for_board() as first, place_for_board() as second:
        for place, robot in zip((first, second), ROBOTS, strict=True):
            place.mkdir()
            directory.make_file(place / "private", PRIVATE, robot)
            directory.make_file(place / "own", OWN, robot)
        with board(first) as one, board(second) as other:
            for opened in (other, one):
                for name in ITEMS[:: 1 if opened is one else -1]:  # at the other robot items lie elsewhere
                    opened.add(Item(name, size=8))
            found = Robots(tmp_path / "board", (first, second), (one, other))
            found.is_robot(0)
            yield found


def component(robots: Robots, tmp_path: Path, *words: str) -> Program:
    """The program, when it has opened the board, under epoch 3."""
    env = {"FAILOVER_BOARD": str(robots.path), "FAILOVER_EPOCH": f"{3:020d}", "PATH": os.environ["PATH"]}
    command = [sys.executable, str(IN_PYTHON)] if "python" in words else [program("board_component"), *words]
    started = start(command, tmp_path, env=env)
    started.wait_for_line("ready")
    return started


def answer(asked: Program) -> dict[str, str]:
    """What the program knows now."""
    told = asked.directory / "answer"
    told.unlink(missing_ok=True)
    (asked.directory / "ask").touch()
    asked.wait_until(told.exists, "its answer")
    return dict(line.split(" ", 1) for line in told.read_text().splitlines())


@LANGUAGES
def test_a_program_that_resumes_on_another_robot_puts_and_gets_on_that_robots_board(
    robots: Robots, tmp_path: Path, language: str
) -> None:
    one, other = robots.boards
    with ended(component(robots, tmp_path, language)) as first, protected(first) as session:
        assert answer(first)["robot"] == "robot1"
        base = transported(captured_at_last(session, CaptureOrder()))
        session.acknowledge(base.position)
        delta = transported(captured_at_last(session, CaptureOrder(base=False, sequence=2)))
        first.kill()
    left = one.item("map").get()
    assert left.number > 3 << 40
    robots.is_robot(1)
    with ended(restored([base, delta], tmp_path, epoch=5)) as second:
        found = answer(second)
        assert (found["robot"], found["put"], found["own"]) == ("robot2", "0", "0")
        assert found["own_value"] == found["count"]
        reading = other.item("map").get()
        assert int(found["own_number"]) <= reading.number
        assert 5 << 40 < int(found["own_number"]) < (5 << 40) + 1 + int(found["count"]), "numbers begin above the epoch"
        assert reading.age_ns >= 0
        assert {pid for pid, _, _ in other.users()} == {os.getpid(), second.born.inner_pid}
        with pytest.raises(Exception, match="written by"):
            other.item("map").put(bytes(8))
    still = one.item("map").get()
    assert (still.number, still.value) == (left.number, left.value), "it wrote to the board that it left"
    one.item("map").put(bytes(8))  # its lock there is free


@LANGUAGES
def test_a_ready_board_may_come_late(robots: Robots, tmp_path: Path, language: str) -> None:
    """Until the robot's agent has made its board the calls fail in a sentence; then they work."""
    with ended(component(robots, tmp_path, language)) as first, protected(first) as session:
        base = transported(captured_at_last(session, CaptureOrder()))
        first.kill()
    robots.path.unlink()
    robots.path.symlink_to("/proc/1/not-there-yet")
    with ended(restored(base, tmp_path)) as second:
        found = answer(second)
        assert (found["robot"], int(found["put"]) < 0, int(found["own"]) < 0) == ("none", True, True)
        robots.is_robot(1)
        found = answer(second)
        assert (found["robot"], found["put"], found["own"]) == ("robot2", "0", "0")


def test_a_program_that_waits_for_an_item_waits_on_for_that_of_the_other_robot(robots: Robots, tmp_path: Path) -> None:
    with ended(component(robots, tmp_path, "wait")) as first, protected(first) as session:
        base = transported(captured_at_last(session, CaptureOrder()))
        first.kill()
    robots.is_robot(1)
    with ended(restored(base, tmp_path)) as second:
        robots.boards[1].item("order").put((77).to_bytes(8, "little"))
        second.wait_for_line("order 77")


def years_later(state: Snapshot, years: int) -> Snapshot:
    """The same as captured on a machine that has been on for so much longer."""
    ns, clocks = years * YEAR_S * NS_PER_S, state.clocks
    return replace(state, clocks=Clocks(clocks.realtime_ns, clocks.monotonic_ns + ns, clocks.boottime_ns + ns))


@LANGUAGES
@pytest.mark.parametrize("years", [3, 6])
def test_a_program_resumed_in_a_time_namespace_years_ahead_tells_true_ages(
    robots: Robots, tmp_path: Path, years: int, language: str
) -> None:
    with ended(component(robots, tmp_path, language)) as first, protected(first) as session:
        base = transported(captured_at_last(session, CaptureOrder()))
        first.kill()
    robots.is_robot(1)
    other = robots.boards[1]
    peer = directory.make_peer(robots.places[1], "robot9")
    with peer.changing():
        peer.add(Wanted(1025, "map", 8))
    record = peer.record("map")
    assert record is not None
    with ended(restored(years_later(base, years), tmp_path, isolate=True)) as second:
        offsets = Path(f"/proc/{second.pid}/timens_offsets").read_text().split()
        assert abs(int(offsets[offsets.index("boottime") + 1]) - years * YEAR_S) < YEAR_S // 100
        stamp = boottime.now_ns(0)
        put_carefully(peer.place(record), 1, (4).to_bytes(8, "little"), stamp)
        before = boottime.now_ns(0) - stamp
        found = answer(second)
        assert (found["peer"], found["peer_value"]) == ("0", "4")
        assert before <= int(found["peer_age"]) <= boottime.now_ns(0) - stamp, "the age of a value of this machine's clock"
        reading = other.item("map").get()
        assert 0 <= reading.age_ns < 60 * NS_PER_S, "the age of a value of the other clock"


@pytest.mark.parametrize("years", [3, 6])
def test_two_components_whose_clocks_are_years_apart_tell_each_others_ages_within_a_millisecond(years: int) -> None:
    """Each age lies between what this process's clock tells right before and right after."""
    with place_for_board() as place, board(place) as python:
        python.add(Item("ball", size=8))
        python.add(Item("plan", size=8))
        command = ["unshare", "-T", "--boottime", str(years * YEAR_S), "--fork", program("board_tool")]
        env = {"FAILOVER_BOARD": str(place), "PATH": os.environ["PATH"]}
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env) as started:
            assert started.stdin is not None
            assert started.stdout is not None

            def said(line: str) -> str:
                started.stdin.write(f"{line}\n")  # type: ignore[union-attr]
                started.stdin.flush()  # type: ignore[union-attr]
                return started.stdout.readline().rstrip("\n")  # type: ignore[union-attr]

            if said("open") != "ok":
                pytest.skip("no time namespaces here")
            assert [said("find ball 8"), said("find plan 8")] == ["ok", "ok"]
            narrow = False
            deadline = time.monotonic() + 60
            while not narrow and time.monotonic() < deadline:
                began = boottime.now_ns(0)
                assert said("put ball x") == "ok"
                put_by = boottime.now_ns(0)
                reading = python.item("ball").get()
                now = boottime.now_ns(0)
                assert began <= now - reading.age_ns <= now
                assert reading.age_ns <= now - began
                first = boottime.now_ns(0)
                python.item("plan").put(b"y")
                last = boottime.now_ns(0)
                asked = boottime.now_ns(0)
                age = int(said("get plan -").split()[2])
                assert asked - last <= age <= boottime.now_ns(0) - first
                narrow = put_by - began < NS_PER_MS and boottime.now_ns(0) - asked + last - first < NS_PER_MS
            assert narrow, "the machine was too busy to tell a millisecond"
