"""What users of the robot and their programs say: control socket, task socket, local channels, the operators' page."""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Any

import msgspec

from tests.fuzz.target import SENTENCES, Decoder, target


@target("any user of the robot: a request at the control socket", "msgpack")
def control_request() -> Decoder:
    from agent.worker.control import arguments as ours
    from agent.worker.control import server
    from failover.client.control import Request, encoded

    kinds = [kind for name, kind in vars(ours).items() if name.endswith("Arguments")]
    said: list[tuple[str, dict[str, Any]]] = [
        ("run", {"argv": ["/bin/sh", "-c", "true"], "env": {"A": "b"}, "carry": ["/tmp/x"], "devices": {"/dev/x": "reset"}}),
        ("protect", {"pid": 4711, "name": "/lab/a", "hooks": {"after_resume": ["x", "y"]}}),
        ("logs", {"name": "/lab/a", "follow": True, "offsets": [0, -1]}),
        ("reserve", {"name": "/lab/a", "span_ms": 5_000, "why": "maintenance"}),
        ("stop", {"name": "/lab/a", "signal": 15}),
    ]

    def call(content: bytes) -> object:
        request = server._request(bytearray(content))
        found = []
        for kind in kinds:
            with contextlib.suppress(*SENTENCES):
                found.append(ours.arguments_of(kind, request.verb, request.arguments))
        return found

    return Decoder([encoded(Request(verb, arguments)) for verb, arguments in said], call)


@target("whatever listens at FAILOVER_SOCKET: an answer to a command", "msgpack")
def control_reply() -> Decoder:
    from failover.client import control

    replies = [control.Result({"epoch": 3}), control.Refused("RefusedError", "no", ("why",)), control.Output(1, 0, b"x")]
    path = Path("/run/x")
    return Decoder([msgspec.msgpack.encode(one) for one in replies], lambda content: control.decoded(content, path, "status"))


def _channel(incoming: Any, messages: list[msgspec.Struct]) -> Decoder:
    from checkpoint.keeper.messages import INLINE, INLINE_LIMIT, Channel, pair

    ours, theirs = pair()
    receiver: Channel[Any] = Channel(theirs, incoming)
    theirs.setblocking(False)

    def call(content: bytes) -> object:
        if not content or len(content) > INLINE_LIMIT:
            return None
        ours.send(content)
        return receiver.receive()

    return Decoder([INLINE + msgspec.msgpack.encode(one) for one in messages], call)


@target("a keeper, in which a hostile program was captured or restored: its answers", "msgpack")
def keeper_packet() -> Decoder:
    from checkpoint.keeper import messages
    from checkpoint.model import Position

    captured = messages.Captured(Position(1, 1, b""), None, 10, 10, 10)
    return _channel(messages.Reply | messages.Request, [captured, messages.Protect(7, "/lab/a")])


@target("a guard, or its agent: the messages between them", "msgpack")
def guard_packet() -> Decoder:
    from agent.guard import messages

    start = messages.Start("/lab/a", (b"bc",), (b"A=B",), b"/", 18, True, "/logs")
    return _channel(messages.Reply | messages.Request, [start, messages.Refused("no")])


@target("a program that keeps its state, or its guard: TASK.md")
def task_packet() -> Decoder:
    from checkpoint.segment import task_messages as messages
    from checkpoint.segment.task_messages import Begin, Hello, Keeps, Kept, Origin, Refused, Safe

    begin = Begin("/lab/a", 3, (7, 8), Origin("robot1", 4, "taken over", 5))
    packets = [Hello(), Keeps(), begin, Begin("/lab/a", 3, (0, 0)), Refused("no"), Safe(7), Kept(8)]

    def call(content: bytes) -> object:
        found = None
        with contextlib.suppress(*SENTENCES):
            found = messages.from_program(content)
        again = found if found is not None else messages.from_guard(content)
        assert found is not None or len(messages.encode(again)) == len(content)
        return again

    return Decoder([messages.encode(one) for one in packets], call)


@target("a browser: what a page's window says over its websocket", "json", "starlette")
def page_look() -> Decoder:
    from page import viewers
    from page.errors import TurnedAwayError

    def call(content: bytes) -> object:
        text = content.decode(errors="surrogatepass") if b"\xed" in content else content.decode(errors="replace")
        try:
            return viewers._looks.decode(text)
        except (msgspec.DecodeError, RecursionError) as error:  # as `Viewer.listen`
            raise TurnedAwayError(400, f"a message that no page of ours sends: {error}") from error

    return Decoder([b'{"look":"component:/lab/a"}', b'{"look":""}'], call, (*SENTENCES, UnicodeDecodeError))


def _posted(kind: str, seeds: list[dict[str, Any]]) -> Decoder:
    from starlette.requests import Request

    from page import app, orders

    headers = [(b"content-type", b"application/json")]
    wanted = getattr(app, kind, None) or getattr(orders, kind)

    async def posted(content: bytes) -> object:
        pieces = [content[:100], content[100:]]

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": pieces.pop(0) if pieces else b"", "more_body": bool(pieces)}

        request = Request({"type": "http", "method": "POST", "headers": headers}, receive)
        return await app._body(request, wanted)

    loop = asyncio.new_event_loop()
    return Decoder([msgspec.json.encode(one) for one in seeds], lambda content: loop.run_until_complete(posted(content)))


@target("a browser: an order that is posted", "json", "starlette")
def page_order() -> Decoder:
    wish = {"id": "12345678", "verb": "handover", "name": "/lab/a", "boot": "x", "to": "robot2", "epoch": 3, "age_ms": 5.5}
    return _posted("Wish", [wish, {**wish, "verb": "call", "call": "set", "body": {"duty": [0.5, None]}}])


@target("a browser, before any login: name and password", "json", "starlette")
def page_login() -> Decoder:
    return _posted("Login", [{"name": "anna", "password": "häuser"}])


@target("a program of zenoh: the fields of a call", "json")
def zenoh_call() -> Decoder:
    from types import SimpleNamespace

    from failover.bridges.zenoh_bridge import _Callers

    proxy = SimpleNamespace(call=lambda verb, fields: fields)
    calls = _Callers.__new__(_Callers)
    calls._proxy = lambda driver: proxy  # type: ignore[method-assign, assignment, return-value]
    return Decoder(
        [b'{"duty":0.5,"names":["a"]}', b""], lambda content: calls._called("lab/PWM", "set", SimpleNamespace(payload=content))
    )
