"""A program that keeps its state resumes under another Python or numpy at the robot that takes it over, and comes back."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

CHECKOUT: Final = Path(__file__).resolve().parents[2]
VENV: Final = Path(sys.prefix)
MORE: Final = 20
"""Lines after a resumption that are waited for."""

LAUNCHER: Final = """#!/bin/sh
# The robot on which it is started first has the interpreter of the first line of a file, the other one that of the second.
here=$(readlink /proc/self/ns/net)
mkdir "$0.first" 2>/dev/null && echo "$here" >"$0.first/robot"
if [ "$(cat "$0.first/robot")" = "$here" ]; then number=1; else number=2; fi
line=$(sed -n "${number}p" "$0.interpreters")
PYTHONPATH=${line#* } exec "${line%% *}" -m tests.e2e.traveller
"""

Pair = tuple[RobotMachine, RobotMachine]


@dataclass(frozen=True, slots=True)
class Interpreter:
    """A Python, and where it finds its modules."""

    program: Path
    path: str


OURS: Final = Interpreter(Path(sys.executable), str(CHECKOUT))
OTHERS: Final = {
    "numpy": (Interpreter(Path(sys.executable), f"{VENV / 'numpy-1'}:{CHECKOUT}"), VENV / "numpy-1" / "numpy"),
    "python": (Interpreter(VENV / "other-python" / "bin" / "python", str(CHECKOUT)), VENV / "other-python"),
}
"""Each with what must be there; `./run setup` brings it where it can."""


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        yield both


@dataclass(frozen=True, slots=True)
class Life:
    """What the program said of itself when it began."""

    python: str
    numpy: str
    digest: str


def lives(robot: RobotMachine) -> list[Life]:
    lines = robots.output(robot, "traveller").decode().splitlines()
    return [Life(*line.split()[1:]) for line in lines if line.startswith("#")]


def counted(robot: RobotMachine) -> list[int]:
    lines = robots.output(robot, "traveller").decode().splitlines()
    return [int(line) for line in lines if not line.startswith("#")]


def start(robot: RobotMachine, folder: Path, interpreters: list[Interpreter]) -> None:
    launcher = folder / "launcher"
    launcher.write_text(LAUNCHER)
    lines = (f"{one.program} {one.path}\n" for one in interpreters)
    launcher.with_name("launcher.interpreters").write_text("".join(lines))
    robots.run(robot, "traveller", "/bin/sh", str(launcher), cwd=str(folder), engine="cooperative")


def went_on(robot: RobotMachine, life: int) -> None:
    robots.until(lambda: len(lives(robot)) > life, f"life {life + 1} at {robot.name}")
    before = len(counted(robot))
    robots.until(lambda: len(counted(robot)) > before + MORE, "the count to go on")
    numbers = counted(robot)
    assert numbers == list(range(len(numbers)))


def handed_over(source: RobotMachine, target: RobotMachine) -> None:
    robots.until_protected(source, "traveller")
    done = robots.failover(source, "handover", "traveller")
    assert done.returncode == 0, done.stdout + done.stderr
    robots.until(lambda: robots.component(target, "traveller").get("state") == "running", f"{target.name} to run it")


@pytest.mark.root
@pytest.mark.skipif(not robots.has_cable(), reason="needs robots with networks of their own, by which they are told apart")
@pytest.mark.parametrize("what", OTHERS)
def test_a_state_moves_between_two_versions_and_back(pair: Pair, tmp_path: Path, what: str) -> None:
    other, needed = OTHERS[what]
    if not needed.exists():
        pytest.skip(f"needs another {what}, which ./run setup could not find here")
    first, second = pair
    start(first, tmp_path, [OURS, other])
    robots.until(lambda: robots.checkpoints(second, "traveller") > 1, "checkpoints at robot2")
    handed_over(first, second)
    went_on(second, 1)
    handed_over(second, first)
    went_on(first, 2)
    there, elsewhere, back = lives(first)
    assert getattr(there, what) != getattr(elsewhere, what), "they are two versions"
    assert there == back
    assert there.digest == elsewhere.digest, "the state is the same to the byte"
