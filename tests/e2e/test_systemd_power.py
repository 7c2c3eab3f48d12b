"""Two machines, each under a systemd of its own, joined by a cable: one is lost, the other counts on."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import machines, robots
from tests.e2e.machines import CHECKOUT, Machine
from tests.e2e.service import COUNT, POLITE, SERVICE, component, counted, install, started, two_robots

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.skipif(bool(machines.why_not()), reason=machines.why_not() or "-"),
]

MORE = 20
SNAPSHOTS = 5
USER = "nobody"
"""Whose the programs are: not root's."""


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[tuple[Machine, Machine]]:
    """Two robots of one team that hear each other."""
    with two_robots(tmp_path, install) as (first, second):
        yield first, second
        print(second.run("journalctl", "--unit", SERVICE, "--no-pager", "--lines=100", check=False).stdout)


def protected(machine: Machine, name: str, script: str = COUNT) -> None:
    """Start a counting component and wait until its neighbour holds some of its snapshots."""
    started(machine, name, script, USER)
    robots.until(lambda: int(component(machine, name).get("snapshots") or 0) >= SNAPSHOTS, "snapshots")
    robots.until(lambda: len(counted(machine, name)) > MORE, "output")


def expect_it_to_go_on_at(machine: Machine, name: str) -> None:
    """It runs there as its owner still, and its output has no gap and no repetition."""
    robots.until(lambda: component(machine, name).get("restores", 0) >= 1, "the other robot to take over")
    before = len(counted(machine, name))
    robots.until(lambda: len(counted(machine, name)) > before + MORE, "the count to go on")
    numbers = counted(machine, name)
    assert numbers == list(range(len(numbers)))
    found = component(machine, name)
    lines = (machine.root / f"proc/{found['pid']}/status").read_text().splitlines()
    uid = machine.run("id", "-u", USER).stdout.strip()
    assert str(found["owner"]) == uid and f"Uid:\t{uid}\t{uid}\t{uid}\t{uid}" in lines
    assert "CapEff:\t0000000000000000" in lines


def test_a_machine_whose_power_is_cut_is_replaced_by_the_other(pair: tuple[Machine, Machine]) -> None:
    first, second = pair
    protected(first, "cut")
    first.end()
    expect_it_to_go_on_at(second, "cut")


def test_a_machine_that_is_shut_down_in_order_is_replaced_by_the_other(pair: tuple[Machine, Machine]) -> None:
    """Also where a program exits as if it were done, because systemd told it to end: that is no end of the component."""
    first, second = pair
    protected(first, "shut")
    protected(first, "polite", POLITE)
    first.run("systemctl", "poweroff", check=False)
    first.process.wait(machines.PATIENCE_S)
    expect_it_to_go_on_at(second, "shut")
    expect_it_to_go_on_at(second, "polite")


def expect_nothing_to_move(first: Machine, second: Machine, name: str, *command: str) -> None:
    """A command there has the agent restart: the program acts on as the same process under the same epoch, without a gap."""
    seen, agent = component(first, name), first.property(SERVICE, "MainPID")
    first.run(*command)
    robots.until(lambda: first.property(SERVICE, "MainPID") not in (agent, "0"), "the next agent")
    robots.until(lambda: component(first, name).get("protection") == "protected", "it to be protected again")
    before = len(counted(first, name))
    robots.until(lambda: len(counted(first, name)) > before + MORE, "the count to go on")
    numbers, found = counted(first, name), component(first, name)
    assert numbers == list(range(len(numbers)))
    assert [found[key] for key in ("pid", "epoch", "primary", "restores")] == [
        seen[key] for key in ("pid", "epoch", "primary", "restores")
    ]
    assert component(second, name)["role"] == "standby"
    told = " ".join(first.run("failover", "why", name).stdout.split())
    _, left, since = told.partition("the agent of robot1 is about to restart")  # a busy machine may freeze it before
    away, back, _ = since.partition("the agent of robot1 is back; it has run on")
    assert left and back and "freezes it" not in away, told


def test_a_restart_of_the_service_moves_nothing_and_a_stop_is_a_loss(pair: tuple[Machine, Machine]) -> None:
    first, second = pair
    protected(first, "stays")
    expect_nothing_to_move(first, second, "stays", "systemctl", "restart", SERVICE)
    first.run("systemctl", "stop", SERVICE)
    expect_it_to_go_on_at(second, "stays")


UNIT = "[Service]\nExecStart=/opt/controller/controller\nUser=nobody\nRestart=on-failure\n[Install]\nWantedBy=multi-user.target\n"


def typed(recipe: str) -> str:
    """What a recipe has a person type."""
    section = (CHECKOUT / "docs" / "recipes.md").read_text().split(f"## {recipe}\n")[1]
    return section.split("```\n")[1].replace("/lab/r1/", "/lab/robot1/").replace('"robot"', f'"{USER}"')


@pytest.mark.compiler
def test_a_cpp_program_whose_unit_gives_way_to_the_agent_outlives_its_machine(
    pair: tuple[Machine, Machine], tmp_path: Path
) -> None:
    built, source = tmp_path / "controller", CHECKOUT / "tests" / "recipes" / "controller.cpp"
    if subprocess.run(["c++", "-O2", "-pthread", "-o", built, source], capture_output=True, check=False).returncode:
        pytest.skip("needs a C++ compiler: apt-get install g++")
    first, second = pair
    for machine in pair:
        place = machine.root / "opt/controller"
        place.mkdir(parents=True)
        shutil.copy(built, place)
    (first.root / "etc/systemd/system/controller.service").write_text(UNIT)
    first.run("systemctl", "enable", "--now", "controller")
    first.run("sh", "-ec", typed("A C++ program under systemd"))
    robots.until(lambda: component(first, "controller").get("protection") == "protected", "its protection")
    assert first.property("controller", "ActiveState") == "inactive"
    first.end()
    expect_it_to_go_on_at(second, "controller")
