"""The index of a component's files, beside a slow one that follows every chain from its end to its beginning."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from checkpoint.model import Position
from checkpoint.store.index import Entry, Shelf


def files_by_chance(dice: random.Random) -> tuple[Entry, ...]:
    """Chains of several epochs that fork, of which files are missing and others are there as a base, too; in no order."""
    entries: list[Entry] = []
    for epoch in range(1, 4):
        known: list[Position | None] = [None, *(entry.position for entry in entries)]
        for sequence in range(1, 12):
            position = Position(epoch, sequence, dice.randbytes(2))
            parent = dice.choice(known[-3:])
            entries.append(Entry(Path(f"{len(entries)}"), position, parent, epoch, 1))
            known.append(position)
            if dice.random() < 0.1:
                entries.append(Entry(Path(f"{len(entries)}"), position, None, epoch, 1))
    return tuple(dice.sample(entries, k=len(entries) - dice.randrange(4)))


def best(entries: tuple[Entry, ...], position: Position) -> Entry | None:
    here = [entry for entry in entries if entry.position == position]
    return next((entry for entry in here if entry.parent is None), here[0] if here else None)


def chain(entries: tuple[Entry, ...], position: Position) -> tuple[Entry, ...]:
    found: list[Entry] = []
    wanted: Position | None = position
    while wanted is not None:
        entry = best(entries, wanted)
        if entry is None:
            return ()
        found.append(entry)
        wanted = entry.parent
    return tuple(reversed(found))


@pytest.mark.parametrize("seed", range(30))
def test_the_index_answers_as_one_that_follows_every_chain(seed: int) -> None:
    entries = files_by_chance(random.Random(seed))
    shelf = Shelf("/lab/one", entries)
    positions = {entry.position for entry in entries}
    whole = sorted((chain(entries, one)[-1] for one in positions if chain(entries, one)), key=lambda entry: entry.order)
    assert shelf.positions() == tuple(entry.position for entry in whole)
    assert shelf.newest() == (whole[-1].position if whole else None)
    for position in positions:
        assert shelf.chain_to(position) == chain(entries, position)
        is_whole = bool(chain(entries, position))
        assert shelf.order_of(position) == (chain(entries, position)[-1].order if is_whole else None)
        floor = shelf.order_of(position)
        needed = {file for entry in whole if floor and entry.order >= floor for file in chain(entries, entry.position)}
        assert set(shelf.unneeded_for(position)) == (set(entries) - needed if is_whole else set())
    assert shelf.with_entry(entries[0]).without(entries) == Shelf("/lab/one")
