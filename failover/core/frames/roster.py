"""The roster: every member of the team file in the order W, so that a small number, the *rank*, names a member in a frame.

Two robots with the same team file compute the same roster and the same digest. A frame with another digest is not read: its
ranks would name other robots. A set of ranks travels as one *word* of 64 bits, and what a robot sees of each member (two bits) as
words of 32 ranks.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from hashlib import blake2b

from msgspec import Struct

from failover.core.types import PEERS_MAX
from failover.core.wire.names import weight

RANKS_MAX = PEERS_MAX + 1
"""Members of a roster: a set of them is one word. Generations hold the same limit (epoch × 64 + place)."""

SEEN_BITS = 2
SEEN_PER_WORD = 64 // SEEN_BITS
SEEN_MASK = (1 << SEEN_BITS) - 1

_PERSON = b"failover-roster1"


class Roster(Struct, frozen=True, dict=True):
    """Who is who in a frame.

    Attributes:
        names: by rank.
        terms: the digest of whatever else must be the same at every robot: the board's items. b"" for nothing.
    """

    names: tuple[str, ...]
    terms: bytes = b""

    def __len__(self) -> int:
        return len(self.names)

    @functools.cached_property
    def ranks(self) -> dict[str, int]:
        """Name → rank."""
        return {name: rank for rank, name in enumerate(self.names)}

    @functools.cached_property
    def everybody(self) -> int:
        """The word of all ranks."""
        return (1 << len(self.names)) - 1

    @functools.cached_property
    def digest(self) -> int:
        """64 bits over names and terms, each with its length before it; a frame holds the low 32."""
        hashed = blake2b(digest_size=8, person=_PERSON)
        for text in (self.terms, *(name.encode() for name in self.names)):
            hashed.update(len(text).to_bytes(4, "little") + text)
        return int.from_bytes(hashed.digest(), "little")

    @functools.cached_property
    def short_digest(self) -> int:
        """What a frame carries: the low 32 bits."""
        return self.digest & 0xFFFFFFFF


def roster(members: Iterable[str], terms: bytes = b"") -> Roster:
    """The roster of these members, in whatever order they come.

    Raises:
        ValueError: there are more than `RANKS_MAX`; the team file is checked for that before.
    """
    names = tuple(sorted(set(members), key=weight))
    if len(names) > RANKS_MAX:
        raise ValueError(f"{len(names)} members are over the limit of {RANKS_MAX}")
    return Roster(names, terms)


def word(ranks: Iterable[int]) -> int:
    """A set of ranks as one word: bit r is rank r."""
    bits = 0
    for rank in ranks:
        bits |= 1 << rank
    return bits


def ranks_in(bits: int) -> tuple[int, ...]:
    """The ranks of a word, ascending."""
    return tuple(rank for rank in range(bits.bit_length()) if bits >> rank & 1)


def place_in(bits: int, rank: int) -> int:
    """How many ranks of a word are lower than ``rank``."""
    return (bits & ((1 << rank) - 1)).bit_count()


def pack_seen(seen: Sequence[int]) -> tuple[int, ...]:
    """What is seen of each rank (0 to 3), two bits each, as words of 32 ranks; rank 0 in the lowest bits."""
    return tuple(_packed(seen[first : first + SEEN_PER_WORD]) for first in range(0, len(seen), SEEN_PER_WORD))


def _packed(seen: Sequence[int]) -> int:
    packed = 0
    for place, value in enumerate(seen):
        packed |= value << SEEN_BITS * place
    return packed


def seen_of(words: Sequence[int], count: int) -> int | None:
    """All words as one number, of which bits 2r and 2r + 1 are of rank r; None if they are not of a roster of ``count``."""
    if len(words) != -(-count // SEEN_PER_WORD):
        return None
    together = 0
    for place, one in enumerate(words):
        if not 0 <= one < 1 << 64:
            return None
        together |= one << 64 * place
    return None if together >> SEEN_BITS * count else together


def unpack_seen(words: Sequence[int], count: int) -> tuple[int, ...] | None:
    """The inverse of `pack_seen`, for a roster of ``count``; None if the words are not of such a roster."""
    together = seen_of(words, count)
    return None if together is None else tuple(together >> SEEN_BITS * rank & SEEN_MASK for rank in range(count))
