"""Watches one program's output through a robot's agent, with the instant at which each piece arrived."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from typing import Final

from msgspec import Struct, field

from failover.client.control import Control, Output
from failover.errors import FailoverError

AGAIN_S: Final = 0.02
"""Pause before asking an agent again that does not know the component yet."""


class Watcher(Struct):
    """Follows standard output and standard error of one component on one robot, in a thread of its own.

    Attributes:
        arrivals: (instant on our clock in ns, bytes in all so far) of each piece; grows while it is read.
        last: the newest whole line.
    """

    name: str
    socket: Path
    arrivals: list[tuple[int, int]] = field(default_factory=list)
    last: str = ""
    size: int = 0
    _over: threading.Event = field(default_factory=threading.Event)

    def start(self) -> None:
        """Begin."""
        threading.Thread(target=self._follow, name=f"watch {self.name}", daemon=True).start()

    def stop(self) -> None:
        """No longer of interest; the thread ends with its connection."""
        self._over.set()

    def first_after(self, instant_ns: int) -> int | None:
        """When the first output after an instant came, None if none did yet."""
        return next((arrived for arrived, _ in self.arrivals if arrived >= instant_ns), None)

    def _follow(self) -> None:
        while not self._over.is_set():
            try:
                with Control.open(self.socket) as link:
                    for reply in link.stream("logs", name=self.name, follow=True, offsets=[self.size, 0]):
                        if isinstance(reply, Output):
                            self._take(reply)
                return
            except FailoverError:  # not known there yet, or the agent has gone
                self._over.wait(AGAIN_S)

    def _take(self, piece: Output) -> None:
        if piece.stream != 1:
            return
        self.size = piece.offset + len(piece.content)
        self.arrivals.append((time.monotonic_ns(), self.size))
        lines = piece.content.decode(errors="replace").splitlines()
        if lines:
            self.last = lines[-1]


def whole_output(socket: Path, name: str) -> tuple[bytes, int | None]:
    """Everything a component has written, standard output then standard error, and its wait status if it has ended."""
    streams = {1: bytearray(), 2: bytearray()}
    status: int | None = None
    with Control.open(socket) as link:
        for reply in link.stream("logs", name=name, follow=False, offsets=[0, 0]):
            if isinstance(reply, Output):
                streams[reply.stream] += reply.content
            else:
                status = reply.value.get("exit_status")
    return bytes(streams[1] + streams[2]), status
