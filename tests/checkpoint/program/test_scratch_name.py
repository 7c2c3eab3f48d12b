"""Scratch memory is in no snapshot and comes back as zeros; all other memory comes back as it was."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

import failover
from checkpoint.engine import CaptureOrder
from checkpoint.model import Snapshot
from checkpoint.program.scratch_name import MAPPED
from failover.errors import RequestError
from tests.checkpoint.round_trip import captured_at_last, ended, protected, restored, start, transported

SIZE: Final = 32 << 20
USES_SCRATCH: Final = """
import os, sys, time
import failover
size, holds_it_open = int(sys.argv[1]), sys.argv[2] == "open"
def said(word):
    while not os.path.exists(word):
        time.sleep(0.002)
if holds_it_open:
    import mmap
    descriptor = os.memfd_create("failover-scratch", 0)
    os.ftruncate(descriptor, size)
    scratch = mmap.mmap(descriptor, size)
else:
    scratch = failover.scratch(size)
noise = os.urandom(1 << 20)
kept = bytearray(noise)
def fill(content):
    for offset in range(0, size, len(content)):
        scratch[offset : offset + len(content)] = content
fill(noise)
print("ready", flush=True)
said("write")
fill(noise[::-1])
print("written", flush=True)
said("tell")
print("kept" if kept == noise else "lost", "zeros" if scratch[:] == bytes(size) else "something", flush=True)
scratch[size - 1 : size] = b"x"
print("writable", scratch[size - 1], flush=True)
"""


def size_of(snapshot: Snapshot) -> int:
    return sum(run.size for run in snapshot.runs)


@pytest.mark.parametrize("how", ["closed", "open"])
def test_scratch_memory_is_in_no_snapshot_and_comes_back_as_zeros(tmp_path: Path, how: str) -> None:
    taken: list[Snapshot] = []
    with ended(start([sys.executable, "-c", USES_SCRATCH, str(SIZE), how], tmp_path)) as program:
        program.wait_for_line("ready")
        with protected(program) as session:
            for sequence in (1, 2):
                order = CaptureOrder(base=sequence == 1, sequence=sequence)
                taken.append(transported(captured_at_last(session, order)))
                session.acknowledge(taken[-1].position)
                if sequence == 1:
                    (tmp_path / "write").touch()
                    program.wait_for_line("written")
    assert [size_of(one) < SIZE for one in taken] == [True, True]
    (tmp_path / "tell").touch()
    with ended(restored(taken, tmp_path)) as again:
        assert again.finish() == 0
        assert again.output.splitlines()[-2:] == ["kept zeros", f"writable {ord('x')}"]


def mappings() -> int:
    return Path("/proc/self/maps").read_text().count(MAPPED)


def test_scratch_memory_is_given_back_when_nothing_refers_to_it(tmp_path: Path) -> None:
    gc.collect()  # what other tests have left
    before, open_before = mappings(), len(os.listdir("/proc/self/fd"))
    memory = failover.scratch(100)
    assert (len(memory), bytes(memory)) == (100, bytes(100))
    part = memory[10:20]
    del memory
    gc.collect()
    assert mappings() == before + 1
    part[0] = 1
    del part
    gc.collect()
    assert mappings() == before
    assert len(os.listdir("/proc/self/fd")) == open_before


USES_IT_TO_THE_END: Final = """
import atexit
held = []
atexit.register(lambda: (held[0].__setitem__(0, 1), print("used", flush=True)))
import failover
held.append(failover.scratch(100))
"""


def test_a_program_that_uses_it_while_it_ends_ends_as_it_would() -> None:
    ended = subprocess.run([sys.executable, "-c", USES_IT_TO_THE_END], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (0, "used\n")


@pytest.mark.parametrize("size", [0, -1, 1 << 62, 1 << 70])
def test_sizes_that_cannot_be_are_refused(size: int) -> None:
    with pytest.raises(RequestError, match="scratch memory"):
        failover.scratch(size)
