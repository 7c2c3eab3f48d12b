"""Memory of a family: common since a fork, shared, of a child that was born late; and where there is no room for it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder
from checkpoint.engines.ptrace.facts import memory_limits
from checkpoint.errors import UnsupportedError
from tests.checkpoint.engines.ptrace.capture.test_trees import three_lives
from tests.checkpoint.engines.ptrace.restore.families import PREAMBLE, goes_through_three_lives
from tests.checkpoint.round_trip import (
    captured_at_last,
    ended,
    everybody_below,
    expect_ok,
    protected,
    restored,
    start,
    transported,
)

pytestmark = pytest.mark.root

FAMILY_MIB = int(os.environ.get("FAILOVER_TEST_FAMILY_MIB", "8"))
"""What each process of a family has, untouched since the fork; the issue says 100."""


MIB = 1 << 20


FORKED = """
import hashlib, mmap
size = int(sys.argv[1]) << 20
memory = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
for offset in range(0, size, 1 << 20):
    memory[offset : offset + (1 << 20)] = os.urandom(1 << 20)
begin = hashlib.sha256(memory).digest()

def work():
    number = os.getpid()
    memory[:4096] = bytes([number % 256]) * 4096
    memory.madvise(mmap.MADV_DONTNEED, 8192, 4096)
    os.write(write_end, b".")
    wait_for_go()
    expect("its own page", memory[:4096], bytes([number % 256]) * 4096)
    expect("a page that it gave back", memory[8192:12288], bytes(4096))
    expect("the rest", hashlib.sha256(memory[12288:]).digest(), rest)

rest = hashlib.sha256(memory[12288:]).digest()
read_end, write_end = os.pipe()
children = [born(work) for _ in range(5)]
for _ in children:
    os.read(read_end, 1)
is_ready()
memory[4096] = 1 ^ memory[4096]
memory[4096] = 1 ^ memory[4096]
expect("the first one's memory", hashlib.sha256(memory).digest(), begin)
for child in children:
    expect_child(child)
print("ok", flush=True)
"""


def shared_out(pids: list[int]) -> int:
    """Bytes of memory that these processes take, what they have in common once (PSS)."""
    lines = [line for pid in pids for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()]
    return sum(int(line.split()[1]) << 10 for line in lines if line.startswith("Pss_Anon:"))


def test_memory_that_a_family_has_in_common_since_a_fork_is_there_once(tmp_path: Path) -> None:
    program = start([sys.executable, "-c", PREAMBLE + FORKED, str(FAMILY_MIB)], tmp_path, isolate=True)
    last, taken = three_lives(program, lambda one: "ready\n" in one.output)
    with ended(last):
        everybody = [last.pid, *everybody_below(last.pid)]
        assert len(everybody) == 6
        once = FAMILY_MIB * MIB
        assert shared_out(everybody) < 1.2 * once + 16 * MIB
        assert len(taken[-1].contents) < 1.2 * once + 16 * MIB
        last.tell()
        expect_ok(last)


SHARED = """
import mmap
size = 64 * mmap.PAGESIZE
memory = mmap.mmap(-1, size)
read_end, write_end = os.pipe()

def write():
    memory[size // 2 : size // 2 + 5] = b"child"

def work():
    memory[size - 4 : size] = b"tail"
    os.write(write_end, b".")
    wait_for_go()
    expect("what was written by one that has ended", memory[size // 2 : size // 2 + 5], b"child")
    expect("what it has written itself", memory[size - 4 : size], b"tail")

os.waitpid(born(write), 0)
child = born(work)
os.read(read_end, 1)
is_ready()
expect_child(child)
expect("what a child has written", memory[size - 4 : size], b"tail")
print("ok", flush=True)
"""


def test_shared_memory_that_only_children_have_written_is_whole(tmp_path: Path) -> None:
    """The parent's page tables tell nothing of it."""
    goes_through_three_lives(SHARED, tmp_path)


BORN_LATE = """
import hashlib
read_end, write_end = os.pipe()

def work():
    memory = os.urandom(1 << 20)
    digest = hashlib.sha256(memory).digest()
    os.write(write_end, b".")
    wait_for_go()
    expect("its memory", hashlib.sha256(memory).digest(), digest)

print("begun", flush=True)
while not os.path.exists("fork"):
    time.sleep(0.01)
child = born(work)
os.read(read_end, 1)
is_ready()
expect_child(child)
print("ok", flush=True)
"""


def test_a_child_whose_first_delta_was_lost_is_whole_in_the_next(tmp_path: Path) -> None:
    program = start([sys.executable, "-c", PREAMBLE + BORN_LATE], tmp_path, isolate=True)
    with ended(program), protected(program) as session:
        program.wait_for_line("begun")
        base = captured_at_last(session, CaptureOrder(base=True, sequence=1))
        session.acknowledge(base.position)
        (tmp_path / "fork").touch()
        program.wait_for_line("ready")
        lost = captured_at_last(session, CaptureOrder(base=False, sequence=2))
        delta = captured_at_last(session, CaptureOrder(base=False, sequence=3, hold=True))
        assert lost.parent == delta.parent == base.position
        chain = [transported(base), transported(delta)]
        program.kill()
    program = restored(chain, tmp_path)
    with ended(program):
        program.tell()
        expect_ok(program)


CROWD = """
held = bytearray(os.urandom(1 << 20) * 8)
child = born(lambda: wait_for_go() or 0 if sum(held[:1 << 20]) else 1)
is_ready()
expect_child(child)
print("ok", flush=True)
"""


def test_a_family_for_which_there_is_no_room_is_refused_by_name_and_runs_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = start([sys.executable, "-S", "-c", PREAMBLE + CROWD], tmp_path)
    with ended(program):
        program.wait_for_line("ready")
        with protected(program) as session:
            with monkeypatch.context() as little:
                little.setattr(memory_limits, "free", lambda: 16 * MIB)
                with pytest.raises(UnsupportedError, match=r"its processes hold 0\.0 GB together, and copying them takes"):
                    session.capture(CaptureOrder())
            snapshot = captured_at_last(session, CaptureOrder())
        with monkeypatch.context() as little:
            little.setattr(memory_limits, "free", lambda: 16 * MIB)
            (reason,) = memory_limits.refuse_restore(snapshot)
            assert "its processes hold 0.0 GB where each has its own" in reason
        assert memory_limits.refuse_restore(snapshot) == ()
        program.tell()
        expect_ok(program)
