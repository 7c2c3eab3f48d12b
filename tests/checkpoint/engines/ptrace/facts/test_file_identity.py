"""What a snapshot tells of the files behind the mappings, while the program runs on."""

from __future__ import annotations

import mmap
import os

import pytest

from checkpoint.engines.ptrace.facts.file_identity import Identities
from checkpoint.linux.memory.tracker import NONE
from checkpoint.linux.procfs import procfs

PAGES = 3

pytestmark = pytest.mark.root


def test_memory_that_the_program_unmaps_after_the_freeze_keeps_its_size_and_mode() -> None:
    """The files are looked at when the program runs again: it may be between a munmap(2) and the next mmap(2)."""
    memory, identities = os.memfd_create("shared"), Identities(os.getpid(), {})
    os.ftruncate(memory, PAGES * mmap.PAGESIZE)
    mapped = mmap.mmap(memory, mmap.PAGESIZE)  # a part of it: its size is not to be guessed by the mapping
    lines = tuple(
        line for line in procfs.parse_maps(procfs.read_text(os.getpid(), "maps")) if line.name.startswith("/memfd:shared")
    )
    (before,) = identities.vmas(lines, {}, NONE)
    mapped.close()
    os.close(memory)
    (after,) = identities.vmas(lines, {}, NONE)
    assert after == before
    assert after.file is not None
    assert after.file.size == PAGES * mmap.PAGESIZE
