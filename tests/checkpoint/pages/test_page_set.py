"""Sets of pages behave like sets, and a page sum kept step by step equals that of the whole."""

from __future__ import annotations

import random

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from checkpoint.model import PageRun
from checkpoint.pages import page_set
from tests.checkpoint.snapshots import PAGE, START, runs_of, vma

NUMBERS = st.frozensets(st.integers(0, 40))


def as_extents(numbers: frozenset[int]) -> page_set.Words:
    return page_set.extents(PageRun(START + number * PAGE, START + (number + 1) * PAGE) for number in numbers)


def as_numbers(found: page_set.Words) -> set[int]:
    return {(address - START) // PAGE for address in page_set.addresses_of(found, PAGE).tolist()}


@settings(max_examples=200, deadline=None)
@given(NUMBERS, NUMBERS)
def test_sets_of_pages_are_sets(left: frozenset[int], right: frozenset[int]) -> None:
    ours, theirs = as_extents(left), as_extents(right)
    assert as_numbers(page_set.union(ours, theirs)) == left | right
    assert as_numbers(page_set.intersection(ours, theirs)) == left & right
    assert as_numbers(page_set.difference(ours, theirs)) == left - right
    assert page_set.covers(ours, theirs) == (right <= left)
    assert page_set.covers(page_set.union(ours, theirs), theirs)
    assert page_set.total_size(ours) == len(left) * PAGE
    addresses = page_set.addresses_of(ours, PAGE)
    assert np.array_equal(page_set.extents_of_addresses(addresses, PAGE), ours)
    for made in (page_set.union(ours, theirs), page_set.difference(ours, theirs)):
        assert (made[:, 0] < made[:, 1]).all()
        assert (made[1:, 0] > made[:-1, 1]).all(), "extents neither touch nor overlap"


def test_overlapping_and_unordered_runs_become_one_set() -> None:
    runs = [PageRun(8 * PAGE, 9 * PAGE), PageRun(PAGE, 5 * PAGE), PageRun(2 * PAGE, 3 * PAGE), PageRun(5 * PAGE, 6 * PAGE)]
    assert page_set.page_runs(page_set.extents(runs)) == (PageRun(PAGE, 6 * PAGE), PageRun(8 * PAGE, 9 * PAGE))


@given(st.lists(st.integers(min_value=0, max_value=9)))
def test_values_are_told_once_and_in_order(values: list[int]) -> None:
    assert page_set.distinct(np.array(values, dtype=np.uint64)).tolist() == sorted(set(values))


def test_only_pages_without_a_single_bit_are_zero() -> None:
    content = bytearray(64 * PAGE)
    dice = random.Random(7)
    written = {number: dice.randrange(PAGE) for number in range(0, 64, 3)}
    for number, offset in written.items():
        content[number * PAGE + offset] = 1 << dice.randrange(8)
    zero = page_set.zero_pages(content, PAGE)
    assert [number for number in range(64) if not zero[number]] == sorted(written)


STEPS = st.lists(st.tuples(st.dictionaries(st.integers(0, 40), st.binary(max_size=3), max_size=5), NUMBERS), max_size=6)


@settings(max_examples=100, deadline=None)
@given(STEPS, st.integers(1, 41))
def test_a_page_sum_kept_step_by_step_is_that_of_the_whole(
    steps: list[tuple[dict[int, bytes], frozenset[int]]], size: int
) -> None:
    table, state = page_set.PageTable.empty(PAGE), {}
    for index, (written, cleared) in enumerate(steps):
        last = size if index == len(steps) - 1 else 41
        carried = {number: content.ljust(PAGE, b"\1") for number, content in written.items() if number < last}
        state = {number: content for number, content in state.items() if number not in cleared and number < last} | carried
        contents = b"".join(carried[number] for number in sorted(carried))
        table = table.apply(runs_of(set(cleared)), runs_of(carried), contents, (vma(0, last),))
    whole = b"".join(state[number] for number in sorted(state))
    assert table.page_sum == page_set.PageTable.empty(PAGE).apply((), runs_of(state), whole, (vma(0, 41),)).page_sum
    assert [(address - START) // PAGE for address in table.pages.addresses.tolist()] == sorted(state)


def test_a_page_sum_tells_content_and_place_apart() -> None:
    def sum_at(number: int, byte: bytes) -> bytes:
        return page_set.PageTable.empty(PAGE).apply((), runs_of({number}), byte * PAGE, (vma(0, 9),)).page_sum

    assert len({sum_at(1, b"a"), sum_at(2, b"a"), sum_at(1, b"b"), page_set.EMPTY_SUM}) == 4


def test_the_same_mappings_are_worked_out_once() -> None:
    mappings = page_set.Mappings(vma(number, 2) for number in (0, 2, 9))
    assert page_set.page_runs(page_set.extents(mappings)) == page_set.page_runs(page_set.extents(tuple(mappings)))
    assert page_set.extents(mappings) is page_set.extents(mappings)
    assert not page_set.extents(mappings).flags.writeable, "several hold it"
    assert page_set.extents(page_set.Mappings()).shape == (0, 2)
