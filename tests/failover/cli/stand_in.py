"""An agent's control socket simulated by a thread: it speaks the real protocol over a real socket and answers by a script."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec

from failover.client.control import Output, Refused, Request, Result, Update

Answer = Iterable[Update | Output | Result | Refused]
LENGTH = struct.Struct(">I")


class StandIn:
    """Listens on ``path``; every connection is served by its own thread. ``asked`` keeps the requests."""

    def __init__(self, path: Path, answer: Callable[[Request], Answer]) -> None:
        self.path = path
        self.asked: list[Request] = []
        self._answer = answer
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(path))
        self._listener.listen()
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        """Stop listening; the socket's file goes too."""
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.path.unlink(missing_ok=True)

    def _accept(self) -> None:
        while True:
            try:
                link, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._serve, args=(link,), daemon=True).start()

    def _serve(self, link: socket.socket) -> None:
        # A command that has ended in the middle of an answer resets the connection.
        with contextlib.suppress(ConnectionError), link, link.makefile("rb") as incoming:
            while head := incoming.read(LENGTH.size):
                request = msgspec.msgpack.decode(incoming.read(*LENGTH.unpack(head)), type=Request)
                self.asked.append(request)
                for reply in self._answer(request):
                    body = msgspec.msgpack.encode(reply)
                    try:
                        link.sendall(LENGTH.pack(len(body)) + body)
                    except OSError:
                        return
                    if isinstance(reply, Result | Refused):
                        break
                else:
                    return  # the agent "went away" in the middle of its answer
