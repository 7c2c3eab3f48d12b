"""The item of a component, at the robot that is its primary: it follows a takeover.

An item belongs to a robot. A program that is taken over puts the same item at another robot. A reader that wants what the program
puts asks by the component. The agent tells which robot that is, in a file of the board that it alone writes.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

import msgspec
from msgspec import Struct

from checkpoint.errors import UNDECODABLE
from failover.core.board.banks import EPOCH_SHIFT, Reading
from failover.errors import BoardError, NeverWrittenError

SLICE_S: Final = 0.02
"""The longest sleep without a look at who is the primary: about a round of the agents."""


class Readable(Protocol):
    """The part of an item that is needed here (`failover.boards.item.Item`)."""

    @property
    def name(self) -> str: ...
    @property
    def get(self) -> Callable[..., Any]: ...
    def is_at(self, robot: str) -> bool: ...
    def rest(self, robot: str, timeout_s: float) -> None: ...


class Primary(Struct, frozen=True, array_like=True):
    """Where a component runs, as this robot's agent sees it.

    Attributes:
        robot: its primary.
        epoch: number of this primacy: the fencing token of the copy that runs.
        since_ns: BOOTTIME of this machine at which the agent saw another primary become this one.
    """

    robot: str
    epoch: int
    since_ns: int


_decode: Final = msgspec.msgpack.Decoder(dict[str, Primary]).decode
encode: Final = msgspec.msgpack.Encoder().encode


def decode(content: bytes) -> Mapping[str, Primary]:
    """The agent's table: component → primary.

    Raises:
        BoardError: it is none.
    """
    try:
        return _decode(content)
    except UNDECODABLE as error:
        raise BoardError(f"damaged: the agent's table of primaries: {error}") from None


class ComponentItem:
    """A handle of one item of one component, to read. Like `Item`, without `put`.

    It remembers from which robot it read last. Between a takeover and the first put of the new copy it still gives what the copy
    before put last, as old as it is by then. What another robot put in an earlier primacy it never gives in place of that.
    """

    def __init__(self, item: Readable, component: str, primary: Callable[[str], Primary], now_ns: Callable[[], int]) -> None:
        self._item, self._component = item, component
        self._primary, self._now_ns = primary, now_ns
        self._last: tuple[str, int] | None = None

    @property
    def robot(self) -> str:
        """The primary of the component now.

        Raises:
            BoardError: the agent knows none.
        """
        return self._primary(self._component).robot

    def get(self) -> Reading:
        """The newest value of the component.

        Raises:
            NeverWrittenError: the copy that runs now has not put it, and this handle has read none of a copy before.
            BoardError: the agent knows no primary of the component; no agent runs here; see `Item.get`.
        """
        primary = self._primary(self._component)
        reading = self._of(primary.robot)
        if reading is not None and self._is_of(primary, reading):
            self._last = (reading.robot, reading.number)
            return reading
        if self._last is not None:
            reading = self._of(self._last[0])
            if reading is not None and reading.number >= self._last[1]:
                return reading
        raise NeverWrittenError(
            f"item {self._item.name!r} of {self._component}: it runs on {primary.robot} under epoch {primary.epoch}, and has not "
            "put it there yet"
        )

    def _of(self, robot: str) -> Reading | None:
        """What a robot has; None where it has not the item, or has never put it."""
        try:
            reading: Reading = self._item.get(robot)
        except NeverWrittenError:
            return None
        except BoardError:
            if self._item.is_at(robot):
                raise
            return None
        return reading

    def _is_of(self, primary: Primary, reading: Reading) -> bool:
        """Whether the copy that runs now put it: under its epoch, or since it runs there (its epoch may grow while it runs)."""
        return reading.number >> EPOCH_SHIFT >= primary.epoch or self._now_ns() - reading.age_ns >= primary.since_ns

    def wait(self, after: int | None = None, timeout: float | None = None) -> Reading:
        """Sleep until there is another reading than number ``after``; then as `get`. It follows a takeover while it sleeps.

        Args:
            after: `Reading.number` of the newest that is known; None: the newest at the call.
            timeout: seconds; None: for ever.

        Raises:
            TimeoutError: there was none.
        """
        end = None if timeout is None else time.monotonic() + timeout
        known = after
        if known is None:
            reading = self._tried()
            known = 0 if reading is None else reading.number
        while True:
            reading = self._tried()
            if reading is not None and reading.number != known:
                return reading
            left = SLICE_S if end is None else end - time.monotonic()
            if left <= 0:
                raise TimeoutError(f"item {self._item.name!r} of {self._component} was not put within {timeout} s")
            self._sleep(min(left, SLICE_S))

    def _tried(self) -> Reading | None:
        try:
            return self.get()
        except NeverWrittenError:
            return None

    def _sleep(self, span_s: float) -> None:
        """Until the primary puts, and not longer than this."""
        try:
            self._item.rest(self.robot, span_s)
        except BoardError:
            time.sleep(span_s)
