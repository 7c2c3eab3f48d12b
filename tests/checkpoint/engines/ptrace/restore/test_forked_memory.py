"""Memory that new processes of a tree inherit (`checkpoint.engines.ptrace.restore.forked_memory`).

`tests.checkpoint.engines.ptrace.capture.test_trees` tests real ones.
"""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from checkpoint.engines.ptrace.restore import forked_memory
from checkpoint.model import FileIdentity, PageRun, Snapshot, Vma, VmaKind
from checkpoint.pages.page_set import Words
from tests.checkpoint.snapshots import PAGE, START, page, snapshot

NO_PAGES = forked_memory.NO_PAGES


def with_written(path: str, *written: int) -> Snapshot:
    """A process that has ten pages of a file mapped, and has written some of them."""
    mapping = Vma(START, START + 10 * PAGE, 3, False, VmaKind.FILE, name=path, file=FileIdentity(path, size=10 * PAGE))
    runs = tuple(PageRun(START + number * PAGE, START + (number + 1) * PAGE) for number in written)
    contents = b"".join(page(f"{number}") for number in written)
    return replace(snapshot({}), vmas=(mapping,), runs=runs, contents=contents)


def numbers(pages: Words) -> list[tuple[int, int]]:
    return [((start - START) // PAGE, (end - START) // PAGE) for start, end in pages.tolist()]


def test_what_was_given_back_is_stale_for_whom_others_have_it() -> None:
    views = [with_written("/usr/lib/one", 1, 2, 5), with_written("/usr/lib/one", 1, 2, 7), with_written("/usr/lib/one", 1)]
    inheritance = forked_memory.of(views, NO_PAGES)
    assert [numbers(regions) for _, regions in inheritance.of_files] == [[(0, 10)]]
    assert [numbers(one.there) for one in inheritance.legacies] == [[(1, 3)], [(1, 3)], [(1, 2)]]
    assert [numbers(one.stale) for one in inheritance.legacies] == [[], [], [(2, 3)]]


@pytest.mark.parametrize("path", ["/dev/shm/made", "/usr/lib/brought"])
def test_a_file_that_may_not_be_there_yet_is_left_to_each_process(path: str) -> None:
    views = [with_written(path, 1), with_written(path, 1)]
    inheritance = forked_memory.of(views, NO_PAGES, {"/usr/lib/brought"})
    assert inheritance.of_files == ()
    assert not any(len(one.kept) for one in inheritance.legacies)
