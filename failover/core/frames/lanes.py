"""All lanes of one robot's frames: one for the links without slots, one for each medium with slots.

A lane counts its parts by itself, so that a robot that hears one medium only misses nothing there. Lanes of media on which this
robot only hears, because it keeps no slots there, are made when the first frame comes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from failover.core.frames.frame import KEYS_PER_SENDER, MAGIC, VERSION, Reason, Refused
from failover.core.frames.lane import FrameLane, Heard
from failover.core.frames.roster import Roster

MEDIA_MAX: Final = 8
"""Media with slots: more links than a robot has."""

OURS: Final = MAGIC + bytes([VERSION])
"""How a frame of this version begins."""

_MEDIUM: Final = slice(6, 8)


def medium_of(datagram: bytes) -> int:
    """The number of the medium that a datagram names; it proves nothing before the datagram is authenticated."""
    return int.from_bytes(datagram[_MEDIUM], "little")


class FrameLanes:
    """Lanes by the number of their medium.

    Args:
        make: a new lane of that medium.
    """

    def __init__(self, make: Callable[[int], FrameLane]) -> None:
        self._make = make
        self._spoken: dict[str, bytes] = {}
        self._heard: dict[str, tuple[bytes, ...]] = {}
        self._lanes = {0: make(0)}

    def lane(self, medium: int) -> FrameLane:
        """The lane of a medium, 0 to `MEDIA_MAX`."""
        assert 0 <= medium <= MEDIA_MAX, medium
        if medium not in self._lanes:
            lane = self._lanes[medium] = self._make(medium)
            for peer, key in self._spoken.items():
                lane.speak(peer, key)
            for peer, keys in self._heard.items():
                for key in keys:
                    lane.hear(peer, key)
        return self._lanes[medium]

    def change(self, roster: Roster, make: Callable[[int], FrameLane]) -> None:
        """Go on with these members. Args: make: a new lane of a medium, for them."""
        self._make = make
        self._spoken = {peer: key for peer, key in self._spoken.items() if peer in roster.ranks}
        self._heard = {peer: keys for peer, keys in self._heard.items() if peer in roster.ranks}
        self._lanes = {medium: lane.changed(roster) for medium, lane in self._lanes.items()}

    def speak(self, peer: str, key: bytes) -> None:
        """The peer knows now that we seal with this key."""
        self._spoken[peer] = key
        for lane in self._lanes.values():
            lane.speak(peer, key)

    def hear(self, peer: str, key: bytes) -> None:
        """The peer seals with this key from now on.

        Raises:
            ValueError: see `FrameLane.hear`.
        """
        for lane in self._lanes.values():
            lane.hear(peer, key)
        before = [one for one in self._heard.get(peer, ()) if one != key]
        self._heard[peer] = (*before, key)[-KEYS_PER_SENDER:]

    def forget_older(self, peer: str) -> None:
        """See `FrameLane.forget_older`."""
        self._heard[peer] = self._heard.get(peer, ())[-1:]
        for lane in self._lanes.values():
            lane.forget_older(peer)

    def open(self, datagram: bytes, came_ns: int) -> Heard | Refused:
        """The part inside, or why it is not believed. Never raises for any bytes."""
        medium = int.from_bytes(datagram[_MEDIUM], "little")
        lane = self._lanes.get(medium)
        if lane is None:
            if medium > MEDIA_MAX:
                if datagram.startswith(OURS):
                    return Refused(Reason.NOT_OURS)
                lane = self._lanes[0]  # in another version, these bytes mean another thing: say of it what it is
            else:
                lane = self.lane(medium)
        return lane.open(datagram, came_ns)

    def all(self) -> tuple[FrameLane, ...]:
        """Those that there are."""
        return tuple(self._lanes.values())
