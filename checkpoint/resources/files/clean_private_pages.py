"""Unwritten pages of private mappings of files without a name: later writes to the file still show in such pages.

That matters where a process may still write to the file: the file is open, or also mapped shared. The snapshot carries all pages
of such a mapping. This resource says which of them are the file's own, so that a restore leaves these pages to the file that it
makes again.

Facts: ``descriptors`` (none); ``runs``: a list of [start, end], whole pages in address order.

Source: mmap(2), MAP_PRIVATE; Linux does what POSIX leaves open.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from checkpoint.linux.memory import tracker
from checkpoint.linux.memory.tracker import NONE
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.model import Fact, Resource
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words
from checkpoint.resources.open_file import OpenFile
from checkpoint.resources.restore_context import number_of

KIND: Final = "untouched"


def describe(lines: Sequence[MapsLine], theirs: Words, opened: Iterable[OpenFile]) -> tuple[Resource, ...]:
    """The clean private pages of a process that stood still.

    Args:
        theirs: pages of such mappings that are not the process's own.
        opened: its open files then.
    """
    if not len(theirs):
        return ()
    written_to = {(held.first.device, held.first.inode) for held in opened}
    written_to |= {(line.device, line.inode) for line in lines if line.shared and line.has_file}
    linked = [line for line in lines if tracker.is_orphan(line) and (line.device, line.inode) in written_to]
    runs: list[Fact] = [list(run) for run in page_set.intersection(theirs, tracker.extents_of(linked)).tolist()]
    return (Resource(KIND, "untouched pages", {"descriptors": [], "runs": runs}),) if runs else ()


def of(resources: Iterable[Resource]) -> Words:
    """The pages that a snapshot tells of."""
    found = [run for held in resources if held.kind == KIND for run in _runs(held.facts["runs"])]
    return np.array(found, dtype=np.uint64).reshape(-1, 2) if found else NONE


def _runs(fact: Fact) -> list[tuple[int, int]]:
    assert isinstance(fact, list)
    return [(number_of(run[0]), number_of(run[1])) for run in fact if isinstance(run, list)]
