"""logs: shows the output of a component, on whichever robot it was written."""

from __future__ import annotations

import argparse
import time
from bisect import bisect_right
from collections import deque
from typing import Any, Final

from msgspec import Struct, field

from failover.cli.connection import connect
from failover.cli.output import render
from failover.cli.verbs.components import reconnect, write_output
from failover.cli.verbs.why import instant
from failover.client.control import Control, Output, Result
from failover.errors import LostAgentError

STREAMS: Final = (1, 2)

TAIL_SIZE: Final = 64 << 10
"""Bytes of each stream among which its last lines are looked for first; then in twice as many, and so on."""

KEPT_SIZE: Final = 256 << 20
"""Of each stream: more than what a robot keeps of it is not looked for."""


class Shown(Struct):
    """What was shown so far. ``offsets``: of the next byte of each stream; ``begins``: it begins a line."""

    arguments: argparse.Namespace
    offsets: list[int] = field(default_factory=lambda: [0, 0])
    begins: list[bool] = field(default_factory=lambda: [True, True])

    def show(self, piece: Output) -> None:
        """One piece, unchanged; or each of its lines with the instant at which it was written."""
        self.offsets[piece.stream - 1] = piece.offset + len(piece.content)
        if self.arguments.stream not in (None, piece.stream):
            return
        if self.arguments.json:
            text = piece.content.decode(errors="surrogateescape")
            told = {"stream": piece.stream, "offset": piece.offset, "content": text}
            render.as_json(told | {"times": piece.times} if self.arguments.times else told)
        elif self.arguments.times:
            write_output(Output(piece.stream, piece.offset, self._timed(piece)))
        else:
            write_output(piece)

    def _timed(self, piece: Output) -> bytes:
        told, offset, at = bytearray(), piece.offset, piece.stream - 1
        for line in piece.content.splitlines(keepends=True):
            if self.begins[at]:
                told += f"{_instant(piece, offset)}  ".encode()
            told += line
            offset, self.begins[at] = offset + len(line), line.endswith(b"\n")
        return bytes(told)


def logs(arguments: argparse.Namespace) -> int:
    """Show it, from its beginning or a later point; with --follow through restarts of the agent."""
    shown = Shown(arguments)
    agent = connect(arguments)
    try:
        since_ms, began_s = arguments.since or 0, time.monotonic()
        if arguments.tail is not None:
            totals, since_ms = _show_tail(agent, shown), 0
        while arguments.follow or arguments.tail is None:
            try:
                totals = _show(agent, shown, since_ms)
                break
            except LostAgentError:
                if not arguments.follow:
                    raise
                agent.close()
                agent = reconnect(arguments, arguments.name)
                since_ms += int((time.monotonic() - began_s) * 1000) if since_ms else 0  # of a stream of which none was shown
                began_s = time.monotonic()
    except KeyboardInterrupt:
        return 0
    finally:
        agent.close()
    if arguments.json:
        render.as_json(totals)
    return 0


def _show(agent: Control, shown: Shown, since_ms: int) -> dict[str, Any]:
    """Show the streams from where they were left; returns the agent's last answer."""
    wanted: dict[str, Any] = {"follow": shown.arguments.follow, "offsets": shown.offsets}
    for reply in agent.stream("logs", name=shown.arguments.name, **wanted, **_besides(shown.arguments, since_ms)):
        if isinstance(reply, Output):
            shown.show(reply)
        elif isinstance(reply, Result):
            return reply.value
    return {}


def _show_tail(agent: Control, shown: Shown) -> dict[str, Any]:
    """Show the last lines of each stream; returns the agent's last answer."""
    lines, since_ms, size = shown.arguments.tail, shown.arguments.since or 0, TAIL_SIZE
    while True:
        tails = {stream: Tail(lines) for stream in STREAMS}
        offsets = [0, 0] if since_ms else [-size, -size]
        answer: dict[str, Any] = {}
        for reply in agent.stream("logs", name=shown.arguments.name, offsets=offsets, **_besides(shown.arguments, since_ms)):
            if isinstance(reply, Output):
                tails[reply.stream].add(reply)
            elif isinstance(reply, Result):
                answer = reply.value
        is_all = since_ms or size >= KEPT_SIZE
        if is_all or all(tail.is_enough(size) for tail in tails.values()):
            break
        size *= 2
    for tail in tails.values():
        for piece in tail.last_lines():
            shown.show(piece)
    shown.offsets[:] = answer["totals"]
    return answer


def _besides(arguments: argparse.Namespace, since_ms: int) -> dict[str, Any]:
    """What only an agent of this release understands, where it is asked for."""
    return ({"since_ms": since_ms} if since_ms else {}) | ({"times": True} if arguments.times else {})


class Tail:
    """The last lines of one stream, while its pieces come: of all that was written since yesterday no more than is shown."""

    def __init__(self, lines: int) -> None:
        self._lines = lines
        self._pieces: deque[Output] = deque()
        self._newlines = 0

    def add(self, piece: Output) -> None:
        """Take one that follows; forget those before the last lines."""
        if not piece.content:
            return
        self._pieces.append(piece)
        self._newlines += piece.content.count(b"\n")
        while self._newlines - (first := self._pieces[0].content.count(b"\n")) > self._lines:
            self._newlines -= first
            self._pieces.popleft()

    @property
    def held(self) -> int:
        """Pieces."""
        return len(self._pieces)

    def is_enough(self, size: int) -> bool:
        """Whether there are so many whole lines, or fewer bytes came than were asked for."""
        return self._newlines > self._lines or sum(len(piece.content) for piece in self._pieces) < size

    def last_lines(self) -> list[Output]:
        """What is shown; a last line that is not whole yet counts."""
        found: list[Output] = []
        left = self._lines + (not self._pieces or self._pieces[-1].content.endswith(b"\n"))
        for piece in reversed(self._pieces):
            begin = len(piece.content)
            while left > 0 and (newline := piece.content.rfind(b"\n", 0, begin)) >= 0:
                begin, left = newline, left - 1
            if left > 0:
                found.append(piece)
                continue
            found.append(Output(piece.stream, piece.offset + begin + 1, piece.content[begin + 1 :], piece.times))
            break
        return found[::-1] if self._lines else []


def _instant(piece: Output, offset: int) -> str:
    """When the byte at an offset was written."""
    at = bisect_right(piece.times, offset, key=lambda way: way[0]) - 1
    return instant(piece.times[max(at, 0)][1] / 1e9) if piece.times else "time not known"
