"""The board live: read over a websocket as the published protocol says, by a client that is not of the server's makers."""

from __future__ import annotations

import json
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("foxglove")
pytest.importorskip("websockets")

from websockets.sync.client import ClientConnection, connect

import failover
from failover.boards import directory
from failover.boards.board import Board
from failover.boards.received import ReceivedItems
from failover.cli import main
from failover.core.board import layout, recording
from failover.core.frames.frame import Portion
from tests.failover.boards.conftest import place as place
from tests.failover.boards.programs import ROOT

PATIENCE_S = 60
AGAIN_S = 5
MESSAGE = struct.Struct("<BIQ")
"""Source: Foxglove WebSocket protocol, *Message Data*: opcode 1, subscription, log time."""


@contextmanager
def served(*options: str) -> Iterator[str]:
    """The address of a server that runs."""
    command = [sys.executable, "-m", "failover", "board", "serve", "--foxglove", "0", "--json", "--no-decisions", *options]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        told = json.loads(server.stdout.readline())
        try:
            yield f"ws://{told['address']}:{told['port']}"
        finally:
            server.send_signal(signal.SIGINT)
            server.communicate()
    assert server.returncode == 0


class Looker:
    """A client: knows what is advertised, and subscribes."""

    def __init__(self, link: ClientConnection) -> None:
        self._link = link
        self.channels: dict[str, dict[str, Any]] = {}
        self.gone: list[int] = []

    def hear(self, patience_s: float = PATIENCE_S) -> tuple[str, int, Any] | None:
        """The next message: topic, log time, JSON; None: it was an advertisement or the like."""
        said = self._link.recv(patience_s)
        if isinstance(said, bytes):
            opcode, subscription, log_ns = MESSAGE.unpack_from(said)
            assert opcode == 1
            topic = next(name for name, one in self.channels.items() if one["id"] == subscription)
            return topic, log_ns, json.loads(said[MESSAGE.size :])
        told = json.loads(said)
        if told["op"] == "advertise":
            self.channels |= {one["topic"]: one for one in told["channels"]}
        elif told["op"] == "unadvertise":
            self.gone += told["channelIds"]
        return None

    def until(self, topic: str) -> tuple[int, Any]:
        """The next message of a channel.

        The SDK advertises a channel before it knows it itself: who subscribes in the same millisecond is not heard.
        """
        until = time.monotonic() + PATIENCE_S
        while True:
            try:
                heard = self.hear(AGAIN_S)
            except TimeoutError:
                assert time.monotonic() < until, f"nothing of {topic}"
                self.subscribe(topic)
                continue
            if heard is not None and heard[0] == topic:
                return heard[1:]

    def subscribe(self, topic: str) -> None:
        while topic not in self.channels:
            self.hear()
        number = self.channels[topic]["id"]
        self._link.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": number, "channelId": number}]}))


@contextmanager
def looking(address: str) -> Iterator[Looker]:
    with connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None) as link:  # type: ignore[list-item]
        assert link.subprotocol == "foxglove.sdk.v1"
        yield Looker(link)


@pytest.fixture
def board(place: Path) -> Iterator[Board]:
    with failover.board() as opened:
        yield opened


def test_one_who_subscribes_gets_the_newest_value_at_once_and_then_each_put(board: Board) -> None:
    goal = board.add(failover.Item("goal", {"x": "f4", "mark": "u1[2]"}))
    goal.put({"x": 1.5, "mark": b"\0\xff"})
    topic = f"/{board.robot}/goal"
    with served() as address, looking(address) as first:
        first.subscribe(topic)
        log_ns, message = first.until(topic)
        assert (message["value"], message["number"]) == ({"x": 1.5, "mark": "00ff"}, 1) and message["age_us"] > 0
        one = first.channels[topic]
        assert (one["encoding"], one["schemaEncoding"]) == ("json", "jsonschema")
        assert one["schemaName"].startswith("failover.board.goal.")
        schema = json.loads(one["schema"])
        assert schema["properties"]["value"]["properties"]["x"] == {"type": "number"}
        goal.put({"x": 2.5, "mark": b"ab"})
        later_ns, message = first.until(topic)
        assert (message["value"]["x"], message["number"]) == (2.5, 2) and later_ns > log_ns
        with looking(address) as second:  # it has come late, and nothing is put any more
            second.subscribe(topic)
            assert second.until(topic)[1]["number"] == 2
            second.subscribe(recording.ROBOTS_TOPIC)
            assert second.until(recording.ROBOTS_TOPIC)[1]["robots"][0]["name"] == board.robot


def test_an_item_that_is_declared_anew_has_another_channel(board: Board) -> None:
    board.add(failover.Item("goal", {"x": "f4"})).put({"x": 1.0})
    topic = f"/{board.robot}/goal"
    with served("--items", "g*") as address, looking(address) as looker:
        looker.subscribe(topic)
        looker.until(topic)
        before = looker.channels[topic]["id"]
        board.remove("goal")
        board.add(failover.Item("goal", {"y": "f8"})).put({"y": 2.0})
        while looker.channels[topic]["id"] == before or before not in looker.gone:
            looker.hear()
        looker.subscribe(topic)
        assert looker.until(topic)[1]["value"] == {"y": 2.0}


def test_an_item_that_is_declared_again_as_at_first_is_not_silent(board: Board) -> None:
    received = ReceivedItems(directory.make_peer(board.directory, "robot2", rank=1, state=layout.RUN))
    puts = 0

    def take() -> None:
        nonlocal puts
        puts += 1
        now = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        assert received.take([Portion(7, 0, puts, puts.to_bytes(4, "little"))], now, 0, puts) == 1

    wanted = [
        layout.Wanted(7, "goal", 4, kind=layout.STRUCT, flags=layout.ADDED, text=text) for text in ("{x:u4}", "{y:u4}", "{x:u4}")
    ]
    received.change((), wanted[:1])
    take()
    with served() as address, looking(address) as looker:
        before = -1
        for number, one in enumerate(wanted, 1):
            if number > 1:
                received.change((7,), (one,))
                take()
            while looker.channels.get("/robot2/goal", {"id": before})["id"] == before:
                looker.hear()
            before = looker.channels["/robot2/goal"]["id"]
            looker.subscribe("/robot2/goal")
            assert looker.until("/robot2/goal")[1]["value"] == {one.text[1]: number}


def refused(capsys: pytest.CaptureFixture[str], *options: str) -> str:
    assert main.main(["board", "serve", "--foxglove", *options]) == main.FAILED
    out, err = capsys.readouterr()
    assert out == "" and len(err.splitlines()) == 1
    return err


@pytest.mark.parametrize("address", ["0.0.0.0", "192.168.1.1", "::"])
def test_an_address_that_others_reach_is_refused(board: Board, capsys: pytest.CaptureFixture[str], address: str) -> None:
    assert f"refused to listen at {address}" in refused(capsys, "8765", "--listen", address)


def test_an_address_that_is_none_is_refused(board: Board, capsys: pytest.CaptureFixture[str]) -> None:
    assert "'robot2' is no IP address" in refused(capsys, "8765", "--listen", "robot2", "--unsafe-listen")


def test_a_port_that_is_taken_is_told(board: Board, capsys: pytest.CaptureFixture[str]) -> None:
    board.add(failover.Item("goal", size=4))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert f"cannot listen at 127.0.0.1, port {port}: " in refused(capsys, str(port))


def test_without_the_library_it_says_how_to_install_it(
    board: Board, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    board.add(failover.Item("goal", size=4))
    assert "pip install 'failover[foxglove]'" in refused(capsys, "8765")
