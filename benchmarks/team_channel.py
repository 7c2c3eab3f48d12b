"""The team's frames among real agents on one switch: how evenly they follow each other, and what main loops cost.

Run as root: python -m benchmarks.team_channel [--robots 4] [--items 20] [--for 60s] [WAY …]
or: python -m benchmarks.team_channel --urgent 600

Ways: unicast, multicast (each 20 ms), timers (multicast each 50 ms, without slots), slots (50 ms). Each robot's items are put at
20 Hz. All ways in one run, one after the other: only rows of one run can be compared. With --urgent: how soon an urgent item of
379 bytes is seen at another robot, beside other ways between the same network namespaces.
"""

from __future__ import annotations

import argparse
import itertools
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from msgspec import Struct

import failover
from agent.main_loop import starvation
from benchmarks import urgent
from failover.cli.demo.robots import Pace
from failover.client.control import SOCKET_VARIABLE
from failover.config.quantities import span_ms
from tests.e2e import bridged, robots
from tests.e2e.bridged import SwitchStage
from tests.e2e.frames_seen import Seen

PUT_S: Final = 0.05
SETTLE_S: Final = 2.0
SHORT_MS: Final = 4.7
"""A gap in which a frame of 379 bytes does not fit between two others, on a radio's lowest rate."""

GROUP: Final = "239.77.255.1"
PORTS: Final = range(7495, 7500)
"""Of what is measured beside the team's frames, and not the team's."""

ITEM: Final = '[board.items.item{}]\ntype = {{ x = "f8", y = "f8", angle = "f8", at = "u8" }}\n'


class Way(Struct, frozen=True):
    """How frames leave: lines of agent.toml, and the period."""

    settings: str
    pace: Pace


def _medium(line: str) -> str:
    return f"\n[media.{bridged.CABLE}]\n{line}\n"


WAYS: Final = {
    "unicast": Way(_medium('cast = "unicast"'), Pace(20, 400)),
    "multicast": Way(_medium('cast = "auto"'), Pace(20, 400)),
    "timers": Way(_medium('cast = "auto"'), Pace(50, 400)),
    "slots": Way(_medium("slots = true"), Pace(50, 400)),
}


@contextmanager
def _putting(stage: SwitchStage, items: int) -> Iterator[None]:
    """Put every item of every robot at 20 Hz meanwhile, in a thread of this process."""
    boards = []
    for robot in stage.robots:
        os.environ[SOCKET_VARIABLE] = str(robot.socket)
        boards.append(failover.board())
    handles = [board.item(f"item{number}") for board in boards for number in range(items)]
    ends = threading.Event()

    def put() -> None:
        at = 0
        while not ends.wait(PUT_S):
            at += 1
            for handle in handles:
                handle.put({"x": 1.0, "y": 2.0, "angle": 0.5, "at": at})

    thread = threading.Thread(target=put)
    thread.start()
    try:
        yield
    finally:
        ends.set()
        thread.join()
        for board in boards:
            board.close()


def _used_ns(pids: list[int]) -> list[int]:
    turns = [starvation.look(pid) for pid in pids]
    return [one.ran_ns if one is not None else 0 for one in turns]


def _gaps_ms(stage: SwitchStage, span_s: float) -> tuple[list[float], list[float]]:
    """(gaps between two frames of any robots, rounds of each robot), as the first robot's interface has them."""
    inside = ["nsenter", "--net", f"--target={stage.robots[0].process.pid}"]
    program = [sys.executable, "-m", "tests.e2e.frames_seen", bridged.CABLE, str(span_s), "both"]
    told = subprocess.run([*inside, *program], capture_output=True, text=True, check=True).stdout
    seen = sorted((Seen.read(line) for line in told.splitlines()), key=lambda one: one.at_ns)
    cast = [one for one in seen if one.to.startswith("239.77.")]
    gaps = [(after.at_ns - before.at_ns) / 1e6 for before, after in itertools.pairwise(cast)]
    rounds = []
    for rank in range(len(stage.robots)):
        own = [one.at_ns for one in cast if one.rank == rank]
        rounds += [(after - before) / 1e6 for before, after in itertools.pairwise(own)]
    return gaps, rounds


def _measure(name: str, robot_count: int, items: int, span_s: float) -> None:
    way = WAYS[name]
    board = "".join(ITEM.format(number) for number in range(items))
    with (
        tempfile.TemporaryDirectory(prefix="failover-team-") as directory,
        bridged.on_one_switch(Path(directory), robot_count, way.settings, board, way.pace) as stage,
        _putting(stage, items),
    ):
        pids = [robots.host_pid(robot, int(robot.status()["pid"])) for robot in stage.robots]
        time.sleep(SETTLE_S)
        before, packets, began = _used_ns(pids), bridged.sent(stage.robots[0]), time.monotonic()
        gaps, rounds = _gaps_ms(stage, span_s)
        passed_s = time.monotonic() - began
        shares = [(after - first) / 1e7 / passed_s for first, after in zip(before, _used_ns(pids), strict=True)]
        sent = (bridged.sent(stage.robots[0]) - packets) / passed_s
        sentence = (
            f"{name:10} main loop {statistics.mean(shares):5.2f} % of a core (most {max(shares):.2f}), {sent:4.0f} packets/s sent"
        )
        if len(gaps) > 100:
            cuts = statistics.quantiles(gaps, n=100)
            short = sum(gap < SHORT_MS for gap in gaps) / len(gaps)
            sentence += f"; gaps p1/p50/p99 {cuts[0]:.2f}/{cuts[49]:.2f}/{cuts[98]:.2f} ms, least {min(gaps):.2f}, "
            sentence += f"under {SHORT_MS} ms {short:.2%} of {len(gaps)}; rounds {statistics.mean(rounds):.2f} ms"
        print(sentence, flush=True)
        for one in stage.robots if name == "slots" else []:
            slots = bridged.medium(one)["slots"]
            assert isinstance(slots, dict)
            print(f"    {one.name}: K {slots['count']}, place {slots['place']}, late at most {slots['late_us_max'] / 1e3:.1f} ms")


def _measure_urgent(count: int) -> None:
    with (
        tempfile.TemporaryDirectory(prefix="failover-team-") as directory,
        bridged.on_one_switch(Path(directory), 2, "", urgent.ITEM, Pace(50, 400)) as stage,
    ):
        ends = [
            urgent.End(
                (robot.socket.parent / "board").resolve(),
                bridged.ADDRESS.format(number),
                ("nsenter", "--net", f"--target={robot.process.pid}"),
            )
            for number, robot in enumerate(stage.robots, 1)
        ]
        time.sleep(SETTLE_S)
        seen = urgent.measured(ends[0], ends[1], GROUP, PORTS, count, Path(directory))
    ways = {
        "an urgent put until it is seen": seen.put,
        "a bare multicast until it is received": seen.datagram,
        "a bare datagram passed on by two processes": seen.relayed,
        "zenoh by its router": seen.zenoh,
    }
    for name, found in ways.items():
        if not found:
            continue
        cuts = statistics.quantiles(found, n=100)
        print(f"{name}: p50 {cuts[49]:.0f} µs, p90 {cuts[89]:.0f}, p99 {cuts[98]:.0f}, least {min(found):.0f}, of {len(found)}")


def main() -> None:
    """Measure the ways that are named, or all."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.team_channel", description=__doc__)
    parser.add_argument("ways", nargs="*", choices=[*WAYS, []], metavar="WAY")
    parser.add_argument("--robots", type=int, default=4)
    parser.add_argument("--items", type=int, default=20)
    parser.add_argument("--for", dest="span_ms", type=span_ms, default=60_000, metavar="SPAN")
    parser.add_argument("--urgent", type=int, metavar="PUTS")
    arguments = parser.parse_args()
    if arguments.urgent:
        _measure_urgent(arguments.urgent)
        return
    load = os.getloadavg()[0]
    print(f"{arguments.robots} robots, {arguments.items} items each, {os.cpu_count()} cores, load before {load:.1f}")
    for name in arguments.ways or WAYS:
        _measure(name, arguments.robots, arguments.items, arguments.span_ms / 1e3)


if __name__ == "__main__":
    main()
