"""One robot's frames on one medium: seals what it says, opens what others say, and bounds how long that was on its way.

The same object serves the agent and the simulator. Time is an argument; the sockets are the caller's.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from typing import Final

import msgspec
from msgspec import Struct

from failover.core.frames.assembly import Assembly
from failover.core.frames.casts import Casts
from failover.core.frames.clock_offset import ClockOffset
from failover.core.frames.frame import (
    NO_CASTS,
    Part,
    Portion,
    Receiver,
    Refused,
    Sealer,
    bodies,
    body_size_max,
    codes,
    echoes_max,
)
from failover.core.frames.roster import Roster
from failover.core.frames.terms import US, Said
from failover.core.wire.messages import Beat

LEFT_MAX: Final = 256
"""Parts of ours whose instant of leaving is remembered: several seconds."""

ECHOED_NS: Final = 1_000_000_000
"""For so long a frame is echoed: an older one says nothing of today's ways."""


class Sealed(Struct, frozen=True):
    """The datagrams of one frame, and to whom they go."""

    to: tuple[str, ...]
    datagrams: list[bytes]


class Heard(Struct, frozen=True, gc=False):
    """A part that was believed.

    Attributes:
        items: of its items those that are whole now.
        way_ns: the longest that it can have been on its way; None: not known.
        missing: parts of its sender that did not come over this medium since the newest one before it.
    """

    part: Part
    items: Sequence[Portion]
    way_ns: int | None
    missing: int = 0


class _Peer(Struct):
    """What the frames of one peer told.

    Attributes:
        boot, counter, came_ns: of its newest part.
        has_heard: it has heard this life of ours, so that what it echoes are our counters.
    """

    offset: ClockOffset
    boot: int = 0
    counter: int = 0
    came_ns: int = 0
    has_heard: bool = False


class FrameLane:
    """The frames of one life of one robot on one medium.

    Args:
        round_us: between two of its frames.
        medium: its number; 0: all links.
        bounds_ways: bound how long frames are on their way. Only ages of items need it: a team without a board does without.

    Attributes:
        casts: None where no frame can be cast: each member gets a datagram of its own, or no link of this robot is known to cast.
    """

    def __init__(
        self, me: str, team: str, roster: Roster, boot: int, round_us: int, medium: int = 0, *, bounds_ways: bool = True
    ) -> None:
        self._me, self._rank, self._boot, self._medium = me, roster.ranks[me], boot, medium
        self._team, self._roster = team, roster
        self._round_us, self._bounds_ways = round_us, bounds_ways
        self._others = tuple(name for name in roster.names if name != me)
        self._sealer = Sealer(me, team, roster, boot)
        self._receiver = Receiver(me, team, roster)
        self._keys: dict[str, bytes] = {}
        self._peers = {rank: _Peer(ClockOffset()) for name, rank in roster.ranks.items() if name != me}
        self._left: OrderedDict[int, int] = OrderedDict()
        self._room, self._codes, self._echoes = body_size_max(len(roster)), codes(len(roster)), echoes_max(len(roster))
        self._shares = self._shared()
        self._echo_from = 0
        self.assembly = Assembly()
        self.casts: Casts | None = None

    def changed(self, roster: Roster) -> FrameLane:
        """The same life in another team: parts are counted on, and what is known of members that stay is kept.

        Its `casts` are None: ranks have changed, and who hears casts is found out anew.
        """
        other = FrameLane(self._me, self._team, roster, self._boot, self._round_us, self._medium, bounds_ways=self._bounds_ways)
        other._sealer.counter = self._sealer.counter
        other._receiver = self._receiver.changed(self._team, self._me, roster)
        other._keys = {peer: key for peer, key in self._keys.items() if peer in other._others}
        other._shares = other._shared()
        other._left, other.assembly = self._left, self.assembly
        for name, rank in self._roster.ranks.items():
            if name in other._others:
                other._peers[roster.ranks[name]] = self._peers[rank]
        return other

    @property
    def is_shared(self) -> bool:
        """Whether one datagram is for all members, so that it can be cast."""
        return len(self._others) == self._codes

    @property
    def counter(self) -> int:
        """Of the last part that was sealed."""
        return self._sealer.counter

    def speak(self, peer: str, key: bytes) -> None:
        """The peer knows now that we seal with this key."""
        if peer in self._others:
            self._keys[peer] = key
            self._shares = self._shared()

    def _shared(self) -> list[tuple[tuple[str, ...], list[bytes]]]:
        """Who gets a datagram with which keys' authenticators."""
        to = tuple(peer for peer in self._others if peer in self._keys)
        keys = [self._keys.get(peer, b"") for peer in self._others]
        return [(to, keys)] if len(keys) == self._codes else [((peer,), [self._keys[peer]]) for peer in to]

    def hear(self, peer: str, key: bytes) -> None:
        """The peer seals with this key from now on.

        Raises:
            ValueError: the key is too short, or there are more peers than a team has robots.
        """
        self._receiver.accept(peer, key)

    def forget_older(self, peer: str) -> None:
        """The peer seals with its newest key alone: whoever told us the others may not speak for it any more."""
        self._receiver.forget_older(peer)

    def seal(
        self,
        beat: Beat | None,
        items: Sequence[Portion],
        now_ns: int,
        said: Said | None = None,
        *,
        flags: int = 0,
        round_: int = 0,
    ) -> tuple[list[Sealed], int]:
        """A frame for everybody who knows our key, and how many of the items, the first ones, are in it.

        Args:
            items: with their ages at ``now_ns``, the instant right before the frame leaves.
            said: of our slots; None: there are none, and only the echoes are told, if ways are bounded.
        """
        if said is None and self._bounds_ways:
            said = Said(self._round_us, 0, 0, (), self._echo(now_ns))
        elif said is not None and len(said.echo) > self._echoes:
            said = msgspec.structs.replace(said, echo=self._some(said.echo))
        casts = self.casts.says() if self.casts is not None else NO_CASTS
        parts, placed = bodies(said, beat, items, now_ns // US, self._room, casts)
        made: list[Sealed] = []
        seal = self._sealer.seal
        for to, keys in self._shares:
            sealed = seal(parts, keys, medium=self._medium, flags=flags, round_=round_, again=bool(made))
            made.append(Sealed(to, sealed))
        if self._bounds_ways and made:
            left, counter = self._left, self._sealer.counter
            for number in range(counter - len(parts) + 1, counter + 1):
                left[number] = now_ns
            while len(left) > LEFT_MAX:
                left.popitem(last=False)
        return made, placed

    def open(self, datagram: bytes, came_ns: int) -> Heard | Refused:
        """The part inside, or why it is not believed. Never raises for any bytes.

        Args:
            came_ns: when it came; it may have come earlier, not later.
        """
        part = self._receiver.open(datagram)
        if isinstance(part, Refused):
            return part
        peer = self._peers.get(part.rank)
        if peer is None or not part.alike:
            return Heard(part, (), None)
        if part.casts and self.casts is not None:
            self.casts.told(part.rank, part.casts)
        if not self._bounds_ways and not part.items:
            return Heard(part, (), None)
        if part.boot > peer.boot:
            peer = self._peers[part.rank] = _Peer(ClockOffset(), part.boot)
            self.assembly.forget(part.sender)
        missing = 0
        if part.counter > peer.counter:
            missing = part.counter - peer.counter - 1 if peer.counter else 0
            peer.counter, peer.came_ns = part.counter, came_ns
        way_ns = self._way_ns(peer, part, came_ns)
        return Heard(part, self._whole(part), way_ns, missing)

    def _whole(self, part: Part) -> Sequence[Portion]:
        for item in part.items:
            if item.total:
                break
        else:
            return part.items
        whole = [self.assembly.take(part.sender, item) for item in part.items]
        return [item for item in whole if item is not None]

    def clock_of(self, rank: int) -> ClockOffset:
        """What is known of a peer's clock. For people and for messages, never for a rule."""
        return self._peers[rank].offset

    def _way_ns(self, peer: _Peer, part: Part, came_ns: int) -> int | None:
        left_ns = part.left_us * US
        peer.offset.heard(left_ns, came_ns)
        if not peer.has_heard and part.beat is not None:
            peer.has_heard = any(echo.robot == self._me and echo.boot == self._boot for echo in part.beat.echoes)
        if part.slots is not None and peer.has_heard:
            ours = self._rank
            for rank, counter, hold_us in part.slots.echo:
                if rank == ours and counter in self._left and hold_us >= 0:
                    return peer.offset.echoed(self._left[counter], left_ns, hold_us * US, came_ns)
        return peer.offset.most_ns(left_ns, came_ns)

    def _echo(self, now_ns: int) -> tuple[tuple[int, int, int], ...]:
        """Of whom we have heard lately; in a large team of some, in turn."""
        since_ns, echoes = now_ns - ECHOED_NS, []
        for rank, peer in self._peers.items():
            if peer.came_ns > since_ns and peer.counter:
                echoes.append((rank, peer.counter, max(now_ns - peer.came_ns, 0) // US))
        return self._some(tuple(echoes)) if len(echoes) > self._echoes else tuple(echoes)

    def _some(self, echoes: tuple[tuple[int, int, int], ...]) -> tuple[tuple[int, int, int], ...]:
        """As many as a frame has room for, in turn: there are more."""
        self._echo_from = (self._echo_from + self._echoes) % len(echoes)
        return (echoes + echoes)[self._echo_from : self._echo_from + self._echoes]
