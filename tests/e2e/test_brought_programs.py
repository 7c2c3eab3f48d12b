"""Two robots with different files: a program that only one of them has resumes at the other."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

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


def start(robot: RobotMachine, place: Path, name: str = "count") -> None:
    robots.run(robot, name, str(place / "count"), env={"LD_LIBRARY_PATH": str(place)}, cwd=str(place))


def goes_on(robot: RobotMachine, act: Callable[[], object], name: str = "count") -> None:
    """The count has no gap after what is done to its robot."""
    before = len(robots.numbers(robot, name))
    act()
    robots.until_taken_over(robot, name)
    robots.until(lambda: len(robots.numbers(robot, name)) > before + 20, "the count to go on")
    counted = robots.numbers(robot, name)
    assert counted == list(range(len(counted)))


def contents_of(robot: RobotMachine) -> set[str]:
    """What was brought to it, by content."""
    folder = robot.directory / "state" / "store" / "contents"
    return {path.name for path in folder.iterdir()} if folder.is_dir() else set()


def process_of(robot: RobotMachine) -> int:
    """The program's process; it runs a moment before the status knows its PID."""
    robots.until(lambda: robots.component(robot, "count")["pid"], f"{robot.name} to tell the PID")
    return robots.host_pid(robot, robots.component(robot, "count")["pid"])


def test_a_program_that_only_its_robot_has_goes_on_at_the_other(pair: Pair, place: Path) -> None:
    first, second = pair
    start(first, place)
    robots.until_protected(first)
    goes_on(second, first.cut_power)
    running = process_of(second)
    assert not list(Path(f"/proc/{running}/root{place.parent}").rglob("count")), "no file was put in place"
    assert len(contents_of(second)) == 2, "the program and its library; all else is the same here"


def test_a_second_program_with_the_same_files_sends_nothing(pair: Pair, place: Path) -> None:
    first, second = pair
    start(first, place)
    robots.until_protected(first)
    before = contents_of(second)
    start(first, place, "again")
    robots.until_protected(first, "again")
    assert contents_of(second) == before
    assert first.log.read_text().count("lacks") == 1, "the second was asked about, and lacked nothing"


def test_a_program_returns_to_its_own_files(pair: Pair, place: Path) -> None:
    first, second = pair
    start(first, place)
    robots.until_protected(first)
    goes_on(second, lambda: robots.failover(first, "handover", "count", "--to", second.name))
    robots.until_protected(second)
    goes_on(first, lambda: robots.failover(second, "failback", "count"))
    running = process_of(first)
    assert os.readlink(f"/proc/{running}/exe") == str(place / "count")
    assert not contents_of(first)


def test_a_program_that_is_upgraded_while_it_runs_goes_on_as_it_was(pair: Pair, place: Path) -> None:
    """Here, after a crash, and there."""
    first, second = pair
    start(first, place)
    robots.until_protected(first)
    program = place / "count"  # robot1 sees our files
    other = program.read_bytes() + b"a later release"
    program.unlink()
    program.write_bytes(other)
    robots.until(lambda: contents_of(first), "robot1 to keep what runs there")
    goes_on(first, lambda: os.kill(process_of(first), signal.SIGSEGV))
    robots.until_protected(first)
    assert program.read_bytes() == other
    goes_on(second, first.cut_power)


CPYTHON = "import time\nfor i in range(1_000_000):\n    print(i, flush=True)\n    time.sleep(0.01)\n"


def test_cpython_goes_on_where_the_interpreter_and_the_c_library_are_other_versions(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path) as (first, second):
        libraries = {str(Path(path).resolve()) for path in mapped_by("/usr/bin/python3", "-S", "-c", "")}
        for path in sorted(libraries):
            other = tmp_path / ("other-" + Path(path).name)
            shutil.copy(path, other)
            with other.open("ab") as file:
                file.write(b"another release")
            over(second, other, Path(path))
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", CPYTHON)
        robots.until_protected(first)
        assert len(contents_of(second)) >= len(libraries)
        goes_on(second, first.cut_power)


def mapped_by(*argv: str) -> set[str]:
    """The executable and libraries that a program maps."""
    script = "import os,sys; print(open('/proc/self/maps').read())"
    shown = subprocess.run([*argv[:-1], script], check=True, capture_output=True, text=True).stdout
    names = (line.split()[5] for line in shown.splitlines() if len(line.split()) > 5)
    return {name for name in names if (name.startswith("/") and ".so" in name) or "python" in name}


def over(robot: RobotMachine, other: Path, place: Path) -> None:
    """From now on this robot has another file at a path."""
    pid = robot.processes()[-1]
    subprocess.run(["nsenter", "--mount", f"--target={pid}", "mount", "--bind", str(other), str(place)], check=True)


COUNTER = """
import time
from counting import steps
import failover

state = failover.resume("count", default={"value": 0})
while True:
    print(state["value"], flush=True)
    state["value"] += steps.ONE
    failover.commit()
    time.sleep(0.01)
"""


def test_a_program_that_keeps_its_state_is_started_from_what_was_brought_of_it(pair: Pair, place: Path) -> None:
    """With the package beside it; and it waits there, started already."""
    first, second = pair
    (place / "counter.py").write_text(COUNTER)
    (place / "secret.txt").write_text("stays at home")
    (place / "counting").mkdir()
    (place / "counting" / "__init__.py").touch()
    (place / "counting" / "steps.py").write_text("ONE = 1\n")
    robots.run(first, "count", sys.executable, str(place / "counter.py"), cwd=str(place), engine="cooperative")
    robots.until_protected(first)
    assert len(contents_of(second)) == 3
    robots.until(lambda: robots.component(second, "count").get("warm"), "the program to wait at robot2")
    goes_on(second, first.cut_power)
    running = process_of(second)
    shown = Path(f"/proc/{running}/root{place}")
    assert sorted(path.name for path in shown.rglob("*.py")) == ["__init__.py", "counter.py", "steps.py"]
    assert not (shown / "secret.txt").exists()
    agent = robots.host_pid(second, second.status()["pid"])
    assert not list(Path(f"/proc/{agent}/root{place}").iterdir()), "nobody else sees them"


def test_status_tells_what_is_still_on_its_way(tmp_path: Path, place: Path) -> None:
    """Over a link of 8 Mbit/s two seconds pass until the C library is there."""
    with robots.two_robots(tmp_path, "link_mbit_s = 8\n") as (first, second):
        hide(second, place.parent)
        start(first, place)
        shown = robots.until(lambda: on_its_way(first), "the status to tell")
        assert "protected from robot2 after" in next(note for note in shown["notes"] if ARRIVING in note)
        assert shown["protection"] == "none"
        robots.until_protected(first)
        assert not on_its_way(first)


def test_a_standby_that_would_have_to_take_too_much_is_none_and_says_which_files(tmp_path: Path, place: Path) -> None:
    with robots.two_robots(tmp_path, 'bring_size = "1MB"\n') as (first, second):
        hide(second, place.parent)
        start(first, place)
        words = "over bring_size = 1.0 MB there", str(place / "libc.so.6")
        robots.until_status(first, 1, *words)
        assert robots.component(first, "count")["protection"] != "protected"
        assert not contents_of(second)


ARRIVING = "have arrived"


def on_its_way(robot: RobotMachine) -> dict[str, Any]:
    """What its status shows of the component while it tells of files that travel; empty otherwise."""
    shown = robots.component(robot, "count")
    return shown if any(ARRIVING in note for note in shown.get("notes", ())) else {}


READER = """
import time
data = open("{path}")
for line in data:
    print(int(line), flush=True)
    time.sleep(0.01)
"""


def test_data_that_is_only_read_is_brought_by_choice(tmp_path: Path, place: Path) -> None:
    table = '[components."/demo/robot1/count"]\nbring_data = true\n'
    with robots.two_robots(tmp_path, table) as (first, second):
        hide(second, place.parent)
        data = place / "data"
        data.write_text("".join(f"{number}\n" for number in range(100_000)))
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", READER.format(path=data))
        robots.until_protected(first)
        assert len(contents_of(second)) == 1
        goes_on(second, lambda: robots.failover(first, "handover", "count", "--to", second.name))
        robots.until_protected(second)
        goes_on(first, lambda: robots.failover(second, "failback", "count"))
        pid = process_of(first)
        assert str(data) in {os.readlink(one) for one in Path(f"/proc/{pid}/fd").iterdir()}, "its own file again"
