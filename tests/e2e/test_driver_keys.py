"""A driver and the program that calls it, on two robots that replace their keys: both run on, and a copied key is refused."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from failover.drivers.here import DIRECTORY, ROBOT, TEAM
from tests.e2e import robots
from tests.e2e.growing import GrowingStage, machines, together

ROOT = Path(__file__).parents[2]
MORE = 20
FOUND_S = 240.0
"""Some scans for names, 20 s apart, on a busy machine."""

DRIVER = """
import failover
@failover.driver("Lab/robot1/Counter")
class Counter:
    def __init__(self):
        self.count = 0
    @failover.command
    def next(self) -> int:
        self.count += 1
        return self.count
print("begins", flush=True)
failover.run(Counter)
"""
CALLER = """
import time, failover
with failover.proxy("Lab/robot1/Counter") as counter:
    while True:
        print(counter.call("next", timeout=3600), flush=True)
        time.sleep(0.02)
"""

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(not robots.has_cable(), reason="robots have no networks of their own here"),
]


@contextmanager
def running(stage: GrowingStage, robot: str, script: str, team: Path, output: Path) -> Iterator[Path]:
    """A process in a robot's network, with these files of the team; the file into which it writes."""
    with tempfile.TemporaryDirectory(prefix="fo-", dir="/tmp") as meeting:  # short: the address of a unix socket has 107 bytes
        environment = {**os.environ, "PYTHONPATH": str(ROOT), ROBOT: robot, TEAM: str(team), DIRECTORY: meeting}
        inside = ["nsenter", "--net", f"--target={stage.machine(robot).process.pid}"]
        with output.open("wb") as written:
            process = subprocess.Popen([*inside, sys.executable, "-c", script], env=environment, stdout=written)
        try:
            yield output
            assert process.poll() is None, output.read_text()
        finally:
            process.kill()
            process.wait()


def lines(output: Path) -> int:
    return len(output.read_text().splitlines())


def goes_on(caller: Path, what: str) -> None:
    before = lines(caller)
    robots.until(lambda: lines(caller) > before + MORE, what, FOUND_S)


def test_both_run_on_with_other_keys_and_a_copy_of_the_old_ones_is_refused(tmp_path: Path) -> None:
    with machines(tmp_path, 2, own_network=True) as stage:
        stage.create("robot1")
        stage.brought("robot1", "robot2")
        together(stage, "robot1", "robot2")
        copied = shutil.copytree(stage.place("robot2"), tmp_path / "copied")
        with running(stage, "robot1", DRIVER, stage.place("robot1"), tmp_path / "driver") as driver:
            robots.until(lambda: lines(driver), "the driver to begin")
            with (
                running(stage, "robot2", CALLER, stage.place("robot2"), tmp_path / "caller") as caller,
                running(stage, "robot2", CALLER, copied, tmp_path / "thief") as thief,
            ):
                robots.until(lambda: min(lines(caller), lines(thief)) > MORE, "both to be answered", FOUND_S)
                for robot in ("robot2", "robot1"):  # first the one whose keys were copied: the driver proves what the thief knows
                    ran = stage.typed(robot, "rotate")
                    assert ran.returncode == 0, ran.stderr
                    goes_on(caller, f"the caller to be answered after {robot} has other keys")
                    stolen = lines(thief)
                    goes_on(caller, "the caller to go on")
                    assert lines(thief) == stolen, f"after {robot} has other keys"
                counted = [int(line) for line in caller.read_text().splitlines()]
                assert counted == sorted(set(counted)), "none was carried out twice"
