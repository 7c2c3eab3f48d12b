"""Malformed bytes at every interface that takes bytes: each is refused in words, nothing is lost, no process fails."""

from __future__ import annotations

import array
import asyncio
import contextlib
import os
import socket
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agent.errors import RefusedError
from agent.guard import messages as guard_messages
from agent.worker.components import prerequisites
from agent.worker.control.arguments import ProtectArguments, RunArguments, StopArguments, arguments_of
from agent.worker.network.remote_orders import Errands
from checkpoint.keeper import messages as keeper_messages
from checkpoint.keeper.messages import Channel, ChannelError
from checkpoint.model import Position
from failover.core.types import ComponentSpec
from failover.core.wire import codec, messages
from failover.core.wire.messages import Bulk, Errand, ErrandDone

DEEP = b"\x91" * 100_000 + b"\x01"
"""A list in a list in a list …: more than any reader's stack holds."""

BULK: tuple[Bulk, ...] = (
    messages.Hello(1, "lab", "robot1", 3, bytes(32)),
    messages.Goodbye("another version"),
    messages.Offer(1, "/lab/a", 2, Position(1, 2, bytes(16)), None, 100, bytes(32), ComponentSpec("/lab/a")),
    messages.Credit(1, 1 << 20),
    messages.Chunk(1, 0, b"pages"),
    messages.Taken(1),
    messages.Refuse(1, "no room"),
    messages.Cancel(1),
    Errand(1, "stop", msgspec.msgpack.encode({"name": "/lab/a"})),
    ErrandDone(1, b"\x80"),
)


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """The bytes with a few places altered, cut out or put in."""
    content = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        place = draw(st.integers(0, max(len(content) - 1, 0)))
        content[place : place + draw(st.integers(0, 3))] = draw(st.binary(max_size=4) | st.just(b"\xdd\xff\xff\xff\xff"))
    return bytes(content)


@pytest.mark.parametrize("message", BULK, ids=lambda message: type(message).__name__)
def test_a_damaged_bulk_message_is_a_message_or_none(message: Bulk) -> None:
    assert codec.decode_bulk(codec.encode_bulk(message)) == message

    @settings(max_examples=100, deadline=None)
    @given(damaged(codec.encode_bulk(message)))
    def decoded(body: bytes) -> None:
        found = codec.decode_bulk(body)
        assert found is None or type(found) in {type(one) for one in BULK}

    decoded()


@pytest.mark.parametrize("body", [DEEP, b"\x81\xa4type\xa4of\xff\xff", b"\x81\xa4type\xdf\xff\xff\xff\xff", b""])
def test_a_bulk_message_of_hostile_form_is_none(body: bytes) -> None:
    assert codec.decode_bulk(body) is None


# --- Local sockets: keeper, guard, worker ---


KINDS = [keeper_messages.Request, keeper_messages.Reply, guard_messages.Request, guard_messages.Reply]
WHOLE = [
    keeper_messages.Protect(7, "/lab/a"),
    keeper_messages.Captured(Position(1, 1, b""), None, 10, 10, 10),
    guard_messages.Start("/lab/a", (b"bc",), (b"A=B",), b"/", 18, True, "/logs"),
    guard_messages.Refused("no"),
]


@pytest.mark.parametrize(("incoming", "message"), list(zip(KINDS, WHOLE, strict=True)), ids=["asked", "told", "guard", "guarded"])
def test_a_damaged_packet_is_a_message_or_an_error(incoming: Any, message: msgspec.Struct) -> None:
    ours, theirs = keeper_messages.pair()
    receiver: Channel[Any] = Channel(theirs, incoming)
    theirs.setblocking(False)

    @settings(max_examples=100, deadline=None)
    @given(damaged(keeper_messages.INLINE + msgspec.msgpack.encode(message)).filter(bool))
    def received(packet: bytes) -> None:
        ours.send(packet)
        with contextlib.suppress(ChannelError):  # any other error is a mistake
            receiver.receive()

    with ours:
        received()
    receiver.close()


def memory_file(content: bytes, seal: bool) -> int:
    descriptor = os.memfd_create("message", os.MFD_ALLOW_SEALING)
    os.write(descriptor, content)
    if seal:
        keeper_messages.seal(descriptor)
    return descriptor


def huge() -> int:
    descriptor = os.memfd_create("message", os.MFD_ALLOW_SEALING)
    os.truncate(descriptor, 1 << 40)
    keeper_messages.seal(descriptor)
    return descriptor


BODY = msgspec.msgpack.encode(keeper_messages.Probe(7))
FILES: dict[str, Callable[[], int]] = {
    "not sealed": lambda: memory_file(BODY, seal=False),
    "a terabyte": huge,
    "no memory file": lambda: os.open("/dev/null", os.O_RDONLY),
    "empty": lambda: memory_file(b"", seal=True),
    "text that is none": lambda: memory_file(BODY.replace(b"Probe", b"Pr\xffbe"), seal=True),
}


@pytest.mark.parametrize("file", FILES)
def test_a_message_in_a_file_that_is_none_is_refused_and_its_descriptors_are_closed(file: str) -> None:
    ours, theirs = keeper_messages.pair()
    receiver: Channel[Any] = Channel(theirs, keeper_messages.Request)
    descriptors = [FILES[file](), os.open("/dev/null", os.O_RDONLY)]
    with ours:
        ours.sendmsg([keeper_messages.IN_MEMFD], [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", descriptors))])
        keeper_messages.close_all(tuple(descriptors))
        before = len(os.listdir("/proc/self/fd"))
        with pytest.raises(ChannelError, match="no message"):
            receiver.receive()
        assert len(os.listdir("/proc/self/fd")) == before
    receiver.close()


@pytest.mark.parametrize(
    "packet",
    [b"\x07" + BODY, keeper_messages.IN_MEMFD + BODY, keeper_messages.IN_MEMFD, keeper_messages.INLINE, b"\x00" + DEEP[:60_000]],
)
def test_a_packet_of_no_known_form_is_refused(packet: bytes) -> None:
    ours, theirs = keeper_messages.pair()
    receiver: Channel[Any] = Channel(theirs, keeper_messages.Request)
    with ours:
        ours.send(packet)
        with pytest.raises(ChannelError, match="no message"):
            receiver.receive()
    receiver.close()


# --- Orders of other robots, and their answers ---


class Ends:
    """Errands of one robot whose peer is the test."""

    def __init__(self) -> None:
        self.said: list[Bulk] = []
        self.errands = Errands(lambda _, message: self.said.append(message), lambda _: "", {"stop": self.stop})

    async def stop(self, arguments: dict[str, Any], _by: int) -> dict[str, Any]:
        return arguments


@pytest.mark.parametrize("arguments", [b"", b"\xc1", b"\x81\xa1a\xa1\xff", DEEP, b"\x93\x01\x02\x03"])
def test_an_order_whose_arguments_are_none_is_answered_by_a_refusal(arguments: bytes) -> None:
    async def body() -> None:
        ends = Ends()
        ends.errands.received("robot1", Errand(1, "stop", arguments))
        while not ends.said:
            await asyncio.sleep(0)
        assert isinstance(ends.said[0], ErrandDone)
        assert "the arguments of stop were not understood" in ends.said[0].refusal

    asyncio.run(body())


@pytest.mark.parametrize("content", [b"", b"\xc1", b"\x81\xa1a\xa1\xff", DEEP, b"\x93\x01\x02\x03"])
def test_an_answer_that_is_none_is_a_refusal(content: bytes) -> None:
    async def body() -> None:
        ends = Ends()
        asked = asyncio.ensure_future(ends.errands.send("robot1", "stop", {}))
        while not ends.said:
            await asyncio.sleep(0)
        sent = ends.said[0]
        assert isinstance(sent, Errand)
        ends.errands.done("robot1", ErrandDone(sent.number, content))
        with pytest.raises(RefusedError, match=r"does not understand the answer of .* to stop"):
            await asked

    asyncio.run(body())


@pytest.mark.parametrize(("lacking", "told"), [(None, None), (5, None), ("a", None), ([], ()), (["a disk", 5], ("a disk", "5"))])
def test_what_a_peer_says_that_it_lacks_is_sentences_or_nothing(lacking: Any, told: tuple[str, ...] | None) -> None:
    async def body() -> None:
        ends = Ends()
        asked = asyncio.ensure_future(prerequisites.asked_of(ends.errands, "robot1", "/lab/mapper"))
        while not ends.said:
            await asyncio.sleep(0)
        sent = ends.said[0]
        assert isinstance(sent, Errand)
        ends.errands.done("robot1", ErrandDone(sent.number, msgspec.msgpack.encode({"lacks": lacking})))
        assert await asked == told

    asyncio.run(body())


# --- Arguments of verbs ---


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        (RunArguments, {"argv": ["/bin/\0sh"]}),
        (RunArguments, {"argv": ["/bin/sh"], "cwd": "/\0"}),
        (RunArguments, {"argv": ["/bin/sh"], "umask": -1}),
        (RunArguments, {"argv": ["/bin/sh"], "umask": 1 << 40}),
        (RunArguments, {"argv": ["/bin/sh"], "env": {"A=B": "C"}}),
        (RunArguments, {"argv": ["/bin/sh"], "env": {"A": "\0"}}),
        (RunArguments, {"argv": ["/bin/sh"], "env": {1: "C"}}),
        (RunArguments, {"argv": ["/bin/sh"], "hooks": {None: []}}),
        (ProtectArguments, {"pid": -1, "name": "a"}),
        (ProtectArguments, {"pid": 1 << 40, "name": "a"}),
        (StopArguments, {"name": "a", "signal": 65}),
        (StopArguments, {"name": "a", "signal": 0}),
        (StopArguments, {"name": "a", "singal": 9}),
        (StopArguments, {}),
    ],
)
def test_arguments_that_no_program_could_be_started_or_ended_with_are_refused(kind: type, arguments: dict[str, Any]) -> None:
    with pytest.raises(RefusedError, match="its arguments are not right"):
        arguments_of(kind, "verb", arguments)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"engine": "ptrce"}, "engine: 'ptrce' is none of auto, ptrace, cooperative; did you mean 'ptrace'?"),
        ({"connections": "cary"}, "connections: 'cary' is none of reset, carry, refuse; did you mean 'carry'?"),
        ({"hooks": {"after_resmue": ["x"]}}, "did you mean 'after_resume'?"),
    ],
)
def test_a_word_that_is_none_of_its_choices_is_refused_with_all_of_them(arguments: dict[str, Any], said: str) -> None:
    with pytest.raises(RefusedError) as refused:
        arguments_of(RunArguments, "run", {"argv": ["x"], **arguments})
    assert said in str(refused.value)
