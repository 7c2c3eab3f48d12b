"""A whole site loses its power, or is cut off: its program goes on at the other one by an operator's order, and there alone."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from failover.cli.demo.robots import RobotMachine
from tests.conftest import compiler
from tests.e2e import robots
from tests.e2e.test_archive import is_gone
from tests.e2e.test_orders import MORE, counted
from tests.e2e.test_sealed_copies import copies, is_primary, sealed_of
from tests.e2e.two_sites import PATIENCE_S, ROLES, SETTINGS, TwoSites, is_connected, stage

pytest.importorskip("cryptography")

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.timeout(1800),
    pytest.mark.compiler,
    pytest.mark.skipif(not robots.has_cable() or not Path("/dev/net/tun").exists(), reason="needs network namespaces and TUN"),
]

COUNTS = """
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

int main(void) {
    static char held[300000];
    for (int at = 0; at < 300000; at++) held[at] = rand();
    for (long number = 0;; number++) {
        printf("%ld\\n", number);
        fflush(stdout);
        nanosleep(&(struct timespec){0, 10000000}, NULL);
    }
}
"""
"""A small program, for the wire is slow; but a copy of it is a while under way."""


def until(condition: Any, what: str) -> Any:
    return robots.until(condition, what, PATIENCE_S)


def numbers_of(robot: RobotMachine) -> list[int]:
    """What it wrote, as this robot has it; each number once, in order."""
    numbers = counted(robot)
    assert numbers == list(range(len(numbers))), "no gap and no repetition"
    return numbers


def goes_on(robot: RobotMachine, beyond: int) -> None:
    """It counts there."""
    until(lambda: len(numbers_of(robot)) > beyond + MORE, f"it to go on at {robot.name}")


def begin(site: TwoSites) -> int:
    """A program of robot1 of which the witness keeps copies; what it had counted to before the newest one."""
    first, gate = site.members["robot1"], site.members["gate"]
    program = site.directory / "count"
    subprocess.run([str(compiler()), "-xc", "-O1", "-o", program, "-"], input=COUNTS, text=True, check=True)
    robots.run(first, "count", str(program))
    until(lambda: len(copies(gate)) >= 2, "two copies")
    number = counted(first)[-1]
    for what in ("a later copy", "a copy that was begun since"):
        newest = copies(gate)[-1].name
        until(lambda newest=newest: copies(gate)[-1].name > newest, what)
    return number


def recover(site: TwoSites, name: str, newest: int = 0) -> None:
    """What an operator does at a robot, to have the component go on there: from that checkpoint, if no newer one comes."""
    robot = site.members[name]
    robots.keep_on(robot)
    robots.stop_agent(robot)
    ran = site.failover_agent(name, "recover", "count")
    assert (ran.returncode, ran.stderr) == (0, "")
    assert re.search(
        rf"{name} holds /demo/robot1/count as robot\d archived it, .*\nthis copy was sealed at .*, \d+ s ago", ran.stdout
    )
    robots.start_agent(robot)
    resumed = f"it resumes from checkpoint {newest or ''}"
    until(lambda: robots.answers(robot) and resumed in robots.failover(robot, "why", "count").stdout, resumed)


def sequence_of(copy: Path) -> int:
    """The number of the checkpoint in a sealed copy."""
    return int(copy.name.split("-")[3], 16)


def runs_at(robot: RobotMachine, by: RobotMachine) -> bool:
    """Whether a robot of another site says that it has the component no longer; two copies must not act."""
    shown = robots.component(by, "count")
    return shown.get("primary") == robot.name and shown.get("state") == "held"


def test_a_program_of_a_lost_site_goes_on_at_the_other_one_alone_and_comes_back_by_an_order(tmp_path: Path) -> None:
    with stage(tmp_path) as site:
        first, third, gate = (site.members[name] for name in ROLES)
        begin(site)
        before, carried = copies(gate), site.wire.counts()["bytes"]
        size = before[-1].stat().st_size
        until(lambda: site.wire.counts()["bytes"] - carried > size // 2, "half of a copy to be under way")
        site.wire.cut()
        until(lambda: not is_connected(first), "the cut to be noticed")
        number = counted(first)[-1]
        site.wire.mend()
        for what in ("a copy after the cut", "a copy that was begun after the cut"):
            newest = copies(gate)[-1].name
            until(lambda newest=newest: copies(gate)[-1].name > newest, what)  # type: ignore[misc]
        site.cut_power("robot1")
        until(lambda: is_gone(first), "everything of it to have ended")
        recover(site, "robot3", sequence_of(copies(gate)[-1]))
        goes_on(third, number)
        assert "epoch" in robots.failover(third, "status").stdout and is_primary(third)

        first = site.switch_on("robot1")

        def has_heard() -> bool:
            assert not is_primary(first), "two copies act"
            return runs_at(third, first)

        until(has_heard, "robot1 to hear what was recovered")
        assert "an operator recovered it at robot3, of another site" in robots.failover(first, "status").stdout
        refused = robots.failover(first, "promote", "count", "--yes")
        assert refused.returncode and "to bring it back: failover-agent recover /demo/robot1/count" in refused.stderr
        goes_on(third, len(counted(third)))

        number = counted(third)[-1]
        newest = copies(gate)[-1].name
        until(lambda: copies(gate)[-1].name > newest and sealed_of(third).get("at") == "gate", "robot3 to put copies")
        newest = copies(gate)[-1].name
        until(lambda: copies(gate)[-1].name > newest, "a later one")
        recover(site, "robot1")
        goes_on(first, number)
        until(lambda: runs_at(first, third), "robot3 to hear that it was brought back")
        assert "failover lost" in robots.failover(third, "status").stdout, "its state is kept aside"


def test_a_copy_that_ran_on_behind_a_cut_gives_up_to_the_one_that_an_operator_recovered(tmp_path: Path) -> None:
    with stage(tmp_path, SETTINGS + "bring = false\n") as site:
        first, third, _ = (site.members[name] for name in ROLES)
        number = begin(site)
        site.wire.cut()
        until(lambda: not is_connected(first), "the cut to be noticed")
        recover(site, "robot3")
        goes_on(third, number)
        goes_on(first, len(counted(first)))  # nothing can stop it there
        site.wire.mend()
        until(lambda: runs_at(third, first), "robot1 to hear what was recovered")
        assert "failover lost" in robots.failover(first, "status").stdout, "its state is kept aside"
        goes_on(third, len(counted(third)))
        assert is_primary(third) and not is_primary(first)
