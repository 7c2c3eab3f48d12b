"""The demo's robots: a power cut takes everything, nothing is left behind, robots do not see one another."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from failover.cli.demo import robots
from failover.cli.demo.robots import GO, RobotMachine

BOUND_S = 20.0

TREE = "import os, sys, time\nif os.fork() == 0:\n    os.setsid()\n    if os.fork(): os._exit(0)\ntime.sleep(600)\n"
"""A process and a grandchild that has left its session and its parent, as guards do."""


def wait_for(what: str, condition: Callable[[], bool]) -> None:
    """Poll until a condition holds."""
    deadline = time.monotonic() + BOUND_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.005)


def start(directory: Path, own_pids: bool, script: str = TREE) -> RobotMachine:
    """A robot whose agent is a Python script."""
    with (directory / "agent.log").open("wb") as log:
        command = robots.host_command(own_pids, [sys.executable, "-c", script])
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log)
    robot = RobotMachine("robot1", directory, process)
    robot.switch_on()
    return robot


@pytest.fixture(
    params=[pytest.param(True, marks=pytest.mark.user_namespaces, id="own-pids"), pytest.param(False, id="subreaper")]
)
def robot(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[RobotMachine]:
    """A robot that runs a process and an orphan."""
    machine = start(tmp_path, request.param)
    wait_for("the orphan", lambda: len(machine.processes()) >= (3 if request.param else 2))
    yield machine
    machine.end()


def test_a_power_cut_takes_every_process_of_a_robot_also_those_that_left_their_parent(robot: RobotMachine) -> None:
    before = robot.processes()
    assert robot.cut_power() >= len(before)
    wait_for("all of them to end", lambda: not [pid for pid in before if running(pid)])  # its host may not have reaped them
    assert robot.process.returncode is not None


def test_a_robot_ends_with_the_process_that_started_it(tmp_path: Path) -> None:
    script = (
        "import psutil, sys, time\nfrom pathlib import Path\nfrom tests.failover.cli.demo.test_demo_robots import start\n"
        f"robot = start(Path({str(tmp_path)!r}), False)\n"
        "while len(psutil.Process(robot.process.pid).children()) < 2: time.sleep(0.01)  # until the orphan is the host's\n"
        "print(robot.process.pid, *robot.processes(), flush=True)\nsys.stdin.read()\n"
    )
    root = Path(__file__).parents[4]
    starter = subprocess.Popen([sys.executable, "-c", script], cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert starter.stdout is not None
    pids = [int(word) for word in starter.stdout.readline().split()]
    assert len(pids) >= 3
    starter.kill()
    starter.communicate()
    wait_for("everything to end", lambda: not [pid for pid in pids if running(pid)])


def running(pid: int) -> bool:
    """Whether a process exists and is no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.user_namespaces
def test_a_robot_with_its_own_pids_sees_none_of_ours(tmp_path: Path) -> None:
    script = "import os\nprint(sorted(int(name) for name in os.listdir('/proc') if name.isdecimal()), flush=True)"
    robot = start(tmp_path, own_pids=True, script=script)
    robot.process.wait()
    assert robot.log.read_text().strip() == "[1, 2]"


def test_a_host_that_never_gets_the_word_starts_nothing(tmp_path: Path) -> None:
    mark = tmp_path / "started"
    command = robots.host_command(False, ["/bin/touch", str(mark)])
    ran = subprocess.run(command, stdin=subprocess.DEVNULL, check=False)
    assert ran.returncode != 0
    assert not mark.exists()
    assert subprocess.run(command, input=GO, check=False).returncode == 0
    assert mark.exists()


def test_free_ports_are_all_different() -> None:
    ports = robots.free_ports(8)
    assert len(set(ports)) == 8
