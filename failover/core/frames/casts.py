"""Who hears what this robot casts. A frame that is cast is one datagram for all members; a switch, an access point or a filter
may drop it and tell no robot of it.

So each frame says, for each link of its sender, which part of each member came last by cast over that link. A robot sends to a
member by unicast besides, unless that member has said that it heard a cast of the last moments. Silence proves nothing: a member
from which nothing comes gets its frames by unicast, too.
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from typing import Final

LINKS_MAX: Final = 2
"""Links whose casts are told of: a frame has room for two beside a heartbeat. Over further links frames go by unicast."""

LEFT_MAX: Final = 256
"""Parts of ours that are remembered: more than leave in the moments that count."""

COUNTER_SIZE: Final = 2
"""Bytes of a counter: its low half suffices, for only the newest ones are looked up."""

_LOW: Final = (1 << 8 * COUNTER_SIZE) - 1


class Casts:
    """The casts of one robot, and those that it hears.

    Args:
        me: our rank; ``members``: how many ranks there are.
        ways: rank of a member → (our link, its link) pairs over which we send to it.
    """

    def __init__(self, me: int, members: int, ways: Mapping[int, Sequence[tuple[int, int]]]) -> None:
        self._me, self._members, self._size = me, members, COUNTER_SIZE * members
        self._low_halves = struct.Struct(f"<{members}H")
        self._ways = ways
        self._heard: list[list[int]] = []
        self._lives: dict[int, int] = {}
        self._said: tuple[bytes, ...] | None = ()
        self._left: tuple[OrderedDict[int, int], ...] = tuple(OrderedDict() for _ in range(LINKS_MAX))
        self._proved_ns: dict[tuple[int, int], int] = {}
        self._claims: dict[tuple[int, int], int] = {}

    # --- What we hear ---

    def heard(self, place: int, rank: int, boot: int, counter: int) -> None:
        """A part of that member came by cast over our link ``place``."""
        if not 0 <= place < LINKS_MAX or boot < self._lives.get(rank, 0):
            return
        if boot > self._lives.get(rank, 0):
            self._lives[rank] = boot
            for counters in self._heard:
                counters[rank] = 0
        while len(self._heard) <= place:
            self._heard.append([0] * self._members)
        if counter > self._heard[place][rank]:
            self._heard[place][rank] = counter
            self._said = None

    def heard_again(self, place: int, rank: int, counter: int) -> None:
        """A copy of a part that had come already came by cast over our link ``place``."""
        self.heard(place, rank, self._lives.get(rank, 0), counter)

    def says(self) -> tuple[bytes, ...]:
        """For a frame of ours: for each of our links the low half of the counter of each rank's newest cast; 0: none."""
        if self._said is None:
            self._said = tuple(self._low_halves.pack(*[counter & _LOW for counter in counters]) for counters in self._heard)
        return self._said

    # --- Who hears us ---

    def left(self, place: int, counter: int, now_ns: int) -> None:
        """A part of ours leaves by cast over our link ``place``."""
        left = self._left[place]
        left[counter & _LOW] = now_ns
        if len(left) > LEFT_MAX:
            left.popitem(last=False)

    def told(self, rank: int, casts: Sequence[bytes]) -> None:
        """A member's frame said what it heard. Of whatever was not cast lately it proves nothing; never raises.

        One that hears no casts any more repeats the last one that it heard, of which a later part has the low half, too.
        """
        at = COUNTER_SIZE * self._me
        for ours, theirs in self._ways.get(rank, ()):
            if ours >= LINKS_MAX or theirs >= len(casts) or len(casts[theirs]) != self._size:
                continue
            claim, way = int.from_bytes(casts[theirs][at : at + COUNTER_SIZE], "little"), (rank, ours)
            if claim in (0, self._claims.get(way)):
                continue
            self._claims[way] = claim
            left_ns = self._left[ours].get(claim)
            if left_ns is not None and left_ns > self._proved_ns.get(way, 0):
                self._proved_ns[way] = left_ns

    def forget(self, place: int) -> None:
        """Over our link ``place`` frames are cast in another way from now on: who heard the way before may not hear this one."""
        self._left[place].clear()
        for rank, ours in [one for one in self._proved_ns if one[1] == place]:
            del self._proved_ns[rank, ours]

    def hears(self, rank: int, place: int, since_ns: int) -> bool:
        """Whether the member has said that it heard a cast over our link ``place`` that left since then."""
        return self._proved_ns.get((rank, place), 0) >= since_ns
