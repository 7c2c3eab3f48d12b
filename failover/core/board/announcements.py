"""How items that programs add while they run become known at the other robots: pages of a table, and a word to compare it by.

A robot tells a change of its table in its next three frames. A page says which items exist *in a range of numbers*, so that one
form serves for what is new, what was removed and what was lost on the way. Each page has the *word*, the digest of the whole
table; without one every sixteenth frame has it. A robot that computes another word from what it knows asks, and gets the whole
table, page by page.

Pages and questions travel among a frame's items, under numbers that no item has (FRAME.md, *Items of the agents*). Numbers from
1,024 × (rank + 1) on belong to the robot of that rank: no agreement is needed. Nothing here raises for any bytes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Annotated, Final

import msgspec
import xxhash
from msgspec import Meta, Struct, field

from checkpoint.errors import UNDECODABLE
from failover.core.board.item_types import Opaque, parse
from failover.core.board.items import ITEMS_MAX, Item
from failover.core.board.layout import FINITE, KEPT, NOT_SENT, URGENT, Record, Wanted
from failover.errors import ItemError

RESERVED: Final = (1 << 32) - 16
"""From here on numbers are no items': what agents tell each other in their place."""
PAGE: Final = RESERVED
QUESTION: Final = RESERVED + 1

TIMES: Final = 3
"""Frames that tell a change: two of them may be lost before a question is needed."""
WORD_ROUNDS: Final = 16
"""Between two words of a robot that changes nothing: a third of a second on wires, one byte a frame."""
ASK_ROUNDS: Final = 8
"""Between two questions about the same robot: an answer of one page has come by then."""
HEARD_ROUNDS: Final = 4 * WORD_ROUNDS
"""A robot whose words do not come any more is not asked."""

PAGE_SIZE: Final = 800
"""Bytes of declarations in a page: beside a heartbeat it fits one datagram. A longer declaration has a page of its own."""
DECLARATION_SIZE_MAX: Final = 8 << 10
"""Bytes of one declaration that is told: eight datagrams. A struct of 4 KiB whose fields have short names is shorter."""

CONTENT_SIZE_MAX: Final = PAGE_SIZE + DECLARATION_SIZE_MAX
"""Bytes of a page that is read: no robot tells a longer one."""

TOO_LONG: Final = "items added here with a declaration too long to be told"
NOT_POSSIBLE: Final = "items added by other robots that no board can have"

_U32 = Annotated[int, Meta(ge=0, lt=1 << 32)]
_U64 = Annotated[int, Meta(ge=0)]


class Declared(Struct, frozen=True, array_like=True):
    """One item as it is told. ``type``: its text; ``flags``: those of its record that other robots need."""

    number: _U32
    name: str
    type: str
    size: _U32
    period: _U32
    phase: _U32
    banks: _U32
    bound_ns: _U64
    flags: _U32


class Page(Struct, frozen=True, array_like=True):
    """These items, and no others, have numbers from ``first`` on and below ``after``; none are told where the two are equal.

    Attributes:
        word: of the whole table.
        items: a `Declared` each, encoded: the word is computed from these bytes.
    """

    word: _U64
    first: _U32 = 0
    after: _U32 = 0
    items: tuple[bytes, ...] = ()


_encode: Final = msgspec.msgpack.Encoder().encode
_page: Final = msgspec.msgpack.Decoder(Page).decode
_declared: Final = msgspec.msgpack.Decoder(Declared).decode
_ranks: Final = msgspec.msgpack.Decoder(tuple[_U32, ...]).decode


def first_number(rank: int) -> int:
    """The lowest number of the items that the robot of this rank adds; `ITEMS_MAX` from it on are its own."""
    return ITEMS_MAX * (rank + 1)


def told(record: Record | Wanted) -> bytes:
    """A record as it is told."""
    flags = record.flags & (URGENT | FINITE | KEPT)
    text = record.text or f"bytes[{record.size}]"
    numbers = (record.size, record.period, record.phase, record.banks, record.bound_ns, flags)
    return _encode(Declared(record.id, record.name, text, *numbers))


def item_of(declared: Declared | Record, *, shared: bool = True) -> Item:
    """The declaration that a record or an announcement is of.

    Raises:
        ItemError: no item can be declared so.
    """
    text = declared.text if isinstance(declared, Record) else declared.type
    kind = parse(text or f"bytes[{declared.size}]")
    if isinstance(kind, Opaque) and kind.size != declared.size:
        raise ItemError(f"{text} of {declared.size} bytes", "size")
    flags = declared.flags
    return Item(
        declared.name,
        kind,
        size=declared.size,
        shared=shared,
        period=declared.period,
        phase=declared.phase,
        banks=declared.banks,
        bound_ms=declared.bound_ns / 1_000_000,
        transmit=not flags & NOT_SENT,
        urgent=bool(flags & URGENT),
        finite=bool(flags & FINITE),
        keep=bool(flags & KEPT),
    )


def word_of(items: Iterable[bytes]) -> int:
    """The word of a table: its items' digests, one over the other, so that their order does not matter; 0 without items."""
    word = 0
    for item in items:
        word ^= xxhash.xxh3_64_intdigest(item)
    return word


def question(ranks: Iterable[int]) -> bytes:
    """Asks the robots of these ranks for their whole tables."""
    return _encode(tuple(ranks))


def asks(content: bytes, rank: int) -> bool:
    """Whether a question is for the robot of this rank."""
    try:
        return rank in _ranks(content)
    except UNDECODABLE:
        return False


class _Medium(Struct):
    """What is still to be told over one medium.

    Attributes:
        times: number of an item that changed → frames that are to tell it.
        sweep: where the whole table goes on, if it was asked for.
    """

    times: dict[int, int] = field(default_factory=dict)
    sweep: int | None = None


class Announcer:
    """Tells this robot's table: at most one page in each frame. Over each medium all of it: a member may hear but one."""

    def __init__(self, rank: int) -> None:
        self._first = first_number(rank)
        self._items: dict[int, bytes] = {}
        self._word = 0
        self._media = {0: _Medium()}
        self._is_new = True
        self._too_long: set[int] = set()

    @property
    def refused(self) -> Counter[str]:
        """What is not told, by reason."""
        return Counter({TOO_LONG: len(self._too_long)})

    def hold(self, records: Iterable[Record]) -> None:
        """These items were added at run time, and are there now."""
        mine = range(self._first, self._first + ITEMS_MAX)
        items = {record.id: told(record) for record in records if record.id in mine}
        for number, item in list(items.items()):
            if len(item) > DECLARATION_SIZE_MAX:
                del items[number]
                self._too_long.add(number)
        changed = [number for number in items.keys() | self._items.keys() if items.get(number) != self._items.get(number)]
        self._items, self._word = items, word_of(items.values())
        if not self._is_new:  # else the others know the table from before, or will ask
            for medium in self._media.values():
                medium.times.update((number, TIMES) for number in changed)
        self._is_new = False

    def asked(self) -> None:
        """A robot lacks a part of the table: tell all of it."""
        for medium in self._media.values():
            if medium.sweep is None:
                medium.sweep = self._first

    def due(self, round_: int, medium: int = 0) -> bytes | None:
        """What to tell in the frame of this round over this medium."""
        of = self._media.setdefault(medium, _Medium())
        if of.times:
            return self._told(min(of.times), of)
        if of.sweep is not None:
            return self._told(of.sweep, of)
        return None if round_ % WORD_ROUNDS else _encode(Page(self._word))

    def _told(self, first: int, of: _Medium) -> bytes:
        """A page that begins with this number, as far as it has room."""
        after, size = self._first + ITEMS_MAX, 0
        items: list[bytes] = []
        for number in sorted(number for number in self._items if number >= first):
            size += len(self._items[number])
            if items and size > PAGE_SIZE:
                after = number
                break
            items.append(self._items[number])
        of.times = {
            number: times - (first <= number < after)
            for number, times in of.times.items()
            if times > 1 or not first <= number < after
        }
        if of.sweep is not None and first <= of.sweep < after:
            of.sweep = after if after < self._first + ITEMS_MAX else None
        return _encode(Page(self._word, first, after, tuple(items)))


class Change(Struct, frozen=True):
    """What is to be under one number: this item; None: nothing. The caller makes it so, and notes it (`Learned.note`)."""

    number: int
    item: Item | None
    told: bytes | None


class Learned:
    """What is known of another robot's table.

    Attributes:
        refused: by reason.
    """

    def __init__(self, rank: int, known: Iterable[Record]) -> None:
        self._first = first_number(rank)
        self._known = {record.id: told(record) for record in known}
        self._word = word_of(self._known.values())
        self._newest = 0
        self._other_word: int | None = None
        self._waited = self._silent = 0
        self.refused: Counter[str] = Counter()

    def begin_life(self) -> None:
        """The robot's agent began anew: it counts its pages from 1."""
        self._newest = 0

    def take(self, put: int, content: bytes) -> Sequence[Change]:
        """A page came: what it changes.

        Args:
            put: the page's number among all pages of that robot's life.
        """
        if put <= self._newest:
            return ()  # an older page on a slower way
        if len(content) > CONTENT_SIZE_MAX:
            self.refused[NOT_POSSIBLE] += 1
            return ()
        try:
            page = _page(content)
            items = [(_declared(item), item) for item in page.items]
        except UNDECODABLE:
            self.refused[NOT_POSSIBLE] += 1
            return ()
        self._newest = put
        self._other_word, self._silent = page.word, 0
        if page.first < page.after:
            self._waited = 0
        there = {declared.number: (declared, item) for declared, item in items if page.first <= declared.number < page.after}
        changes = [self._change(number, declared, item) for number, (declared, item) in there.items()]
        gone = [number for number in self._known if page.first <= number < page.after and number not in there]
        return [*(Change(number, None, None) for number in gone), *filter(None, changes)]

    def _change(self, number: int, declared: Declared, item: bytes) -> Change | None:
        if self._known.get(number) == item:
            return None
        try:
            if number not in range(self._first, self._first + ITEMS_MAX):
                raise ItemError(f"item {number} is not of that robot")
            return Change(number, item_of(declared), item)
        except ItemError:
            self.refused[NOT_POSSIBLE] += 1
            return Change(number, None, item)

    def note(self, change: Change) -> None:
        """It was made, or cannot be made and is not to be asked for again."""
        if change.told is None:
            self._known.pop(change.number, None)
        elif change.number in self._known or len(self._known) < ITEMS_MAX:
            self._known[change.number] = change.told
        self._word = word_of(self._known.values())

    def is_to_ask(self) -> bool:
        """Once in each round of ours: whether a part is lacking, and a question is due."""
        self._silent += 1
        if self._other_word in (None, self._word) or self._silent > HEARD_ROUNDS:
            self._waited = 0
            return False
        self._waited += 1
        if self._waited < ASK_ROUNDS:
            return False
        self._waited = 0
        return True
