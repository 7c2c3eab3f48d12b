"""What a host and the process of one version say to each other, over a socket pair: four bytes of length, then msgpack.

host                        version's process
Start   →  (confine, import)      ← Hello | Failed
Begin   →  (state, instance)      ← Ready | Failed
Call    →  (one message)          ← Done
Pause   →  (the instance goes)    ← Ready: its state at the end
Begin … again, or the end of the connection: the process ends.
"""

from __future__ import annotations

import socket
import struct
import time
from typing import Any, Final

import msgspec
from msgspec import Struct

from checkpoint.errors import UNDECODABLE
from failover.errors import ProgramError
from failover.kept_state.api import Resumed

FRAME_SIZE_MAX: Final = 64 << 20
"""Bytes; a state and a message stay below it."""

_LENGTH: Final = struct.Struct("!I")


class State(Struct, frozen=True):
    """A kept state, as `failover.state.Encoded`; regions: (name, content)."""

    data: bytes
    regions: tuple[tuple[str, bytes], ...] = ()


class Confinement(Struct, frozen=True):
    """What a process may have. ``uid``: as whom, 0: as the host; ``is_trusted``: nothing is taken from it."""

    uid: int = 0
    is_trusted: bool = False
    network: bool = False
    devices: tuple[str, ...] = ()
    memory_mb: int = 0


class Start(Struct, frozen=True, tag="start"):
    """Which program."""

    directory: str
    file: str
    name: str
    confinement: Confinement


class Verb(Struct, frozen=True):
    """One verb, as its declaration has it."""

    role: str
    coalesce: str
    rate_hz: float


class Hello(Struct, frozen=True, tag="hello"):
    """Its imports are done. ``enforced``, ``not_enforced``: one sentence each."""

    path: str
    aliases: tuple[str, ...]
    rate_hz: float | None
    verbs: dict[str, Verb]
    described: dict[str, Any]
    labels: dict[str, str]
    kept: tuple[str, ...]
    enforced: tuple[str, ...]
    not_enforced: tuple[str, ...]


class Begin(Struct, frozen=True, tag="begin"):
    """Take this state, None: the first one, and be ready for messages. ``resumed``: where the state comes from."""

    state: State | None
    resumed: Resumed | None = None


class Ready(Struct, frozen=True, tag="ready"):
    """The state as it is now; None: it keeps none. ``notes``: what its migration changed."""

    state: State | None
    notes: tuple[str, ...] = ()


class Call(Struct, frozen=True, tag="call"):
    """A message, as `failover.core.messaging.envelope` encodes it."""

    message: bytes


class Done(Struct, frozen=True, tag="done"):
    """Its answer, likewise. ``state``: None: as before."""

    answer: bytes
    state: State | None = None
    trouble: str = ""


class Pause(Struct, frozen=True, tag="pause"):
    """Another version takes over: let the device go."""


class Failed(Struct, frozen=True, tag="failed"):
    """It could not be done, in a sentence."""

    sentence: str


Message = Start | Hello | Begin | Ready | Call | Done | Pause | Failed


class ChannelClosedError(ProgramError):
    """The other side has ended, or did not answer in time."""


class Channel:
    """One end. Used by one thread at a time."""

    def __init__(self, connection: socket.socket) -> None:
        self._socket = connection
        self._encode = msgspec.msgpack.Encoder().encode
        self._decode = msgspec.msgpack.Decoder(Message).decode

    def fileno(self) -> int:
        """Of the connection."""
        return self._socket.fileno()

    def close(self) -> None:
        """End it."""
        self._socket.close()

    def send(self, message: Message, timeout_s: float | None = None) -> None:
        """Send one.

        Raises:
            ChannelClosedError: the other side has ended, or does not read.
        """
        content = self._encode(message)
        if len(content) > FRAME_SIZE_MAX:
            raise ProgramError(f"{len(content)} bytes of a state or message are more than {FRAME_SIZE_MAX}")
        self._socket.settimeout(timeout_s)
        try:
            self._socket.sendall(_LENGTH.pack(len(content)) + content)
        except TimeoutError:
            raise ChannelClosedError(f"its process did not read for {timeout_s:g} s") from None
        except OSError:
            raise ChannelClosedError("its process has ended") from None

    def receive(self, timeout_s: float | None = None) -> Message:
        """The next one.

        Raises:
            ChannelClosedError: the other side has ended, did not answer in time, or sent what is no message.
        """
        end = None if timeout_s is None else time.monotonic() + timeout_s
        (length,) = _LENGTH.unpack(self._exactly(_LENGTH.size, end, timeout_s))
        if length > FRAME_SIZE_MAX:
            raise ChannelClosedError("its process sent what is no message")
        try:
            found: Message = self._decode(self._exactly(length, end, timeout_s))
        except UNDECODABLE as error:
            raise ChannelClosedError(f"its process sent what is no message: {error}") from error
        return found

    def _exactly(self, size: int, end: float | None, timeout_s: float | None) -> bytes:
        parts = bytearray()
        while len(parts) < size:
            left = None if end is None else end - time.monotonic()
            if left is not None and left <= 0:
                raise ChannelClosedError(f"its process did not answer within {timeout_s:g} s")
            self._socket.settimeout(left)
            try:
                got = self._socket.recv(min(size - len(parts), 1 << 20))
            except TimeoutError:
                continue
            except OSError:
                got = b""
            if not got:
                raise ChannelClosedError("its process has ended")
            parts += got
        return bytes(parts)
