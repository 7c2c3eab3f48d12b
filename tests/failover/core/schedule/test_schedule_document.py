"""SCHEDULE.md is normative: a reader written from the document alone reads the sample, and what our layout
writes is the sample.
"""

from __future__ import annotations

import re
import struct
from pathlib import Path

import pytest

from failover.core.schedule import layout, orders, terms
from failover.core.schedule.layout import View
from failover.core.schedule.terms import Kind, Terms
from failover.errors import ScheduleError, ScheduleGoneError
from tests.failover.core.schedule.table_bytes import MS, SAMPLE, add, new, sample, write

DOCUMENT = (Path(layout.__file__).parent / "SCHEDULE.md").read_text()


def number(content: bytes, offset: int, size: int = 8) -> int:
    return int.from_bytes(content[offset : offset + size], "little")


def test_a_reader_written_from_the_document_reads_the_sample() -> None:
    content = SAMPLE.read_bytes()
    assert content[:8] == bytes.fromhex("89464f5343480d0a")
    assert [number(content, offset, 4) for offset in (8, 12, 28)] == [1, 8, 256]
    assert [number(content, offset) for offset in (16, 32, 56)] == [2, 528_384, 5_000_000_000]
    assert (content[40:56], content[64:128].rstrip(b"\0")) == (bytes(range(16)), b"robot1")
    odometry, mapper, named = (4096 + 2048 * index for index in range(3))
    assert [content[row + 16 : row + 256].rstrip(b"\0") for row in (odometry, mapper, named)] == [
        b"odometry",
        b"/lab/robot1/mapper",
        b"map",
    ]
    assert [number(content, row, 4) for row in (odometry, mapper, named)] == [1, 1, 0]
    assert [number(content, row + 8, 4) for row in (odometry, mapper, named)] == [1, 0, 1]
    assert (number(content, odometry + 4, 4), number(content, mapper + 4, 4)) == (1, 2)
    first = odometry + 512
    assert [number(content, first + offset) for offset in (8, 16, 24, 48, 56)] == [10 * MS, 2 * MS, 8 * MS, MS, 3]
    second = mapper + 256
    assert (number(content, second, 4), number(content, second + 8), number(content, second + 24)) == (3, 100 * MS, 100 * MS)
    assert struct.unpack_from("<iHHHH3H", content, second + 64) == (40, 1, 0, 1, 2, 0, 2, 0)
    assert number(content, mapper + 12, 4) == 2
    assert struct.unpack_from("<24sQQQQ", content, mapper + 1024 + 64) == (b"eco".ljust(24, b"\0"), 100 * MS, 0, 5 * MS, 0)
    assert (number(content, odometry + 768, 4), number(content, odometry + 772, 4), number(content, odometry + 776)) == (
        3,
        4711,
        7,
    )
    words = [number(content, odometry + offset) for offset in range(784, 872, 8)]
    assert words == [7, 8, 5_072_000_000, 5_072_060_000, 5_063_000_000, 5_080_000_000, 7, 1, 2, 1, 0]
    assert [number(content, odometry + offset, 4) for offset in (872, 876, 880)] == [0, 1, 1]
    assert [number(content, odometry + offset) for offset in (912, 920, 928)] == [0, 5_002_000_000, 10 * MS]
    assert [number(content, odometry + 1536 + 4 * bucket, 4) for bucket in (15, 16, 17)] == [0, 1, 1]
    assert number(content, odometry + 1792 + 4 * 20, 4) == 1


def test_our_layout_writes_the_sample() -> None:
    assert sample() == SAMPLE.read_bytes()


def whole_sample() -> View:
    return View(memoryview(bytearray(SAMPLE.read_bytes().ljust(layout.FILE_SIZE, b"\0"))))


def test_our_layout_reads_the_sample() -> None:
    view = whole_sample()
    assert layout.read_header(view.octets).origin_ns == 5_000_000_000
    rows = layout.read_rows(view)
    assert {index: row.name for index, row in rows.items()} == {0: "odometry", 1: "/lab/robot1/mapper", 2: "map"}
    assert rows[1].terms is not None and rows[1].terms.after == (0, 2) and rows[1].terms.strict and rows[1].terms.at_next
    assert [mode.name for mode in rows[1].modes] == ["full", "eco"]
    live = layout.read_live(view, 0)
    assert (live.state, live.settled, live.counts.ended, live.blamed, live.adopted) == (3, 7, 7, -1, 1)
    seen = layout.read_predecessor(view, 0)
    assert (seen.is_declared, seen.has_ended(5_071_999_999), seen.has_ended(5_072_000_000)) == (True, True, False)
    assert not layout.read_predecessor(view, 2).is_declared
    lateness = layout.read_histogram(view, 0, layout.LATENESS_FIELD)
    assert (layout.percentile_ns(lateness, 0.5), layout.percentile_ns(lateness, 0.99)) == (1 << 16, 1 << 17)


def test_the_limits_in_the_document_are_those_of_the_code() -> None:
    assert f"rows: {terms.TASKS_MAX}" in DOCUMENT
    assert f"size of the file: {layout.FILE_SIZE}" in DOCUMENT
    assert f"quality modes, up to {terms.MODES_MAX}" in DOCUMENT
    assert f"predecessors, up to {terms.PREDECESSORS_MAX}" in DOCUMENT
    assert f"name, 1 to {terms.NAME_SIZE_MAX} bytes" in DOCUMENT
    assert f"period in ns, {terms.PERIOD_MIN_NS:,} to 10¹⁵" in DOCUMENT and terms.PERIOD_MAX_NS == 10**15
    assert (layout.ROW_LOCKS, layout.TABLE_LOCK) == (1 << 41, 1 << 62)
    row = {int(found) for found in re.findall(r"(?m)^\| (\d+) \|", DOCUMENT.partition("## Rows")[2].partition("## Terms")[0])}
    names = [layout.NAME_FIELD, layout.LIVE_FIELD, layout.SETTLED_FIELD, layout.MODES_FIELD, layout.LATENESS_FIELD]
    assert row.issuperset({*names, layout.DURATION_FIELD, layout.BLAMED_FIELD, layout.COURSE_NUMBER_FIELD, *layout.TERMS_FIELDS})


# --- Bad bytes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("offset", "octets", "said"),
    [
        (0, b"GIF89a..", "begins with"),
        (8, struct.pack("<I", 2), "version 2"),
        (16, bytes(8), "generation 0"),
        (28, struct.pack("<I", 7), "room for 7"),
    ],
)
def test_what_is_no_table_is_an_error_in_a_sentence(offset: int, octets: bytes, said: str) -> None:
    view = new()
    view.octets[offset : offset + len(octets)] = octets
    with pytest.raises(ScheduleError, match=said):
        layout.read_header(view.octets)


def test_a_table_that_was_made_anew_and_a_hole_are_gone() -> None:
    view = new()
    view.words[2] = layout.GONE
    with pytest.raises(ScheduleGoneError):
        layout.read_header(view.octets)
    with pytest.raises(ScheduleGoneError):
        layout.read_header(bytes(layout.FILE_SIZE))
    with pytest.raises(ScheduleError, match="10 bytes"):
        layout.read_header(bytes(10))


@pytest.mark.parametrize(
    ("offset", "form", "value"),
    [
        (8, "<Q", 0),
        (8, "<Q", 2**64 - 1),
        (16, "<Q", 10 * MS),
        (24, "<Q", 2**60),
        (64, "<i", 100),
        (64, "<i", -1),
        (70, "<H", 3),
        (72, "<H", 9),
        (74, "<H", 17),
        (76, "<H", 256),
    ],
)
def test_terms_that_were_spoilt_are_an_error_of_that_row_alone(offset: int, form: str, value: int) -> None:
    view = new()
    ten = Terms(period_ns=10 * MS)
    add(view, [terms.Declaration(name, ten) for name in ("c", "a", "b")])
    write(view, orders.changed(layout.read_rows(view), [orders.Change("a", after=("c",))]))
    serial, before = layout.read_terms(view, 1)
    assert before.after == (0,)
    struct.pack_into(form, view.octets, layout.row_at(1) + layout.TERMS_FIELDS[serial % 2] + offset, value)
    with pytest.raises(ScheduleError, match="row 1"):
        layout.read_terms(view, 1)
    assert layout.read_terms(view, 0)[1].period_ns == layout.read_terms(view, 2)[1].period_ns == 10 * MS


def test_a_row_that_gets_another_name_begins_anew() -> None:
    view = new()
    for place in range(terms.TASKS_MAX):
        add(view, [terms.Declaration(f"t{place}", Terms(kind=Kind.ONE_SHOT, at_ns=1))])
    layout.count(view, 3, layout.LATENESS_FIELD, 5)
    with pytest.raises(ScheduleError, match="no room"):
        orders.added(layout.read_rows(view), [terms.Declaration("one more", Terms(period_ns=MS))])
    write(view, orders.removed(layout.read_rows(view), ["t3"]))
    add(view, [terms.Declaration("one more", Terms(period_ns=MS))])
    assert layout.name_of(view, 3) == "one more"
    assert sum(layout.read_histogram(view, 3, layout.LATENESS_FIELD)) == 0
