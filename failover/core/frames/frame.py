"""A team frame ⇄ authenticated datagrams. ``FRAME.md`` has the byte table.

A *frame* is what one robot says at one instant: where it stands in its round (`Said`), its heartbeat (`Beat`), and the items of
its board that are due (`Portion`). It leaves as one datagram, or as several *parts*. Each part is sealed by itself for every
receiver: a member can check what another one says, and cannot say it in the other's name.

An incoming datagram is untrusted until its authenticator is checked, so nothing here raises for it: `Receiver.open` returns the
part, or a `Refused` that says why.
"""

from __future__ import annotations

import enum
import functools
import hmac
import struct
from collections.abc import Iterable, Sequence
from hashlib import blake2b
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, Struct

from checkpoint.errors import UNDECODABLE
from failover.core.frames import casts as frame_casts
from failover.core.frames.roster import RANKS_MAX, SEEN_PER_WORD, Roster
from failover.core.frames.terms import Said
from failover.core.types import PEERS_MAX
from failover.core.wire.codec import NUMBER_MAX, is_sound, team_tag
from failover.core.wire.messages import Beat

VERSION: Final = 1

FRAME_SIZE_MAX: Final = 1_200
"""Bytes of a part: passes every path of the Internet in one piece (RFC 9000, section 14.1)."""

PARTS_MAX: Final = 64
"""Of one frame: 70 KB. What is due beyond that waits for the next frame."""

CODES_MAX: Final = 16
"""Receivers of one part: a team with more members gets a part for each receiver, with one authenticator."""

KEY_SIZE_MIN: Final = 16
"""Bytes of a key that is worth checking against."""

WINDOW: Final = 64
"""Counters below the highest one that may still arrive, each once (RFC 4303, section 3.4.3)."""

KEYS_PER_SENDER: Final = 2
"""The present key and the one before it, while a new one is being handed over."""

ITEM_SIZE_MAX: Final = 64 << 10
"""Bytes of an item's value, as the board's layout has it."""

AGE_US_MAX: Final = (1 << 32) - 1
"""An age of an hour and more: told as this."""

LEFT_US_MAX: Final = (1 << 53) - 1
"""285 years after a start: as nanoseconds it fits 63 bits."""

MAGIC: Final = b"fF"
MAGIC_BEFORE: Final = b"fB"
"""Of the heartbeats of older releases: a robot that still sends them is not understood, and it lives."""

SLOTTED, LAST, GROUP_KEY, LISTENS_ONLY = 1, 2, 4, 8
"""Flags: the sender keeps slots; last part of its slot; (reserved) sealed with one key for all; the sender listens only."""

NO_RANK: Final = -1

HEADER: Final = struct.Struct("<2sBBHH8sIIQQIBBH")
CODE_SIZE: Final = 8
NUMBER_SIZE: Final = 2
SEAL_SIZE: Final = NUMBER_SIZE + CODE_SIZE
"""Of one authenticator: which key, and the code under it."""

DIGEST_SIZE: Final = 32
_PERSON: Final = b"failover-frame-1"
_EMPTY: Final = blake2b(digest_size=DIGEST_SIZE, person=_PERSON)
_NO_SEAL: Final = bytes(SEAL_SIZE)
_FIRST: Final = range(1)

PIECE_HEAD: Final = 1 + 5 + 5 + 9 + 3 + 5 + 5
"""Most bytes of an item in a frame, or of a piece of it, without its value."""

ECHO_SIZE_MAX: Final = 1 + 1 + 9 + 5
"""Bytes of one of the slots' echoes."""

ECHOES_OF_MANY: Final = 4

PIECE_SIZE_MIN: Final = 64
"""Less than this of a value does not begin in the rest of a part."""

BODY_HEAD: Final = 1 + 1 + 1 + 3 + 9
"""Bytes of a body without content: the array's head, no slots, no beat, the head of many items, the instant."""

NO_CASTS: Final[tuple[bytes, ...]] = ()


class Reason(enum.StrEnum):
    """Why a frame was not believed."""

    NOT_OURS = "not a frame"
    VERSION = "another version"
    TEAM = "another team"
    PART = "a part beyond its parts"
    ROSTER = "another roster"
    UNKNOWN_KEY = "unknown key"
    UNSEALED = "sealed for other robots only"
    FORGED = "wrong authentication code"
    MALFORMED = "not a well-formed frame"
    SENDER = "key of another sender"
    REPLAYED = "seen before, or too old"
    EARLIER_LIFE = "from an earlier life of its sender"


class Refused(Struct, frozen=True, gc=False):
    """A datagram that was not believed.

    Attributes:
        sender: known only where the code was right.
        counter: of a frame that was seen before, or is too old.
    """

    reason: Reason
    sender: str = ""
    counter: int = 0


class Portion(Struct, frozen=True, array_like=True, gc=False):
    """One item's value in a frame, or a part of it.

    Attributes:
        number: of the item, as the board counts them.
        age_us: at the instant at which the frame left; `AGE_US_MAX`: that or more.
        put: number of the put, so that a receiver tells a repeated value from a new one.
        total: bytes of the whole value, of which these begin at ``offset``; 0: this is all of it.
    """

    number: Annotated[int, Meta(ge=0, lt=1 << 32)]
    age_us: Annotated[int, Meta(ge=0, le=AGE_US_MAX)]
    put: Annotated[int, Meta(ge=1)]
    value: bytes
    offset: Annotated[int, Meta(ge=0, lt=ITEM_SIZE_MAX)] = 0
    total: Annotated[int, Meta(ge=0, le=ITEM_SIZE_MAX)] = 0

    @property
    def is_sound(self) -> bool:
        """Whether it lies inside of its value."""
        if self.total == 0:
            return self.offset == 0
        return 0 < len(self.value) <= self.total - self.offset


class Body(Struct, frozen=True, array_like=True, gc=False):
    """What a part says. ``slots`` and ``beat`` are in the first part of a frame, or absent.

    Attributes:
        left_us: instant of the ages of its items, by the sender's clock.
        casts: which casts the sender heard (`failover.core.frames.casts`); in the first part of a frame, if of any.
    """

    slots: Said | None = None
    beat: Beat | None = None
    items: tuple[Portion, ...] = ()
    left_us: Annotated[int, Meta(ge=0, le=LEFT_US_MAX)] = 0
    casts: tuple[bytes, ...] = NO_CASTS


class Part(Struct, frozen=True, gc=False):
    """An authenticated part of a frame.

    Attributes:
        sender: by its key; ``rank``: its rank in our roster, `NO_RANK` if it has none.
        alike: the sender's roster is ours. If it is not, neither `slots` nor `items` were read: their numbers mean other things.
        boot, counter: life of the sender, and place of this part among all its parts of that life.
    """

    sender: str
    alike: bool
    rank: int
    medium: int
    flags: int
    boot: int
    counter: int
    round: int
    part: int
    parts: int
    slots: Said | None
    beat: Beat | None
    items: tuple[Portion, ...]
    left_us: int
    casts: tuple[bytes, ...] = NO_CASTS


_encode = msgspec.msgpack.Encoder().encode
_decode = msgspec.msgpack.Decoder(Body).decode


# --- Sealing ---------------------------------------------------------------------------------------------------------


def codes(members: int) -> int:
    """Authenticators of each part in a team of so many: one for each receiver, or one alone."""
    return members - 1 if members - 1 <= CODES_MAX else 1


def body_size_max(members: int) -> int:
    """Bytes of a part's body in a team of so many."""
    return FRAME_SIZE_MAX - HEADER.size - SEAL_SIZE * codes(members)


def beat_size_max(members: int) -> int:
    """Bytes of a beat that fits a part beside the slots, in a team of so many."""
    views = 1 + 9 * -(-members // SEEN_PER_WORD)
    slots = 1 + 5 + 9 + 5 + views + 3 + ECHO_SIZE_MAX * echoes_max(members)
    return body_size_max(members) - BODY_HEAD + 2 - slots - casts_size_max(members)


def casts_size_max(members: int) -> int:
    """Bytes of what a frame says of casts; a team of which each member gets a datagram of its own has none."""
    counters = 2 + frame_casts.COUNTER_SIZE * members
    return 1 + frame_casts.LINKS_MAX * counters if members - 1 <= CODES_MAX else 0


def echoes_max(members: int) -> int:
    """Peers whose frames one frame echoes, in a team of so many: all; in a large one some, in turn."""
    return members - 1 if members - 1 <= CODES_MAX else ECHOES_OF_MANY


def size_of(value: Any) -> int:
    """Bytes of a part of a body."""
    return len(_encode(value))


def bodies(
    said: Said | None,
    beat: Beat | None,
    items: Sequence[Portion],
    left_us: int,
    room: int,
    casts: tuple[bytes, ...] = NO_CASTS,
) -> tuple[list[bytes], int]:
    """The bodies of a frame's parts, each of at most ``room`` bytes, and how many of the items, the first ones, found a place.

    An item that is longer than a part has room goes in several; they follow each other.
    """
    tail = (left_us, casts) if casts else (left_us,)
    whole = _encode((said, beat, items, *tail))
    if len(whole) <= room:
        return [whole], len(items)
    parts: list[list[Portion]] = [[]]
    fresh = room - BODY_HEAD
    left = fresh + 2 - size_of(said) - size_of(beat) - (size_of(casts) if casts else 0)
    assert left >= 0, f"slots and beat do not fit the {room} bytes of a part"
    placed = 0
    for item in items:
        count, last = len(parts), len(parts[-1])
        for piece in _pieces(item, left, fresh):
            size = size_of(piece)
            if size > left:
                parts.append([])
                left = fresh
            parts[-1].append(piece)
            left -= size
        if len(parts) > PARTS_MAX:
            del parts[count:], parts[-1][last:]
            break
        placed += 1
    first, *others = parts
    rest = [_encode((None, None, part, left_us)) for part in others]
    return [_encode((said, beat, first, *tail)), *rest], placed


def _pieces(item: Portion, left: int, fresh: int) -> Iterable[Portion]:
    """The item, if a part has room for all of it; else what it is cut into.

    Args:
        left: bytes that are left of the present part; ``fresh``: of each that follows.
    """
    value, size = item.value, len(item.value)
    if size + PIECE_HEAD <= fresh:
        yield item
        return
    step = left if left >= PIECE_HEAD + PIECE_SIZE_MIN else fresh
    at = 0
    while at < size:
        piece = value[at : at + step - PIECE_HEAD]
        yield Portion(item.number, item.age_us, item.put, piece, at, size)
        at += len(piece)
        step = fresh


class Sealer:
    """Seals what one robot says in one of its lives. ``counter`` is that of the last part."""

    def __init__(self, me: str, team: str, roster: Roster, boot: int) -> None:
        self._rank = roster.ranks[me]
        self._tag, self._name, self._roster = team_tag(team), name_tag(me), roster.short_digest
        self._boot = boot
        self.counter = 0

    def seal(
        self,
        bodies: Sequence[bytes],
        keys: Sequence[bytes],
        *,
        medium: int = 0,
        flags: int = 0,
        round_: int = 0,
        again: bool = False,
    ) -> list[bytes]:
        """The datagrams of one frame.

        Args:
            keys: those of the receivers: of all of them by rank, without this robot; or of the one. b"": not known yet.
            again: the same frame as before, for another receiver: it has the same counters.
        """
        rank, tag, roster, name, boot = self._rank, self._tag, self._roster, self._name, self._boot
        count, places, round_ = len(bodies), len(keys), round_ & 0xFFFFFFFF
        counter = self.counter - count if again else self.counter
        self.counter = counter + count
        sealed = []
        for part, body in enumerate(bodies):
            counter += 1
            last = flags | LAST if part == count - 1 else flags
            header = HEADER.pack(
                MAGIC, VERSION, last, rank, medium, tag, roster, name, boot, counter, round_, part, count, places
            )
            sealed.append(b"".join((header, *_seals(_digest(header, body), keys), body)))
        return sealed


@functools.cache
def name_tag(robot: str) -> int:
    """Four bytes that tell a sender to robots with another roster, for which its rank means another one."""
    return int.from_bytes(blake2b(robot.encode(), digest_size=4, person=b"failover-sender\x00").digest(), "little")


def _digest(header: bytes, body: bytes) -> bytes:
    digest = _EMPTY.copy()
    digest.update(header)
    digest.update(body)
    return digest.digest()


@functools.lru_cache(4 * PEERS_MAX)
def _prepared(key: bytes) -> tuple[bytes, blake2b]:
    """Number of a key, by which a receiver tells one that it was not given yet from a forgery; and what has taken in the key."""
    number = blake2b(key, digest_size=NUMBER_SIZE, person=b"failover-key-id\x00").digest()
    return number, blake2b(digest_size=CODE_SIZE, key=key[:64], person=_PERSON)


def _seals(digest: bytes, keys: Sequence[bytes]) -> list[bytes]:
    """The authenticator of each receiver, as one or two pieces."""
    seals = []
    for key in keys:
        if not key:
            seals.append(_NO_SEAL)
            continue
        number, keyed = _prepared(key)
        code = keyed.copy()
        code.update(digest)
        seals += (number, code.digest())
    return seals


# --- Opening ---------------------------------------------------------------------------------------------------------


class _Window(Struct):
    """Which parts of one sender were seen: all of earlier lives, all up to ``highest`` that ``seen`` (bit i: highest - i) has."""

    boot: int = 0
    highest: int = 0
    seen: int = 0

    def take(self, boot: int, counter: int) -> Reason | None:
        """Note the part, or say why it is none of today's."""
        if boot < self.boot:
            return Reason.EARLIER_LIFE
        if boot > self.boot:
            self.boot, self.highest, self.seen = boot, 0, 0
        ahead = counter - self.highest
        if ahead > 0:
            self.seen = ((self.seen << min(ahead, WINDOW)) | 1) & ((1 << WINDOW) - 1)
            self.highest = counter
            return None
        if -ahead >= WINDOW or self.seen >> -ahead & 1:
            return Reason.REPLAYED
        self.seen |= 1 << -ahead
        return None


class _Sender(Struct):
    """Who may send to us, with the present key and the one before it.

    Attributes:
        rank: in our roster, or `NO_RANK`; ``places``: where its parts have our authenticator, if its roster is ours.
    """

    name: str
    rank: int
    places: range
    window: _Window
    keys: tuple[bytes, ...] = ()


class Receiver:
    """Opens the parts that reach one robot: right key, right sender, and each only once.

    A sender's boot count can only grow, and only in a part whose code is right: a stranger cannot reset a window.
    """

    def __init__(self, me: str, team: str, roster: Roster) -> None:
        self._me = roster.ranks[me]
        self._tag, self._digest = team_tag(team), roster.short_digest
        self._roster, self._others = roster, len(roster) - 1
        self._senders: dict[int, _Sender] = {}

    def accept(self, sender: str, key: bytes) -> None:
        """From now on believe ``sender`` when it uses ``key``; its last but one key is forgotten.

        Raises:
            ValueError: the key is too short, or there are more senders than a team has robots.
        """
        if len(key) < KEY_SIZE_MIN:
            raise ValueError(f"a beat key of {len(key)} bytes for {sender}: use at least {KEY_SIZE_MIN} random bytes")
        tag = name_tag(sender)
        if tag not in self._senders and len(self._senders) > PEERS_MAX:
            raise ValueError(f"no room for the frames of {sender}: at most {PEERS_MAX} robots share a team")
        known = self._senders.get(tag)
        if known is None or known.name != sender:
            rank = self._roster.ranks.get(sender, NO_RANK)
            place = self._me - (self._me > rank)
            known = self._senders[tag] = _Sender(sender, rank, range(place, place + 1), _Window())
        known.keys = (key, *[one for one in known.keys if one != key])[:KEYS_PER_SENDER]

    def forget_older(self, sender: str) -> None:
        """Believe ``sender`` by its newest key alone."""
        known = self._senders.get(name_tag(sender))
        if known is not None and known.name == sender:
            known.keys = known.keys[:1]

    def changed(self, team: str, me: str, roster: Roster) -> Receiver:
        """The same for another roster: senders that stay keep their keys, and what was seen of them."""
        other = Receiver(me, team, roster)
        for sender in self._senders.values():
            if sender.name in roster.ranks:
                for key in reversed(sender.keys):
                    other.accept(sender.name, key)
                other._senders[name_tag(sender.name)].window = sender.window
        return other

    def open(self, datagram: bytes) -> Part | Refused:
        """The part inside, or why it is not believed. Never raises for any bytes."""
        if not HEADER.size + SEAL_SIZE < len(datagram) <= FRAME_SIZE_MAX:
            return Refused(Reason.VERSION if datagram[:2] == MAGIC_BEFORE else Reason.NOT_OURS)
        magic, version, flags, rank, medium, tag, roster, name, boot, counter, round_, part, parts, count = HEADER.unpack_from(
            datagram
        )
        if magic != MAGIC:
            return Refused(Reason.VERSION if magic == MAGIC_BEFORE else Reason.NOT_OURS)
        if version != VERSION:
            return Refused(Reason.VERSION)
        if tag != self._tag:
            return Refused(Reason.TEAM)
        start = HEADER.size + SEAL_SIZE * count
        if not 0 < count < RANKS_MAX or start >= len(datagram):
            return Refused(Reason.NOT_OURS)
        if not part < parts <= PARTS_MAX:
            return Refused(Reason.PART)
        alike = roster == self._digest
        sender = self._senders.get(name)
        if sender is None:
            place = self._me - (self._me > rank)
            is_cast = alike and count == self._others and _is_unsealed(datagram, range(place, place + 1))
            return Refused(Reason.UNSEALED if is_cast else Reason.UNKNOWN_KEY)
        if alike and rank == sender.rank and count == self._others:
            places = sender.places
        else:
            places = self._places(count, alike)
        if not places:
            return Refused(Reason.ROSTER)
        body = datagram[start:]
        refusal = _check(datagram, body, places, sender.keys)
        if refusal is not None:
            return Refused(Reason.UNSEALED if alike and _is_unsealed(datagram, places) else refusal)
        try:
            said = _decode(body)
        except UNDECODABLE:
            return Refused(Reason.MALFORMED, sender.name)
        beat, items = said.beat, said.items
        if (beat is not None and beat.sender != sender.name) or (alike and rank != sender.rank):
            return Refused(Reason.SENDER, sender.name)
        if not _is_sound(beat, items, boot, counter):
            return Refused(Reason.MALFORMED, sender.name)
        refusal = sender.window.take(boot, counter)
        if refusal is not None:
            return Refused(refusal, sender.name, counter)
        slots = said.slots
        if not alike:
            if beat is None:
                return Refused(Reason.ROSTER, sender.name)
            slots, items = None, ()
        return Part(
            sender.name,
            alike,
            sender.rank,
            medium,
            flags,
            boot,
            counter,
            round_,
            part,
            parts,
            slots,
            beat,
            items,
            said.left_us,
            said.casts,
        )

    def _places(self, count: int, alike: bool) -> range:
        """Which of the authenticators may be ours, where they are not all those of our roster; none where they should be."""
        if count == 1:
            return _FIRST
        return range(0) if alike else range(min(count, CODES_MAX))


def _check(datagram: bytes, body: bytes, places: range, keys: Sequence[bytes]) -> Reason | None:
    """Whether one of the authenticators is ours and right."""
    digest = b""
    for key in keys:
        number, keyed = _prepared(key)
        for place in places:
            at = HEADER.size + SEAL_SIZE * place
            if datagram.startswith(number, at):
                digest = digest or _digest(datagram[: HEADER.size], body)
                code = keyed.copy()
                code.update(digest)
                if hmac.compare_digest(datagram[at + NUMBER_SIZE : at + SEAL_SIZE], code.digest()):
                    return None
    return Reason.FORGED if digest else Reason.UNKNOWN_KEY


def _is_unsealed(datagram: bytes, places: range) -> bool:
    """Whether the sender has not told us a key yet: what it casts to all comes nevertheless."""
    return all(datagram.startswith(_NO_SEAL, HEADER.size + SEAL_SIZE * place) for place in places)


def _is_sound(beat: Beat | None, items: Sequence[Portion], boot: int, counter: int) -> bool:
    """Whether the numbers lie in the ranges that ``FRAME.md`` gives."""
    for item in items:
        if (item.total or item.offset) and not item.is_sound:
            return False
    return 0 < boot < NUMBER_MAX and 0 < counter < NUMBER_MAX and (beat is None or (beat.boot == boot and is_sound(beat)))
