"""Takes bundles from other robots of the team: a driver ``ROBOT/programs``, to which ``failover program send --to ROBOT`` calls.

A bundle comes in parts, in order, and is checked as one that is sent on the robot itself: who signed it matters, not who brings
it. One comes at a time; one that stops coming makes room after `IDLE_S`.
"""

from __future__ import annotations

import base64
import binascii
import time
from pathlib import Path
from typing import Annotated, Final

import msgspec
from msgspec import Struct

from failover.core.programs import bundle
from failover.core.programs.archive import BUNDLE_SIZE_MAX
from failover.drivers.declare import command, driver
from failover.drivers.proxy import Proxy
from failover.errors import DriverError, ProgramError
from failover.programs.store import Store

PART: Final = 512 << 10
"""Bytes of a part: as text it fits into a message."""

IDLE_S: Final = 30.0
FINISH_S: Final = 60.0
"""How long checking and unpacking may take."""

Size = Annotated[int, msgspec.Meta(ge=1, le=BUNDLE_SIZE_MAX)]
Digest = Annotated[str, msgspec.Meta(pattern="^[0-9a-f]{64}$")]


def path_of(robot: str) -> str:
    """Under which name a robot takes bundles."""
    return f"{robot}/programs"


class Staged(Struct, frozen=True):
    """What a robot tells of a bundle that it has taken."""

    name: str
    version: str
    digest: str
    owner: str


def receiver(store: Store, team: Path, robot: str) -> type:
    """The driver, as a class for `failover.drivers.server.Serving`."""

    @driver(path_of(robot))
    class Receiver:
        """One bundle on its way."""

        def __init__(self) -> None:
            self._digest, self._size, self._at = "", 0, 0.0
            self._content = bytearray()

        @command
        def offer(self, digest: Digest, size: Size) -> int:
            """Begin a bundle; how many bytes of it are here already."""
            now = time.monotonic()
            if self._digest not in ("", digest) and now - self._at < IDLE_S:
                raise ProgramError("another bundle is on its way to this robot; try again in a minute")
            if (self._digest, self._size) != (digest, size):
                self._digest, self._size, self._content = digest, size, bytearray()
            self._at = now
            return len(self._content)

        @command
        def part(self, digest: Digest, at: int, content: str) -> int:
            """The next bytes, as base64; how many are here then."""
            if digest != self._digest or at != len(self._content):
                raise ProgramError("these bytes do not follow those that are here; send the bundle again")
            try:
                found = base64.b64decode(content, validate=True)
            except binascii.Error as error:
                raise ProgramError(f"these bytes are no base64: {error}") from error
            if len(self._content) + len(found) > self._size:
                raise ProgramError("these are more bytes than were offered; send the bundle again")
            self._content += found
            self._at = time.monotonic()
            return len(self._content)

        @command
        def finish(self, digest: Digest) -> Staged:
            """Check it, and keep it."""
            content, self._digest, self._content = bytes(self._content), "", bytearray()
            if len(content) != self._size or bundle.digest_of(content) != digest:
                raise ProgramError("the bundle has not come whole; send it again")
            found = store.take(content, team)
            said = found.program.manifest
            return Staged(said.name, said.version, found.program.digest, found.owner)

    return Receiver


def send(proxy: Proxy, content: bytes) -> Staged:
    """Bring a bundle to a robot.

    Raises:
        CallRefusedError: that robot does not take it; says why.
        DriverError: what answers there takes no bundles.
        NoAnswerError: it does not answer.
    """
    digest = bundle.digest_of(content)
    at = proxy.told("offer", int, {"digest": digest, "size": len(content)})
    _check_at(proxy, at, max(0, min(at, len(content))))
    while at < len(content):
        part = content[at : at + PART]
        expected = at + len(part)
        at = proxy.told("part", int, {"digest": digest, "at": at, "content": base64.b64encode(part).decode()})
        _check_at(proxy, at, expected)
    return proxy.told("finish", Staged, {"digest": digest}, timeout=FINISH_S)


def _check_at(proxy: Proxy, at: int, expected: int) -> None:
    if at != expected:
        raise DriverError(f"{proxy.path} has {at} bytes of the bundle, and {expected} were sent; send the bundle again")
