"""Guard pages are found where they are now, whichever mappings are watched or no longer watched."""

from __future__ import annotations

import numpy as np

from checkpoint.linux.memory.guard_pages import Guards
from checkpoint.linux.memory.tracker import NONE, Scan
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words

PAGE = 4096


def extents(*found: tuple[int, int]) -> Words:
    """These pages, by first and end."""
    return np.array([(first * PAGE, end * PAGE) for first, end in found], dtype=np.uint64)


def test_guards_where_a_scan_names_nothing_any_more_are_looked_for() -> None:
    there = extents((3, 4), (13, 14))
    guards = Guards(lambda places: page_set.intersection(there, places))
    mapped = extents((0, 20))
    assert guards.found(mapped, mapped).tolist() == there.tolist()
    guards.named(Scan(NONE, NONE))
    assert guards.found(mapped, mapped).tolist() == there.tolist()
    there = extents((3, 4), (15, 16))
    guards.named(Scan(NONE, NONE))
    assert guards.found(mapped, extents((0, 10))).tolist() == there.tolist()
