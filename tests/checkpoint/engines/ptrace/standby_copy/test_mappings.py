"""Mappings of a ready copy after a delta: each as if all of it were mapped anew, whichever part of it is new."""

from __future__ import annotations

import random

import numpy as np
import pytest
from msgspec.structs import asdict, replace

from checkpoint.engines.ptrace.standby_copy.mappings import NO_PAGES, Change
from checkpoint.linux.abi import PAGE_SIZE, PROT_READ, PROT_WRITE
from checkpoint.model import PageRun, Snapshot, Vma, VmaKind
from checkpoint.pages import page_set
from tests.samples.make import sample


def _memory(end: int) -> Vma:
    return Vma(PAGE_SIZE, end * PAGE_SIZE, PROT_READ, False, VmaKind.ANONYMOUS)


def _delta(vma: Vma) -> Snapshot:
    return replace(sample(), vmas=(vma,), runs=(), cleared=())


def test_what_is_mapped_beside_pages_that_are_held_can_be_written_as_they_can() -> None:
    held = page_set.extents([PageRun(PAGE_SIZE, 2 * PAGE_SIZE)])
    grown = Change.between([_memory(2)], held, _delta(_memory(3)))
    assert [(piece.start, piece.end) for piece in grown.fresh] == [(2 * PAGE_SIZE, 3 * PAGE_SIZE)]
    assert grown.protections == ((2 * PAGE_SIZE, 3 * PAGE_SIZE, PROT_READ | PROT_WRITE),)


def test_what_is_mapped_where_nothing_is_held_has_its_own_protection() -> None:
    assert Change.between([_memory(2)], NO_PAGES, _delta(_memory(3))).protections == ()


@pytest.mark.parametrize("seed", range(40))
def test_a_delta_of_the_same_mappings_is_worked_out_as_any_other(seed: int) -> None:
    """A list is never equal to the tuple of a delta: so all of it is compared."""
    dice = random.Random(seed)
    protections = (PROT_READ, PROT_READ | PROT_WRITE, 0)
    vmas = tuple(
        Vma(first * PAGE_SIZE, (first + 4) * PAGE_SIZE, dice.choice(protections), False, VmaKind.ANONYMOUS)
        for first in range(1, 40, dice.choice((4, 5)))
    )
    every = page_set.addresses_of(page_set.extents(vmas), PAGE_SIZE).tolist()

    def some(share: float) -> page_set.Words:
        chosen = [address for address in every if dice.random() < share]
        return page_set.extents_of_addresses(np.array(chosen, dtype=np.uint64), PAGE_SIZE)

    held = some(dice.choice((0.0, 0.5, 1.0)))
    runs = page_set.intersection(held, some(0.5)) if dice.random() < 0.5 else some(0.3)
    cleared = page_set.difference(some(dice.choice((0.0, 0.2))), runs)
    delta = replace(sample(), vmas=vmas, runs=page_set.page_runs(runs), cleared=page_set.page_runs(cleared))
    stiff = some(0.1)
    found, expected = (asdict(Change.between(before, held, delta, stiff)) for before in (vmas, list(vmas)))
    for name, value in expected.items():
        assert np.array_equal(found[name], value) if isinstance(value, np.ndarray) else found[name] == value, name
