"""Pages of several copies in one buffer: in a new one, and in the memory of one of the copies."""

from __future__ import annotations

import random

import numpy as np
import pytest

from checkpoint.linux.memory.tracker import NONE
from checkpoint.pages import merge, page_set
from checkpoint.pages.merge import Copy

PAGE = 64
ROOM = 3


def copy_of(numbers: set[int], dice: random.Random, room: int = 0) -> Copy:
    """A copy of pages with these numbers, and room for so many more."""
    addresses = np.array(sorted(numbers), np.uint64) * np.uint64(PAGE)
    content = bytearray(dice.randbytes((len(numbers) + room) * PAGE))
    return Copy(page_set.extents_of_addresses(addresses, PAGE), content)


def some(count: int, limit: int, dice: random.Random) -> set[int]:
    return set(dice.sample(range(limit), min(count, limit)))


@pytest.mark.parametrize("seed", range(300))
def test_what_is_gathered_within_a_copy_is_what_is_gathered_elsewhere(seed: int) -> None:
    dice = random.Random(seed)
    first = some(dice.randrange(1, 40), 50, dice)
    known = set(range(60)) if dice.random() < 0.3 else first | set(range(50, 60))
    later = [some(dice.randrange(8), 60, dice) & known for _ in range(2)]
    copies = [copy_of(first, dice, ROOM), *(copy_of(numbers, dice) for numbers in later)]
    dropped = copy_of(some(dice.randrange(10), 60, dice), dice).pages
    sources, _ = merge.newest(copies, PAGE).without(
        page_set.extents_of_addresses(np.arange(60, dtype=np.uint64) * PAGE, PAGE), dropped
    )
    contents = [copy.content for copy in copies]
    expected = bytes(merge.gathered(contents, sources, PAGE))
    before = bytes(contents[0])
    found = merge.gathered_within(0, contents, sources, PAGE)
    if found is None:
        assert bytes(contents[0]) == before
        moves_up = any(words[0] == 0 and words[1] < at for at, words in enumerate(sources.words.tolist()))
        assert moves_up or len(sources.addresses) > len(first) + ROOM
    else:
        assert bytes(found) == expected


def test_pages_that_came_since_find_room_behind_those_of_the_copy() -> None:
    dice = random.Random(1)
    copies = [copy_of({1, 2, 3}, dice, ROOM), copy_of({2, 9}, dice)]
    sources = merge.newest(copies, PAGE)
    assert sources.without(copies[0].pages, NONE)[0].addresses.size == 3
    contents = [copy.content for copy in copies]
    expected = bytes(merge.gathered(contents, sources, PAGE))
    found = merge.gathered_within(0, contents, sources, PAGE)
    assert found is not None
    assert bytes(found) == expected
