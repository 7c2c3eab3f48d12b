"""The main loop of a team with a board: its processor time, and how soon an urgent put of one robot is seen at another.

Real agents on this machine's loopback: each has its main loop and its worker. Nothing is protected; all that the main loops do is
to exchange heartbeats and items.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import time
from pathlib import Path
from typing import Any, Final

from benchmarks import urgent
from benchmarks.figures import OURS, Figure, Findings
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
PACE: Final = Pace(beat_ms=50, lease_ms=400)
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

UDP: Final = "bare UDP"
RELAYED: Final = "bare UDP, passed on by two processes"
ZENOH: Final = "zenoh, by its router"
ITEM: Final = '[board.items.item{}]\ntype = {{ x = "f8", y = "f8" }}\n'


class TeamStage(Stage):
    """Robots of a team with a board, on the loopback."""

    def __init__(self, directory: Path, count: int, items: str, settings: str = "", pace: Pace = PACE) -> None:
        super().__init__(directory, Means(own_pids=False, own_network=False), settings, pace=pace)
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
            until(lambda robot=robot: _hears_all(robot), f"{robot.name} to hear its team", START_PATIENCE_S)

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
    puts = _urgent(QUICK_URGENT_PUTS if quick else URGENT_PUTS, directory / "two")
    return Findings(
        "The main loop of a team with a board",
        f"{ROBOTS} agents on this machine, {ITEMS} items of 16 bytes each, new values in each round of {PACE.beat_ms} ms: "
        "processor time of one main loop, by the kernel's account (schedstat). Then two agents: from an urgent put at robot1 "
        "until a program that waits at robot2 has it; beside it a datagram from program to program, a datagram by way of two "
        "processes that only pass it on, as a put goes by way of two main loops, and zenoh by way of its router. Those who put "
        f"and wait have real-time priority {urgent.PRIORITY}, the main loops theirs, where this user may.",
        (*shares, *puts),
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
    case = f"{ROBOTS} robots, {ITEMS} items each, {PACE.beat_ms} ms"
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
    with TeamStage(directory, 2, urgent.ITEM) as stage:
        directory.mkdir()
        stage.start()
        ends = [urgent.End(agents_place(TEAM, name), "127.0.0.1") for name in stage.names]
        seen = urgent.measured(ends[0], ends[1], "127.0.0.1", free_ports(5), count, directory)
        case = f"from robot1 to robot2, {urgent.SIZE} bytes"
        ways = {OURS: seen.put, UDP: seen.datagram, RELAYED: seen.relayed, ZENOH: seen.zenoh}
        return [Figure("urgent put until seen", case, "µs", tuple(found), way) for way, found in ways.items() if found]


def _hears_all(robot: RobotMachine) -> bool:
    try:
        peers = robot.status()["peers"]
    except (NoAgentError, LostAgentError):
        return False
    return all(peer["state"] == "live" and peer["hears_us"] for peer in peers)


def until(holds: Any, what: str, patience_s: float = PATIENCE_S) -> None:
    """Wait for a condition.

    Raises:
        BenchmarkError: it did not come to hold.
    """
    deadline = time.monotonic() + patience_s
    while not holds():
        if time.monotonic() > deadline:
            raise BenchmarkError(f"waited {patience_s:.0f} s for {what}")
        time.sleep(POLL_S * 10)
