"""Robots of different processors in one team, and two equal emulated ones: programs move, or are refused by name.

Takes many minutes: ``FAILOVER_TEST_MACHINES``, as for `tests.machines.test_machines`.
"""

from __future__ import annotations

import contextlib
import os
import platform
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.cli.demo.robots import NAMES, RobotMachine, free_ports
from tests.e2e import robots
from tests.e2e.guests import MixedStage, to_one_another, to_this_machine
from tests.e2e.test_cooperative import COUNTER
from tests.machines.emulated import KINDS, ROOT, Kind, Machine

pytestmark = [pytest.mark.timeout(7200), pytest.mark.root]

PYTHON = "/usr/bin/python3"
PATIENCE_S = 600.0
PLACES = ("/opt/site", "/root/failover", sysconfig.get_path("purelib"), str(ROOT))
"""Where the program's modules are in a machine, and here."""
COUNTING = "import time, itertools\nfor number in itertools.count():\n    print(number, flush=True)\n    time.sleep(0.05)\n"


def others() -> Iterator[Kind]:
    """Of the kinds that are wanted, those of another processor."""
    return (kind for kind in KINDS if kind.processor != platform.machine())


@pytest.fixture(params=others(), ids=lambda kind: kind.name)
def kind(request: pytest.FixtureRequest) -> Kind:
    wanted: Kind = request.param
    if reason := wanted.unwanted() or wanted.lacking():
        pytest.skip(reason)
    if not robots.has_cable():
        pytest.skip("the robots need networks of their own")
    return wanted


@pytest.fixture
def mixed(kind: Kind, tmp_path: Path) -> Iterator[MixedStage]:
    """robot1 is of this machine, robot2 an emulated one."""
    guest = made(kind, tmp_path)
    with guest.booted(*to_this_machine(NAMES[1])), MixedStage(tmp_path / "stage", {NAMES[1]: guest}) as stage:
        yield from started(stage)


@pytest.fixture
def alike(kind: Kind, tmp_path: Path) -> Iterator[MixedStage]:
    """Both are emulated."""
    wires = to_one_another(*free_ports(1))
    with contextlib.ExitStack() as stack:
        guests = {name: stack.enter_context(made(kind, tmp_path).booted(*wires[name])) for name in NAMES}
        stage = stack.enter_context(MixedStage(tmp_path / "stage", guests))
        yield from started(stage)


def made(kind: Kind, tmp_path: Path) -> Machine:
    machine = Machine(kind, kind.place(tmp_path), *free_ports(1))
    machine.make()
    return machine


def started(stage: MixedStage) -> Iterator[MixedStage]:
    try:
        stage.start()
        yield stage
    finally:
        print(stage.shown())


def counted(robot: RobotMachine, name: str) -> list[int]:
    """The numbers that it has written, without what it says of its origin."""
    return [int(line) for line in robots.output(robot, name).decode().splitlines() if not line.startswith("#")]


def until_it_goes_on(robot: RobotMachine, name: str, before: int) -> None:
    """It counts on there, without gap or repetition."""
    robots.until(lambda: len(counted(robot, name)) > before + 10, f"{name} to go on at {robot.name}", PATIENCE_S)
    numbers = counted(robot, name)
    assert numbers == list(range(len(numbers)))


def hand_over(robot: RobotMachine, name: str) -> None:
    """Order it until the other robot took it: an emulated machine may need longer than a handover may take, and then it stays."""

    def moved() -> bool:
        until_safe(robot, name)
        answer = robots.failover(robot, "handover", name)
        is_taken = answer.returncode == 0 or f" took /demo/robot1/{name} and has not begun to run it in " in answer.stderr
        assert is_taken or f"{name} stays at {robot.name}" in answer.stderr, answer
        return is_taken

    robots.until(moved, f"{name} to move", PATIENCE_S)


def until_safe(robot: RobotMachine, name: str) -> int:
    """Until its standby has it; how many numbers are safe there."""
    robots.until(lambda: robots.component(robot, name).get("protection") == "protected", f"{name} to be safe", PATIENCE_S)
    return len(counted(robot, name))


def test_a_program_that_keeps_its_state_moves_to_another_processor_and_outlives_it(mixed: MixedStage, tmp_path: Path) -> None:
    if sys.version_info[:2] != (3, 11):
        pytest.skip("the machine has Python 3.11")
    first, second = mixed.robots
    program = tmp_path / "counter.py"
    program.write_text(COUNTER.replace("0.01", "0.1"))
    environment = {"PYTHONPATH": os.pathsep.join(PLACES)}
    robots.run(first, "count", PYTHON, str(program), env=environment, cwd=str(tmp_path), engine="cooperative")
    before = until_safe(first, "count")
    hand_over(first, "count")
    until_it_goes_on(second, "count", before)
    before = until_safe(second, "count")
    second.cut_power()
    robots.until(lambda: robots.component(first, "count").get("role") == "primary", "robot1 to take it over", PATIENCE_S)
    until_it_goes_on(first, "count", before)


def test_a_program_that_nobody_prepared_is_refused_there_by_name_and_goes_on(mixed: MixedStage, kind: Kind) -> None:
    first, _ = mixed.robots
    robots.run(first, "count", PYTHON, "-c", COUNTING)
    reason = f"it was taken on {platform.machine()}, this machine is {kind.processor}"
    robots.until(lambda: reason in robots.failover(first, "status").stdout, "the refusal", PATIENCE_S)
    told = robots.failover(first, "status")
    assert "docs/decorator.md" in told.stdout and "running, unprotected" in told.stdout and told.returncode == 1, told
    refused = robots.failover(first, "handover", "count")
    assert refused.returncode == 1 and robots.component(first, "count")["role"] == "primary", refused
    until_it_goes_on(first, "count", len(counted(first, "count")))


def test_a_program_that_nobody_prepared_outlives_its_robot(alike: MixedStage) -> None:
    first, second = alike.robots
    robots.run(first, "count", PYTHON, "-c", COUNTING)
    before = until_safe(first, "count")
    first.cut_power()
    robots.until(lambda: robots.component(second, "count").get("restores"), "robot2 to take it over", PATIENCE_S)
    until_it_goes_on(second, "count", before)
