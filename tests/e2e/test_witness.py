"""A witness: it votes, as an ordinary user, keeps nothing, starts nothing, and is smaller than a robot's agent."""

from __future__ import annotations

import contextlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

from failover.cli.demo.robots import RobotMachine
from failover.config.team import Role
from tests.e2e import robots, teams
from tests.e2e.teams import hears_all
from tests.e2e.test_orders import COUNTING, counted
from tests.robot_processes import command_lines

ROLES: dict[str, Role] = {"robot1": "robot", "robot2": "robot", "gate": "witness"}
NOT_ITS_OWN = (
    "agent.worker.components.supervisor",
    "agent.worker.components.process_pool",
    "agent.guard.server",
    "checkpoint.store.store",
    "checkpoint.snapshot.format",
    "numpy",
    "zstandard",
)
MORE = 20

pytestmark = [pytest.mark.root, pytest.mark.command("unshare")]


def agents(member: RobotMachine) -> list[int]:
    """The processes of an agent: Python ones, without its host."""
    lines = command_lines(member)
    return [pid for pid, words in lines if any(word.startswith("agent.") or word == "checkpoint" for word in words[1:])]


def pss_kb(member: RobotMachine) -> int:
    """Its share of memory, all processes of its agent together."""
    total = 0
    for pid in agents(member):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has ended
            found = re.search(r"^Pss:\s+(\d+)", Path(f"/proc/{pid}/smaps_rollup").read_text(), re.MULTILINE)
            total += int(found[1]) if found else 0
    return total


def test_what_a_witness_does_not_need_is_not_even_imported() -> None:
    code = "import sys, agent.worker.witness; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not set(NOT_ITS_OWN) & set(loaded)


def test_a_witness_decides_between_two_robots_and_does_nothing_else(tmp_path: Path) -> None:
    with teams.acting(tmp_path, ROLES) as stage:
        first, second, gate = (stage.members[name] for name in ROLES)
        robots.run(first, "count", *COUNTING)
        robots.until_protected(first)
        shown = robots.failover(gate, "status")
        assert shown.returncode == 0 and "hears 3 of 3" in shown.stdout and "witness" in shown.stdout, shown
        print(f"memory: a witness {pss_kb(gate)} kB PSS, a robot {pss_kb(first)} kB")
        assert pss_kb(gate) < pss_kb(first)
        stage.cut_power("robot1")
        robots.until(lambda: robots.component(second, "count").get("role") == "primary", "robot2 to be elected")
        before = len(counted(second))
        robots.until(lambda: len(counted(second)) > before + MORE, "it to go on at robot2")
        for order in (("run", "--", "true"), ("stop", "count"), ("promote", "count", "--yes")):
            refused = robots.failover(gate, *order)
            assert refused.returncode == 1 and "gate is a witness: it votes, and neither runs nor keeps" in refused.stderr
        robots.until(lambda: "robot2 claims epoch" in robots.failover(gate, "why", "count").stdout, "robot2 to tell its part")
        assert len(agents(gate)) == 2, "the main loop and its worker"
        for pid in agents(gate):
            status = Path(f"/proc/{pid}/status").read_text()
            assert re.search(r"^CapEff:\s+0+$", status, re.MULTILINE) and re.search(r"^CapBnd", status, re.MULTILINE)
        names = {path.name.partition(".")[0] for path in (gate.directory / "state").iterdir()}
        assert names <= {"ballot", "sites", "story"}, names
        assert {path.name for path in (gate.directory / "run").iterdir()} == {"control.sock"}
        stage.switch_on("robot1")
        robots.until(lambda: hears_all(gate), "robot1 to be back")
