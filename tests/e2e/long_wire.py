"""A long wire between two robots with networks of their own: each packet is late, some are lost, and it can be cut.

Each end is a TUN device in a robot's network namespace. A process of its own carries packets between the two:
``python -m tests.e2e.long_wire FIRST SECOND DELAY_MS LOSS SEED``, with the descriptors of both devices. It obeys the lines
``cut``, ``mend`` and ``count`` of its standard input. It answers each with how many packets it carried, lost at random, and
dropped in cuts.
"""

from __future__ import annotations

import collections
import contextlib
import fcntl
import json
import os
import random
import select
import struct
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any, Final

from failover.cli.demo.robots import RobotMachine, ip_command, ip_inside, run

DELAY_MS: Final = 100
"""One way: a round trip takes 200 ms."""

LOSS: Final = 0.02
ADDRESS: Final = "10.71.9.{}"
NAME: Final = "far"
PACKET_SIZE_MAX: Final = 1 << 16
QUEUED_MAX: Final = 10_000
"""Packets under way in one direction; more are dropped, as a router would."""

TUNSETIFF: Final = 0x400454CA
IFF_TUN: Final = 0x0001
IFF_NO_PI: Final = 0x1000
"""Source: linux/if_tun.h."""


class LongWire:
    """The wire, as a test holds it."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    def cut(self) -> dict[str, int]:
        """From now on nothing arrives, and what is under way is lost."""
        return self._told("cut")

    def mend(self) -> dict[str, int]:
        """Packets arrive again."""
        return self._told("mend")

    def counts(self) -> dict[str, int]:
        """How many packets were carried, lost, and dropped in cuts."""
        return self._told("count")

    def _told(self, order: str) -> dict[str, int]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(f"{order}\n".encode())
        self._process.stdin.flush()
        told: dict[str, int] = json.loads(self._process.stdout.readline())
        return told


@contextlib.contextmanager
def long_wire(
    robots: Sequence[RobotMachine], address: str = ADDRESS, delay_ms: int = DELAY_MS, loss: float = LOSS, seed: int = 0
) -> Iterator[LongWire]:
    """Lay a long wire between two robots; needs root.

    Args:
        address: of its ends, with the number of the robot left open.
    """
    ends = [_end(robot, address.format(index)) for index, robot in enumerate(robots, start=1)]
    command = [sys.executable, "-m", "tests.e2e.long_wire", *map(str, ends), str(delay_ms), str(loss), str(seed)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, pass_fds=ends)
    for end in ends:
        os.close(end)
    try:
        yield LongWire(process)
    finally:
        process.kill()
        process.wait()


def _end(robot: RobotMachine, address: str) -> int:
    """A TUN device in the robot's network namespace, with this address; its descriptor."""
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    made = fcntl.ioctl(
        descriptor, TUNSETIFF, struct.pack("16sH22x", f"{NAME}{os.getpid() % 10_000}%d".encode(), IFF_TUN | IFF_NO_PI)
    )
    name = made[:16].rstrip(b"\0").decode()
    run([ip_command() or "ip", "link", "set", name, "netns", str(robot.process.pid), "name", NAME])
    run(ip_inside(robot, "address", "add", f"{address}/24", "dev", NAME))
    run(ip_inside(robot, "link", "set", NAME, "up", "txqueuelen", "1000"))
    return descriptor


class _Way:
    """One direction."""

    def __init__(self, source: int, target: int) -> None:
        self.source, self.target = source, target
        self.under_way: collections.deque[tuple[float, bytes]] = collections.deque()


def relay(ends: tuple[int, int], delay_s: float, loss: float, seed: int) -> None:
    """Carry packets until the standard input ends."""
    dice = random.Random(seed)
    ways = [_Way(*ends), _Way(*reversed(ends))]
    counts: dict[str, int] = {"carried": 0, "lost": 0, "dropped": 0, "bytes": 0}
    is_cut = False
    poll = select.poll()
    for descriptor in (*ends, sys.stdin.fileno()):
        poll.register(descriptor, select.POLLIN)
    while True:
        firsts = [way.under_way[0][0] for way in ways if way.under_way]
        wait_ms = max(min(firsts) - time.monotonic(), 0) * 1_000 if firsts else None
        ready = {descriptor for descriptor, _ in poll.poll(wait_ms)}
        for way in ways:
            if way.source in ready:
                for packet in _packets(way.source):
                    if is_cut or len(way.under_way) >= QUEUED_MAX:
                        counts["dropped"] += 1
                    elif dice.random() < loss:
                        counts["lost"] += 1
                    else:
                        way.under_way.append((time.monotonic() + delay_s, packet))
            _deliver(way, counts)
        if sys.stdin.fileno() in ready:
            order = sys.stdin.buffer.raw.readline()  # type: ignore[attr-defined]
            if not order:
                return
            is_cut = {b"cut\n": True, b"mend\n": False}.get(order, is_cut)
            if is_cut:
                counts["dropped"] += sum(len(way.under_way) for way in ways)
                for way in ways:
                    way.under_way.clear()
            print(json.dumps(counts), flush=True)


def _packets(descriptor: int) -> Iterator[bytes]:
    with contextlib.suppress(BlockingIOError):
        while True:
            yield os.read(descriptor, PACKET_SIZE_MAX)


def _deliver(way: _Way, counts: dict[str, Any]) -> None:
    now_s = time.monotonic()
    while way.under_way and way.under_way[0][0] <= now_s:
        _, packet = way.under_way.popleft()
        with contextlib.suppress(OSError):  # the device is not up yet, or not any more
            os.write(way.target, packet)
            counts["carried"] += 1
            counts["bytes"] += len(packet)


if __name__ == "__main__":
    relay((int(sys.argv[1]), int(sys.argv[2])), float(sys.argv[3]) / 1_000, float(sys.argv[4]), int(sys.argv[5]))
