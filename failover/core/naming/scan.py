"""How tables of names reach every process: a scan every 20 s, as one object; pure: every instant is an argument.

At each scan a process tells all that it knows of which tables it has, as a *digest*: boot, serial and *beat* of each origin. Who
lacks something asks for it and gets pages of at most 64 KiB. An origin raises its beat with every scan; it is heard as long as
its beat rises, through any teller. Thus a name is found although its origin cannot be reached from here directly.

    Digest -- a row is newer than our table --> Ask       -- it lacks what we have --> our Digest, once
    Ask    --> Pages; what did not fit is named, and asked for at once
    Pages  -- each that follows on our table --> taken in

Invariants: only an origin changes its table, so no two processes disagree for long; a table never loses a change; an origin that
sees a newer life of itself begins one that is newer still; no message, however odd, raises.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

import msgspec
import xxhash
from msgspec import Struct

from checkpoint.errors import UNDECODABLE
from failover.core.naming import records
from failover.core.naming.records import Record
from failover.core.naming.tables import (
    COUNT_MAX,
    NAMES_MAX,
    ORIGINS_MAX,
    PAGE_SIZE_MAX,
    Entry,
    Page,
    Table,
    newer,
    page_of,
    patched,
)
from failover.core.naming.tree import Claims, Reach, Tree
from failover.errors import NameFormatError

SECOND: Final = 1_000_000_000

MULTICAST: Final = ""
"""The address of all that listen on the network, known or not; only digests of one row go there."""

REMOVED_MIN: Final = 64
"""Removed entries that an origin keeps in any case: a few bytes each."""

MESSAGE_SIZE_MAX: Final = 1 << 20
"""Bytes of a message; the largest honest one is a digest of `ORIGINS_MAX` rows, a tenth of it."""


class Terms(Struct, frozen=True):
    """The times of the scan.

    Attributes:
        scan_ns: between two scans, more or less by a tenth: processes that start together drift apart.
        live_scans: an origin that was heard within so many scans is live.
        unreachable_ns: how much longer it is shown.
        urgent_ns: the least time between two scans: changes that come together leave together.
        ask_ns: how long an answer is waited for before another process is asked.
    """

    scan_ns: int = 20 * SECOND
    live_scans: int = 3
    unreachable_ns: int = 600 * SECOND
    urgent_ns: int = SECOND // 4
    ask_ns: int = SECOND

    @property
    def gone_ns(self) -> int:
        """After what silence an origin is forgotten."""
        return self.live_scans * self.scan_ns + self.unreachable_ns


class Row(Struct, frozen=True, array_like=True):
    """Up to where a process has one origin's table, and when it heard of the origin, rounded up."""

    origin: str
    boot: int
    serial: int
    beat: int = 0
    age_s: int = 0


class Digest(Struct, frozen=True, array_like=True, tag="d"):
    """What a process has. ``address``: where it is answered; ``whole``: what is not in it, it lacks."""

    address: str
    rows: tuple[Row, ...]
    whole: bool = True


class Ask(Struct, frozen=True, array_like=True, tag="a"):
    """Please tell what is newer than these."""

    address: str
    rows: tuple[Row, ...]


class Pages(Struct, frozen=True, array_like=True, tag="p"):
    """Parts of tables. ``rest``: origins of which more was asked for than fits."""

    address: str
    pages: tuple[Page, ...]
    rest: tuple[str, ...] = ()


Message = Digest | Ask | Pages

encode = msgspec.msgpack.Encoder().encode
_decoder: msgspec.msgpack.Decoder[Message] = msgspec.msgpack.Decoder(Message)


def decode(content: bytes | memoryview) -> Message | None:
    """A message of another process; None if it is none, or holds a number that leaves no room to count on."""
    if len(content) > MESSAGE_SIZE_MAX:
        return None
    try:
        message = _decoder.decode(content)
    except UNDECODABLE:
        return None
    return message if all(0 <= number < COUNT_MAX for number in _numbers(message)) else None


def _numbers(message: Message) -> Iterator[int]:
    if isinstance(message, Pages):
        for page in message.pages:
            yield from (page.boot, page.since, page.upto, page.beat, page.age_s, *(entry.serial for entry in page.entries))
    else:
        for row in message.rows:
            yield from (row.boot, row.serial, row.beat, row.age_s)


class Send(Struct, frozen=True):
    """A message that the caller is to send. ``to``: an address of another process, or `MULTICAST`."""

    to: str
    message: Message


class Scan:
    """The names that one process registers, and those of all others.

    The caller, for each instant `next_ns`: sends what `tick` returns; for each message that comes: what `heard` returns.
    """

    def __init__(
        self,
        origin: str,
        boot: int,
        now_ns: int,
        *,
        address: str = "",
        seeds: Iterable[str] = (),
        multicast: bool = False,
        terms: Terms = Terms(),  # noqa: B008  frozen
        claims: Claims = Claims(),  # noqa: B008  frozen
    ) -> None:
        """
        Args:
            origin: the robot, or ``robot/NAME`` of a driver without an agent; of one process at a time.
            boot: greater than in all its lives before, with room for some thousand between.
            address: where other processes reach this one; in the words of the transport.
            seeds: addresses that are told in any case: the robots of the team file.
        """
        self.origin = origin
        self.terms = terms
        self.claims = claims
        self.outbid = 0
        self.full = ""
        self._seeds = frozenset(seeds)
        self._multicast = multicast
        self._tables = {origin: Table(origin, boot, 0, address)}
        self._beats = {origin: 0}
        self._heard_ns = {origin: now_ns}
        self._asked_ns: dict[str, int] = {}
        self._told_ns: dict[str, int] = {}
        self._expires_ns: dict[str, int] = {}
        self._scanned_ns = now_ns - terms.scan_ns
        self._next_ns = now_ns
        self._tree: tuple[int, dict[str, Reach], Tree] | None = None
        self._changes = 0

    def know(self, seeds: Iterable[str], claims: Claims) -> None:
        """The team has other members now."""
        self._seeds = frozenset(seeds)
        if claims != self.claims:
            self.claims = claims
            self._changes += 1

    @property
    def own(self) -> Table:
        """What this process says itself."""
        return self._tables[self.origin]

    # --- What this process registers --------------------------------------------------------------------------------------

    def put(self, record: Record, now_ns: int, *, urgent: bool = False) -> Record:
        """Register a record, or change it; ``urgent``: tell the others at once, not with the next scan.

        Returns:
            It in normal form.

        Raises:
            NameFormatError: it cannot be registered; nothing was changed.
        """
        record = records.checked(record)
        if refusal := self.claims.refusal(record.path, self.origin.partition("/")[0]):
            raise NameFormatError(f"{record.path!r} cannot be registered: {refusal}")
        if record.path not in self.own.entries and self._count() >= NAMES_MAX:
            raise NameFormatError(f"{record.path!r} cannot be registered: the team has {NAMES_MAX} names, and that is the limit")
        body = records.pack(record)
        old = self.own.entries.get(record.path)
        if old is None or old.body != body:
            self._change(Entry(record.path, self.own.serial + 1, body), now_ns, urgent=urgent)
        self.renew(record.path, now_ns, record.lease_s)
        return record

    def renew(self, path: str, now_ns: int, lease_s: float) -> None:
        """What stands behind a path has shown that it lives; ``lease_s`` 0: it needs not to."""
        if lease_s > 0:
            self._expires_ns[path] = now_ns + int(lease_s * SECOND)
        else:
            self._expires_ns.pop(path, None)

    def remove(self, path: str, now_ns: int, *, urgent: bool = False) -> bool:
        """Withdraw a record; whether there was one."""
        self._expires_ns.pop(path, None)
        old = self.own.entries.get(path)
        if old is None or not old.body:
            return False
        self._change(Entry(path, self.own.serial + 1), now_ns, urgent=urgent)
        removed = sum(not entry.body for entry in self.own.entries.values())
        if removed > max(REMOVED_MIN, len(self.own.entries) - removed):
            self._begin(self.own.boot + 1)
        return True

    def _change(self, entry: Entry, now_ns: int, *, urgent: bool) -> None:
        own = self.own
        self._keep(Table(own.origin, own.boot, entry.serial, own.address, {**own.entries, entry.path: entry}))
        if urgent:
            self.soon(now_ns)

    def _begin(self, boot: int) -> None:
        """A new life with the same names: all others take the table anew."""
        own = self.own
        lives = [entry for entry in own.entries.values() if entry.body]
        entries = {one.path: Entry(one.path, serial, one.body) for serial, one in enumerate(lives, 1)}
        self._beats[self.origin] = 0
        self._keep(Table(own.origin, boot, len(entries), own.address, entries))

    def _keep(self, table: Table) -> None:
        self._tables[table.origin] = table
        self._changes += 1

    def _count(self) -> int:
        return sum(len(table.entries) for table in self._tables.values())

    # --- Scans ------------------------------------------------------------------------------------------------------------

    def next_ns(self) -> int:
        """When `tick` is due."""
        return self._next_ns

    def soon(self, now_ns: int) -> None:
        """Scan at once: others are to learn what this process has heard, and not only what it says itself."""
        self._next_ns = min(self._next_ns, max(now_ns, self._scanned_ns + self.terms.urgent_ns))

    def tick(self, now_ns: int) -> list[Send]:
        """Scan if it is due: forget who is silent for long, and tell everyone known what we have."""
        if now_ns < self._next_ns:
            return []
        for path in [path for path, expires_ns in self._expires_ns.items() if expires_ns <= now_ns]:
            self.remove(path, now_ns)
        for origin in [one for one, heard_ns in self._heard_ns.items() if now_ns - heard_ns >= self.terms.gone_ns]:
            if origin != self.origin:
                del self._tables[origin], self._heard_ns[origin], self._beats[origin]
                self._changes += 1
        self._asked_ns = {one: asked_ns for one, asked_ns in self._asked_ns.items() if now_ns - asked_ns < self.terms.ask_ns}
        self._told_ns = {one: told_ns for one, told_ns in self._told_ns.items() if now_ns - told_ns < self.terms.ask_ns}
        self._beats[self.origin] += 1
        self._heard_ns[self.origin] = self._scanned_ns = now_ns
        self._next_ns = now_ns + self._pause_ns()
        digest = self.digest(now_ns)
        sends = [Send(to, digest) for to in sorted(self._known())]
        if self._multicast:
            sends.append(Send(MULTICAST, Digest(self.own.address, (self._row(self.own, now_ns),), whole=False)))
        return sends

    def _pause_ns(self) -> int:
        """A scan's length, a tenth more or less, by a draw that only this process makes at this beat."""
        drawn = xxhash.xxh3_64_intdigest(f"{self.origin} {self.own.boot} {self._beats[self.origin]}".encode())
        return self.terms.scan_ns * (90 + drawn % 21) // 100

    def _known(self) -> set[str]:
        return {*self._seeds, *(table.address for table in self._tables.values())} - {self.own.address, ""}

    def digest(self, now_ns: int) -> Digest:
        """Up to where this process has which table."""
        return Digest(self.own.address, tuple(self._row(table, now_ns) for table in self._tables.values()))

    def _row(self, table: Table, now_ns: int) -> Row:
        return Row(table.origin, table.boot, table.serial, self._beats[table.origin], self._age_s(table.origin, now_ns))

    def _age_s(self, origin: str, now_ns: int) -> int:
        """Rounded up, so that no origin grows younger from mouth to mouth."""
        return 0 if origin == self.origin else max(now_ns - self._heard_ns[origin], 0) // SECOND + 1

    # --- What others say --------------------------------------------------------------------------------------------------

    def heard(self, message: Message, now_ns: int) -> list[Send]:
        """Take in a message; what is to be sent because of it."""
        if isinstance(message, Digest):
            return self._compare(message, now_ns)
        if isinstance(message, Ask):
            return self._answer(message, now_ns)
        return self._take_in(message, now_ns)

    def _compare(self, digest: Digest, now_ns: int) -> list[Send]:
        """Ask for what is newer there; tell what is newer here."""
        wants: list[Row] = []
        lacks = False
        present = 0
        for row in digest.rows:
            table = self._tables.get(row.origin)
            present += table is not None
            if row.origin == self.origin:
                self._compare_own(row, now_ns)
                lacks |= (row.boot, row.serial) < self.own.version
                continue
            if table is not None:
                if row.boot == table.boot and row.beat > self._beats[row.origin]:
                    self._hear(row.origin, row.boot, row.beat, row.age_s, now_ns)
                if row.boot == table.boot and row.serial == table.serial:
                    continue
                if (row.boot, row.serial) < table.version:
                    lacks = True
                    continue
            if self._may_ask(row, now_ns):
                self._asked_ns[row.origin] = now_ns
                wants.append(Row(row.origin, *self._version(row.origin)))
        sends = [Send(digest.address, Ask(self.own.address, tuple(wants)))] if wants else []
        lacks |= digest.whole and present < len(self._tables)
        is_new = not digest.whole and bool(wants)
        if (lacks or is_new) and now_ns - self._told_ns.get(digest.address, now_ns - self.terms.ask_ns) >= self.terms.ask_ns:
            self._told_ns[digest.address] = now_ns
            sends.append(Send(digest.address, self.digest(now_ns)))
        return sends

    def _compare_own(self, row: Row, now_ns: int) -> None:
        """Another life of this origin is newer, as after the clock was set back, or a second process uses its name."""
        if (row.boot, row.serial) > self.own.version:
            self.outbid += 1
            self._begin(row.boot + 1)
            self.soon(now_ns)

    def _may_ask(self, row: Row, now_ns: int) -> bool:
        asked_ns = self._asked_ns.get(row.origin)
        is_waiting = asked_ns is not None and now_ns - asked_ns < self.terms.ask_ns
        is_gone = row.age_s * SECOND >= self.terms.gone_ns
        has_room = row.origin in self._tables or len(self._tables) < ORIGINS_MAX
        return has_room and not is_gone and not is_waiting

    def _hear(self, origin: str, boot: int, beat: int, age_s: int, now_ns: int) -> None:
        """An origin's beat has risen, as another process tells: it was alive at most ``age_s`` ago."""
        if boot == self._tables[origin].boot and beat > self._beats[origin]:
            self._beats[origin] = beat
            self._heard_ns[origin] = max(self._heard_ns[origin], now_ns - age_s * SECOND)

    def _answer(self, ask: Ask, now_ns: int) -> list[Send]:
        room = PAGE_SIZE_MAX
        pages: list[Page] = []
        rest: list[str] = []
        for row in ask.rows:
            table = self._tables.get(row.origin)
            if table is None or table.version <= (row.boot, row.serial):
                continue
            if room <= 0:
                rest.append(row.origin)
                continue
            since = row.serial if row.boot == table.boot else 0
            page = page_of(table, since, room, self._beats[row.origin], self._age_s(row.origin, now_ns))
            room -= page.size
            pages.append(page)
            if page.upto < table.serial:
                rest.append(row.origin)
        return [Send(ask.address, Pages(self.own.address, tuple(pages), tuple(rest)))] if pages else []

    def _take_in(self, message: Pages, now_ns: int) -> list[Send]:
        taken = [self._take(page, now_ns) for page in message.pages]
        rest = [origin for origin in message.rest if origin != self.origin] if any(taken) else []
        self._asked_ns.update(dict.fromkeys(rest, now_ns))
        rows = tuple(Row(origin, *self._version(origin)) for origin in rest)
        return [Send(message.address, Ask(self.own.address, rows))] if rows else []

    def _version(self, origin: str) -> tuple[int, int]:
        table = self._tables.get(origin)
        return table.version if table is not None else (0, 0)

    def _take(self, page: Page, now_ns: int) -> bool:
        """Whether a page told something new, and there was room for it."""
        old = self._tables.get(page.origin)
        self._asked_ns.pop(page.origin, None)
        if page.origin == self.origin or page.age_s * SECOND >= self.terms.gone_ns:
            return False
        table = patched(old, page)
        if table is None or newer(old, table) is old:
            return False
        before = len(old.entries) if old is not None else 0
        self.full = ""
        if self._count() + len(table.entries) - before > NAMES_MAX or (old is None and len(self._tables) >= ORIGINS_MAX):
            self.full = f"names of {page.origin} were not taken in: the limit is {NAMES_MAX} names of {ORIGINS_MAX} origins"
            return False
        if old is None or old.boot != table.boot:
            self._beats[page.origin], self._heard_ns[page.origin] = page.beat, now_ns - page.age_s * SECOND
        self._keep(table)
        self._hear(page.origin, page.boot, page.beat, page.age_s, now_ns)
        return True

    def versions(self) -> dict[str, tuple[int, int]]:
        """Origin → boot and serial of its table here."""
        return {origin: table.version for origin, table in self._tables.items()}

    # --- What is known ----------------------------------------------------------------------------------------------------

    def reach(self, now_ns: int) -> dict[str, Reach]:
        """Origin → whether it is heard; one silent for longer is left out."""
        live_ns, gone_ns = self.terms.live_scans * self.terms.scan_ns, self.terms.gone_ns
        found = {self.origin: Reach.LIVE}
        for origin, heard_ns in self._heard_ns.items():
            if origin != self.origin and (silent_ns := now_ns - heard_ns) < gone_ns:
                found[origin] = Reach.LIVE if silent_ns <= live_ns else Reach.UNREACHABLE
        return found

    def tree(self, now_ns: int) -> Tree:
        """All names as they stand now."""
        reach = self.reach(now_ns)
        if self._tree is None or self._tree[:2] != (self._changes, reach):
            self._tree = self._changes, reach, Tree(self._tables.values(), reach, self.claims)
        return self._tree[2]
