"""An item of a board in a program's hands: put, get, wait.

`put` and `get` are closures of `failover.core.board.banks`, made for the place where the item lies. They go the slow way, which
is written here, whenever something is not as it was: the table changed, the board was made anew, a robot was named, a process was
forked. So this file may take its time, and the closures need none.
"""

from __future__ import annotations

import asyncio
import os
import sys
import time
import weakref
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import partial
from types import FrameType
from typing import Any, Final, Protocol

from failover.boards import boottime, futex
from failover.boards.component_item import ComponentItem, Primary
from failover.boards.fence import FENCE
from failover.boards.mapping import MappedFile
from failover.core.board import ages, layout
from failover.core.board.banks import UNKNOWN, Found, Get, Put, Reading, Remember, Writer, first_of_epoch, get_carefully
from failover.core.board.banks import reader as reader_of
from failover.core.board.banks import writer as writer_of
from failover.core.board.item_types import OPAQUE, Opaque, canonical, parse, size_of
from failover.core.board.item_values import Values, values_of
from failover.core.board.layout import Record
from failover.errors import (
    BoardError,
    BoardGoneError,
    ItemError,
    NeverWrittenError,
    OvertakenError,
    ValueMisfitError,
    WriterTakenError,
)
from failover.fencing.epoch import epoch

SLICE_S: Final = 0.1
"""The longest sleep without a look: a wake-up may be lost (BOARD.md), and a board may be made anew."""
NUMBER_MAX: Final = 1 << 63
"""No put has such a number; a board's file that was written over may say so."""
TURNS: Final = 100
"""Of a call whose board is made anew each time it looks."""
PUT_WAIT_S: Final = 5.0
"""For another thread's put of the same item, which takes a microsecond of its processor's time."""


class OpenBoard(Protocol):
    """The part of a board that an item needs (`failover.boards.board.Board`)."""

    guard: AbstractContextManager[Any]
    skew_ns: int

    @property
    def robot(self) -> str: ...
    def found(self, name: str, robot: str) -> tuple[MappedFile, Record]: ...
    def has(self, name: str, robot: str) -> bool: ...
    def is_good(self, source: Source) -> bool: ...
    def living(self) -> list[str]: ...
    def primary(self, component: str) -> Primary: ...
    def read_only(self, file: MappedFile, record: Record) -> str: ...
    def own_source(self, name: str) -> Source: ...
    def whose(self, file: MappedFile, record: Record) -> str: ...
    def writer(self, name: str) -> ItemWriter: ...


def values_for(record: Record, shape: Any) -> Values:
    """How a program that means ``shape`` packs and unpacks an item.

    Raises:
        ItemError: the item is declared as something else; says both.
        BoardError: the file's declaration is damaged.
    """
    where = f"item {record.name!r}"
    try:
        declared = parse(record.text or f"bytes[{record.size}]")
    except ItemError as error:
        raise BoardError(f"damaged: {where}: {error}") from None
    kind = layout.KINDS.index(declared.kind) if isinstance(declared, Opaque) else layout.STRUCT
    if (size_of(declared), kind) != (record.size, record.kind):
        raise BoardError(f"damaged: {where}: {record.text} for {record.size} bytes of the kind {layout.KINDS[record.kind]}")
    meant = "bytes" if shape is bytes else shape
    opaque = declared.kind if isinstance(declared, Opaque) else ""
    if isinstance(meant, str) and meant in OPAQUE:
        if opaque != meant:
            raise ItemError(f"{where} is declared as {canonical(declared)}, not as {meant}", "type")
        meant = None
    elif opaque == "bytes" and meant is not None:
        raise ItemError(f"{where} is declared as {canonical(declared)}; take it as bytes, or declare its type", "type")
    try:
        return values_of(declared, meant, bool(record.flags & layout.FINITE))
    except ItemError as error:
        raise ItemError(f"{where}: {error}", error.key) from None


class Source:
    """One robot's item, as this program has it mapped.

    Attributes:
        get: its fast get.
        generation: at which record and place were examined last.
    """

    def __init__(self, file: MappedFile, record: Record, values: Values) -> None:
        self.file = file
        self.record = record
        self.values = values
        self.place = file.place(record)
        self.generation = UNKNOWN
        self.get: Get | None = None
        self._remember: Remember | None = None

    def use(self, get: Get, remember: Remember) -> None:
        self.get, self._remember = get, remember
        self.remember(self.generation)

    def remember(self, generation: int) -> None:
        """The fast get works while the file has this generation."""
        self.generation = generation
        if self._remember is not None and FENCE is None:
            self._remember(generation)


class ItemWriter:
    """All puts of one item by this process: one lock and one count for all handles."""

    def __init__(self, board: OpenBoard, name: str) -> None:
        self._board = board
        self.name = name
        self._writer: Writer | None = None
        self._source: Source | None = None
        self._followers: weakref.WeakSet[Item] = weakref.WeakSet()

    def follow(self, item: Item) -> None:
        """Tell a handle whenever there is a new fast put."""
        self._followers.add(item)

    @property
    def put(self) -> Put:
        """The fast put of bytes, or the slow one before the first."""
        return self.put_slowly if self._writer is None else self._writer.put

    def forget(self) -> None:
        """The next put examines everything, and takes the lock anew."""
        if self._writer is not None:
            self._writer.remember(UNKNOWN)
        self._writer = self._source = None

    def put_slowly(self, value: Any, at: int | None = None) -> None:
        """Take the steps that the fast put leaves out: examine, take the lock, wait for another thread.

        Raises:
            ValueMisfitError, WriterTakenError, BoardError: nothing was put.
        """
        writer, source = self.ready()
        octets = self._examined(source, value)
        skew, now = self._board.skew_ns, boottime.now_ns(self._board.skew_ns)
        stamp = now if at is None else at - skew
        if not 0 <= stamp <= now:
            raise ValueMisfitError(
                f"item {self.name!r}: at={at} is {'in the future' if stamp > now else 'before the machine started'}; "
                "give nanoseconds of time.clock_gettime_ns(time.CLOCK_BOOTTIME)"
            )
        end = time.monotonic() + PUT_WAIT_S
        while not writer.store(octets, stamp, 0):
            if _is_inside(writer) or time.monotonic() > end:
                raise BoardError(f"item {self.name!r} is put inside of a put of it, by a signal's function; put it elsewhere")
            time.sleep(0)

    def ready(self) -> tuple[Writer, Source]:
        """The lock is held, and the place is right.

        Raises:
            WriterTakenError: another process writes the item.
            BoardError: it may only be read here.
        """
        with self._board.guard:
            source = self._board.own_source(self.name)
            if self._writer is None or self._source is not source:
                self._writer = self._taken(source)
                self._source = source
                for item in list(self._followers):
                    item.take_put(self)
            if FENCE is None:
                self._writer.remember(source.generation)
            return self._writer, source

    def _taken(self, source: Source) -> Writer:
        file, record, place = source.file, source.record, source.place
        if not file.is_writable:
            raise BoardError(f"item {self.name!r} cannot be put: {self._board.read_only(file, record)}")
        if not file.take_writer(record, os.getpid()):
            raise WriterTakenError(self._board.whose(file, record))
        newest = place.words[place.newest]
        number = first_of_epoch(newest, epoch(), record.banks) - 1
        if number >= NUMBER_MAX:
            raise BoardError(
                f"damaged: item {self.name!r} of {file.path}: its newest put has the number {newest}; none can follow"
            )
        woken = _waker(file, record)
        return writer_of(place, number, boottime.CLOCK, self._board.skew_ns, self.put_slowly, woken, file.always_wakes, FENCE)

    def _examined(self, source: Source, value: Any) -> bytes:
        """The value's bytes, for an item of bytes; those of a typed one are packed already."""
        try:
            octets: bytes = source.values.pack(value) if source.record.kind == layout.BYTES else value
        except ValueMisfitError as error:
            self.refuse(source)
            raise ValueMisfitError(f"item {self.name!r}: {error}") from None
        if len(octets) > source.record.size:
            self.refuse(source)
            raise ValueMisfitError(f"item {self.name!r}: a value of {len(octets)} bytes; the item holds {source.record.size}")
        return octets

    def refuse(self, source: Source) -> None:
        """Count a put that was refused."""
        if source.file.is_writable:
            source.place.words[(source.record.at + layout.REFUSED_FIELD) // 8] += 1


def _is_inside(writer: Writer) -> bool:
    """Whether this thread is in the middle of a put already, besides the one that has just gone the slow way."""
    codes = (writer.put.__code__, writer.store.__code__)
    frame: FrameType | None = sys._getframe(2).f_back
    while frame is not None and frame.f_code not in codes:
        frame = frame.f_back
    return frame is not None


def _waker(file: MappedFile, record: Record) -> Callable[[int], None]:
    """What wakes those that wait for an item, or for any of several (BOARD.md, *Waiting*); it is given the stamp of the put."""
    area, words, at = file.area, file.words, record.at + layout.WAITERS_FIELD
    newest, changed = file.address(record.at + layout.NEWEST_FIELD), file.address(layout.CHANGED_AT)  # good while `area` is
    is_urgent, always_wakes = bool(record.flags & layout.URGENT), file.always_wakes

    def wake(stamp_ns: int) -> None:
        item, any_ = area[at : at + 2]
        if any_:  # what is not set stays as it is: the agent may ask in this moment
            area[at + 1] = 0
            if is_urgent:
                file.touch()
        if item:
            area[at] = 0
        if item or always_wakes:
            futex.wake(newest)
        if any_:
            words[layout.CHANGED_AT // 8] = stamp_ns
            futex.wake(changed)

    return wake


class Item:
    """A handle of one item: this robot's, to put and get, and the other robots', to get.

    Any number of threads may get. Puts of one item by several threads follow one another.

    Attributes:
        put: ``put(value, at=None)``. ``at``: ns of CLOCK_BOOTTIME at which the value was measured; None: now.
            Raises ValueMisfitError, WriterTakenError, BoardError; then nothing was put.
        get: ``get(robot=None)`` → `Reading`; None: this robot's.
            Raises NeverWrittenError, OvertakenError, BoardError.
    """

    __slots__ = ("__weakref__", "_board", "_gets", "_shape", "_sources", "_taken", "get", "name", "put")

    def __init__(self, board: OpenBoard, name: str, shape: Any) -> None:
        self.name = name
        self._board = board
        self._shape = shape
        self._sources: dict[str, Source] = {}
        self._gets: dict[str, Get] = {}
        self._taken: dict[str, int] = {}
        self.get: Get = self._slow_own
        self.put: Put = self._put_first

    # --- Put ---

    def _put_first(self, value: Any, at: int | None = None) -> None:
        """Put a value; the first time."""
        writer = self._board.writer(self.name)
        writer.follow(self)
        writer.ready()
        self.take_put(writer)
        self.put(value, at)

    def take_put(self, writer: ItemWriter) -> None:
        """Use the present fast put of this item."""
        source = self._board.own_source(self.name)
        raw = writer.put
        if source.record.kind == layout.BYTES:
            self.put = raw
            return
        pack = values_for(source.record, self._shape).pack

        def put(value: Any, at: int | None = None) -> None:
            """Put a value; ``at``: nanoseconds of CLOCK_BOOTTIME at which it was produced, unless that is now."""
            try:
                octets = pack(value)
            except ValueMisfitError as error:
                writer.refuse(source)
                raise ValueMisfitError(f"item {self.name!r}: {error}") from None
            raw(octets, at)

        self.put = put

    # --- Get ---

    def _elsewhere(self, robot: str | None) -> Reading:
        get = self._gets.get(robot)  # type: ignore[arg-type]
        return self._get_slowly(robot) if get is None else get()

    def _get_slowly(self, of: str | None = None) -> Reading:
        """The newest value; takes the steps that the fast get leaves out."""
        for _ in range(TURNS):
            source = self.source(of)
            try:
                found = get_carefully(source.place, FENCE)
                value = source.values.unpack(found.value)
            except (NeverWrittenError, OvertakenError, ValueMisfitError, BoardError) as error:
                if source.file.is_gone:
                    continue
                raise type(error)(f"item {self.name!r} of {source.file.header.robot}: {error}") from None
            if not source.file.is_gone:
                return self._reading(source, found, value, boottime.now_ns(self._board.skew_ns))
        raise BoardGoneError(f"item {self.name!r}: the board was made anew {TURNS} times while it was read")

    def _reading(self, source: Source, found: Found, value: Any, now_ns: int) -> Reading:
        age_ns = now_ns - found.stamp_ns
        age_max_ns = ages.age_max_ns(age_ns, found.error_us)
        bound_ns = source.record.bound_ns or source.place.words[source.place.formula]
        stale = ages.is_stale(age_max_ns, bound_ns)
        return Reading(value, age_ns, age_max_ns, source.file.header.robot, found.number, stale)

    def source(self, robot: str | None = None) -> Source:
        """Where one robot's item lies now.

        Raises:
            BoardError: the robot or the item is not there, the file is damaged, or the board is closed.
        """
        board = self._board
        with board.guard:
            robot = board.robot if robot is None else robot
            source = self._sources.get(robot)
            if source is None or not board.is_good(source):
                source = self._bound(robot)
            return source

    def _bound(self, robot: str) -> Source:
        board = self._board
        file, record = board.found(self.name, robot)
        source = Source(file, record, values_for(record, self._shape))
        source.generation = file.generation if file.generation % 2 == 0 else UNKNOWN
        unpack = None if record.kind == layout.BYTES else source.values.unpack
        is_own = robot == board.robot
        slow: Get = self._slow_own if is_own else partial(self._slow_peer, robot)
        get, remember = reader_of(source.place, boottime.CLOCK, board.skew_ns, robot, unpack, record.bound_ns, not is_own, slow)
        source.use(get, remember)
        self._sources[robot] = source
        self._gets[robot] = get
        if is_own and FENCE is None:
            self.get = get
        return source

    def _slow_own(self, of: str | None = None) -> Reading:
        """The newest value of this robot; of another one that is named by its fast get, once there is one."""
        return self._get_slowly() if of is None else self._elsewhere(of)

    def _slow_peer(self, robot: str, _of: str | None) -> Reading:
        return self._get_slowly(robot)

    def forget(self) -> None:
        """Examine everything at the next call."""
        for source in self._sources.values():
            source.remember(UNKNOWN)
        self._sources = {}
        self._gets = {}
        self.get = self._slow_own
        self.put = self._put_first

    # --- More ---

    def take(self, robot: str | None = None) -> Reading | None:
        """The newest value, once: None if this handle has taken it already, or there is none yet.

        Nothing is erased; other readers take it too.
        """
        try:
            reading: Reading = self.get(robot)
        except NeverWrittenError:
            return None
        if self._taken.get(reading.robot) == reading.number:
            return None
        self._taken[reading.robot] = reading.number
        return reading

    def youngest(self) -> Reading:
        """The reading with the lowest age, over this robot and all that are running.

        Raises:
            NeverWrittenError: none of them has put it.
        """
        readings = []
        for robot in self._board.living():
            try:
                readings.append(self.get(robot))
            except (NeverWrittenError, BoardGoneError):
                continue
            except BoardError:
                if self._board.has(self.name, robot):
                    raise
        if not readings:
            raise NeverWrittenError(f"item {self.name!r}: no robot that is running has put it")
        return min(readings, key=lambda reading: reading.age_ns)

    def of(self, component: str) -> ComponentItem:
        """This item at the robot that is the primary of a component: to read, it follows a takeover.

        Args:
            component: its path, "/lab/robot1/mapper".
        """
        board = self._board
        return ComponentItem(self, component, board.primary, lambda: boottime.now_ns(board.skew_ns))

    def is_at(self, robot: str) -> bool:
        """Whether a robot has this item."""
        return self._board.has(self.name, robot)

    def rest(self, robot: str, timeout_s: float) -> None:
        """Sleep until a robot puts this item, and not longer than this; it may wake early.

        Raises:
            BoardError: the robot or the item is not there.
        """
        self._sleep(robot, self._number(robot), timeout_s)

    def wait(self, robot: str | None = None, after: int | None = None, timeout: float | None = None) -> Reading:
        """Sleep until there is another put than ``after``; then as `get`.

        Args:
            after: `Reading.number` of the newest that is known; None: the newest at the call.
            timeout: seconds; None: for ever.

        Raises:
            TimeoutError: there was none.
        """
        end = None if timeout is None else time.monotonic() + timeout
        known = self._number(robot) if after is None else after
        while True:
            left = SLICE_S if end is None else end - time.monotonic()
            if self._sleep(robot, known, min(left, SLICE_S)):
                return self.get(robot)
            if end is not None and time.monotonic() >= end:
                raise TimeoutError(f"item {self.name!r} of {robot or self._board.robot} was not put within {timeout} s")

    def _number(self, robot: str | None) -> int:
        place = self.source(robot).place
        return place.words[place.newest]

    def _sleep(self, robot: str | None, known: int, timeout_s: float) -> bool:
        """Sleep for a while, or until the newest put is another one than ``known``; whether it is."""
        source = self.source(robot)
        file, place, at = source.file, source.place, source.record.at
        is_peer = bool(file.header.flags & layout.PEER)
        if place.words[place.newest] in (0, known) and timeout_s > 0:
            if file.is_writable and not is_peer:
                file.area[at + layout.WAITERS_FIELD] = 1
            word = layout.CHANGED_AT if is_peer else at + layout.NEWEST_FIELD
            before = file.word32(word)
            if place.words[place.newest] in (0, known):
                futex.wait(file.address(word), before, timeout_s)
        return place.words[place.newest] not in (0, known)

    async def changes(self, robot: str | None = None) -> AsyncIterator[Reading]:
        """Each new value from now on. A value that is replaced before it is read is not seen: an item is a state."""
        loop = asyncio.get_running_loop()
        known = self._number(robot)
        with ThreadPoolExecutor(1, "failover-board") as sleeper:
            while True:
                if await loop.run_in_executor(sleeper, self._sleep, robot, known, SLICE_S):
                    reading: Reading = self.get(robot)
                    known = reading.number
                    yield reading
