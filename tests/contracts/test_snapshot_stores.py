"""The contract of a store of snapshots, `checkpoint.store.contract`: one suite for every implementation."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import pytest
from blake3 import blake3
from msgspec.structs import replace

from checkpoint.errors import ChainError, FormatError, StoreError
from checkpoint.keeper.messages import close_all, memfd_holding
from checkpoint.model import Position, Snapshot
from checkpoint.snapshot import format
from checkpoint.store import chain
from checkpoint.store.contract import SnapshotStore
from checkpoint.store.store import open_store
from tests.checkpoint.snapshots import COMPONENT, history, page, pages_of, snapshot

OTHER = "/lab/robot1/planner"


class Place(Protocol):
    """Where an implementation keeps its snapshots: opened as often as a test wants, one life after the other."""

    def open(self) -> SnapshotStore: ...

    def alter(self, component: str, position: Position) -> None:
        """Change one byte of a stored snapshot behind the back of the store, which is open."""
        ...


class Directory:
    """On a disk of this machine."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def open(self) -> SnapshotStore:
        self._store = open_store(self._root)
        return self._store

    def alter(self, component: str, position: Position) -> None:
        path = self._store.chain_of(component, position)[-1].path
        with path.open("r+b") as file:
            file.seek(-200, os.SEEK_END)
            byte = file.read(1)
            file.seek(-200, os.SEEK_END)
            file.write(bytes([byte[0] ^ 1]))


PLACES: dict[str, Callable[[Path], Place]] = {"directory": lambda path: Directory(path / "store")}


@pytest.fixture(params=PLACES)
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    return PLACES[request.param](tmp_path)


@contextmanager
def opened(place: Place) -> Iterator[SnapshotStore]:
    store = place.open()
    try:
        yield store
    finally:
        store.close()


@pytest.fixture
def store(place: Place) -> Iterator[SnapshotStore]:
    with opened(place) as store:
        yield store


def put(store: SnapshotStore, *made: Snapshot, prove: bool = True) -> None:
    for one in made:
        descriptor = memfd_holding(format.encode_bytes(one), "snapshot")
        try:
            assert store.put(descriptor, prove=prove).position == one.position
        finally:
            os.close(descriptor)


def positions(made: tuple[Snapshot, ...]) -> tuple[Position, ...]:
    return tuple(one.position for one in made)


def test_an_empty_store_has_nothing(store: SnapshotStore) -> None:
    assert store.components() == () and store.positions(COMPONENT) == ()
    assert store.newest(COMPONENT) is None and store.kept(COMPONENT) is None and store.notices == []
    for ask in (store.chain_of, store.open_chain, store.load):
        with pytest.raises(StoreError, match=COMPONENT):
            ask(COMPONENT)


@pytest.mark.parametrize("prove", [True, False])
def test_what_was_put_is_there_in_the_next_life(place: Place, prove: bool) -> None:
    made = history(3)
    with opened(place) as store:
        put(store, *made, prove=prove)
        put(store, snapshot({1: page("other")}, component=OTHER), prove=prove)
    with opened(place) as store:
        assert store.components() == (COMPONENT, OTHER)
        assert store.positions(COMPONENT) == positions(made) and store.newest(COMPONENT) == made[-1].position
        for length in (1, 2, 3):
            assert pages_of(store.load(COMPONENT, made[length - 1].position)) == pages_of(chain.fold(made[:length]))
        kept = store.kept(COMPONENT)
        assert kept is not None and (kept.positions, kept.olds) == (3, 0) and kept.size > 0


def test_a_file_without_a_name_is_filled_and_put(store: SnapshotStore) -> None:
    base = history(1)[0]
    descriptor = store.unnamed()
    try:
        os.write(descriptor, format.encode_bytes(base))
        store.put(descriptor)
    finally:
        os.close(descriptor)
    assert pages_of(store.load(COMPONENT)) == pages_of(base)


def test_a_second_put_of_a_position_changes_nothing(store: SnapshotStore) -> None:
    made = history(2)
    put(store, *made)
    before = store.kept(COMPONENT), store.chain_of(COMPONENT)
    put(store, *made)
    assert (store.kept(COMPONENT), store.chain_of(COMPONENT)) == before


def test_a_delta_is_taken_after_its_parent_only(store: SnapshotStore) -> None:
    base, second, third = history(3)
    with pytest.raises(ChainError, match="ask for a base"):
        put(store, second)
    put(store, base)
    with pytest.raises(ChainError, match="ask for a base"):
        put(store, third)
    assert store.positions(COMPONENT) == (base.position,)


def test_a_snapshot_that_leads_to_another_state_than_it_names_is_refused(store: SnapshotStore) -> None:
    base, second = history(2)
    put(store, base)
    with pytest.raises(ChainError, match="ask for a base"):
        put(store, replace(second, position=replace(second.position, digest=bytes(16))))
    assert store.positions(COMPONENT) == (base.position,)


def test_half_a_snapshot_is_refused_and_leaves_nothing(place: Place) -> None:
    with opened(place) as store:
        content = format.encode_bytes(history(1)[0])
        descriptor = memfd_holding(content[: len(content) // 2], "snapshot")
        try:
            with pytest.raises(FormatError):
                store.put(descriptor)
        finally:
            os.close(descriptor)
        assert store.components() == ()
    with opened(place) as store:
        assert store.components() == () and store.notices == []


def test_the_files_of_a_chain_stay_readable_when_they_are_removed(store: SnapshotStore) -> None:
    made = history(3)
    put(store, *made)
    whole, rest = store.open_chain(COMPONENT), store.open_chain(COMPONENT, beyond=made[0].position)
    try:
        entry = store.chain_of(COMPONENT)[-1]
        outline = store.outline(COMPONENT, entry, whole[-1])
        store.drop(COMPONENT)
        assert store.components() == () and store.kept(COMPONENT) is None
        assert [format.verify(one).position for one in whole] == list(positions(made))
        assert [format.verify(one).position for one in rest] == list(positions(made)[1:])
        assert (outline.position, entry.position, outline.parent) == (made[2].position, made[2].position, made[1].position)
    finally:
        close_all((*whole, *rest))


def test_what_a_kept_position_needs_is_never_pruned(store: SnapshotStore) -> None:
    made = history(6)
    put(store, *made)
    store.fold(COMPONENT, made[3].position)
    assert store.is_prune_due(COMPONENT, made[3].position)
    store.prune(COMPONENT, replace(made[3].position, digest=bytes(16)))
    assert store.positions(COMPONENT) == positions(made), "a position that is not held forgets nothing"
    store.prune(COMPONENT, made[3].position)
    assert store.positions(COMPONENT) == positions(made)[3:]
    assert len(store.chain_of(COMPONENT)) == 3
    assert pages_of(store.load(COMPONENT)) == pages_of(chain.fold(made))
    store.fold(COMPONENT, made[5].position)
    store.keep_newest(COMPONENT, 1)
    assert not store.is_prune_due(COMPONENT, made[5].position)
    assert store.positions(COMPONENT) == positions(made)[5:]
    assert pages_of(store.load(COMPONENT)) == pages_of(chain.fold(made))


def test_only_a_position_that_nothing_continues_is_discarded(store: SnapshotStore) -> None:
    made = history(3)
    put(store, *made)
    store.discard(COMPONENT, made[1].position)
    assert store.positions(COMPONENT) == positions(made)
    store.discard(COMPONENT, made[2].position)
    assert store.positions(COMPONENT) == positions(made)[:2]


def test_a_line_that_lost_is_kept_for_inspection_alone(store: SnapshotStore) -> None:
    base = history(1)[0]
    lost = snapshot({1: page("lost")}, generation=2)
    put(store, base, lost)
    path = store.set_aside(COMPONENT, {2})
    assert path is not None and pages_of(format.decode(path)) == pages_of(lost)
    assert store.positions(COMPONENT) == (base.position,)
    assert store.set_aside(COMPONENT, {7}) is None


def test_what_was_altered_is_passed_over_now_and_in_the_next_life(place: Place) -> None:
    made = history(3)
    with opened(place) as store:
        put(store, *made)
        place.alter(COMPONENT, made[2].position)
        assert store.load(COMPONENT).position == made[1].position
        assert store.newest(COMPONENT) == made[1].position and len(store.notices) == 1
    with opened(place) as store:
        assert store.positions(COMPONENT) == positions(made)[:2] and len(store.notices) == 1
        put(store, made[2])
        assert store.load(COMPONENT).position == made[2].position


def test_contents_are_kept_by_their_digest_and_removed_when_nothing_names_them(store: SnapshotStore) -> None:
    content = b"#!/bin/sh\n" * 100
    digest = blake3(content).digest()
    assert not store.contents.has(digest, len(content)) and not store.contents.hold(digest, len(content))
    with pytest.raises(StoreError, match=digest.hex()):
        store.contents.open(digest)
    descriptor = memfd_holding(content, "content")
    try:
        store.contents.put(descriptor, digest)
    finally:
        os.close(descriptor)
    assert store.contents.has(digest, len(content)) and not store.contents.has(digest, len(content) - 1)
    assert store.collect_contents() == 0 and store.contents.hold(digest, len(content)), "it is young: its snapshot is on its way"
    descriptor = store.contents.open(digest)
    try:
        assert os.read(descriptor, 4096) == content
    finally:
        os.close(descriptor)


def test_one_life_at_a_time_has_the_store(place: Place) -> None:
    with opened(place), pytest.raises(StoreError, match="another process"):
        place.open()
