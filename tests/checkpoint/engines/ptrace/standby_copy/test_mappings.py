"""Mappings of a ready copy after a delta: each as if all of it were mapped anew, whichever part of it is new."""

from __future__ import annotations

from msgspec.structs import replace

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
