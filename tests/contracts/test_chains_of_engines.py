"""The contract of every engine's snapshots, so that chain, store and standby need not know which engine made them.

The ptrace engine on a small process that obeys orders, the cooperative engine on a segment that we write: the same suite.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder, Session
from checkpoint.engines.cooperative.session import CooperativeSession
from checkpoint.engines.registry import engine_named
from checkpoint.errors import ChainError, CheckpointError
from checkpoint.keeper.messages import memfd_holding
from checkpoint.model import Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import EMPTY_SUM
from checkpoint.segment.layout import PAGE
from checkpoint.segment.reader import SegmentReader
from checkpoint.segment.writer import SegmentWriter
from checkpoint.snapshot import format
from checkpoint.store import chain
from checkpoint.store.store import open_store
from tests.checkpoint.segments import layout, source

PAGES = 16

CHILD = f"""
import mmap, sys
memory = mmap.mmap(-1, {PAGES * PAGE}, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
print("ready", flush=True)
for line in sys.stdin:
    page, value = map(int, line.split())
    memory[page * {PAGE} : page * {PAGE} + 8] = value.to_bytes(8, "little")
    print("done", flush=True)
"""


class Program(Protocol):
    """A program whose state we change a page at a time."""

    session: Session

    def write(self, page: int, value: int) -> None:
        """Put a value at the beginning of a page, at a point that may be captured."""
        ...

    def close(self) -> None:
        """End it."""
        ...


@dataclass
class Traced:
    """An unprepared process under the ptrace engine."""

    process: subprocess.Popen[str]
    session: Session

    def write(self, page: int, value: int) -> None:
        assert self.process.stdin and self.process.stdout
        self.process.stdin.write(f"{page} {value}\n")
        self.process.stdin.flush()
        assert self.process.stdout.readline() == "done\n"

    def close(self) -> None:
        self.session.close()
        self.process.kill()
        self.process.communicate()


class Cooperating:
    """A segment that we write, under the cooperative engine."""

    def __init__(self) -> None:
        self.array = bytearray(PAGES * PAGE)
        self.writer = SegmentWriter(layout(PAGE, PAGES * PAGE))
        self.session: Session = CooperativeSession(SegmentReader(self.writer.descriptor), os.getpid(), "/lab/r1/program")
        self.write(0, 0)

    def write(self, page: int, value: int) -> None:
        self.array[page * PAGE : page * PAGE + 8] = value.to_bytes(8, "little")
        assert self.writer.commit([source(b"state"), source(self.array)])

    def close(self) -> None:
        self.session.close()
        self.writer.close()


def traced() -> Traced:
    process = subprocess.Popen([sys.executable, "-c", CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout and process.stdout.readline() == "ready\n"
        return Traced(process, engine_named("ptrace").protect(process.pid, ProtectOrder("/lab/r1/program")))
    except CheckpointError as error:
        process.kill()
        process.communicate()
        pytest.skip(f"this machine cannot capture by ptrace: {error}")


@pytest.fixture(params=["ptrace", "cooperative"])
def program(request: pytest.FixtureRequest) -> Iterator[Program]:
    made: Program = traced() if request.param == "ptrace" else Cooperating()
    try:
        yield made
    finally:
        made.close()


def values(state: Snapshot) -> set[int]:
    """The numbers that stand at the beginnings of a whole state's pages."""
    heads = np.frombuffer(state.contents, dtype="<u8").reshape(-1, PAGE // 8)[:, 0]
    return set(heads.tolist())


def captured(program: Program, sequence: int, *, base: bool = False) -> Snapshot:
    snapshot = program.session.capture(CaptureOrder(base=base, generation=3, sequence=sequence, epoch=2, robot="r1"))
    read = format.decode(memfd_holding(format.encode_bytes(snapshot), "snapshot"))
    assert read.position == snapshot.position and read.page_sum != EMPTY_SUM
    return read


MARK = 0xFA11_0000_0000_0000
"""Numbers that stand nowhere by chance."""


def test_a_base_and_its_deltas_fold_to_the_state_that_was_captured(program: Program) -> None:
    program.write(1, MARK + 1)
    base = captured(program, 1, base=True)
    program.session.acknowledge(base.position)
    program.write(2, MARK + 2)
    delta = captured(program, 2)
    assert base.is_base and delta.parent == base.position
    assert MARK + 1 in values(base) and MARK + 2 not in values(base)
    folded = chain.fold((base, delta))
    assert {MARK + 1, MARK + 2} <= values(folded)
    assert page_set.total_size(page_set.extents(delta.runs)) < page_set.total_size(page_set.extents(base.runs))


def test_what_was_captured_and_never_acknowledged_is_in_the_next_delta(program: Program) -> None:
    base = captured(program, 1, base=True)
    program.session.acknowledge(base.position)
    program.write(3, MARK + 3)
    lost = captured(program, 2)
    program.write(4, MARK + 4)
    delta = captured(program, 3)
    assert delta.parent == base.position
    assert {MARK + 3, MARK + 4} <= values(chain.fold((base, delta)))
    with pytest.raises(ChainError):
        chain.check_continues(lost.position, delta)


def test_an_acknowledged_delta_is_what_the_next_one_continues(program: Program) -> None:
    made = [captured(program, 1, base=True)]
    for sequence in range(2, 6):
        program.session.acknowledge(made[-1].position)
        program.write(sequence, MARK + sequence)
        made.append(captured(program, sequence))
    assert [one.parent for one in made[1:]] == [one.position for one in made[:-1]]
    assert {MARK + sequence for sequence in range(2, 6)} <= values(chain.fold(made))


def test_a_base_is_whole_whatever_was_acknowledged(program: Program) -> None:
    program.write(1, MARK + 1)
    first = captured(program, 1, base=True)
    program.session.acknowledge(first.position)
    program.write(2, MARK + 2)
    again = captured(program, 2, base=True)
    assert again.is_base and {MARK + 1, MARK + 2} <= values(chain.fold((again,)))


def test_nothing_is_acknowledged_by_a_position_that_was_never_captured(program: Program) -> None:
    base = captured(program, 1, base=True)
    program.session.acknowledge(base.position)
    program.session.acknowledge(type(base.position)(9, 9, bytes(16)))
    assert captured(program, 2).parent == base.position


def test_the_store_takes_every_snapshot_and_proves_it(program: Program, tmp_path: Path) -> None:
    store = open_store(tmp_path / "store")
    base = captured(program, 1, base=True)
    program.session.acknowledge(base.position)
    program.write(7, MARK + 7)
    for snapshot in (base, captured(program, 2)):
        descriptor = memfd_holding(format.encode_bytes(snapshot), "snapshot")
        store.put(descriptor, prove=True)
        os.close(descriptor)
    assert MARK + 7 in values(store.load("/lab/r1/program"))
    store.close()
