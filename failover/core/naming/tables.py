"""Tables of names: each *origin* (a robot's agent, or a driver without one) writes its own, and every process keeps all.

An origin numbers its changes: *serial*. A table is complete up to its serial: it holds the newest form of every entry that
changed until then. So of two tables of one origin the one of the higher (boot, serial) says all that the other does, and merging
is taking the newer one (`newer`): in any order, any number of times, the outcome is the same. Only what the other lacks travels
(`page_of`, `patched`). An entry's body is passed on as it came: a record of a later version loses nothing on its way.

A removed entry stays as one without a body, until its origin has many of them and begins a new boot without them. No other
process ever forgets one alone, so no removed name comes back from a process that was cut off.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from msgspec import Struct

NAMES_MAX: Final = 65_536
"""Entries of all tables together: 256 guests and 64 robots with 200 each."""

ORIGINS_MAX: Final = 1_024
"""Tables that a process keeps: all robots and guests of a team thrice."""

BODY_SIZE_MAX: Final = 4 << 10
"""Bytes of one entry's body: a record with some twenty verbs and their schemas."""

PAGE_SIZE_MAX: Final = 64 << 10
"""Bytes of entries in one message: it holds up nothing on a radio for long."""

COUNT_MAX: Final = 1 << 62
"""Boots and serials above this are a mistake: believing one would leave no room to count on."""


class Entry(Struct, frozen=True, array_like=True):
    """One name of a table. ``serial``: of the change that made it so; ``body``: a record as msgpack, b"" if it was removed."""

    path: str
    serial: int
    body: bytes = b""

    @property
    def size(self) -> int:
        """Bytes in a page, at most."""
        return len(self.path) * 4 + len(self.body) + 24


class Table(Struct, frozen=True):
    """What one origin has said, up to a serial.

    Attributes:
        boot: grows with each life of the origin; a higher one makes all that was said before void.
        serial: of the newest change in it, from 1; 0: nothing was said.
        address: where the origin's tables are exchanged.
    """

    origin: str
    boot: int
    serial: int = 0
    address: str = ""
    entries: Mapping[str, Entry] = {}

    @property
    def version(self) -> tuple[int, int]:
        """By which tables of one origin are compared."""
        return self.boot, self.serial


class Page(Struct, frozen=True, array_like=True):
    """The entries of one table that changed after ``since`` and up to ``upto``, by serial.

    Attributes:
        beat: the origin's newest scan of which the sender has heard, ``age_s`` seconds ago at most.
    """

    origin: str
    boot: int
    since: int
    upto: int
    address: str
    beat: int
    age_s: int
    entries: tuple[Entry, ...] = ()

    @property
    def size(self) -> int:
        """Bytes in a message, at most."""
        return sum(entry.size for entry in self.entries) + 4 * (len(self.origin) + len(self.address)) + 64


def newer(one: Table | None, other: Table | None) -> Table | None:
    """The one of two tables of an origin that says all that the other does; a tie between liars is broken alike everywhere."""
    if one is None or other is None:
        return one or other
    if one.version != other.version:
        return one if one.version > other.version else other
    return max(one, other, key=_content)


def _content(table: Table) -> tuple[str, list[tuple[str, int, bytes]]]:
    return table.address, sorted((entry.path, entry.serial, entry.body) for entry in table.entries.values())


def page_of(table: Table, since: int, room: int, beat: int = 0, age_s: int = 0) -> Page:
    """What a table has and one of the same boot up to ``since`` lacks, as much as fits ``room`` bytes; one entry always does."""
    held: list[Entry] = []
    upto = table.serial
    for entry in sorted((one for one in table.entries.values() if one.serial > since), key=_serial):
        room -= entry.size
        if held and room < 0:
            upto = held[-1].serial
            break
        held.append(entry)
    return Page(table.origin, table.boot, since, upto, table.address, beat, age_s, tuple(held))


def patched(table: Table | None, page: Page) -> Table | None:
    """The table with a page's changes; None if the page does not follow on what the table has."""
    old = table if table is not None and table.boot == page.boot else None
    known = old.serial if old is not None else 0
    if page.since > known or (old is not None and page.upto <= known):
        return None
    entries = dict(old.entries) if old is not None else {}
    entries.update((entry.path, entry) for entry in page.entries if entry.serial > known)
    return Table(page.origin, page.boot, page.upto, page.address, entries)


def _serial(entry: Entry) -> int:
    return entry.serial
