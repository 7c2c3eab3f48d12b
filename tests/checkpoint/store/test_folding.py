"""A chain's files as the file of one base: the same as its fold, and an unchanged frame is copied as it is stored."""

from __future__ import annotations

import io
import os
import random
import tracemalloc
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import pytest
from hypothesis import given, settings
from msgspec.structs import replace

from checkpoint.errors import ChainError, FormatError
from checkpoint.keeper.messages import memfd_holding
from checkpoint.model import PageRun, Position, Snapshot
from checkpoint.snapshot import format, frames
from checkpoint.snapshot.byte_sources import opened
from checkpoint.snapshot.layout import FRAME_SIZE
from checkpoint.store import chain, fold_rules
from checkpoint.store.base_on_disk import stored_base
from checkpoint.store.folding import Folding
from checkpoint.store.index import Entry
from checkpoint.store.store import open_store
from checkpoint.store.xor_cache import Sender
from tests.checkpoint.pages.test_xor_delta import STEPS, as_told, whole_chain
from tests.checkpoint.snapshots import COMPONENT, PAGE, START, history, page, pages_of, snapshot, vma

IN_A_FRAME = FRAME_SIZE // PAGE
COUNT = 5 * IN_A_FRAME + 100
ROOM = (vma(0, COUNT + 1000),)


def folded_file(files: Sequence[bytes]) -> bytes:
    """The file that these are folded into."""
    file = io.BytesIO()
    with stored_base(*files) as base:
        size = Folding(base, base.outline).write(file)
    assert size == len(file.getvalue())
    return file.getvalue()


@settings(max_examples=60, deadline=None)
@given(STEPS)
def test_what_is_folded_frame_by_frame_is_the_fold(steps: list[tuple[dict[int, int], frozenset[int]]]) -> None:
    told = as_told(whole_chain(steps))
    made = format.decode(folded_file([format.encode_bytes(one) for one in told]))
    assert replace(made, contents=b"") == replace(chain.fold(told), contents=b"")
    assert pages_of(made) == pages_of(chain.fold(told))


def continued(base: Snapshot, *changes: tuple[dict[int, bytes], set[int]]) -> list[Snapshot]:
    """A chain: pages that are told, and pages that are forgotten before."""
    state, made = pages_of(base), [base]
    for sequence, (carried, gone) in enumerate(changes, 2):
        state = {number: content for number, content in state.items() if number not in gone} | carried
        parent = made[-1].position
        made.append(snapshot(state, carried=carried, cleared=frozenset(gone), parent=parent, sequence=sequence, vmas=ROOM))
    return made


@pytest.fixture(scope="module")
def base() -> Snapshot:
    dice = random.Random(2)
    return snapshot({number: dice.randbytes(PAGE // 2) + bytes(PAGE // 2) for number in range(COUNT)}, vmas=ROOM)


CHANGES = {
    "one page of the third frame": ([({2 * IN_A_FRAME + 7: page("new")}, set())], {2}),
    "the same page again and again": ([({5: page("a")}, set()), ({5: page("b")}, set()), ({5: page("c")}, set())], {0}),
    "a page that was changed and is forgotten": ([({3: page("a")}, set()), ({COUNT + 3: page("b")}, {3})], {0, 1, 2, 3, 4, 5}),
    "pages at the end": ([({COUNT + 1: page("x"), COUNT + 2: page("y")}, set())], {5}),
    "so many at the end that a frame is added": ([({COUNT + number: page(str(number)) for number in range(200)}, set())], {5, 6}),
    "a page that went from the fourth frame": ([({}, {3 * IN_A_FRAME})], {3, 4, 5}),
    "the last page": ([({}, {COUNT - 1})], {5}),
    "the last frame": ([({}, set(range(5 * IN_A_FRAME, COUNT)))], set()),
    "one that went, and one that came beside it": ([({COUNT: page("x")}, {COUNT - 1})], {5}),
    "everything": ([({1: page("all that is left")}, set(range(COUNT)))], {0}),
    "nothing": ([({}, set())], set()),
}


@pytest.mark.parametrize(("changes", "made_anew"), CHANGES.values(), ids=CHANGES)
def test_only_frames_in_which_something_changed_or_moved_are_made_anew(
    base: Snapshot, changes: list[tuple[dict[int, bytes], set[int]]], made_anew: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    told = as_told(continued(base, *changes), 1 << 30)
    files = [format.encode_bytes(one) for one in told]
    before, made = bodies(files[0]), []
    pack = frames.Packer.__call__
    monkeypatch.setattr(frames.Packer, "__call__", lambda self, raw: made.append(len(raw)) or pack(self, raw))
    file = folded_file(files)
    monkeypatch.undo()
    assert len(made) == len(made_anew)
    after = bodies(file)
    assert {index for index, body in enumerate(after) if index >= len(before) or body != before[index]} <= made_anew
    assert pages_of(format.decode(file)) == pages_of(chain.fold(told))
    chain.fold([format.decode(file)])


def bodies(file: bytes) -> list[bytes]:
    """Of every frame of a file, as they are stored."""
    with opened(file) as reader:
        preamble, _ = format.outlined(reader)
        return [bytes(reader.read(one.body_offset, one.head.stored_size)) for one in frames.frames_of(reader, preamble)]


def test_a_page_that_is_not_what_the_newest_position_says_is_found(base: Snapshot) -> None:
    told = continued(base, ({5: page("a")}, set()), ({5: page("b"), 900: page("c")}, {20}))
    wrong = replace(told[-1], contents=page("b") + page("d"))
    with pytest.raises(ChainError, match="the pages do not add up"):
        folded_file([format.encode_bytes(one) for one in (*told[:-1], wrong)])


@pytest.mark.parametrize("number", [0, 2 * IN_A_FRAME], ids=["a frame that is made anew", "a frame that is copied"])
def test_a_base_that_was_damaged_on_the_disk_is_found(base: Snapshot, number: int) -> None:
    told = continued(base, ({5: page("a")}, set()))
    file = bytearray(format.encode_bytes(base))
    with opened(bytes(file)) as reader:
        preamble, _ = format.outlined(reader)
        frame = list(frames.frames_of(reader, preamble))[number // IN_A_FRAME]
    file[frame.body_offset + frame.head.stored_size // 2] ^= 1
    with pytest.raises(FormatError, match="its body does not match"):
        folded_file([bytes(file), format.encode_bytes(told[1])])


def test_what_would_not_hold_together_is_refused_before_anything_is_written(base: Snapshot) -> None:
    """A guard over a page that the chain still carries: the delta should have cleared it."""
    (whole,) = base.vmas
    guarded = replace(whole, guards=(PageRun(START + PAGE, START + 2 * PAGE),))
    delta = snapshot(pages_of(base), carried={}, parent=base.position, sequence=2, vmas=(guarded,))
    with stored_base(format.encode_bytes(base), format.encode_bytes(delta)) as stored, pytest.raises(FormatError, match="guards"):
        Folding(stored, stored.outline)


def test_a_fold_that_cannot_be_written_blames_no_file(base: Snapshot, tmp_path: Path) -> None:
    (whole,) = base.vmas
    guarded = replace(whole, guards=(PageRun(START + PAGE, START + 2 * PAGE),))
    delta = snapshot(pages_of(base), carried={}, parent=base.position, sequence=2, vmas=(guarded,))
    store = open_store(tmp_path / "store")
    try:
        for one in (base, delta):
            file = tmp_path / "one"
            file.write_bytes(format.encode_bytes(one))
            with open(file, "rb") as source:
                store.put(source.fileno())
        with pytest.raises(FormatError, match="guards"):
            store.fold(COMPONENT, delta.position)
        assert store.positions(COMPONENT) == (base.position, delta.position)
        assert pages_of(store.load(COMPONENT)) == pages_of(base)
        assert not store.notices
    finally:
        store.close()


DELTAS: Final = 24
DELTA_PAGES: Final = 1_500


def test_a_fold_holds_a_bounded_part_of_the_deltas_pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program that changes a little of many pages has small files: 20 of them took 500 MB to fold."""
    sender, store = Sender(), open_store(tmp_path / "store")
    whole = [snapshot(dict.fromkeys(range(DELTA_PAGES), page("base")), vmas=ROOM)]
    for number in range(DELTAS):
        state = dict.fromkeys(range(DELTA_PAGES), page(f"base, changed {number}"))
        whole.append(snapshot(state, carried=state, parent=whole[-1].position, sequence=number + 2, vmas=ROOM))
    size = DELTA_PAGES * PAGE
    monkeypatch.setattr(fold_rules, "FOLDED_AT_ONCE_SIZE", 4 * size)
    try:
        for one in whole:
            told, _ = sender.told(one, 2 * size)
            sender.acknowledge(one.position)
            file = tmp_path / "one"
            file.write_bytes(format.encode_bytes(told))
            with open(file, "rb") as source:
                store.put(source.fileno())
        tracemalloc.start()
        try:
            store.fold(COMPONENT, whole[-1].position)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < 10 * size
        assert len(store.chain_of(COMPONENT)) == 1
        assert pages_of(store.load(COMPONENT)) == pages_of(whole[-1])
    finally:
        store.close()


@pytest.mark.parametrize(("pages_size", "count", "is_due"), [(1 << 20, 13, True), (100 << 20, 13, False), (100 << 20, 65, True)])
def test_a_chain_whose_base_has_many_pages_is_folded_more_seldom_however_well_they_compress(
    pages_size: int, count: int, is_due: bool
) -> None:
    base = Entry(Path("base"), Position(1, 1, b""), None, 1, 3 << 20, pages_size=pages_size)
    deltas = [Entry(Path(f"{n}"), Position(1, n, b""), Position(1, n - 1, b""), 1, 8_000) for n in range(2, count + 2)]
    assert fold_rules.fold_is_due([base, *deltas]) is is_due


def test_how_many_bytes_of_pages_a_file_tells_is_known_after_a_restart_too(tmp_path: Path) -> None:
    made = history(2)
    for _ in range(2):
        store = open_store(tmp_path / "store")
        try:
            for one in made if store.newest(COMPONENT) is None else ():
                descriptor = memfd_holding(format.encode_bytes(one), "snapshot")
                store.put(descriptor)
                os.close(descriptor)
            assert [entry.pages_size for entry in store.chain_of(COMPONENT)] == [len(one.contents) for one in made]
        finally:
            store.close()
