"""The bytes of a board's file: header, users, records, banks. BOARD.md beside this file is normative.

This file turns bytes into values and values into bytes. It checks every offset and size that a file tells against the size of
what is mapped, so that a damaged or hostile file is an error in a sentence and never an access outside of the mapping. It opens
nothing: `failover.boards` maps the files; `banks.py` has the order of the stores of a put and the loads of a get.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import astuple

from failover.core.board.item_types import ITEM_SIZE_MAX, Opaque, canonical
from failover.core.board.items import BANKS_MAX, BANKS_MIN, BLOCK_SIZE_MAX, ITEMS_MAX, NAME_SIZE_MAX, Item
from failover.errors import BoardError, BoardGoneError

Buffer = bytes | bytearray | memoryview

MAGIC: Final = b"\x89FOBRD\r\n"
VERSION: Final = 1
LINE: Final = 64
"""Bytes of a cache line; banks begin at a multiple of it."""

PRIVATE: Final = 1
OWN: Final = 2
PEER: Final = 4
AREAS: Final = (PRIVATE, OWN, PEER)
ALONE: Final = 8
"""Flags of a header; `ALONE`: made without an agent, so that the last user removes it."""

HOLE: Final = 0
GONE: Final = 2**64 - 1
FIRST: Final = 2
"""Generations: of no board, of one that was made anew elsewhere, of a new file."""

NOT, INSERT, RUN, REMOVE = range(4)
STATES: Final = ("not", "insert", "run", "remove")
"""States of a robot, as the header has them and as people read them."""

RANKS: Final = 1 << 16
"""More than robots of any team; numbers of items are multiples of it."""
USERS_MAX: Final = 256
"""Processes of one robot that have its board open: their rows lie between the header and the records."""
TEXT_SIZE_MAX: Final = 0xFFFF
"""Bytes of a declaration's text: its length has two bytes."""

BYTES, STRUCT, MSGPACK, JSON = range(4)
KINDS: Final = ("bytes", "struct", "msgpack", "json")

URGENT: Final = 1
NOT_SENT: Final = 2
KEPT: Final = 4
ADDED: Final = 8
FINITE: Final = 16
"""Flags of a record."""

USER_LOCKS: Final = 1 << 40
WRITER_LOCKS: Final = 1 << 41
TABLE_LOCK: Final = 1 << 62
"""Bytes of a file that stand for something when they are locked."""

HEADER: Final = struct.Struct("<8sIIQIIQ16sQ64sQIIQ")
USER: Final = struct.Struct("<II56s")
DECLARATION: Final = struct.Struct("<IHHQIIIIQQQI4x")
LENGTH: Final = struct.Struct("<H")
COUNT: Final = struct.Struct("<I")
WORD: Final = struct.Struct("<Q")

GENERATION_AT: Final = 16
COUNT_AT: Final = 24
FILE_SIZE_AT: Final = 32
CHANGED_AT: Final = 128
STATE_AT: Final = 140
HEARD_AT: Final = 144
USERS_AT: Final = 4096
RECORDS_AT: Final = 20480
RECORD_SIZE: Final = 192
"""Offsets in a file."""

BANKS_FIELD: Final = 6
NEWEST_FIELD: Final = 64
WAITERS_FIELD: Final = 72
PID_FIELD: Final = 76
REFUSED_FIELD: Final = 80
FRAMES_FIELD: Final = 128
LOST_FIELD: Final = 136
TRANSIT_FIELD: Final = 144
ROUND_FIELD: Final = 148
FORMULA_FIELD: Final = 152
"""Offsets in a record."""

BANK_HEAD: Final = 32
NUMBER_WORD, STAMP_WORD, SUM_WORD, SIZE_WORD = range(4)
"""Words of a bank before its value; the last one has the size in its low half and the error in its high one."""


class Header(Struct, frozen=True):
    """The header of a file, in which it describes itself.

    Attributes:
        count: records in use, holes included.
        heard_ns: in a peer's file: instant of the newest frame from that robot; 0: none.
    """

    flags: int
    generation: int
    count: int
    capacity: int
    file_size: int
    boot_id: bytes
    roster_digest: int
    robot: str
    rank: int
    state: int
    heard_ns: int


class Wanted(Struct, frozen=True):
    """An item as it is to be put into a table.

    Attributes:
        id: number of the item: CAMBADA's id.
        kind: index into `KINDS`.
        size: most bytes of a value.
        text: the declaration's canonical text; `digest` is its XXH3-64.
        period, phase: in rounds.
        bound_ns: past it a reading is stale; 0: not declared.
    """

    id: int
    name: str
    size: int
    kind: int = BYTES
    banks: int = BANKS_MIN
    period: int = 1
    phase: int = 0
    digest: int = 0
    bound_ns: int = 0
    flags: int = 0
    text: str = ""


def wanted_of(item: Item, id_: int, flags: int = 0) -> Wanted:
    """A declaration as a table has it; ``flags``: besides those that it says itself."""
    kind = KINDS.index(item.type.kind) if isinstance(item.type, Opaque) else STRUCT
    said = {URGENT: item.urgent, NOT_SENT: not item.transmit, KEPT: item.keep, FINITE: item.finite}
    flags |= sum(flag for flag, is_said in said.items() if is_said)
    bound_ns = round(item.bound_ms * 1_000_000)
    numbers = (item.size, kind, item.banks, item.period, item.phase, item.type_digest, bound_ns, flags)
    return Wanted(id_, item.name, *numbers, canonical(item.type))


class Record(Wanted, frozen=True):
    """An item as a table has it.

    Attributes:
        index: of the record; its writer's lock is byte `WRITER_LOCKS` + index.
        offset: of bank 0.
        stride: from one bank to the next.
    """

    index: int = 0
    offset: int = 0
    stride: int = 0

    @property
    def at(self) -> int:
        """Offset of the record in its file."""
        return record_at(self.index)


def is_exactly(record: Record | None, wanted: Wanted) -> bool:
    """Whether a record is exactly as it is wanted."""
    return record is not None and all(getattr(record, name) == getattr(wanted, name) for name in Wanted.__struct_fields__)


def aligned(size: int) -> int:
    """Bytes of the cache lines that so many bytes take."""
    return -(-size // LINE) * LINE


def record_at(index: int) -> int:
    """Where a record lies."""
    return RECORDS_AT + index * RECORD_SIZE


def names_at(capacity: int) -> int:
    """Where the records end: names and banks lie behind."""
    return aligned(RECORDS_AT + capacity * RECORD_SIZE)


# --- Reading ---------------------------------------------------------------------------------------------------------


def read_header(view: Buffer) -> Header:
    """The header of a mapped file.

    Raises:
        BoardGoneError: the file is no board any more: made anew, or zeros in its place.
        BoardError: it is no board, of another version, or damaged; names the first thing that is wrong.
    """
    if len(view) < RECORDS_AT:
        raise BoardError(f"this is no board: it has {len(view)} bytes where a header and a table of users take {RECORDS_AT}")
    (magic, version, flags, generation, count, capacity, size, boot_id, roster, robot, _changed, rank, state, heard) = (
        HEADER.unpack_from(view)
    )
    if generation == GONE or (generation == HOLE and magic == bytes(8)):
        raise BoardGoneError("this board was made anew, or removed")
    if magic != MAGIC:
        raise BoardError(f"this is no board: it begins with {magic.hex(' ')}")
    if version != VERSION:
        raise BoardError(f"the board has version {version}, this program reads version {VERSION}; update the older of the two")
    if flags & sum(AREAS) not in AREAS or flags > sum(AREAS) + ALONE:
        raise BoardError(f"damaged: flags {flags:#x} are not those of a private, own or peer's file")
    if generation == HOLE:
        raise BoardError("damaged: generation 0")
    if not (1 <= capacity <= ITEMS_MAX and names_at(capacity) <= len(view)):
        raise BoardError(f"damaged: room for {capacity} records in {len(view)} bytes")
    if count > capacity:
        raise BoardError(f"damaged: {count} records where there is room for {capacity}")
    if not names_at(capacity) <= size <= BLOCK_SIZE_MAX:
        raise BoardError(f"damaged: it says that it has {size} bytes; {names_at(capacity)} to {BLOCK_SIZE_MAX} are possible")
    if rank >= RANKS:
        raise BoardError(f"damaged: the robot's rank is {rank}; 0 to {RANKS - 1} are possible")
    if state >= len(STATES):
        raise BoardError(f"damaged: the robot's state is {state}; 0 to {len(STATES) - 1} are possible")
    name = _text(robot.rstrip(b"\0"), "the robot's name")
    return Header(flags, generation, count, capacity, size, boot_id, roster, name, rank, state, heard)


def read_records(view: Buffer, header: Header) -> Iterator[Record]:
    """The items of a mapped file, in the order of their records, without holes.

    Raises:
        BoardError: a record is damaged; names it.
    """
    return (record for index in range(header.count) if (record := read_record(view, header, index)) is not None)


def read_record(view: Buffer, header: Header, index: int) -> Record | None:
    """One record; None where there is a hole.

    All that it names lies inside of ``view``: the file may be longer than the mapping, when others have added items since.

    Raises:
        BoardError: it is damaged, or lies outside of the mapping.
    """
    id_, kind, banks, offset, size, stride, period, phase, digest, name_offset, bound, flags = DECLARATION.unpack_from(
        view, record_at(index)
    )
    if banks == 0:
        return None
    where = f"damaged: record {index}"
    if kind >= len(KINDS):
        raise BoardError(f"{where} is of kind {kind}; 0 to {len(KINDS) - 1} are possible")
    if not BANKS_MIN <= banks <= BANKS_MAX:
        raise BoardError(f"{where} has {banks} banks; {BANKS_MIN} to {BANKS_MAX} are possible")
    if not 1 <= size <= ITEM_SIZE_MAX:
        raise BoardError(f"{where} has values of {size} bytes; 1 to {ITEM_SIZE_MAX} are possible")
    if stride % LINE or stride < BANK_HEAD + size:
        raise BoardError(f"{where}: a bank of {stride} bytes for values of {size} bytes")
    low = names_at(header.capacity)
    if offset % LINE or not low <= offset <= len(view) - banks * stride:
        raise BoardError(f"{where}: {banks} banks of {stride} bytes at {offset} do not lie between {low} and {len(view)}")
    if period == 0 or phase >= period:
        raise BoardError(f"{where}: phase {phase} of a period of {period} rounds")
    name, after = _counted(view, name_offset, low, where)
    text, _ = _counted(view, after, low, where)
    if not 1 <= len(name.encode()) <= NAME_SIZE_MAX:
        raise BoardError(f"{where} has a name of {len(name.encode())} bytes; 1 to {NAME_SIZE_MAX} are possible")
    return Record(
        *(id_, name, size, kind, banks, period, phase, digest, bound, flags, text),
        *(index, offset, stride),
    )


def _counted(view: Buffer, offset: int, low: int, where: str) -> tuple[str, int]:
    """A text with its length in front, and where it ends."""
    if low <= offset <= len(view) - LENGTH.size:
        begin = offset + LENGTH.size
        end = begin + LENGTH.unpack_from(view, offset)[0]
        if end <= len(view):
            return _text(bytes(view[begin:end]), f"{where}: a name or declaration"), end
    raise BoardError(f"{where}: its name or declaration at {offset} does not lie between {low} and {len(view)}")


def _text(raw: bytes, what: str) -> str:
    try:
        return raw.decode()
    except UnicodeDecodeError:
        raise BoardError(f"{what} is not UTF-8") from None


def read_user(view: Buffer, index: int) -> tuple[int, int, str]:
    """Pid as it sees itself, uid, and name of a user; believed only while its byte is locked."""
    pid, uid, name = USER.unpack_from(view, USERS_AT + index * USER.size)
    return pid, uid, name.rstrip(b"\0").decode(errors="replace")


# --- Writing ---------------------------------------------------------------------------------------------------------


Piece = tuple[int, bytes]
"""Bytes and the offset at which they are to be written."""


def new_header(
    flags: int, capacity: int, robot: str, boot_id: bytes, *, rank: int = 0, state: int = RUN, roster_digest: int = 0
) -> bytes:
    """The first bytes of a file that has no items yet; its size is `names_at` (``capacity``), and all others are zeros."""
    name = robot.encode()
    return HEADER.pack(
        MAGIC, VERSION, flags, FIRST, 0, capacity, names_at(capacity), boot_id, roster_digest, name, 0, rank, state, 0
    )  # fmt: skip


class Addition(Struct, frozen=True):
    """How a record gets into a table.

    Attributes:
        size: of the file, to be set first (ftruncate).
        pieces: to be written after that, in this order; the last one counts the record.
    """

    record: Record
    size: int
    pieces: tuple[Piece, ...]


def addition(header: Header, wanted: Wanted) -> Addition:
    """The pieces to write for one more item; the generation is that of the caller, which holds the table lock.

    Raises:
        BoardError: there is no room, or the item is outside of the limits.
    """
    what = f"cannot add item {wanted.name!r}"
    name, text = wanted.name.encode(), wanted.text.encode()
    if header.count >= header.capacity:
        raise BoardError(f"{what}: the table has {header.count} records and no room for more; start the board anew")
    if not 1 <= wanted.size <= ITEM_SIZE_MAX:
        raise BoardError(f"{what}: values of {wanted.size} bytes; 1 to {ITEM_SIZE_MAX} are possible")
    if not BANKS_MIN <= wanted.banks <= BANKS_MAX:
        raise BoardError(f"{what}: {wanted.banks} banks; {BANKS_MIN} to {BANKS_MAX} are possible")
    if wanted.period < 1 or not 0 <= wanted.phase < wanted.period:
        raise BoardError(f"{what}: phase {wanted.phase} of a period of {wanted.period} rounds; give 0 <= phase < period")
    if not 1 <= len(name) <= NAME_SIZE_MAX or len(text) > TEXT_SIZE_MAX:
        raise BoardError(f"{what}: a name has 1 to {NAME_SIZE_MAX} bytes and its declaration at most {TEXT_SIZE_MAX}")
    name_offset = header.file_size
    named = LENGTH.pack(len(name)) + name + LENGTH.pack(len(text)) + text
    offset, stride = aligned(name_offset + len(named)), aligned(BANK_HEAD + wanted.size)
    size = offset + wanted.banks * stride
    if size > BLOCK_SIZE_MAX:
        raise BoardError(f"{what}: the file would have {size} bytes; {BLOCK_SIZE_MAX} are possible: fewer or smaller items")
    declaration = DECLARATION.pack(
        *(wanted.id, wanted.kind, wanted.banks, offset, wanted.size, stride, wanted.period, wanted.phase),
        *(wanted.digest, name_offset, wanted.bound_ns, wanted.flags),
    )
    pieces = (
        (name_offset, named),
        (record_at(header.count), declaration.ljust(RECORD_SIZE, b"\0")),
        (FILE_SIZE_AT, WORD.pack(size)),
        (COUNT_AT, COUNT.pack(header.count + 1)),
    )
    place: tuple[Any, ...] = (header.count, offset, stride)
    return Addition(Record(*astuple(wanted), *place), size, pieces)


def removal(index: int) -> Piece:
    """The piece that makes a hole of a record; the generation is the caller's."""
    return record_at(index) + BANKS_FIELD, LENGTH.pack(0)


def next_id(view: Buffer, header: Header) -> int:
    """Number of the next item that this robot adds at run time: above those of its table, holes included."""
    first = ITEMS_MAX * (header.rank + 1)
    ids = (COUNT.unpack_from(view, record_at(index))[0] for index in range(header.count))
    return max((id_ + 1 for id_ in ids if first <= id_ < first + ITEMS_MAX), default=first)


def packed_user(pid: int, uid: int, name: str) -> bytes:
    """A user's row. A name that is too long is cut."""
    return USER.pack(pid, uid, name.encode()[:56])
