"""The heartbeat sockets of two robots on the loopback: which datagrams arrive, over which interface, and when."""

from __future__ import annotations

import select
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from agent.main_loop.beat_sockets import TURN_LIMIT, BeatLane
from agent.system import clock
from failover.config.team import Robot
from failover.core.frames.frame import FRAME_SIZE_MAX, MAGIC

PATIENCE_MS = 10_000
BEAT = MAGIC + b" and so on"


def robot(links: int) -> Robot:
    return Robot(tuple(f"127.0.0.1:{free_port()}" for _ in range(links)), "127.0.0.1:1")


def free_port() -> int:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@pytest.fixture
def worker() -> Iterator[tuple[BeatLane, BeatLane]]:
    """Of robot1 and robot2, with two links each."""
    first, second = robot(2), robot(2)
    ours, theirs = BeatLane(first, {"robot2": second}), BeatLane(second, {"robot1": first})
    yield ours, theirs
    ours.close()
    theirs.close()


def send(lane: BeatLane, frame: bytes) -> None:
    """To robot2 over both links."""
    for place in range(2):
        lane.unicast("robot2", place, [frame])


def waits(lane: BeatLane) -> bool:
    """Whether something comes, as the main loop finds out."""
    with closing(select.epoll()) as loop:
        loop.register(lane.fileno(), select.EPOLLIN)
        return bool(loop.poll(PATIENCE_MS / 1e3))


def test_a_beat_comes_over_every_link_and_says_when(worker: tuple[BeatLane, BeatLane]) -> None:
    ours, theirs = worker
    while not is_stamped(ours, theirs):
        """For the first socket that asks for stamps the kernel begins to give them a moment later (net_enable_timestamp)."""
    before_ns = clock.now_ns()
    send(ours, BEAT)
    sent_ns = clock.now_ns()
    assert waits(theirs)
    time.sleep(0.05)  # it waits for us, and that does not count
    came = list(theirs.receive())
    assert [(frame, link) for frame, link, *_ in came] == [(BEAT, "lo")] * 2
    for _, _, wall_ns, *_ in came:
        assert before_ns - 1_000_000 < clock.now_and_arrival_ns(wall_ns)[1] < sent_ns + 1_000_000


def is_stamped(ours: BeatLane, theirs: BeatLane) -> bool:
    """Whether the kernel stamps a datagram when it comes, and not when it is read."""
    send(ours, BEAT)
    assert waits(theirs)
    time.sleep(0.05)
    read_ns = time.time_ns()
    return all(wall_ns < read_ns - 25_000_000 for _, _, wall_ns, *_ in theirs.receive())


def test_where_nothing_waits_nothing_comes(worker: tuple[BeatLane, BeatLane]) -> None:
    assert list(worker[0].receive()) == []


def test_a_flood_is_taken_in_parts_and_none_of_it_is_lost(worker: tuple[BeatLane, BeatLane]) -> None:
    ours, theirs = worker
    for number in range(TURN_LIMIT):
        send(ours, MAGIC + b"%d" % number)
    assert waits(theirs)
    parts = [[frame for frame, *_ in theirs.receive()] for _ in range(3)]
    assert [len(part) for part in parts] == [TURN_LIMIT, TURN_LIMIT, 0]
    assert sorted(int(frame[2:]) for part in parts for frame in part) == sorted([*range(TURN_LIMIT)] * 2)


def test_what_does_not_begin_as_a_beat_is_dropped_by_the_kernel_and_counted(worker: tuple[BeatLane, BeatLane]) -> None:
    ours, theirs = worker
    longest = MAGIC + bytes(FRAME_SIZE_MAX - len(MAGIC))
    for frame in (b"", b"f", b"GET / HTTP/1.1", longest + b"\0", *[bytes(1_000)] * 5_000):
        send(ours, frame)
    send(ours, longest)
    assert waits(theirs)
    assert [frame for frame, *_ in theirs.receive()] == [longest] * 2
    assert theirs.dropped() == 2 * 5_004
    assert ours.dropped() == 0


GOING_INTERFACES = """
import subprocess
from agent.main_loop.beat_sockets import BeatLane
from failover.config.team import Robot
lane = BeatLane(Robot(("127.0.0.1:7420",), "127.0.0.1:7421"), {}, "team")
for index in range(10, 35):
    subprocess.run(["ip", "link", "add", "cable", "index", str(index), "type", "veth"], check=True)
    subprocess.run(["ip", "link", "set", "cable", "up"], check=True)
    refusal = lane.open_to_casts(0, index)
    assert not refusal, f"the {index - 9}th: {refusal}"
    subprocess.run(["ip", "link", "delete", "cable"], check=True)
"""


@pytest.mark.root
@pytest.mark.command("unshare")
@pytest.mark.command("ip")
def test_an_interface_that_goes_and_comes_back_many_times_is_joined_each_time() -> None:
    """A socket may be in 20 groups: each interface that has gone would be one of them for ever."""
    command = ["unshare", "--net", sys.executable, "-c", GOING_INTERFACES]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
