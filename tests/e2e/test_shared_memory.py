"""A component that shares memory with a stranger: unprotected and told so, or detached by rule; its connections are reset."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

STRANGER = """
import mmap, os, signal, socket, sys
file = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT, 0o666)
os.ftruncate(file, 8192)
kept = mmap.mmap(file, 8192)
kept[4096:4106] = b"from there"
listener = socket.create_server(("127.0.0.1", 7171))
open(sys.argv[2], "w").close()
accepted = listener.accept()
while True:
    signal.pause()
"""
SHARES = """
import mmap, os, socket, sys, time
file = os.open(sys.argv[1], os.O_RDWR)
kept, count = mmap.mmap(file, 8192), 0
connection = socket.create_connection(("127.0.0.1", 7171))
while True:
    assert kept[4096:4106] == b"from there"
    kept[0:8] = count.to_bytes(8, "little")
    print(count, flush=True)
    count += 1
    time.sleep(0.01)
"""

pytestmark = pytest.mark.timeout(300)

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def memory() -> Iterator[Path]:
    path = Path("/dev/shm") / f"{secrets.randbelow(10**9)}.zenoh"
    yield path
    path.unlink(missing_ok=True)


@pytest.fixture
def pair(tmp_path: Path, memory: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        there = tmp_path / "there"
        robots.start_inside(both[0], "/usr/bin/python3", "-S", "-c", STRANGER, str(memory), str(there))
        robots.until(there.exists, "the stranger")
        yield both


def begin(robot: RobotMachine, memory: Path, *rule: str) -> None:
    command = ["/usr/bin/python3", "-S", "-c", SHARES, str(memory)]
    started = robots.failover(robot, "run", "--detach", "--name", "shares", *rule, "--", *command)
    assert started.returncode == 0, started


def count_in(memory: Path) -> int:
    return int.from_bytes(memory.read_bytes()[:8], "little")


def test_without_the_rule_the_status_names_the_switch(pair: Pair, memory: Path) -> None:
    begin(pair[0], memory)
    shown = robots.until_status(pair[0], 1, str(memory), "zenoh made it", "--shared-memory detach")
    assert "transport/shared_memory/enabled" in shown


def test_by_the_rule_it_is_taken_over_with_a_copy_of_its_own(pair: Pair, memory: Path) -> None:
    first, second = pair
    begin(first, memory, "--shared-memory", "detach")
    robots.until_protected(first, "shares")
    robots.until_status(first, 0, "resumes with a copy of its own")
    robots.until(lambda: count_in(memory) > 20, "it to write to what it shares")
    first.cut_power()
    robots.until_taken_over(second, "shares")
    written = count_in(memory)
    before = len(robots.numbers(second, "shares"))
    robots.until(lambda: len(robots.numbers(second, "shares")) > before + 20, "it to go on")
    assert count_in(memory) == written, "it still writes to what others have"
    counted = robots.numbers(second, "shares")
    assert counted == list(range(len(counted)))
    said = "\n".join(robots.component(second, "shares")["notes"])
    assert f"its shared memory {memory} is a copy of its own" in said
    assert "its connections were reset: 1 TCP connection with 127.0.0.1 port 7171" in said
