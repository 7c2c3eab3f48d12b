"""A reader of a component's committed output as it comes: output that it has seen is acknowledged, and must stay true."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from typing import Final

from failover.client.control import Output
from failover.errors import AgentRefusedError
from tests.chaos.actuator import Safe
from tests.chaos.house import AWAY, House, Member

REST_S: Final = 0.3
"""Between two looks."""

STDOUT: Final = 1


class Reader:
    """A thread that asks any member that answers, and notes every contradiction to its earlier lines.

    Attributes:
        newest: step of the last whole line; lines are ``STEP SEAL``.
        seen: lines that the campaign has not taken yet.
        complaint: "" as long as the stream has neither gap nor repetition.
    """

    def __init__(self, house: House, component: str) -> None:
        self.component = component
        self.newest = 0
        self.seen: deque[Safe] = deque()
        self.complaint = ""
        self._house = house
        self._offset = 0
        self._rest = b""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._read, name=f"reader of {component}", daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """End; it may take as long as an answer that does not come."""
        self._over.set()
        self._thread.join()

    def _read(self) -> None:
        while not self._over.wait(REST_S):
            for member in self._order():
                if self._over.is_set() or self._asked(member):
                    break

    def _order(self) -> list[Member]:
        """The members that have power, robots first, another one first each time."""
        able = [member for member in self._house.powered if member.role != "witness" and not member.stopped]
        turn = self._offset % max(len(able), 1)
        return able[turn:] + able[:turn]

    def _asked(self, member: Member) -> bool:
        """Whether it had anything new."""
        before = self._offset
        with contextlib.suppress(*AWAY, AgentRefusedError), member.control() as link:
            for reply in link.stream("logs", name=f"/house/{self.component}", offsets=[self._offset, 0]):
                if isinstance(reply, Output) and reply.stream == STDOUT:
                    self._take(reply, member.name)
        return self._offset > before

    def _take(self, piece: Output, source: str) -> None:
        if piece.offset != self._offset:
            self.complaint = self.complaint or f"{source} goes on at byte {piece.offset}, {self._offset} were read"
            return
        self._offset += len(piece.content)
        *lines, self._rest = (self._rest + piece.content).split(b"\n")
        for line in lines:
            self._read_line(line, source)

    def _read_line(self, line: bytes, source: str) -> None:
        step, _, seal = line.partition(b" ")
        if not (step.isdigit() and seal.isdigit() and int(step) == self.newest + 1):
            self.complaint = self.complaint or f"{source} shows {line!r} after step {self.newest}"
            return
        self.newest = int(step)
        self.seen.append(Safe(time.monotonic_ns(), self.component, int(step), int(seal)))
