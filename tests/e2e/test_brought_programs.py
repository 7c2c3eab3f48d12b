"""Two robots with different files: a program that only one of them has goes on at the other."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

pytestmark = [pytest.mark.root, pytest.mark.compiler]

COUNT = r"""
#include <stdio.h>
#include <time.h>
int main(void) {
    for (int i = 0; i < 1000000; i++) {
        printf("%d\n", i);
        fflush(stdout);
        nanosleep(&(struct timespec){0, 10000000}, NULL);
    }
    return 0;
}
"""

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A directory with a program and a C library of its own."""
    place = tmp_path / "home" / "app"
    place.mkdir(parents=True)
    (tmp_path / "count.c").write_text(COUNT)
    subprocess.run(["cc", "-O1", "-o", str(place / "count"), str(tmp_path / "count.c")], check=True)
    listed = subprocess.run(["ldd", str(place / "count")], check=True, capture_output=True, text=True).stdout
    shutil.copy(next(line.split()[2] for line in listed.splitlines() if "libc.so.6" in line), place / "libc.so.6")
    return place


@pytest.fixture
def pair(tmp_path: Path, place: Path) -> Iterator[Pair]:
    """robot2 has nothing where the program is."""
    with robots.two_robots(tmp_path) as both:
        hide(both[1], place.parent)
        yield both


def hide(robot: RobotMachine, place: Path) -> None:
    """From now on this robot has an empty directory there."""
    pid = robot.processes()[-1]
    if os.readlink(f"/proc/{pid}/ns/mnt") == os.readlink("/proc/self/ns/mnt"):
        pytest.skip("needs robots with mounts of their own")
    subprocess.run(["nsenter", "--mount", f"--target={pid}", "mount", "-t", "tmpfs", "tmpfs", str(place)], check=True)


def seen_by(robot: RobotMachine, path: Path) -> Path:
    """A path as that robot has it."""
    return Path(f"/proc/{robot.processes()[-1]}/root{path}")


def start(robot: RobotMachine, place: Path, name: str = "count") -> None:
    robots.run(robot, name, str(place / "count"), env={"LD_LIBRARY_PATH": str(place)}, cwd=str(place))


def goes_on(robot: RobotMachine, act: Callable[[], object], name: str = "count") -> None:
    """The count has no gap after what is done to its robot."""
    before = len(robots.numbers(robot, name))
    act()
    robots.until(lambda: robots.component(robot, name).get("role") == "primary", f"{robot.name} to take over")
    robots.until(lambda: len(robots.numbers(robot, name)) > before + 20, "the count to go on")
    counted = robots.numbers(robot, name)
    assert counted == list(range(len(counted)))


def contents_of(robot: RobotMachine) -> set[str]:
    """What was brought to it, by content."""
    folder = robot.directory / "state" / "store" / "contents"
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


def test_a_program_that_only_its_robot_has_goes_on_at_the_other(pair: Pair, place: Path) -> None:
    first, second = pair
    start(first, place)
    robots.until_protected(first)
    goes_on(second, first.cut_power)
    assert not list(seen_by(second, place.parent).rglob("count")), "no file was put in place"
    assert len(contents_of(second)) == 2, "the program and its library; all else is the same here"
