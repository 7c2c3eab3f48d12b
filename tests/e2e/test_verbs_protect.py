"""protect and release: a program started by another process is taken in, can be moved, and is let go unharmed."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.robot_processes import parts

COUNT = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.01)\n"
HOLDING_ANOTHER = "import os\nkept = os.pidfd_open(1)\n" + COUNT

Pair = tuple[RobotMachine, RobotMachine]

pytestmark = pytest.mark.root
"""A process is put into a robot's namespaces from outside; a robot of an ordinary user has its own door, `failover run`."""


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        yield both


def stranger(robot: RobotMachine, script: str, written: Path) -> int:
    """Start a program of the robot that nobody protects; returns its PID there. It ends with the robot."""
    enter = ["nsenter", f"--target={robot.processes()[0]}", "--all", "setsid", "sh", "-c"]
    begin = f'exec "$@" </dev/null >{written} 2>&1 & echo $!'
    command = [*enter, begin, "sh", "/usr/bin/python3", "-S", "-c", script]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    robots.until(lambda: written.stat().st_size > 0, "the stranger to count")
    return int(ran.stdout)


def counted(written: Path) -> list[int]:
    return [int(line) for line in written.read_bytes().rpartition(b"\n")[0].split()]


def expect_more(written: Path) -> None:
    """It counts on, and its file as a whole has no gap and no repetition."""
    before = len(counted(written))
    robots.until(lambda: len(counted(written)) > before + 20, "the count to go on in its file")
    numbers = counted(written)  # once: it counts on
    assert numbers == list(range(len(numbers)))


def test_a_stranger_is_protected_again_by_the_robot_that_took_it_over(pair: Pair, tmp_path: Path) -> None:
    first, second = pair
    written = tmp_path / "stranger.out"
    pid = stranger(first, COUNT, written)
    assert robots.failover(first, "protect", str(pid), "--name", "count").returncode == 0
    robots.until(lambda: robots.component(first, "count").get("protection") == "protected", "a checkpoint at robot2")
    assert robots.failover(second, "handover", "count").returncode == 0  # ordered at the robot that is to have it
    expect_more(written)
    robots.until(lambda: robots.component(second, "count").get("protection") == "protected", "a checkpoint at robot1")
    second.cut_power()
    robots.until(lambda: robots.component(first, "count").get("role") == "primary", "robot1 to take it back")
    expect_more(written)


def test_output_that_comes_twice_after_a_takeover_is_told_by_protect_and_by_the_status(pair: Pair, tmp_path: Path) -> None:
    """Another process reads its output, and it appends to a file that does not travel."""
    (tmp_path / "count").write_text(f"echo $$ >{tmp_path}/pid; exec /usr/bin/python3 -S -c '{COUNT}' 2>>{tmp_path}/errors")
    enter = ["nsenter", f"--target={pair[0].processes()[0]}", "--all", "setsid", "sh", "-c"]
    begin = f"sh {tmp_path}/count </dev/null 2>&1 | cat >{tmp_path}/read &"
    subprocess.run([*enter, begin], check=True)
    robots.until(lambda: (tmp_path / "read").exists() and counted(tmp_path / "read"), "the stranger to count")
    pid = (tmp_path / "pid").read_text().strip()
    ran = robots.failover(pair[0], "protect", pid, "--name", "count")
    for said in (f"appends to {tmp_path}/errors", "(cat), which does not move along"):
        assert ran.returncode == 0 and said in ran.stdout + ran.stderr, ran
        robots.until(lambda said=said: any(said in one for one in robots.component(pair[0], "count")["notes"]), said)  # type: ignore[misc]
    robots.until_protected(pair[0])
    shown = robots.component(pair[0], "count")["notes"]
    assert sum("come twice" in note for note in shown) == 2, shown
    assert robots.failover(pair[0], "status").returncode == 0, "that is no fault"


def test_a_stranger_that_cannot_be_kept_is_refused_by_name_and_not_touched(pair: Pair, tmp_path: Path) -> None:
    written = tmp_path / "stranger.out"
    pid = stranger(pair[0], HOLDING_ANOTHER, written)
    ran = robots.failover(pair[0], "protect", str(pid))
    assert ran.returncode == 1
    assert "fd 3 is a pidfd" in ran.stderr, ran.stderr
    assert "let the program close it" in ran.stderr
    expect_more(written)
    assert robots.failover(pair[0], "status").returncode == 0, "a refusal leaves nothing behind"


def test_a_stranger_that_is_released_runs_on_and_can_be_protected_again(pair: Pair, tmp_path: Path) -> None:
    first, second = pair
    written = tmp_path / "stranger.out"
    pid = stranger(first, COUNT, written)
    for giver in (first, second):
        assert robots.failover(first, "protect", str(pid), "--name", "count", "--wait").returncode == 0
        assert robots.component(first, "count")["protection"] == "protected", "it waits until robot2 has a checkpoint"
        released = robots.failover(giver, "release", "count")
        assert released.returncode == 0, released
        assert f"runs on as pid {pid}, unprotected" in released.stdout
        expect_more(written)
    os.kill(robots.host_pid(first, pid), signal.SIGKILL)


def test_a_stranger_that_loses_its_guard_does_not_run_twice(pair: Pair, tmp_path: Path) -> None:
    first, _ = pair
    written = tmp_path / "stranger.out"
    pid = stranger(first, COUNT, written)
    assert robots.failover(first, "protect", str(pid), "--name", "count").returncode == 0
    robots.until(lambda: robots.component(first, "count").get("protection") == "protected", "a checkpoint at robot2")
    program = robots.host_pid(first, pid)
    for guard in parts(first, "guard"):
        os.kill(guard, signal.SIGKILL)
    robots.until(lambda: not Path(f"/proc/{program}").exists(), "the stranger to be ended")
    robots.until(lambda: robots.component(first, "count").get("restores"), "it to be resumed")
    expect_more(written)
