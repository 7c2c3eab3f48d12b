"""The main loop of a team with a board: its processor time, and how soon an urgent put of one robot is seen at another.

Real agents on this machine's loopback: each has its main loop and its worker. Nothing is protected; all that the main loops do is
to exchange heartbeats and items.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from benchmarks.figures import Figure, Findings
from benchmarks.running import PATIENCE_S, POLL_S, BenchmarkError
from failover.boards.board import board as open_board
from failover.boards.directory import agents_place
from failover.cli import key_pairs
from failover.cli.demo.robots import Means, Pace, RobotMachine, Stage, free_ports
from failover.config import team
from failover.config.team import Robot, Team
from failover.errors import LostAgentError, NoAgentError

TEAM: Final = f"benchmark-{os.getpid()}"
ROBOTS: Final = 8
ITEMS: Final = 20
BEAT_MS: Final = 50
LEASE_MS: Final = 400
PUT_S: Final = 0.05
"""Between two puts of all items of a robot: each frame has new values."""

SPAN_S: Final = 30.0
QUICK_SPAN_S: Final = 10.0
PARTS: Final = 5
"""Into which the span is cut: one value of each main loop in each."""

START_PATIENCE_S: Final = 300.0
"""Until all agents hear each other: eight interpreters and their workers start on a machine that may be busy."""

URGENT_PUTS: Final = 600
QUICK_URGENT_PUTS: Final = 150
URGENT_GAP_S: Final = (0.11, 0.17)
"""Between two urgent puts: an item may have ten frames a second, and no put meets the rounds always in the same place."""

PRIORITY: Final = 40
"""SCHED_FIFO of those who put and see, below the main loop's: what else runs on the machine is not to be measured."""

UDP: Final = "bare UDP"
ITEM: Final = '[board.items.item{}]\ntype = {{ x = "f8", y = "f8" }}\n'
URGENT: Final = '[board.items.alarm]\ntype = "u8"\nperiod = 60000\nurgent = true\n'

WATCHER: Final = """
import os, sys, time, contextlib
from failover.boards.board import board
with contextlib.suppress(OSError):
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({priority}))
with board(sys.argv[1]) as here:
    item, last = here.item("alarm"), 0
    print("ready", flush=True)
    while True:
        try:
            reading = item.wait("robot1", after=last, timeout=60)
        except Exception:
            continue
        now_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        last = reading.number
        print(reading.value, now_ns - reading.value, flush=True)
"""

RECEIVER: Final = """
import os, socket, sys, time, contextlib
with contextlib.suppress(OSError):
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({priority}))
link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
link.bind(("127.0.0.1", int(sys.argv[1])))
print("ready", flush=True)
while True:
    sent_ns = int.from_bytes(link.recv(64), "little")
    print(sent_ns, time.clock_gettime_ns(time.CLOCK_BOOTTIME) - sent_ns, flush=True)
"""


class TeamStage(Stage):
    """Robots of a team with a board, on the loopback."""

    def __init__(self, directory: Path, count: int, items: str) -> None:
        super().__init__(directory, Means(own_pids=False, own_network=False), pace=Pace(BEAT_MS, LEASE_MS))
        self.names = tuple(f"robot{number}" for number in range(1, count + 1))
        self._items = items

    def start(self) -> None:
        """Start all agents; wait until each hears all."""
        self._write_team()
        for name in self.names:
            self.robots.append(self.start_robot(name))
        for robot in self.robots:
            robot.switch_on()
        for robot in self.robots:
            _until(lambda robot=robot: _hears_all(robot), f"{robot.name} to hear its team", START_PATIENCE_S)

    def __exit__(self, *raised: object) -> None:
        super().__exit__(*raised)
        for name in self.names:
            shutil.rmtree(agents_place(TEAM, name), ignore_errors=True)

    def _write_team(self) -> None:
        ports = free_ports(2 * len(self.names))
        members = Team(TEAM)
        for index, name in enumerate(self.names):
            public, secret = key_pairs.new_pair()
            directory = self.directory / name / "team"
            directory.mkdir(parents=True)
            team.write_secret_key(directory, name, secret)
            beats, bulk = (f"127.0.0.1:{port}" for port in ports[2 * index : 2 * index + 2])
            members = team.enrol(members, name, Robot((beats,), bulk, "robot", public))
        for name in self.names:
            team.write(self.directory / name / "team", members)
            with (self.directory / name / "team" / team.TEAM_FILE).open("a") as file:
                file.write(self._items)


def main_loop(quick: bool, directory: Path) -> Findings:
    """Processor time in a team of eight, then urgent puts in a team of two."""
    shares = _shares(QUICK_SPAN_S if quick else SPAN_S, directory / "eight")
    urgent = _urgent(QUICK_URGENT_PUTS if quick else URGENT_PUTS, directory / "two")
    return Findings(
        "The main loop of a team with a board",
        f"{ROBOTS} agents on this machine, {ITEMS} items of 16 bytes each, new values in each round of {BEAT_MS} ms: processor "
        "time of one main loop, by the kernel's account (schedstat). Then two agents: from an urgent put at robot1 until a "
        "program that waits at robot2 has it; beside it a datagram from program to program. Those who put and wait have "
        f"real-time priority {PRIORITY}, the main loops theirs, where this user may.",
        (*shares, *urgent),
    )


def _shares(span_s: float, directory: Path) -> list[Figure]:
    values: list[float] = []
    with TeamStage(directory, ROBOTS, "".join(ITEM.format(number) for number in range(ITEMS))) as stage:
        directory.mkdir()
        stage.start()
        pids = [int(robot.status()["pid"]) for robot in stage.robots]
        boards = [open_board(agents_place(TEAM, robot.name)) for robot in stage.robots]
        handles = [[board.item(f"item{number}") for number in range(ITEMS)] for board in boards]
        try:
            _put_for(handles, 1.0)
            for _ in range(PARTS):
                before, began = [_processor_ns(pid) for pid in pids], time.monotonic()
                _put_for(handles, span_s / PARTS)
                took_ns = (time.monotonic() - began) * 1e9
                used = [_processor_ns(pid) - ns for pid, ns in zip(pids, before, strict=True)]
                values += [ns / took_ns * 100 for ns in used]
        finally:
            for board in boards:
                board.close()
    case = f"{ROBOTS} robots, {ITEMS} items each, {BEAT_MS} ms"
    return [Figure("processor time of a main loop", case, "% of a core", tuple(values))]


def _put_for(handles: list[list[Any]], span_s: float) -> None:
    end = time.monotonic() + span_s
    while time.monotonic() < end:
        value = {"x": time.monotonic(), "y": 0.0}
        for robot in handles:
            for item in robot:
                item.put(value)
        time.sleep(PUT_S)


def _processor_ns(pid: int) -> int:
    """Of all threads of a process. Source: Documentation/scheduler/sched-stats.rst."""
    found = 0
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError):
            found += int(path.read_text().split()[0])
    return found


def _urgent(count: int, directory: Path) -> list[Figure]:
    port = free_ports(1)[0]
    with TeamStage(directory, 2, URGENT) as stage:
        directory.mkdir()
        stage.start()
        there = [str(agents_place(TEAM, "robot2"))]
        with (
            open_board(agents_place(TEAM, "robot1")) as board,
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link,
            _listening(WATCHER, there, directory / "seen") as seen,
            _listening(RECEIVER, [str(port)], directory / "received") as received,
            _real_time(),
        ):
            item = board.item("alarm")
            for _ in range(count):
                time.sleep(random.uniform(*URGENT_GAP_S) / 2)
                item.put(time.clock_gettime_ns(time.CLOCK_BOOTTIME))
                time.sleep(random.uniform(*URGENT_GAP_S) / 2)
                link.sendto(time.clock_gettime_ns(time.CLOCK_BOOTTIME).to_bytes(8, "little"), ("127.0.0.1", port))
            _until(lambda: len(_rows(received)) >= count, "the last datagram")
            _until(lambda: len(_rows(seen)) >= 0.9 * count, "the last urgent put")
            case = "from robot1 to robot2"
            return [
                Figure("urgent put until seen", case, "µs", tuple(row[1] / 1000 for row in _rows(seen))),
                Figure("urgent put until seen", case, "µs", tuple(row[1] / 1000 for row in _rows(received)), UDP),
            ]


@contextmanager
def _real_time() -> Iterator[None]:
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)


@contextmanager
def _listening(program: str, arguments: list[str], output: Path) -> Iterator[Path]:
    with output.open("wb") as file:
        command = [sys.executable, "-c", program.format(priority=PRIORITY), *arguments]
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, start_new_session=True)
    try:
        _until(lambda: output.stat().st_size > 0 or process.poll() is not None, "a program that watches")
        yield output
    finally:
        process.kill()
        process.wait()


def _rows(output: Path) -> list[tuple[int, int]]:
    whole, _, _ = output.read_text().rpartition("\n")
    return [(int(first), int(second)) for first, second in (line.split() for line in whole.splitlines()[1:])]


def _hears_all(robot: RobotMachine) -> bool:
    try:
        peers = robot.status()["peers"]
    except (NoAgentError, LostAgentError):
        return False
    return all(peer["state"] == "live" and peer["hears_us"] for peer in peers)


def _until(holds: Any, what: str, patience_s: float = PATIENCE_S) -> None:
    deadline = time.monotonic() + patience_s
    while not holds():
        if time.monotonic() > deadline:
            raise BenchmarkError(f"waited {patience_s:.0f} s for {what}")
        time.sleep(POLL_S * 10)
