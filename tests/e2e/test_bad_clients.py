"""Clients that may use the control socket and send nonsense: refused or disconnected; the agent and its components run on."""

from __future__ import annotations

import os
import random
import socket
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest

from checkpoint.linux.procfs import procfs
from failover.client.control import LENGTH, MESSAGE_LIMIT, REQUEST_LIMIT, Control, Refused, Request
from failover.errors import AgentRefusedError, RequestError
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.robot_processes import parts

SEED = int(os.environ.get("FAILOVER_FUZZ_SEED", random.randrange(1 << 30)))
TURNS = int(os.environ.get("FAILOVER_FUZZ_TURNS", "300"))

CONNECTIONS = 100
GROWTH_MAX = 100 << 20
"""Bytes: a quarter of what so many half requests are together."""

VERBS = (
    "ping",
    "status",
    "run",
    "protect",
    "release",
    "stop",
    "logs",
    "why",
    "handover",
    "failback",
    "prefer",
    "promote",
    "",
    "picture",
)
KEYS = (
    "name",
    "argv",
    "env",
    "cwd",
    "umask",
    "isolate",
    "wait",
    "pid",
    "signal",
    "follow",
    "offsets",
    "to",
    "robot",
    "team",
    "x",
)
VALUES: tuple[Any, ...] = (
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        1 << 31,
        (1 << 64) - 1,
        -(1 << 63),
        1.5,
        float("nan"),
        "",
        "/",
        "nobody",
        "a\0b",
        "☃",
        "x" * 5_000,
    ),
    *([], [""], ["/nonexistent"], [1, 2], [[]], {}, {"": ""}, {"A": 1}, {1: 2}, b"", b"\xff", [0, -1], ["\0"], {"A=B": "C"}),
)
DEEP = b"\x82\xa4verb\xa4ping\xa9arguments\x81\xa1a" + b"\x91" * 100_000 + b"\x01"

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    with robots.two_robots(tmp_path_factory.mktemp("clients")) as both:
        robots.run(both[0], "sleeper", "/bin/sleep", "1000000")
        robots.until_protected(both[0], "sleeper")
        yield both


@pytest.fixture(autouse=True)
def undisturbed(pair: Pair) -> Iterator[None]:
    """The same processes before and after, and the component protected."""
    before = [agent_of(robot) for robot in pair]
    yield
    assert [agent_of(robot) for robot in pair] == before
    stored = robots.checkpoints(pair[1], "sleeper")
    robots.until(lambda: robots.checkpoints(pair[1], "sleeper") > stored, "the next checkpoint")


def agent_of(robot: RobotMachine) -> tuple[int, int, int]:
    status = robot.status()
    return status["life"], status["pid"], status["lanes_pid"]


def connect(path: Path) -> socket.socket:
    link = socket.socket(socket.AF_UNIX)
    link.settimeout(robots.PATIENCE_S)
    link.connect(str(path))
    return link


def answer(link: socket.socket) -> bytes:
    """All that comes until the agent hangs up."""
    link.shutdown(socket.SHUT_WR)
    told = bytearray()
    with suppress(ConnectionResetError):
        while piece := link.recv(1 << 16):
            told += piece
    return bytes(told)


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (LENGTH.pack(0), "was not understood"),
        (LENGTH.pack(5) + b"hello", "was not understood"),
        (LENGTH.pack(MESSAGE_LIMIT + 1), "over the limit"),
        (LENGTH.pack(len(DEEP)) + DEEP, "was not understood"),
        (LENGTH.pack(9) + b"\x81\xa4verb\xa2\xff\xff", "was not understood"),
        (LENGTH.pack(15) + b"\x81\xa4verb\xddzzzz\xff\xff\xff\xff", "was not understood"),
    ],
    ids=["empty", "text", "too long", "deep", "no UTF-8", "a huge list"],
)
def test_a_request_that_is_none_is_refused_in_words(pair: Pair, sent: bytes, said: str) -> None:
    with connect(pair[0].socket) as link:
        link.sendall(sent)
        told = answer(link)
    refused = msgspec.msgpack.decode(told[LENGTH.size :], type=Refused)
    assert said in refused.message


@pytest.mark.parametrize("sent", [b"", b"\0", b"GET / HTTP/1.1\r\n\r\n", LENGTH.pack(100) + b"half"])
def test_a_client_that_hangs_up_midway_leaves_nothing(pair: Pair, sent: bytes) -> None:
    for _ in range(20):
        with connect(pair[0].socket) as link:
            link.sendall(sent)


def test_half_requests_on_many_connections_take_a_bounded_memory_and_no_place(pair: Pair) -> None:
    (worker,) = parts(pair[0], "worker")
    half = LENGTH.pack(REQUEST_LIMIT) + bytes(REQUEST_LIMIT - 1)
    before = procfs.status(worker).resident_size
    with ExitStack() as held:
        for _ in range(CONNECTIONS):
            link = held.enter_context(connect(pair[0].socket))
            with suppress(ConnectionError):  # told that it is too much, and hung up on
                link.sendall(half)
        assert pair[0].status()["robot"] == "robot1"
        assert procfs.status(worker).resident_size - before < GROWTH_MAX


def test_a_client_that_reads_nothing_holds_nobody_up(pair: Pair) -> None:
    with connect(pair[0].socket) as deaf:
        body = msgspec.msgpack.encode(Request("status", {"watch": True, "every_ms": 1}))
        deaf.sendall(LENGTH.pack(len(body)) + body)
        for _ in range(20):
            assert pair[0].status()["robot"] == "robot1"


def test_verbs_with_arguments_of_any_kind_are_answered(pair: Pair) -> None:
    print(f"FAILOVER_FUZZ_SEED={SEED}")
    dice = random.Random(SEED)
    for _ in range(TURNS):
        verb = dice.choice(VERBS)
        arguments = {key: dice.choice(VALUES) for key in dice.sample(KEYS, dice.randrange(4))}
        arguments.pop("watch", None)
        with Control.open(pair[0].socket) as agent, suppress(AgentRefusedError, RequestError):
            agent.ask(verb, **arguments)
    for one in pair[0].status()["components"]:
        if not one["name"].endswith("/sleeper"):
            robots.failover(pair[0], "release", one["name"])
