"""A board's file in memory, made of the pieces that the layout tells, as tests and the sample need it."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from pathlib import Path

from failover.core.board import layout
from failover.core.board.layout import Record, Wanted

BOOT_ID = bytes(range(16))
SAMPLE = Path(__file__).parents[3] / "samples" / "version-1.board"

BALL = Wanted(
    id=0,
    name="ball",
    size=12,
    kind=layout.STRUCT,
    digest=0x1122334455667788,
    bound_ns=120_000_000,
    text="{x:f4,y:f4,seen:u4}",
)
PLAN = Wanted(id=1, name="plan", size=512, kind=layout.MSGPACK, banks=4, period=5, phase=2, digest=7, text="msgpack")


def file_of(items: Iterable[Wanted], capacity: int = 4, flags: int = layout.OWN + layout.ALONE) -> bytearray:
    """The whole content of a new file with these items, none of them written."""
    content = bytearray(layout.names_at(capacity))
    header = layout.new_header(flags, capacity, "robot1", BOOT_ID)
    content[: len(header)] = header
    for item in items:
        add(content, item)
    return content


def add(content: bytearray, item: Wanted) -> Record:
    """One more item, as a user of the board adds it."""
    addition = layout.addition(layout.read_header(content), item)
    content.extend(bytes(addition.size - len(content)))
    for offset, piece in addition.pieces:
        content[offset : offset + len(piece)] = piece
    return addition.record


def put(content: bytearray, record: Record, number: int, value: bytes, stamp_ns: int, error_us: int = 0) -> None:
    """A put, whole."""
    bank = record.offset + number % record.banks * record.stride
    struct.pack_into("<QQQII", content, bank, number, stamp_ns, 0, len(value), error_us)
    content[bank + layout.BANK_HEAD : bank + layout.BANK_HEAD + len(value)] = value
    struct.pack_into("<Q", content, record.at + layout.NEWEST_FIELD, number)


def sample() -> bytes:
    """Two items; the ball was put three times, the plan never; one user."""
    content = file_of([BALL, PLAN], capacity=2)
    ball = layout.read_record(content, layout.read_header(content), 0)
    assert ball is not None
    for number in (1, 2, 3):
        put(
            content,
            ball,
            number,
            struct.pack("<ffI", number, 2.5, 100 + number),
            stamp_ns=number * 1_000_000_000,
            error_us=number,
        )
    struct.pack_into("<I", content, ball.at + layout.PID_FIELD, 4711)
    content[layout.USERS_AT : layout.USERS_AT + 64] = layout.packed_user(4711, 1000, "/lab/robot1/vision")
    struct.pack_into("<Q", content, layout.GENERATION_AT, 6)
    return bytes(content)


if __name__ == "__main__":
    SAMPLE.write_bytes(sample())
