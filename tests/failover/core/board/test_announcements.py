"""Items added at run time: what one robot tells, what another one knows then, whatever is lost on the way."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import astuple

from failover.core.board import layout
from failover.core.board.announcements import (
    ASK_ROUNDS,
    CONTENT_SIZE_MAX,
    NOT_POSSIBLE,
    PAGE_SIZE,
    TIMES,
    TOO_LONG,
    WORD_ROUNDS,
    Announcer,
    Declared,
    Learned,
    Page,
    _encode,
    asks,
    first_number,
    item_of,
    question,
    told,
)
from failover.core.board.items import ITEMS_MAX, Item
from failover.core.board.layout import Record, wanted_of

RANK = 2
FIRST = first_number(RANK)


def record(number: int, name: str = "", **keys: object) -> Record:
    item = Item(name or f"item{number}", keys.pop("type", None), **{"size": 8, **keys} if not keys.get("size") else keys)  # type: ignore[arg-type]
    return Record(*astuple(wanted_of(item, number, layout.ADDED)), 0, 0, 0)  # type: ignore[call-arg]


class Pair:
    """A robot that tells and one that learns."""

    def __init__(self) -> None:
        self.announcer, self.learned = Announcer(RANK), Learned(RANK, ())
        self.table: dict[int, Item] = {}
        self.round = self.put = 0
        self.announcer.hold([])

    def turn(self, lost: bool = False, question_lost: bool = False) -> bytes | None:
        """One round: a page, if there is one, then perhaps a question."""
        self.round += 1
        page = self.announcer.due(self.round)
        if page is not None:
            self.put += 1
            if not lost:
                self.takes(page)
        if self.learned.is_to_ask() and not question_lost:
            assert asks(question([RANK]), RANK)
            self.announcer.asked()
        return page

    def takes(self, page: bytes) -> None:
        for change in self.learned.take(self.put, page):
            self.table.pop(change.number, None)
            if change.item is not None:
                self.table[change.number] = change.item
            self.learned.note(change)

    def settle(self, turns: int = 200) -> None:
        for _ in range(turns):
            self.turn()


def test_a_change_is_told_in_three_frames_and_the_word_every_sixteenth() -> None:
    pair = Pair()
    pair.announcer.hold([record(FIRST)])
    pages = [pair.announcer.due(round_) is not None for round_ in range(1, 2 * WORD_ROUNDS + 1)]
    assert pages == [True] * TIMES + [round_ % WORD_ROUNDS == 0 for round_ in range(TIMES + 1, 2 * WORD_ROUNDS + 1)]


def test_what_is_added_changed_and_removed_becomes_known() -> None:
    pair = Pair()
    second = record(FIRST + 1, type={"x": "f4"}, size=4, period=3, phase=1, bound_ms=2.5, urgent=True)
    pair.announcer.hold([record(FIRST), second])
    pair.turn()
    assert list(pair.table) == [FIRST, FIRST + 1]
    two = pair.table[FIRST + 1]
    assert (two.name, two.period, two.phase, two.bound_ms, two.urgent) == (f"item{FIRST + 1}", 3, 1, 2.5, True)
    pair.announcer.hold([second])
    pair.turn()
    assert list(pair.table) == [FIRST + 1]
    pair.announcer.hold([])
    pair.turn()
    assert not pair.table


@given(st.integers(0, 1 << 32))
def test_whatever_frames_and_questions_are_lost_the_tables_become_alike(seed: int) -> None:
    dice, pair = random.Random(seed), Pair()
    there: dict[int, Record] = {}
    for _ in range(60):
        if dice.random() < 0.3:
            number = FIRST + dice.choice((0, 1, 2, 3, 500, 1023))
            there[number] = record(number, size=dice.randint(1, 4000))
            if dice.random() < 0.4:
                there.pop(dice.choice(list(there)))
            pair.announcer.hold(there.values())
        pair.turn(lost=dice.random() < 0.7, question_lost=dice.random() < 0.5)
    pair.settle()
    assert {number: (item.name, item.size) for number, item in pair.table.items()} == {
        number: (one.name, one.size) for number, one in there.items()
    }


def test_a_full_table_goes_in_pages_that_fit_a_datagram_and_a_robot_without_memory_of_it_asks_for_all() -> None:
    pair = Pair()
    pair.announcer.hold([record(FIRST + number) for number in range(ITEMS_MAX)])
    sizes = [len(page) for _ in range(400) if (page := pair.turn())]
    assert len(pair.table) == ITEMS_MAX and max(sizes) < PAGE_SIZE + 200
    pair.learned, pair.table = Learned(RANK, ()), {}
    pair.settle(WORD_ROUNDS + ASK_ROUNDS + 200)
    assert len(pair.table) == ITEMS_MAX


def test_a_robot_that_knows_the_table_from_its_files_asks_nothing_and_forgets_what_was_removed_meanwhile() -> None:
    pair = Pair()
    pair.announcer.hold([record(FIRST)])
    pair.learned = Learned(RANK, [record(FIRST)])
    pages = [pair.turn() for _ in range(TIMES + 3 * WORD_ROUNDS)]
    assert not pair.table and sum(page is not None for page in pages) == TIMES + 3
    pair.announcer, pair.learned, pair.table = Announcer(RANK), Learned(RANK, [record(FIRST)]), {FIRST: Item("a", size=1)}
    pair.announcer.hold([])
    pair.settle()
    assert not pair.table


def test_an_older_page_on_a_slower_way_changes_nothing() -> None:
    pair = Pair()
    pair.announcer.hold([record(FIRST)])
    old = pair.announcer.due(1)
    pair.announcer.hold([])
    new = pair.announcer.due(2)
    assert old is not None and new is not None
    pair.put = 2
    pair.takes(new)
    pair.put = 1
    pair.takes(old)
    assert not pair.table


@pytest.mark.parametrize(
    "declared",
    [
        Declared(FIRST - 1, "x", "bytes[8]", 8, 1, 0, 2, 0, 0),
        Declared(FIRST, "a/b", "bytes[8]", 8, 1, 0, 2, 0, 0),
        Declared(FIRST, "x", "bytes[8]", 9, 1, 0, 2, 0, 0),
        Declared(FIRST, "x", "{x:f4", 4, 1, 0, 2, 0, 0),
        Declared(FIRST, "x", "{x:f4}", 8, 1, 0, 2, 0, 0),
        Declared(FIRST, "x", "bytes[5000]", 5000, 1, 0, 2, 0, 0),
        Declared(FIRST, "x", "bytes[8]", 8, 0, 0, 2, 0, 0),
        Declared(FIRST, "x", "bytes[8]", 8, 1, 0, 9, 0, 0),
        Declared(FIRST, "x", "{x:" * 500, 8, 1, 0, 2, 0, 0),
    ],
)
def test_what_no_board_can_have_is_refused_counted_and_not_asked_for_again(declared: Declared) -> None:
    learned = Learned(RANK, ())
    item = _encode(declared)
    for put in (1, 2):
        page = _encode(Page(layout_word(item), min(FIRST, declared.number), FIRST + 9, (item,)))
        for change in learned.take(put, page):
            assert change.item is None
            learned.note(change)
    assert learned.refused == {NOT_POSSIBLE: 1}
    assert not any(learned.is_to_ask() for _ in range(3 * ASK_ROUNDS))


def layout_word(item: bytes) -> int:
    from failover.core.board.announcements import word_of

    return word_of([item])


@given(st.binary(max_size=200))
def test_any_bytes_are_a_page_or_are_counted(content: bytes) -> None:
    learned = Learned(RANK, ())
    list(learned.take(1, content))
    asks(content, RANK)


def test_a_declaration_too_long_to_be_told_is_counted() -> None:
    announcer = Announcer(RANK)
    announcer.hold([])
    long = record(FIRST, type={f"field_with_a_long_name_{number:04}" + "x" * 30: "u1" for number in range(200)}, size=200)
    for _ in range(2):
        announcer.hold([record(FIRST + 1), long])
    assert announcer.refused == {TOO_LONG: 1}
    page = announcer.due(1)
    assert page is not None and b"field" not in page


def test_a_record_told_and_read_is_the_declaration() -> None:
    item = Item("goal", "msgpack", size=64, period=2, phase=1, banks=3, bound_ms=0.25, finite=True, keep=True)
    number = FIRST + 7
    assert item_of(Record(*astuple(wanted_of(item, number, layout.ADDED)), 0, 0, 0)) == item  # type: ignore[call-arg]
    assert len(told(wanted_of(item, number))) < 60


def test_a_page_that_is_longer_than_any_that_a_robot_tells_is_not_read() -> None:
    learned = Learned(RANK, ())
    declared = [told(record(FIRST + number, f"item{number}")) for number in range(ITEMS_MAX)]
    count = next(count for count in range(ITEMS_MAX) if sum(map(len, declared[:count])) > CONTENT_SIZE_MAX)
    whole = _encode(Page(0, FIRST, FIRST + count, tuple(declared[:count])))
    assert learned.take(1, whole) == ()
    assert learned.refused == {NOT_POSSIBLE: 1}
    assert len(learned.take(2, _encode(Page(0, FIRST, FIRST + 9, tuple(declared[:9]))))) == 9


def test_a_change_and_a_whole_table_are_told_over_each_medium() -> None:
    announcer = Announcer(RANK)
    announcer.hold([])
    assert announcer.due(1, medium=2) is None
    for change in (lambda: announcer.hold([record(FIRST)]), announcer.asked):
        change()
        told_over = {medium: [announcer.due(1, medium) is not None for _ in range(TIMES + 1)] for medium in (0, 2)}
        assert told_over[0] == told_over[2]
        assert told_over[0][0] and not told_over[0][-1]
