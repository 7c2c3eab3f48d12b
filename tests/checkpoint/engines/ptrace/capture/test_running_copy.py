"""What is copied while a program runs stays as small as what still counts, and keeps its content."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from checkpoint.engines.ptrace.capture.memory import SHED_SHARE, RunningCopy
from checkpoint.linux.memory.tracker import Scan
from checkpoint.pages import merge, page_set
from checkpoint.pages.merge import Copy
from checkpoint.pages.page_set import Words

PAGE = 4096
NONE = page_set.extents(())

sets = st.sets(st.integers(1, 40), max_size=30).map(
    lambda pages: page_set.extents_of_addresses(np.array(sorted(pages), dtype=np.uint64) * PAGE, PAGE)
)


def told(copied: RunningCopy) -> bytes:
    """The newest content of each page that counts."""
    sources, _ = merge.newest(copied.copies, PAGE).without(copied.valid, NONE)
    return bytes(merge.gathered([copy.content for copy in copied.copies], sources, PAGE))


@given(st.lists(st.tuples(sets, sets), min_size=1, max_size=8))
def test_shedding_bounds_the_memory_and_changes_no_content(passes: list[tuple[Words, Words]]) -> None:
    copied = RunningCopy()
    for number, (pages, written) in enumerate(passes, 1):
        if len(pages):
            places = page_set.addresses_of(pages, PAGE) // PAGE
            copied.add(Copy(pages, bytearray(b"".join(bytes([number, place]) * (PAGE // 2) for place in places.tolist()))))
        copied.spoil(Scan(written, NONE))
        before = told(copied)
        copied.shed()
        assert told(copied) == before
        assert sum(page_set.total_size(copy.pages) for copy in copied.copies) <= SHED_SHARE * page_set.total_size(copied.valid)
