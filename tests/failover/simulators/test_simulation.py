"""Simulated robots in processes of their own: programs find, call and read them; what ends leaves nothing; misses are told."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import psutil
import pytest

import failover
from failover.boards.board import Board
from failover.boards.overview import overview
from failover.core.naming import worlds
from failover.drivers.here import DIRECTORY, ROBOT, TEAM, here
from failover.drivers.lookup import whole_tree
from failover.errors import NameUnknownError
from failover.schedule.overview import open_schedule
from failover.simulators.group import Group, Spec
from failover.simulators.world.parts import usual

ROOT = Path(__file__).parents[3]
LIMIT_S = 60
EXAMPLES = ROOT / "examples"
ENGINE = "University/Lab/Robotino/Engines/3/PWM"

T = TypeVar("T")


@pytest.fixture
def place(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A robot without an agent: where its board is, and where its drivers meet."""
    found = tmp_path_factory.mktemp("s")
    monkeypatch.setenv("FAILOVER_BOARD", str(found / "board"))
    monkeypatch.setenv("FAILOVER_SOCKET", str(found / "control"))
    monkeypatch.setenv("FAILOVER_STATE", str(found / "state"))
    monkeypatch.setenv(DIRECTORY, str(found / "m"))
    monkeypatch.setenv(ROBOT, "robot1")
    for name in (TEAM, worlds.VARIABLE):
        monkeypatch.delenv(name, raising=False)
    return found


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "failover", "simulate", *words]


def ran(*words: str, status: int = 0) -> dict[str, Any]:
    """What a simulation tells at its end."""
    done = subprocess.run(command(*words, "--json"), capture_output=True, text=True, timeout=LIMIT_S, check=False)
    assert done.returncode == status, done.stdout + done.stderr
    told: dict[str, Any] = json.loads(done.stdout)
    return told


def until(condition: Callable[[], T], what: str) -> T:
    deadline = time.monotonic() + LIMIT_S
    while not (found := condition()):
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.02)
    return found


@contextlib.contextmanager
def simulated(*words: str, environment: dict[str, str] | None = None) -> Iterator[subprocess.Popen[str]]:
    """A simulation whose robots have begun."""
    with subprocess.Popen(command(*words), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stderr is not None
            said = process.stderr.readline()
            assert "Ctrl-C ends" in said, said + process.stderr.read()
            yield process
        finally:
            process.kill()


def ended(process: subprocess.Popen[str]) -> str:
    """What it says after Ctrl-C. A busy machine may make it miss deadlines."""
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=LIMIT_S)
    assert process.returncode in (0, 1) and "Traceback" not in err, err
    return out


def paths() -> list[str]:
    try:
        return [one.record.path for one in whole_tree(here()).under()]
    except NameUnknownError:
        return []


def policies(process: subprocess.Popen[str]) -> list[set[int]]:
    """Of the threads of each process that simulates robots."""
    found = []
    for child in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split():
        threads = [int(thread) for thread in os.listdir(f"/proc/{child}/task")]
        found.append({os.sched_getscheduler(thread) & ~os.SCHED_RESET_ON_FORK for thread in threads})
    return found


def may_go_ahead() -> bool:
    """Whether this user may run anything ahead of ordinary processes."""
    tried = "import os; os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))"
    return subprocess.run([sys.executable, "-c", tried], stderr=subprocess.DEVNULL, check=False).returncode == 0


@pytest.mark.skipif(not may_go_ahead(), reason="this user may run nothing ahead of ordinary processes")
def test_simulated_robots_run_ahead_of_ordinary_processes_until_they_do_not_fit_on_the_machine(place: Path) -> None:
    with simulated("--robots", "2", "--labs", "1") as process:
        until(lambda: policies(process) == [{os.SCHED_RR}], "the priority of all threads")
        (child,) = psutil.Process(process.pid).children()
        child.suspend()
        time.sleep(2.0)  # 40 ticks
        child.resume()
        until(lambda: policies(process) == [{os.SCHED_OTHER}], "the priority to be given back")
        ended(process)


# --- By a seed ------------------------------------------------------------------------------------------------------------


def board_after(place: Path, ticks: int, seed: int = 1) -> tuple[list[Any], dict[str, str]]:
    """Every item of every robot once a world has gone on for so long, and the digest of all that was put until then."""
    with contextlib.ExitStack() as stack:
        group = Group(Spec(usual(6, 2, seed), 1, 1, 0.0, ticks, str(place / "board")), stack)
        while not group.is_done:
            group.tick()
            group.act()
        with Board(place / "board", "test") as board:
            found = [(one.robot, one.item, one.put, one.value) for one in overview(board)]
        return found, group.figures().digests


def test_the_same_seed_gives_the_same_board(place: Path) -> None:
    once, again, other = board_after(place, 120), board_after(place, 120), board_after(place, 120, seed=2)
    assert once == again
    assert len(once[0]) == 6 * 4 and all(put for _, _, put, _ in once[0])
    assert [row[:3] for row in other[0]] == [row[:3] for row in once[0]] and other != once


def test_two_runs_of_the_command_are_equal_however_fast_they_go(place: Path) -> None:
    words = ("--robots", "4", "--labs", "2", "--for", "2", "--seed", "7")
    once, again = ran(*words, "--pace", "max"), ran(*words, "--pace", "max")
    assert once["digest"] == again["digest"] and once["world_s"] == 2 and once["missed"] is None
    assert ran(*words[:-1], "8", "--pace", "max")["digest"] != once["digest"]
    live = json.loads(subprocess.run(command(*words, "--json"), capture_output=True, timeout=LIMIT_S, check=False).stdout)
    assert live["activations"] + live["missed"] >= 160
    if not live["missed"]:  # a busy machine makes it skip controllers: then their robots went another way
        assert live["digest"] == once["digest"]


# --- Live -----------------------------------------------------------------------------------------------------------------


WORLD = """
[labs.Lab]
size = [6, 6]
[labs.Lab2]
size = [4, 4]
[robots.Robotino]
lab = "Lab"
at = [3, 3]
controller = "none"
aliases = { engine = "Engines/3/PWM" }
[robots.Robotino2]
lab = "Lab"
at = [1, 1]
[robots.Robotino3]
lab = "Lab2"
at = [2, 2]
"""
"""Robotino is driven by programs alone."""


@pytest.fixture
def world(place: Path) -> str:
    (place / "world.toml").write_text(WORLD)
    return str(place / "world.toml")


def test_programs_find_call_and_read_simulated_robots_and_the_end_leaves_nothing(place: Path, world: str) -> None:
    with simulated("--world", world) as process:
        found = paths()
        assert len(found) == 3 * 14 + 1
        assert "Simulated/University/Lab2/Robotino3/US/8" in found and "Simulated/World/1" in found
        with failover.proxy("Simulated/University/Lab/Robotino/Engines/2/PWM") as engine:
            engine.call("set", duty=0.5)
            assert engine.call("read")["duty"] == 0.5
            until(lambda: engine.call("read")["rpm"] > 50, "the engine to turn")
            assert engine.call("read")["moves"] == 1
            assert next(engine.stream("current")) == 1.25
        with failover.proxy("Simulated/University/Lab/Robotino2/US/1") as sensor:
            assert 0 <= sensor.call("read")["metres"] <= 4
        with Board(None, "test") as board:
            assert list(board.robots()) == [board.robot] and len(board.guests()) == 3
            pose = board.item("pose")
            first = pose.wait("Simulated.Robotino2", after=0, timeout=LIMIT_S)
            assert pose.wait("Simulated.Robotino2", after=first.number, timeout=LIMIT_S).number > first.number
            assert set(board.item("battery").wait("Simulated.Robotino3", after=0, timeout=LIMIT_S).value) == {"volts", "level"}
            with pytest.raises(failover.BoardError, match=r"Simulated\.Robotino2"):
                pose.get("Robotino2")
        schedule = open_schedule()
        assert schedule.row_of("Simulated/World/1") is not None
        schedule.close()
        assert "activations of controllers" in ended(process)
        assert not paths() and not list(place.glob("board/*")) and not list(place.glob("m/*.calls"))


def test_programs_that_end_before_the_simulation_or_after_it_find_a_board_without_tasks_and_guests(place: Path) -> None:
    with Board(None, "stays") as board:
        with simulated() as process:
            ended(process)
        assert not board.guests()
        schedule = open_schedule()
        assert schedule.row_of("Simulated/World/1") is None
        schedule.close()


def test_what_a_killed_simulation_left_is_replaced_and_a_living_one_is_not(place: Path) -> None:
    with Board(None, "stays") as board:
        with simulated() as process:
            refused = ran("--for", "1", status=1)
            assert "already" in refused["message"] and "Traceback" not in refused["message"]
            (child,) = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
            os.kill(int(child), signal.SIGKILL)
            _, said = process.communicate(timeout=LIMIT_S)
            assert process.returncode == 1 and "exit status -9" in said and "Traceback" not in said
        assert board.guests(), "its file is still there"
        with simulated() as process:
            pose = board.item("pose")
            assert pose.wait("Simulated.Robotino", after=0, timeout=LIMIT_S).number < 1000, "it has begun anew"
            ended(process)


def test_a_simulation_ends_with_the_process_that_began_it(place: Path) -> None:
    with simulated() as process:
        process.kill()
        process.wait(LIMIT_S)
        until(lambda: not list(place.glob("board/*")), "its processes to end")


# --- A missed deadline ----------------------------------------------------------------------------------------------------


def test_deadlines_that_cannot_be_kept_are_missed_and_told(place: Path) -> None:
    """A period of half a millisecond, for twenty robots in Python."""
    told = ran("--robots", "20", "--for", "2", "--pace", "100", status=1)
    assert told["missed"] > 0 and told["late_ms"]["max"] > 0
    assert told["activations"] + told["missed"] >= 20 * 40


# --- One program, two worlds ----------------------------------------------------------------------------------------------


@contextlib.contextmanager
def real_engine() -> Iterator[None]:
    with subprocess.Popen([sys.executable, str(EXAMPLES / "engine.py")], stderr=subprocess.PIPE, text=True) as driver:
        try:
            assert driver.stderr is not None and "takes messages" in driver.stderr.readline()
            yield
        finally:
            driver.kill()


def test_one_program_drives_the_real_engine_and_the_simulated_one(place: Path, world: str) -> None:
    def drive(name: str, **environment: str) -> str:
        words = [sys.executable, str(EXAMPLES / "engine.py"), "drive", name]
        there = {**os.environ, **environment}
        return subprocess.run(words, capture_output=True, text=True, timeout=LIMIT_S, check=True, env=there).stdout

    with real_engine(), simulated("--world", world):
        for name in (ENGINE, "engine"):
            real, twin = drive(name), drive(name, FAILOVER_WORLD="Simulated")
            assert "'duty': 1.0, 'rpm': 3000.0" in real
            assert "'duty': 1.0, 'rpm': " in twin and "3000.0" not in twin
            assert real.splitlines()[1:] == twin.splitlines()[1:] == ["2.5 A"] * 3


def test_a_program_of_a_world_has_its_robots_on_the_board_by_their_names(place: Path) -> None:
    script = (
        "import failover, json; board = failover.board(); us = board.item('us')\n"
        "for robot in ('Robotino1', 'Robotino2'): us.wait(robot, after=0, timeout=60)\n"
        "print(json.dumps([sorted(board.robots()), us.get('Robotino1').robot, len(us.get('Robotino1').value['metres']),\n"
        "                  us.youngest().robot in ('Robotino1', 'Robotino2'), list(board.guests())]))\n"
    )
    with simulated("--robots", "2"):
        environment = {**os.environ, "FAILOVER_WORLD": "Simulated"}
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=LIMIT_S, env=environment)
        assert done.returncode == 0, done.stderr
        robots, robot, sensors, is_guest, guests = json.loads(done.stdout)
    assert robots[:2] == ["Robotino1", "Robotino2"] and len(robots) == 3
    assert (robot, sensors, is_guest, guests) == ("Robotino1", 8, True, [])


def test_a_driver_of_a_world_has_a_simulated_name(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(worlds.VARIABLE, "Simulated")
    with real_engine():
        (one,) = whole_tree(here()).under()
        assert one.record.path == f"Simulated/{ENGINE}" and one.record.kind == "simulated"
        with failover.proxy("engine") as engine:
            assert engine.call("read")["duty"] == 0.0


# --- The shipped world ----------------------------------------------------------------------------------------------------


def test_the_tree_of_amur_7_is_that_of_the_page(place: Path) -> None:
    page = (ROOT / "docs" / "simulation.md").read_text()
    golden = page.split("```text\n")[1].split("```")[0]
    with simulated("--world", "amur-7"):
        done = subprocess.run(
            [sys.executable, "-m", "failover", "names", "Simulated/RSUH"],
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
            env={**os.environ, "COLUMNS": "400", "NO_COLOR": "1"},
        )
    assert steps(done.stdout) == steps(golden)


def steps(shown: str) -> list[tuple[str, str]]:
    """The first two columns of the tree: name and kind."""
    found = []
    for line in shown.splitlines():
        words = line.split()
        if words and words[0] != "kind" and words[1:] != ["names"]:
            found.append((line[: len(line) - len(line.lstrip())] + words[0], words[1] if len(words) > 1 else ""))
    return found
