"""The bytes of a schedule's table: header, rows, terms, courses, histograms. SCHEDULE.md beside this file is normative.

This file turns bytes into values and values into bytes, and checks each value that it reads: a row that another program has
spoilt is an error in a sentence for that task, and stops no other one. It opens nothing: `failover.boards.schedule_file` maps the
table.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable
from typing import Final

from msgspec import Struct, field

from failover.core.schedule.activation import NO_ROW, STATES, Counts, Predecessor, State
from failover.core.schedule.course import Course, Overrun
from failover.core.schedule.orders import Row
from failover.core.schedule.terms import (
    CPUS_MAX,
    KINDS,
    MODE_SIZE_MAX,
    MODES_MAX,
    NAME_SIZE_MAX,
    PERIOD_MAX_NS,
    PERIOD_MIN_NS,
    PREDECESSORS_MAX,
    PRIORITY_MAX,
    TASKS_MAX,
    Kind,
    Mode,
    Terms,
)
from failover.errors import ScheduleError, ScheduleGoneError

Buffer = bytes | bytearray | memoryview


class View:
    """A table as bytes, and as words of four and of eight bytes: a word is loaded and stored whole.

    Attributes:
        octets, ints, words: the same memory.
    """

    __slots__ = ("ints", "octets", "words")

    def __init__(self, octets: memoryview) -> None:
        self.octets = octets[:FILE_SIZE]
        self.ints, self.words = self.octets.cast("I"), self.octets.cast("Q")


MAGIC: Final = b"\x89FOSCH\r\n"
VERSION: Final = 1

HOLE: Final = 0
GONE: Final = 2**64 - 1
FIRST: Final = 2
"""Generations: of no table, of one that was made anew elsewhere, of a new one."""
ALONE: Final = 8
"""Flag of a header: made without an agent."""
DECLARED: Final = 1
STRICT: Final = 1
AT_NEXT: Final = 2
"""Flags of a row, and of its terms."""

TABLE_LOCK: Final = 1 << 62
ROW_LOCKS: Final = 1 << 41
CPU_LOCKS: Final = 1 << 42
"""Bytes of the file that stand for something when they are locked: the table changes; row i is run by a process; a program whose
task runs on processor i stands still for a capture."""

HEADER: Final = struct.Struct("<8sIIQIIQ16sQ64s")
ROWS_AT: Final = 4096
ROW_SIZE: Final = 2048
FILE_SIZE: Final = ROWS_AT + TASKS_MAX * ROW_SIZE

GENERATION_AT: Final = 16

FLAGS_FIELD: Final = 0
SERIAL_FIELD: Final = 4
SUCCESSORS_FIELD: Final = 8
MODES_COUNT_FIELD: Final = 12
NAME_FIELD: Final = 16
TERMS_FIELDS: Final = (256, 512)
LIVE_FIELD: Final = 768
SETTLED_FIELD: Final = LIVE_FIELD + 8
DUE_FIELD: Final = LIVE_FIELD + 32
STARTED_FIELD: Final = LIVE_FIELD + 24
ENDED_FIELD: Final = LIVE_FIELD + 48
LIMIT_FIELD: Final = LIVE_FIELD + 56
MODES_FIELD: Final = 1024
LATENESS_FIELD: Final = 1536
DURATION_FIELD: Final = 1792
"""Offsets in a row."""

NAME_ROOM: Final = 240
TERMS: Final = struct.Struct("<IIQQQQQQQiHHHH16H")
MODE: Final = struct.Struct("<24sQQQQ8x")
LIVE_WORDS: Final = 12
BLAMED_FIELD: Final = LIVE_FIELD + 104
ADOPTED_FIELD: Final = LIVE_FIELD + 108
COURSE_NUMBER_FIELD: Final = LIVE_FIELD + 112
COURSES_FIELD: Final = LIVE_FIELD + 120
LISTENERS_FIELD: Final = LIVE_FIELD + 168
COURSE_WORDS: Final = 3
HALF: Final = struct.Struct("<I")
BUCKETS: Final = 64
HISTOGRAM: Final = struct.Struct(f"<{BUCKETS}I")

COURSE_TURNS: Final = 16
"""Of reading what is being written: the writer needs less than a microsecond, once in a change."""
LOW_HALF: Final = 0xFFFFFFFF


class Header(Struct, frozen=True):
    """What a table says of itself.

    Attributes:
        origin_ns: the instant that phases count from, CLOCK_MONOTONIC of the initial time namespace.
    """

    flags: int
    generation: int
    boot_id: bytes
    origin_ns: int
    robot: str


class Live(Struct, frozen=True):
    """How a task is, as the process that runs it says. Instants: CLOCK_MONOTONIC of the initial time namespace.

    Attributes:
        settled: activations below this number have ended, or were skipped.
        number: of the activation under way, or of the next one; due at ``due_ns``.
        limit_ns: when the one under way is to have ended; 0: whenever.
        blamed: row of the predecessor for which a deadline was missed last.
        adopted: serial of the terms in force.
    """

    state: State = State.IDLE
    pid: int = 0
    settled: int = 0
    number: int = 0
    due_ns: int = 0
    started_ns: int = 0
    ended_ns: int = 0
    limit_ns: int = 0
    counts: Counts = field(default_factory=Counts)
    blamed: int = NO_ROW
    adopted: int = 0


def row_at(index: int) -> int:
    """Where a row lies."""
    return ROWS_AT + index * ROW_SIZE


def bucket(duration_ns: int) -> int:
    """Of a histogram: bucket b counts what lies from 2^(b-1) to below 2^b ns; bucket 0 what takes no time."""
    return min(max(duration_ns, 0).bit_length(), BUCKETS - 1)


# --- Reading ---------------------------------------------------------------------------------------------------------


def read_header(view: Buffer) -> Header:
    """What a mapped table says of itself.

    Raises:
        ScheduleGoneError: it was made anew, or zeros are in its place.
        ScheduleError: it is no table, or of another version.
    """
    if len(view) < FILE_SIZE:
        raise ScheduleError(f"this is no schedule: it has {len(view)} bytes, a schedule has {FILE_SIZE}")
    magic, version, flags, generation, _count, capacity, _size, boot_id, origin_ns, robot = HEADER.unpack_from(view)
    if generation == GONE or (generation == HOLE and magic == bytes(8)):
        raise ScheduleGoneError("this schedule was made anew, or removed")
    if magic != MAGIC:
        raise ScheduleError(f"this is no schedule: it begins with {magic.hex(' ')}")
    if version != VERSION:
        raise ScheduleError(
            f"the schedule has version {version}, this program reads version {VERSION}; update the older of the two"
        )
    if generation == HOLE or capacity != TASKS_MAX or origin_ns > 2**63:
        raise ScheduleError(f"damaged: generation {generation}, room for {capacity} tasks, origin {origin_ns}")
    return Header(flags, generation, boot_id, origin_ns, robot.rstrip(b"\0").decode(errors="replace"))


def serial_of(view: View, index: int) -> int:
    """The number of the newest order of a row."""
    return view.ints[(row_at(index) + SERIAL_FIELD) // 4]


def name_of(view: View, index: int) -> str:
    """A row's name; "" of one that is not in use."""
    at = row_at(index) + NAME_FIELD
    return bytes(view.octets[at : at + NAME_ROOM]).rstrip(b"\0").decode(errors="replace")


def is_declared(view: View, index: int) -> bool:
    """Whether a row is a task; else no task waits for it."""
    return bool(view.ints[(row_at(index) + FLAGS_FIELD) // 4] & DECLARED)


def is_awaited(view: View, index: int) -> bool:
    """Whether the end of an activation wakes anyone: tasks that run after it, or a capture that waits for it."""
    at = row_at(index)
    return view.ints[(at + SUCCESSORS_FIELD) // 4] != 0 or view.ints[(at + LISTENERS_FIELD) // 4] != 0


def listening_piece(index: int, listens: bool) -> Piece:
    """A capture waits for the end of a task's activation, or does not any more; written by the one process that captures it."""
    return row_at(index) + LISTENERS_FIELD, HALF.pack(listens)


def read_terms(view: View, index: int) -> tuple[int, Terms]:
    """The serial and the terms of the newest order.

    Raises:
        ScheduleError: they are damaged; names the value.
    """
    for _ in range(COURSE_TURNS):
        serial = serial_of(view, index)
        fields = TERMS.unpack_from(view.octets, row_at(index) + TERMS_FIELDS[serial % 2])
        if serial_of(view, index) == serial:
            return serial, _terms(index, fields)
    raise ScheduleError(f"row {index} of the schedule was changed {COURSE_TURNS} times while it was read")


def _terms(index: int, fields: tuple[int, ...]) -> Terms:
    flags, _, period, phase, deadline, at, distance, budget, cpus, priority, mode, kind, overrun, count = fields[:14]
    after = fields[14:]
    where = f"damaged: row {index} of the schedule"
    times = {"period": period, "phase": phase, "deadline": deadline, "distance": distance, "budget": budget}
    for name, value in times.items():
        if value > PERIOD_MAX_NS:
            raise ScheduleError(f"{where} has a {name} of {value} ns; up to {PERIOD_MAX_NS} are possible")
    if kind >= len(KINDS) or overrun >= len(Overrun) or count > PREDECESSORS_MAX or mode >= MODES_MAX or at > 2**63:
        raise ScheduleError(f"{where} has kind {kind}, overrun {overrun}, mode {mode}, {count} predecessors, instant {at}")
    if kind == Kind.PERIODIC and (period < PERIOD_MIN_NS or phase >= period):
        raise ScheduleError(f"{where} has phase {phase} of a period of {period} ns")
    if not 0 <= priority <= PRIORITY_MAX:
        raise ScheduleError(f"{where} has priority {priority}")
    if any(row >= TASKS_MAX for row in after[:count]):
        raise ScheduleError(f"{where} runs after a row that is not there")
    return Terms(
        *(Kind(kind), period, phase, deadline, at, distance, budget, cpus, priority, mode, Overrun(overrun)),
        *(bool(flags & STRICT), bool(flags & AT_NEXT), after[:count]),
    )


def read_modes(view: View, index: int) -> tuple[Mode, ...]:
    """A task's quality modes."""
    at = row_at(index)
    count = min(view.ints[(at + MODES_COUNT_FIELD) // 4], MODES_MAX)
    found = (MODE.unpack_from(view.octets, at + MODES_FIELD + place * MODE.size) for place in range(count))
    return tuple(Mode(name.rstrip(b"\0").decode(errors="replace"), *numbers) for name, *numbers in found)


def read_course(view: View, index: int) -> Course:
    """The instants of a task, as the process that runs it says."""
    at, number, anchor_ns, period_ns = row_at(index), 0, 0, 0
    for _ in range(COURSE_TURNS):
        newest = view.ints[(at + COURSE_NUMBER_FIELD) // 4]
        first = (at + COURSES_FIELD) // 8 + newest % 2 * COURSE_WORDS
        number, anchor_ns, period_ns = view.words[first : first + COURSE_WORDS]
        if view.ints[(at + COURSE_NUMBER_FIELD) // 4] == newest:
            break
    return Course(number, anchor_ns, period_ns)


def read_predecessor(view: View, index: int) -> Predecessor:
    """What a successor sees of a task."""
    course = read_course(view, index)
    return Predecessor(is_declared(view, index), course, view.words[(row_at(index) + SETTLED_FIELD) // 8])


def read_live(view: View, index: int) -> Live:
    """How a task is. Its words are not of one instant while it runs; a state that is none reads as idle."""
    at = row_at(index)
    state, pid = view.ints[(at + LIVE_FIELD) // 4], view.ints[(at + LIVE_FIELD) // 4 + 1]
    first = (at + SETTLED_FIELD) // 8
    settled, number, started, due, began, ended_ns, limit, *counted = view.words[first : first + LIVE_WORDS]
    blamed = view.ints[(at + BLAMED_FIELD) // 4]
    return Live(
        *(State(state) if state < len(STATES) else State.IDLE, pid, settled, number, due, began, ended_ns, limit),
        *(Counts(started, *counted), blamed - 1 if blamed <= TASKS_MAX else NO_ROW, view.ints[(at + ADOPTED_FIELD) // 4]),
    )


def read_pulse(view: View, index: int) -> tuple[int, int, int, int]:
    """State, *settled*, when the activation under way was due, or the next one is, and when the newest one ended: read quickly.

    They are of one instant if a second reading finds the same.
    """
    at, words = row_at(index), view.words
    return (
        view.ints[(at + LIVE_FIELD) // 4],
        words[(at + SETTLED_FIELD) // 8],
        words[(at + DUE_FIELD) // 8],
        words[(at + ENDED_FIELD) // 8],
    )


def read_histogram(view: View, index: int, field: int) -> tuple[int, ...]:
    """How often each `bucket` was hit: of `LATENESS_FIELD` or `DURATION_FIELD`."""
    return HISTOGRAM.unpack_from(view.octets, row_at(index) + field)


def percentile_ns(histogram: tuple[int, ...], share: float) -> int:
    """The bound below which so much of what was counted lies; 0 if nothing was."""
    wanted, seen = share * sum(histogram), 0
    for place, count in enumerate(histogram):
        seen += count
        if count and seen >= wanted:
            return 1 << place
    return 0


def read_rows(view: View) -> dict[int, Row]:
    """All rows in use, as orders see them.

    Raises:
        ScheduleError: one is damaged.
    """
    rows = {}
    for index in range(TASKS_MAX):
        name = name_of(view, index)
        if name:
            terms = read_terms(view, index)[1] if is_declared(view, index) else None
            rows[index] = Row(name, terms, read_modes(view, index) if terms else ())
    return rows


# --- Writing ---------------------------------------------------------------------------------------------------------

Piece = tuple[int, bytes]
"""Bytes and the offset at which they are to be written."""


def new_header(robot: str, boot_id: bytes, origin_ns: int, flags: int = 0) -> bytes:
    """The first bytes of a table without tasks; all others are zeros, up to `FILE_SIZE`."""
    return HEADER.pack(MAGIC, VERSION, flags, FIRST, 0, TASKS_MAX, FILE_SIZE, boot_id, origin_ns, robot.encode())


def pack_terms(terms: Terms) -> bytes:
    """Terms as a bank of a row has them."""
    after = (*terms.after, *(0 for _ in range(PREDECESSORS_MAX - len(terms.after))))
    flags = STRICT * terms.strict | AT_NEXT * terms.at_next
    return TERMS.pack(
        *(flags, 0, terms.period_ns, terms.phase_ns, terms.deadline_ns, terms.at_ns, terms.distance_ns, terms.budget_ns),
        *(terms.cpus & (1 << CPUS_MAX) - 1, terms.priority, terms.mode, terms.kind, terms.overrun, len(terms.after)),
        *after,
    )


def row_pieces(view: View, index: int, row: Row, before: Row | None) -> list[Piece]:
    """What to write for one row, in this order; the last piece makes the order visible. The generation is the caller's, and odd.

    A row that gets another name begins anew: its counts and histograms are zero.
    """
    at, serial = row_at(index), serial_of(view, index)
    pieces: list[Piece] = []
    if before is None or before.name != row.name:
        name = row.name.encode()
        assert len(name) <= NAME_SIZE_MAX
        pieces += [(at + FLAGS_FIELD, HALF.pack(0)), (at + LIVE_FIELD, bytes(ROW_SIZE - LIVE_FIELD))]
        pieces += [(at + NAME_FIELD, name.ljust(NAME_ROOM, b"\0"))]
    if row.terms is None:
        return [*pieces, (at + FLAGS_FIELD, HALF.pack(0)), (at + SERIAL_FIELD, HALF.pack(serial + 1 & LOW_HALF))]
    modes = b"".join(
        MODE.pack(mode.name.encode()[:MODE_SIZE_MAX], mode.period_ns, mode.deadline_ns, mode.budget_ns, mode.cpus)
        for mode in row.modes
    )
    pieces += [(at + MODES_FIELD, modes), (at + MODES_COUNT_FIELD, HALF.pack(len(row.modes)))]
    pieces += [(at + TERMS_FIELDS[(serial + 1) % 2], pack_terms(row.terms)), (at + FLAGS_FIELD, HALF.pack(DECLARED))]
    return [*pieces, (at + SERIAL_FIELD, HALF.pack(serial + 1 & LOW_HALF))]


def successors_pieces(rows: dict[int, Row]) -> list[Piece]:
    """How many tasks run after each row."""
    counts = dict.fromkeys(rows, 0)
    for row in rows.values():
        for index in row.terms.after if row.terms else ():
            counts[index] += 1
    return [(row_at(index) + SUCCESSORS_FIELD, HALF.pack(count)) for index, count in counts.items()]


def write_live(view: View, index: int, live: Live) -> None:
    """The words of a running task, by the process that runs it; *settled* and the state last."""
    at, counts = row_at(index), live.counts
    first = (at + SETTLED_FIELD) // 8
    words = (live.number, counts.started, live.due_ns, live.started_ns, live.ended_ns, live.limit_ns)
    for place, word in enumerate((*words, *(counts.ended, counts.misses, counts.overruns, counts.skipped, counts.orphaned)), 1):
        view.words[first + place] = word
    view.ints[(at + BLAMED_FIELD) // 4] = live.blamed + 1
    view.ints[(at + ADOPTED_FIELD) // 4] = live.adopted
    view.ints[(at + LIVE_FIELD) // 4 + 1] = live.pid
    view.words[first] = live.settled
    view.ints[(at + LIVE_FIELD) // 4] = live.state


class Begin:
    """Writes that an activation begins: what others must know of it. All else is written at its end, by `write_live`."""

    __slots__ = ("_ints", "_limit", "_started", "_state", "_words")

    def __init__(self, view: View, index: int) -> None:
        at = row_at(index)
        self._ints, self._words = view.ints, view.words
        self._state, self._started, self._limit = (at + LIVE_FIELD) // 4, (at + STARTED_FIELD) // 8, (at + LIMIT_FIELD) // 8

    def write(self, started: int, began_ns: int, limit_ns: int) -> None:
        """The state last.

        Args:
            started: activations that began, with this one.
        """
        words, first = self._words, self._started
        words[first], words[first + 2], words[self._limit] = started, began_ns, limit_ns
        self._ints[self._state] = State.RUNNING


def write_course(view: View, index: int, course: Course) -> None:
    """A task's new course, by the process that runs it; to be written before what is settled by it."""
    at = row_at(index)
    newest = view.ints[(at + COURSE_NUMBER_FIELD) // 4] + 1 & LOW_HALF
    first = (at + COURSES_FIELD) // 8 + newest % 2 * COURSE_WORDS
    for place, word in enumerate((course.number, course.anchor_ns, course.period_ns)):
        view.words[first + place] = word
    view.ints[(at + COURSE_NUMBER_FIELD) // 4] = newest


def count(view: View, index: int, field: int, duration_ns: int) -> None:
    """One more in a histogram, by the process that runs the task."""
    place = (row_at(index) + field) // 4 + bucket(duration_ns)
    view.ints[place] = view.ints[place] + 1 & LOW_HALF


def apply(view: View, pieces: Iterable[Piece]) -> None:
    """Write pieces in their order; four bytes are one store."""
    for offset, octets in pieces:
        if len(octets) == HALF.size:
            view.ints[offset // HALF.size] = HALF.unpack(octets)[0]
        else:
            view.octets[offset : offset + len(octets)] = octets
