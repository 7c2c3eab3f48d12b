"""A delta made from two whole states leads from the one to the other, whatever has changed."""

from __future__ import annotations

import random
import tempfile

import pytest
from msgspec.structs import replace

from checkpoint.errors import FormatError
from checkpoint.model import OutputPiece, Snapshot
from checkpoint.snapshot import format
from checkpoint.store import chain
from checkpoint.store.difference import Known, difference, known_of
from tests.checkpoint.snapshots import PAGE, START, family, page, pages_of, snapshot, vma

MANY = 1 << 30


def between(before: Snapshot, after: Snapshot, pages_max: int = MANY) -> Snapshot | None:
    """The delta, as it comes back from a file."""
    with tempfile.TemporaryFile() as file, tempfile.TemporaryFile() as delta:
        format.encode(after, file)
        file.flush()
        made = difference(file.fileno(), known(after), known(before), pages_max)
        if made is None:
            return None
        format.encode(made, delta)
        delta.flush()
        return format.decode(delta.fileno())


def known(state: Snapshot) -> Known:
    with tempfile.TemporaryFile() as file:
        format.encode(state, file)
        file.flush()
        return known_of(file.fileno())


@pytest.mark.parametrize("seed", range(30))
def test_whatever_changes_the_delta_leads_to_it_and_tells_what_has_changed_alone(seed: int) -> None:
    some = random.Random(seed)
    states = [{number: some.randbytes(PAGE) for number in some.sample(range(128), some.randint(0, 60))}]
    for _ in range(3):
        state = dict(states[-1])
        for number in some.sample(sorted(state), len(state) // 3):
            del state[number]
        for number in some.sample(range(128), some.randint(0, 20)):
            state[number] = some.randbytes(PAGE)
        states.append(state)
    mapped = [(vma(0, some.randint(1 + max(state, default=0), 128)),) for state in states]
    made = [snapshot(state, sequence=1 + at, vmas=mapped[at]) for at, state in enumerate(states)]
    whole = [made[0]]
    for before, after, state, former in zip(made, made[1:], states[1:], states, strict=False):
        delta = between(before, after)
        assert delta is not None and delta.parent == before.position and delta.position == after.position
        wanted = sorted(number for number, content in state.items() if former.get(number) != content)
        told = sorted((run.start - START) // PAGE + at for run in delta.runs for at in range(run.size // PAGE))
        assert told == wanted
        whole.append(delta)
    folded = chain.fold(whole)
    assert pages_of(folded) == pages_of(made[-1]) and folded.position == made[-1].position and folded.vmas == made[-1].vmas


def test_of_the_output_it_has_what_came_since_and_the_fold_has_all() -> None:
    def said(sequence: int, *pieces: OutputPiece) -> Snapshot:
        return snapshot({1: page("x")}, sequence=sequence, output=pieces)

    before = said(1, OutputPiece(1, 0, b"one"), OutputPiece(2, 5, b"late"))
    assert between(before, said(2, OutputPiece(1, 0, b"on"), OutputPiece(2, 5, b"late"))) is None, "it begins anew"
    after = said(2, OutputPiece(1, 0, b"one two"), OutputPiece(2, 5, b"late"))
    delta = between(before, after)
    assert delta is not None and delta.output == (OutputPiece(1, 3, b" two"),)
    assert chain.fold([before, delta]).output == after.output
    cut = said(3, OutputPiece(1, 5, b"wo three"), OutputPiece(2, 5, b"late"))  # a folded base keeps the end of it
    delta = between(before, cut)
    assert delta is not None and delta.output == (OutputPiece(1, 5, b"wo three"),)
    pieces = (OutputPiece(1, 0, b"one"), OutputPiece(1, 5, b"wo three"), OutputPiece(2, 5, b"late"))
    assert chain.fold([before, delta]).output == pieces


def test_where_none_can_be_told_or_too_much_has_changed_there_is_none() -> None:
    first, second = snapshot({1: page("a"), 2: page("b")}), snapshot({1: page("c"), 2: page("d")}, sequence=2)
    assert between(first, second, pages_max=2 * PAGE) is not None
    assert between(first, second, pages_max=2 * PAGE - 1) is None
    assert between(second, first) is None and between(first, first) is None, "not later"
    assert between(first, replace(second, epoch=2)) is None, "a later primacy"
    tree = family(2)[0]
    assert between(tree, replace(second, position=replace(second.position, sequence=9))) is None, "of several processes"


def test_a_damaged_file_is_refused() -> None:
    with tempfile.TemporaryFile() as file:
        content = bytearray(format.encode_bytes(snapshot({1: page("a")})))
        content[-100] ^= 1
        file.write(content)
        file.flush()
        with pytest.raises(FormatError):
            known_of(file.fileno())
