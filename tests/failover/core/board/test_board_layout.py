"""The layout: what is added is read back; whatever a file says, a reader gets one clear error and stays inside of the mapping."""

from __future__ import annotations

import contextlib
import random
import struct

import pytest

from failover.core.board import layout
from failover.core.board.layout import Wanted
from failover.errors import BoardError, BoardGoneError
from tests.failover.core.board.board_bytes import BALL, PLAN, add, file_of, sample


def read(content: bytes | bytearray) -> list[layout.Record]:
    """All that a file holds, each record inside of it."""
    header = layout.read_header(content)
    records = list(layout.read_records(content, header))
    for record in records:
        assert layout.names_at(header.capacity) <= record.offset
        assert record.offset + record.banks * record.stride <= len(content)
        assert layout.BANK_HEAD + record.size <= record.stride
    return records


def test_what_was_added_is_read_back() -> None:
    content = file_of([BALL, PLAN])
    added = add(content, Wanted(id=1024, name="ziel-ü", size=layout.ITEM_SIZE_MAX, flags=layout.ADDED))
    assert read(content)[2] == added
    assert (added.offset % 64, added.stride % 64, len(content)) == (0, 0, layout.read_header(content).file_size)
    assert layout.next_id(content, layout.read_header(content)) == 1025


def test_a_removed_item_is_a_hole_whose_number_does_not_come_again() -> None:
    content = file_of([BALL, Wanted(id=1024, name="goal", size=8), PLAN])
    offset, piece = layout.removal(1)
    content[offset : offset + len(piece)] = piece
    assert [record.name for record in read(content)] == ["ball", "plan"]
    assert layout.next_id(content, layout.read_header(content)) == 1025


@pytest.mark.parametrize(
    ("wanted", "why"),
    [
        (Wanted(id=1, name="big", size=layout.ITEM_SIZE_MAX + 1), "65537 bytes"),
        (Wanted(id=1, name="", size=1), "1 to 63"),
        (Wanted(id=1, name="n" * 256, size=1), "1 to 63"),
        (Wanted(id=1, name="b", size=1, banks=9), "9 banks"),
        (Wanted(id=1, name="p", size=1, period=3, phase=3), "phase 3"),
    ],
)
def test_an_item_outside_of_the_limits_is_refused(wanted: Wanted, why: str) -> None:
    with pytest.raises(BoardError, match=why):
        layout.addition(layout.read_header(file_of([])), wanted)


def test_a_full_table_and_a_full_file_are_refused() -> None:
    with pytest.raises(BoardError, match="no room for more"):
        layout.addition(layout.read_header(file_of([BALL], capacity=1)), PLAN)
    content = file_of([], capacity=1024)
    for id_ in range(31):
        add(content, Wanted(id=id_, name=f"item{id_}", size=layout.ITEM_SIZE_MAX, banks=8))
    with pytest.raises(BoardError, match="fewer or smaller items"):
        layout.addition(layout.read_header(content), Wanted(id=31, name="more", size=layout.ITEM_SIZE_MAX, banks=8))
    assert len(read(content)) == 31


def test_gone_and_zeros_say_that_the_board_is_gone() -> None:
    content = file_of([BALL])
    struct.pack_into("<Q", content, layout.GENERATION_AT, layout.GONE)
    for gone in (bytes(content), bytes(len(content))):
        with pytest.raises(BoardGoneError):
            layout.read_header(gone)


def test_any_cut_is_an_error_or_the_items_before_it() -> None:
    content = sample()
    for size in (*range(300), *range(4090, 4100), *range(20470, len(content))):
        with pytest.raises(BoardError):
            read(content[:size])


def test_any_byte_overwritten_is_an_error_or_stays_inside() -> None:
    """Every byte of the header and the records, and of the names, with the values that break most."""
    content = sample()
    places = [*range(160), *range(layout.RECORDS_AT, layout.RECORDS_AT + 64), *range(layout.RECORDS_AT + 192, len(content))]
    refused = 0
    for place in places:
        for value in (0, 1, 0x7F, 0x80, 0xFF):
            changed = bytearray(content)
            changed[place] = value
            try:
                read(changed)
            except BoardError:
                refused += 1
    assert refused > 100


def test_any_word_overwritten_is_an_error_or_stays_inside() -> None:
    seed = random.randrange(1 << 32)
    print(f"seed {seed}")
    dice = random.Random(seed)
    content = sample()
    limits = [0, 1, 2**15, 2**16, 2**31, 2**32 - 1, 2**63, 2**64 - 1, len(content), len(content) - 1, len(content) - 64]
    for _ in range(5000):
        changed = bytearray(content)
        for _ in range(dice.choice((1, 1, 2, 5))):
            place = dice.choice((dice.randrange(0, 160, 4), layout.RECORDS_AT + dice.randrange(0, 384, 4)))
            size = dice.choice((2, 4, 8))
            changed[place : place + size] = (dice.choice(limits) % 256**size).to_bytes(size, "little")
        with contextlib.suppress(BoardError):
            read(changed)
