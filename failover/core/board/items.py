"""What a team's board holds: the declaration of each item, the board of them all, the digests by which robots compare them.

An item is a named value that each robot which has it writes for itself: "ball" of robot1, "ball" of robot2. Shared items travel
to the other robots; private ones (``shared=False``) stay at their robot. Declarations meet here, whether they come from
team.toml, from a program's `add`, from CAMBADA's ``rtdb.conf`` or from RTDB2's XML.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Any, Final

import msgspec
import xxhash
from msgspec import Struct

from failover.core.board.item_types import ITEM_SIZE_MAX, OPAQUE, Opaque, Type, aligned, canonical, size_of
from failover.core.board.item_values import type_of
from failover.core.wire import names
from failover.errors import ItemError, NameFormatError

ITEMS_MAX: Final = 1024
"""Items of one block: each open examines their records, 192 bytes each; numbers of items added later begin at a multiple."""

RADIO_ITEM_SIZE_MAX: Final = 4 << 10
"""Bytes of a shared item's value: four frames of a radio at most, in a slot of some milliseconds."""

BLOCK_SIZE_MAX: Final = 16 << 20
"""Bytes of one robot's area: memory that every robot of the team holds for every other."""

BANKS_MIN: Final = 2
BANKS_MAX: Final = 8
"""Copies of a value: with two, a reader is overtaken only by two puts during its copy."""

PERIOD_MAX: Final = 1 << 16
"""Rounds between two transmissions: an hour at 50 ms."""

BOUND_MS_MAX: Final = 24 * 3_600_000
"""A bound of more than a day bounds nothing."""

NAME_SIZE_MAX: Final = 63
"""Bytes of an item's name, as of a robot's."""

USER_SIZE_MAX: Final = 64
"""Bytes of a user's name; useradd(8) allows 32, a directory of an organisation may have longer ones."""

OWNED_MAX: Final = 400
"""Items of one user alone: their table is one value of an item (`failover.core.board.owners`)."""

OWNERS_MAX: Final = 64
"""Users who have such items: the main loop reads a file of each in every round."""

PATTERNS_MAX: Final = 64
"""Robots or patterns in one list: as many as a team has voters."""

RESERVED: Final = "_"
"""Items whose names begin so belong to the agents: ``_robot``, ``_slots``."""

BANK_HEADER_SIZE: Final = 32
BANK_ALIGNMENT: Final = 64
"""A bank is its header, then the value, on cache lines of its own. Source: BOARD.md."""


class Item(Struct, frozen=True, dict=True):
    """One item as it is declared: `Item("ball", {"x": "f4"})`, `Item("goal", size=64)`, `Item("plan", "json", size=99)`.

    Attributes:
        name: without blanks and "/".
        type: what its values are: a text or a table of `failover.core.board.item_types`, a class or a numpy dtype of
            `failover.core.board.item_values`; kept as the type itself, a class besides as `shape`. Without one: bytes.
        size: bytes of a value; for contents without a layout the most bytes, which must be said.
        shared: whether it travels to the other robots: True, False, or the robots (patterns) from which it does.
        period: rounds between two transmissions, from 1. phase: the first of them, below the period.
        robots: which robots have it: names, or patterns with ``*``.
        bound_ms: past this age a reading is stale; 0: the bound follows from period and round.
        banks: copies, 2 to 8.
        writer: the component that is meant to write it, for people. Nothing enforces that: the first process that puts it does.
        transmit: False: it is received from others and never sent, for a robot that only listens.
        urgent: it is sent at once where no slots are, not with the next round.
        finite: refuse NaN and infinities.
        keep: an item added while it runs is there again after a reboot.
        user: the one user who may put it, on each robot; "": who may write the board may.

    Raises:
        ItemError: says which key is wrong, and what to write.
    """

    name: str
    type: Any = None
    size: int = 0
    shared: bool | tuple[str, ...] = True
    period: int = 1
    phase: int = 0
    robots: tuple[str, ...] = ("*",)
    bound_ms: float = 0
    banks: int = BANKS_MIN
    writer: str = ""
    transmit: bool = True
    urgent: bool = False
    finite: bool = False
    keep: bool = False
    user: str = ""

    def __post_init__(self) -> None:
        _check_kinds(self)
        check_name(self.name)
        kind = _typed(self.type, self.size)
        if not isinstance(self.type, str | Mapping | Type | None):
            self.__dict__["shape"] = self.type
        msgspec.structs.force_setattr(self, "type", kind)
        msgspec.structs.force_setattr(self, "size", size_of(kind))
        for key in ("shared", "robots"):
            said = getattr(self, key)
            if isinstance(said, list):
                msgspec.structs.force_setattr(self, key, tuple(said))
        _check_numbers(self)
        _check_words(self)

    @property
    def shape(self) -> Any:
        """The class or numpy dtype that was given as its type, of which a program's values are; None for a text or a table."""
        return self.__dict__.get("shape")

    @property
    def layout(self) -> Type:
        """The type of its values."""
        kind: Type = self.type
        return kind

    @property
    def type_digest(self) -> int:
        """64 bits of the type: a program that means another one is refused."""
        return type_digest(self.type)

    def is_at(self, robot: str) -> bool:
        """Whether a robot has this item."""
        return _matches(self.robots, robot)

    def is_shared_by(self, robot: str) -> bool:
        """Whether a robot that has this item sends it to the others; else it is private there."""
        shared = self.shared if isinstance(self.shared, bool) else _matches(self.shared, robot)
        return shared and self.is_at(robot)

    def as_words(self) -> dict[str, object]:
        """Every key as plain values, the type as its text: the canonical declaration."""
        kind = canonical(self.type)
        words: dict[str, object] = {name: getattr(self, name) for name in self.__struct_fields__}
        if not self.user:
            del words["user"]  # robots that know no such key have the same digest
        return words | {"type": kind, "bound_ms": float(self.bound_ms)}


def type_digest(kind: Type) -> int:
    """xxh3-64 of a type's text."""
    return xxhash.xxh3_64_intdigest(canonical(kind).encode())


def bank_stride(size: int) -> int:
    """Bytes from one bank of an item to the next."""
    return aligned(BANK_HEADER_SIZE + size, BANK_ALIGNMENT)


def check_name(name: str) -> None:
    """Refuse a name that no item may have.

    Raises:
        ItemError: says why.
    """
    if not name or "/" in name or not _is_visible(name) or names.text_size(name) > NAME_SIZE_MAX:
        raise ItemError(
            f"{name[:80]!r} cannot name an item: use 1 to {NAME_SIZE_MAX} bytes of visible characters without blanks and '/'",
            "name",
        )


def _is_visible(text: str) -> bool:
    return text.isprintable() and not any(character.isspace() for character in text)


def _typed(said: Any, size: int) -> Type:
    """The type of an item by its keys type and size."""
    if size and not 1 <= size <= ITEM_SIZE_MAX:
        raise ItemError(f"size {size} is not from 1 to {ITEM_SIZE_MAX}", "size")
    if said is None or (isinstance(said, str) and said in OPAQUE):
        if not size:
            raise ItemError(f"{said or 'an item without a type'} needs a size: the most bytes of a value", "type")
        return Opaque(said or "bytes", size)
    kind = type_of(said)
    if size and size != size_of(kind):
        raise ItemError(f"size {size} contradicts the type: {canonical(kind)} has {size_of(kind)} bytes; leave size out", "size")
    return kind


def _check_kinds(item: Item) -> None:
    """Refuse what a program gives in a key's place that is of another kind altogether."""
    for key, default in zip(item.__struct_fields__[2:], item.__struct_defaults__[1:], strict=True):
        said = getattr(item, key)
        kinds = {bool: (bool,), int: (int, float) if key == "bound_ms" else (int,), str: (str,)}.get(type(default), ())
        if kinds and key != "shared" and (not isinstance(said, kinds) or (isinstance(said, bool) and bool not in kinds)):
            raise ItemError(f"{key} {said!r} is no {kinds[-1].__name__}", key)
    if not isinstance(item.name, str):
        raise ItemError(f"{item.name!r} cannot name an item: it is no text", "name")


def _check_numbers(item: Item) -> None:
    if not 1 <= item.period <= PERIOD_MAX:
        raise ItemError(f"period {item.period} is not from 1 to {PERIOD_MAX} rounds", "period")
    if not 0 <= item.phase < item.period:
        raise ItemError(f"phase {item.phase} is not from 0 to below the period, {item.period}", "phase")
    if not BANKS_MIN <= item.banks <= BANKS_MAX:
        raise ItemError(f"banks {item.banks} is not from {BANKS_MIN} to {BANKS_MAX}", "banks")
    if not math.isfinite(item.bound_ms) or not 0 <= item.bound_ms <= BOUND_MS_MAX:
        raise ItemError(f"bound_ms {item.bound_ms} is not from 0 to {BOUND_MS_MAX}", "bound_ms")
    if item.shared and item.size > RADIO_ITEM_SIZE_MAX:
        raise ItemError(
            f"a shared item holds at most {RADIO_ITEM_SIZE_MAX} bytes, this one {item.size}; say shared = false, or split it",
            "size" if isinstance(item.type, Opaque) else "type",
        )


def _check_words(item: Item) -> None:
    for key in ("robots", "shared"):
        patterns = getattr(item, key)
        if isinstance(patterns, bool):
            continue
        if not isinstance(patterns, tuple) or len(patterns) > PATTERNS_MAX:
            raise ItemError(f"{key} is no list of at most {PATTERNS_MAX} names of robots", key)
        for pattern in patterns:
            try:
                names.check_robot(pattern)
            except NameFormatError as error:
                raise ItemError(f"{key}: {error}", key) from error
    if item.writer:
        try:
            names.check_component(item.writer)
        except NameFormatError as error:
            raise ItemError(f"writer: {error}", "writer") from error
    if item.user.isdecimal():
        raise ItemError(f"user {item.user[:80]!r} is a number: name the user, whose number each robot looks up", "user")
    if not _is_visible(item.user) or set(item.user) & set("/:") or len(item.user.encode(errors="replace")) > USER_SIZE_MAX:
        raise ItemError(f"user {item.user[:80]!r} cannot be the name of a user; see getent passwd", "user")


def _matches(patterns: tuple[str, ...], robot: str) -> bool:
    return any(re.fullmatch(".*".join(map(re.escape, pattern.split("*"))), robot) is not None for pattern in patterns)


# --- The board -------------------------------------------------------------------------------------------------------


class Board(Struct, frozen=True):
    """All items of a team, the same at every robot; an item's place in the order is its number.

    Raises:
        ItemError: two items of one name, too many, or more memory than a block may have.
    """

    items: tuple[Item, ...] = ()
    group: str = ""

    def __post_init__(self) -> None:
        seen = set()
        for item in self.items:
            if item.name in seen:
                raise ItemError(f"two items are called {item.name!r}", "name")
            seen.add(item.name)
        if len(self.items) > ITEMS_MAX:
            raise ItemError(f"{len(self.items)} items are over the limit of {ITEMS_MAX}")
        users = [item.user for item in self.items if item.user]
        if len(users) > OWNED_MAX or len(set(users)) > OWNERS_MAX:
            raise ItemError(
                f"{len(users)} items of {len(set(users))} users are for one user each; {OWNED_MAX} items of {OWNERS_MAX} users "
                "are possible"
            )
        size = sum(item.banks * bank_stride(item.size) for item in self.items)
        if size > BLOCK_SIZE_MAX:
            raise ItemError(f"the items take {size} bytes with their banks, over the limit of {BLOCK_SIZE_MAX} for a block")

    @property
    def digest(self) -> int:
        """64 bits of every declaration and their order; 0 for a team without a board."""
        if not self.items:
            return 0
        return xxhash.xxh3_64_intdigest(msgspec.json.encode([item.as_words() for item in self.items]))

    @property
    def terms(self) -> bytes:
        """The digest as bytes for a roster; b"" for a team without a board."""
        return self.digest.to_bytes(8, "little") if self.items else b""

    def number_of(self, name: str) -> int | None:
        """An item's number; None where it is not declared."""
        return next((number for number, item in enumerate(self.items) if item.name == name), None)

    def shared_by(self, robot: str) -> dict[int, Item]:
        """Number → item, of those that a robot sends to the others."""
        return {number: item for number, item in enumerate(self.items) if item.is_shared_by(robot)}

    def private_of(self, robot: str) -> dict[int, Item]:
        """Number → item, of those that stay at a robot."""
        return {number: item for number, item in enumerate(self.items) if item.is_at(robot) and not item.is_shared_by(robot)}

    @property
    def owned(self) -> dict[int, Item]:
        """Number → item, of those that one user alone may put, at whichever robots."""
        return {number: item for number, item in enumerate(self.items) if item.user}
