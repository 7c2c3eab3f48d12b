"""Memo of facts: which unchanged objects it remembers, and which facts it must not."""

from __future__ import annotations

import mmap
import os

import pytest

from checkpoint.engines.ptrace.facts.file_identity import Identities
from checkpoint.linux.memory.tracker import NONE
from checkpoint.linux.procfs import procfs
from checkpoint.runtime.identity_memo import Memo


def test_a_result_lasts_as_long_as_the_things_are_the_very_same() -> None:
    made: list[int] = []
    memo = Memo[int]()

    def make() -> int:
        made.append(len(made))
        return made[-1]

    first, alike = [1], [1]
    assert [memo.of(first, 2, make=make), memo.of(first, 2, make=make)] == [0, 0]
    assert memo.of(alike, 2, make=make) == 1, "alike is not the same"
    assert memo.of(alike, make=make) == 2, "fewer things are others"
    memo.forget()
    assert memo.of(alike, make=make) == 3


@pytest.mark.root  # an ordinary user is told which memory file it is, not how large
def test_mappings_that_have_not_changed_are_told_as_before_but_for_a_size_that_they_do_not_tell() -> None:
    pid = os.getpid()
    file = os.memfd_create("grows")
    try:
        os.ftruncate(file, mmap.PAGESIZE)
        with mmap.mmap(file, mmap.PAGESIZE) as shown:
            lines = tuple(procfs.parse_maps(procfs.read_text(pid, "maps")))
            (mine,) = (line for line in lines if "memfd:grows" in line.name)
            others = tuple(line for line in lines if not line.shared)
            identities = Identities(pid, {})
            flags: dict[int, tuple[str, ...]] = {}
            assert identities.vmas(others, flags, NONE) is identities.vmas(others, flags, NONE)

            only = (mine,)

            def told_size() -> int:
                (vma,) = identities.vmas(only, flags, NONE)
                assert vma.file is not None
                return vma.file.size

            assert told_size() == mmap.PAGESIZE
            os.ftruncate(file, 3 * mmap.PAGESIZE)
            assert told_size() == 3 * mmap.PAGESIZE
            assert shown[0] == 0
    finally:
        os.close(file)
