"""The bridge to zenoh, spoken to by a session of zenoh's own."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zenoh")

import zenoh

import failover
from failover.boards import directory
from failover.boards.board import Board
from failover.boards.received import ReceivedItems
from failover.bridges.zenoh_bridge import CALLERS
from failover.cli import main
from failover.core.board import layout
from failover.core.frames.frame import Portion
from tests.failover.boards.conftest import place as place
from tests.failover.boards.programs import ROOT
from tests.failover.drivers.conftest import folder as folder
from tests.failover.drivers.conftest import here as here
from tests.failover.drivers.devices import Engine
from tests.failover.drivers.serving import serving, until

PATIENCE_S = 60


def free_endpoint() -> str:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return f"tcp/127.0.0.1:{listener.getsockname()[1]}"


@contextmanager
def bridging(*options: str) -> Iterator[dict[str, Any]]:
    """A bridge that runs: what it tells of itself."""
    command = [sys.executable, "-m", "failover", "bridge", "zenoh", "--json", "--prefix", "lab", *options]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as bridge:
        assert bridge.stdout is not None
        told = json.loads(bridge.stdout.readline())
        try:
            yield told
        finally:
            bridge.send_signal(signal.SIGINT)
            bridge.communicate()
    assert bridge.returncode == 0


@contextmanager
def session(mode: str, what: str, endpoint: str) -> Iterator[Any]:
    """A program of zenoh, or a router."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("mode", f'"{mode}"')
    config.insert_json5(f"{what}/endpoints", f'["{endpoint}"]')
    with zenoh.open(config) as opened:
        yield opened


@contextmanager
def met(*options: str) -> Iterator[Any]:
    """A program of zenoh that is connected to a bridge."""
    endpoint = free_endpoint()
    with bridging("--listen", endpoint, *options), session("client", "connect", endpoint) as program:
        yield program


def got(program: Any, selector: str, **options: Any) -> dict[str, Any]:
    """The replies to a get, by their keys."""
    replies = {}
    for reply in program.get(selector, timeout=PATIENCE_S, **options):
        assert reply.ok is not None, bytes(reply.err.payload)
        assert str(reply.ok.encoding) == "application/json"
        replies[str(reply.ok.key_expr)] = json.loads(bytes(reply.ok.payload))
    return replies


def refused(program: Any, selector: str, **options: Any) -> str:
    """Why a call was refused."""
    (reply,) = list(program.get(selector, timeout=PATIENCE_S, **options))
    assert reply.err is not None
    return str(json.loads(bytes(reply.err.payload))["error"])


@pytest.fixture
def board(place: Path) -> Iterator[Board]:
    with failover.board() as opened:
        yield opened


def test_each_put_is_published_once_with_its_age_and_a_get_has_the_newest(board: Board) -> None:
    goal = board.add(failover.Item("goal", {"x": "f4"}))
    other = board.add(failover.Item("other", {"y": "f8"}))
    never = board.add(failover.Item("never", {"z": "f8"}))
    goal.put({"x": 0.5})
    other.put({"y": 7.0})
    heard: list[dict[str, Any]] = []
    with met() as program, program.declare_subscriber("lab/**", lambda one: heard.append(json.loads(bytes(one.payload)))):
        first = got(program, "lab/*/*")
        assert {key: one["value"] for key, one in first.items()} == {
            f"lab/{board.robot}/goal": {"x": 0.5},
            f"lab/{board.robot}/other": {"y": 7.0},
        }
        key = f"lab/{board.robot}/goal"
        again = got(program, key)[key]
        assert again["number"] == first[key]["number"] and again["age_us"] > first[key]["age_us"]
        assert got(program, "lab/*/never") == {} and never is not None
        assert got(program, "lab/nowhere/*") == {}
        for number in range(1, 6):
            goal.put({"x": float(number)})
            until(lambda number=number: any(one["value"] == {"x": float(number)} for one in heard))
        numbers = [one["number"] for one in heard if "x" in one["value"]]
        assert len(numbers) == len(set(numbers)), "a get publishes nothing again"


def test_robots_are_alive_while_they_run(board: Board) -> None:
    file = directory.make_peer(board.directory, "robot2", rank=1, state=layout.RUN)
    received = ReceivedItems(file)
    seen: list[tuple[str, str]] = []
    with (
        met() as program,
        program.liveliness().declare_subscriber(
            "lab/*", lambda one: seen.append((str(one.key_expr), str(one.kind))), history=True
        ),
    ):
        until(lambda: any(key == "lab/robot2" and "PUT" in kind for key, kind in seen))
        received.tell_state(layout.NOT)
        until(lambda: any(key == "lab/robot2" and "DELETE" in kind for key, kind in seen))
        received.tell_state(layout.RUN)
        until(lambda: sum(key == "lab/robot2" and "PUT" in kind for key, kind in seen) == 2)
        assert received.take([Portion(7, 0, 1, b"abcd")], time.clock_gettime_ns(time.CLOCK_BOOTTIME), 0, 1) in (0, 1)


def test_drivers_are_called_and_refusals_are_told(board: Board, here: object) -> None:
    with serving(Engine, here), met("--calls") as program:  # type: ignore[arg-type]
        assert got(program, "lab/@call/engine/set", payload=b'{"duty": 0.5}') == {"lab/@call/engine/set": None}
        assert got(program, "lab/@call/engine/read") == {"lab/@call/engine/read": {"duty": 0.5}}
        assert "<= 1" in refused(program, "lab/@call/engine/set", payload=b'{"duty": 7}')
        for payload in (b"[1]", b'{"duty":"\xff"}', b'{"duty":' + b"[" * 12_000):
            for _ in range(CALLERS + 1):  # one that ended a thread would leave the last without an answer
                assert "no JSON object" in refused(program, "lab/@call/engine/set", payload=payload)
        assert "fly" in refused(program, "lab/@call/engine/fly")
        assert "wing" in refused(program, "lab/@call/wing/set")
        assert "one driver and one verb" in refused(program, "lab/@call/engine/*")
        assert "one driver and one verb" not in str(got(program, "lab/**")), "a wildcard calls nothing"
        together = [threading.Thread(target=got, args=(program, "lab/@call/engine/read")) for _ in range(20)]
        for one in together:
            one.start()
        for one in together:
            one.join()
        assert got(program, "lab/@call/engine/read") == {"lab/@call/engine/read": {"duty": 0.5}}


def test_without_calls_none_is_carried(board: Board, here: object) -> None:
    with serving(Engine, here) as engine, met() as program:  # type: ignore[arg-type]
        assert got(program, "lab/@call/engine/set", payload=b'{"duty": 0.5}') == {}
        assert engine.instance.heard == []


def test_a_router_that_went_away_is_found_again(board: Board) -> None:
    goal = board.add(failover.Item("goal", {"x": "f4"}))
    endpoint, key = free_endpoint(), f"lab/{board.robot}/goal"

    def is_found(value: float) -> None:
        with session("client", "connect", endpoint) as program:
            until(lambda: got(program, key).get(key, {}).get("value") == {"x": value})

    with ExitStack() as stack:
        with session("router", "listen", endpoint):
            told = stack.enter_context(bridging("--connect", endpoint))
            assert told["endpoints"] == [endpoint]
            goal.put({"x": 1.0})
            is_found(1.0)
        goal.put({"x": 2.0})
        with session("router", "listen", endpoint):
            is_found(2.0)
        goal.put({"x": 3.0})


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--listen", "tcp/0.0.0.0:7447"], "refused to listen at 0.0.0.0"),
        (["--listen", "127.0.0.1"], "is no endpoint of zenoh"),
        (["--connect", "tcp/127.0.0.1:1"], "no zenoh session at tcp/127.0.0.1:1"),
        (["--config", "missing.json5"], "no zenoh session at missing.json5"),
        (["--prefix", "a/*"], "stands for several"),
        (["--prefix", "/a"], "cannot begin zenoh's keys"),
        (["--items", "gaol"], "no item is called 'gaol'"),
    ],
)
def test_what_cannot_be_is_told_in_a_sentence(
    board: Board, capsys: pytest.CaptureFixture[str], options: list[str], said: str
) -> None:
    board.add(failover.Item("goal", {"x": "f4"}))
    assert main.main(["bridge", "zenoh", *options]) == main.FAILED
    assert said in capsys.readouterr().err
