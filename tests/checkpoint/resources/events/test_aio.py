"""A ring of asynchronous I/O, which the program can overwrite: its content is believed only as far as possible."""

from __future__ import annotations

import pytest

from checkpoint.errors import RestoreError
from checkpoint.linux.abi import PAGE_SIZE
from checkpoint.model import Vma, VmaKind
from checkpoint.resources.events import aio

PLACES = PAGE_SIZE // aio.EVENT_SIZE - 1


def _ring(number: int, tail: int) -> tuple[aio.Ring, ...]:
    vma = Vma(PAGE_SIZE, 2 * PAGE_SIZE, 3, True, VmaKind.FILE, name=aio.NAME)
    return aio.rings_of([vma], lambda _, __: aio.HEADER.pack(number, PLACES, 0, tail, 0, 0, 0, 32))


@pytest.mark.parametrize(("number", "tail"), [(0xFFFFFFFF, 0), (aio.NUMBERS_MAX, 0), (0, 0xFFFFFFFF), (0, PLACES)])
def test_a_ring_that_says_what_cannot_be_is_refused(number: int, tail: int) -> None:
    with pytest.raises(RestoreError, match="which cannot be"):
        _ring(number, tail)


def test_a_ring_is_made_after_those_whose_numbers_come_before_its_own() -> None:
    (ring,) = _ring(3, PLACES - 1)
    assert aio.slots([ring]) == [None, None, None, ring]
