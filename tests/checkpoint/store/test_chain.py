"""A base and its deltas add up to the state that the newest one names, or are refused."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from checkpoint.errors import ChainError
from checkpoint.model import Position, Snapshot
from checkpoint.pages.page_set import PageTable
from checkpoint.snapshot import format, process_tree
from checkpoint.store import chain
from tests.checkpoint.snapshots import PAGE, family, history, page, pages_of, snapshot, vma

STEPS = st.lists(
    st.tuples(st.dictionaries(st.integers(0, 30), st.integers(0, 9), max_size=6), st.frozensets(st.integers(0, 30), max_size=6)),
    max_size=6,
)


@settings(max_examples=100, deadline=None)
@given(STEPS, st.integers(1, 31))
def test_a_fold_is_what_a_dictionary_of_pages_would_hold(
    steps: list[tuple[dict[int, int], frozenset[int]]], last_size: int
) -> None:
    state = {number: page(f"base {number}") for number in range(5)}
    made = [snapshot(state)]
    for sequence, (written, cleared) in enumerate(steps, 2):
        size = last_size if sequence == len(steps) + 1 else 31
        carried = {number: page(f"{sequence} {value}") for number, value in written.items() if number < size}
        state = {number: content for number, content in state.items() if number not in cleared and number < size} | carried
        made.append(
            snapshot(state, carried=carried, cleared=cleared, parent=made[-1].position, sequence=sequence, vmas=(vma(0, size),))
        )
    folded = chain.fold(made)
    assert pages_of(folded) == state
    assert folded.is_base
    assert folded.position == made[-1].position


def test_output_of_all_snapshots_is_joined() -> None:
    folded = chain.fold(history(4))
    assert [(piece.stream, piece.offset, bytes(piece.content)) for piece in folded.output if piece.content] == [
        (1, 0, b"ready\nline 2\nline 3\nline 4\n")
    ]


def refused(snapshots: tuple[Snapshot, ...], words: str) -> None:
    with pytest.raises(ChainError, match=words):
        chain.fold(snapshots)


def test_a_base_alone_is_proved_and_not_copied() -> None:
    base = history(1)[0]
    folded = chain.fold([base])
    assert folded == base
    assert folded.contents is base.contents
    refused((replace(base, contents=bytes(len(base.contents))),), "do not add up")


def test_a_missing_delta_is_found() -> None:
    base, _, third, _ = history(4)
    refused((base, third), "continues 1.2")


def test_a_chain_without_base_is_refused() -> None:
    refused(history(3)[1:], "not a base")
    refused((), "no snapshot")


def test_equal_numbers_with_unequal_digests_have_diverged() -> None:
    base, second, third = history(3)
    other = replace(third, parent=Position(1, 2, bytes(16)))
    refused((base, second, other), "diverged")


def test_pages_that_do_not_add_up_are_found() -> None:
    base, second = history(2)
    forged = bytearray(second.contents)
    forged[0] ^= 1
    refused((base, replace(second, contents=bytes(forged))), "do not add up")


def test_a_changed_register_is_found() -> None:
    base, second = history(2)
    thread = replace(second.threads[0], signal_mask=4)
    refused((base, replace(second, threads=(thread,))), "state is not that")


def test_a_delta_of_another_component_is_refused() -> None:
    base, second = history(2)
    refused((base, replace(second, component="/other")), "/other")


def test_a_chain_of_several_processes_folds_to_what_each_of_them_has() -> None:
    snapshots = family(3)
    assert snapshots[0].copies and len(snapshots[0].contents) == 3 * PAGE
    folded = chain.fold(snapshots)
    assert folded.copies and len(folded.contents) == 3 * PAGE, "what both have is there once"
    parent, child = process_tree.views(folded)
    assert pages_of(parent) == {0: page("both"), 1: page("parent 3")}
    assert pages_of(child) == {0: page("both"), 1: page("child 3")}


def test_equal_pages_of_one_process_are_all_there_when_the_others_have_ended() -> None:
    """A snapshot of one process has no copies: a restore would pass them over."""
    whole = process_tree.expanded(family(1)[0])
    runs, contents, copies = process_tree.told_once(whole.runs, memoryview(page("both") * 4), PAGE)
    whole = replace(whole, runs=runs, contents=bytes(contents), copies=copies)
    whole = replace(whole, page_sum=chain.applied(PageTable.empty(PAGE), whole, (whole.contents,)).page_sum)
    base = replace(whole, position=chain.position_of(whole, 1, 1))
    alone = {0: page("both"), 1: page("both")}
    folded = chain.fold((base, snapshot(alone, carried={}, parent=base.position, sequence=2)))
    assert not folded.copies
    assert pages_of(format.decode(format.encode_bytes(folded))) == alone
