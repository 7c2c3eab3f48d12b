"""Memory of special kinds: each captured, killed and restored, and the result where the machine has none of that kind."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.capability import Verdict
from checkpoint.engine import CaptureOrder
from checkpoint.engines.ptrace.facts.probe import probe
from checkpoint.errors import CheckpointError
from checkpoint.linux import system_v_ipc
from checkpoint.linux.memory.tracker import is_shared_object
from checkpoint.linux.procfs import procfs
from checkpoint.resources import refusals
from checkpoint.resources.ipc import system_v_memory
from tests.capability_table import row_of
from tests.checkpoint.round_trip import (
    NOBODY,
    captured,
    captured_and_killed,
    captured_at_last,
    ended,
    expect_ok,
    expect_three_lives,
    protected,
    restored,
    start,
    start_tracee,
    transported,
)
from tests.conftest import children

Compiled = Callable[..., Path]

COUNT = Path("/proc/sys/vm/nr_hugepages")
SWAP_SIZE = 32 << 20
SYSTEM_PATH = "/usr/sbin:/sbin"
PAGES = 8
"""Huge pages that these tests set aside: 16 MiB."""

pytestmark = [pytest.mark.compiler, pytest.mark.root]


@contextlib.contextmanager
def huge_pages(count: int) -> Iterator[None]:
    """So many huge pages on this machine for the body, or a skip."""
    before = int(COUNT.read_text())
    COUNT.write_text(f"{count}\n")
    try:
        if int(COUNT.read_text()) < count:
            pytest.skip(f"this machine has no {count} huge pages to give")
        yield
    finally:
        COUNT.write_text(f"{before}\n")


KINDS = ("huge", "huge_shared", "keys", "locked", "locked_on_fault", "droppable", "sealed", "grows_down", "paged_out")


@pytest.mark.parametrize("kind", KINDS)
def test_memory_of_a_special_kind_comes_back_as_it_was(kind: str, compiled: Compiled, tmp_path: Path) -> None:
    with huge_pages(PAGES) if kind.startswith("huge") else contextlib.nullcontext():
        tracee = start_tracee(compiled("special_memory", "-O2"), tmp_path, kind)
        for _ in range(2):
            with ended(tracee):
                snapshot = captured_and_killed(tracee)
            tracee = restored(snapshot, tmp_path)
        with ended(tracee):
            tracee.tell()
            expect_ok(tracee)


SHARES_HUGE_PAGES = """
import mmap, os, sys, time
MAP_HUGETLB, SIZE = 0x40000, 2 << 20
ours, theirs, private = [mmap.mmap(-1, SIZE, how | mmap.MAP_ANONYMOUS | MAP_HUGETLB)
    for how in (mmap.MAP_SHARED, mmap.MAP_SHARED, mmap.MAP_PRIVATE)]
content = os.urandom(SIZE)
private[:] = content
child = os.fork()
if child:
    ours[:] = b"o" * SIZE
else:
    theirs[:] = content
    private[:9] = b"the child"
    open("written", "w").close()
def wait_for(name):
    while not os.path.exists(name):
        time.sleep(0.01)
wait_for("written")
print("ready", flush=True) if child else None
wait_for("go")
found = [theirs[:] == content, private[9:] == content[9:]]
if not child:
    found += [private[:9] == b"the child"]
    ours[7:8] = b"c"
    open("told", "w").close()
    os._exit(0 if all(found) else 1)
wait_for("told")
found += [ours[:] == b"o" * 7 + b"c" + b"o" * (SIZE - 8), private[:9] == content[:9], os.waitpid(child, 0)[1] == 0]
print(found)
"""


def test_relatives_share_on_what_was_of_huge_pages(tmp_path: Path) -> None:
    with huge_pages(PAGES):
        program = start([sys.executable, "-c", SHARES_HUGE_PAGES], tmp_path, isolate=True)
        program.wait_for_line("ready")
        for _ in range(3):
            with ended(program):
                snapshot = captured_and_killed(program)
            program = restored(snapshot, tmp_path)
        with ended(program):
            program.tell()
            assert program.finish() == 0
            assert program.output.splitlines()[1:] == [str([True] * 5)]


@pytest.mark.parametrize("kind", ["memfd", "deleted"])
def test_a_file_without_a_name_shows_in_what_is_mapped_of_it_and_was_not_written(
    kind: str, compiled: Compiled, tmp_path: Path
) -> None:
    expect_three_lives(start_tracee(compiled("private_of_nameless", "-O2"), tmp_path, kind), tmp_path)


@pytest.mark.parametrize("kind", ["huge", "huge_shared"])
def test_huge_pages_become_ordinary_ones_where_there_are_none(kind: str, compiled: Compiled, tmp_path: Path) -> None:
    with huge_pages(PAGES), ended(start_tracee(compiled("special_memory", "-O2"), tmp_path, kind)) as tracee:
        snapshot = captured_and_killed(tracee)
    with huge_pages(0), ended(restored(snapshot, tmp_path)) as tracee:
        tracee.tell()
        assert tracee.finish() == 1
        assert tracee.output.splitlines()[1:] == ["flags are, were ht", "differs"], "nothing else is another one"


def test_advice_to_a_whole_mapping_is_seen_by_the_next_base(compiled: Compiled, tmp_path: Path) -> None:
    """/proc/PID/maps stays the same meanwhile."""
    with ended(start_tracee(compiled("special_memory", "-O2"), tmp_path, "locked_late")) as tracee:
        with protected(tracee) as session:
            captured_at_last(session, CaptureOrder())
            (tmp_path / "second").touch()
            tracee.wait_for_line("advised")
            snapshot = transported(captured_at_last(session, replace(CaptureOrder(), sequence=2)))
            tracee.kill()
    with ended(restored(snapshot, tmp_path)) as tracee:
        tracee.tell()
        expect_ok(tracee)


# --- Swapped pages -----------------------------------------------------------------------------------------------------


@pytest.fixture
def swap(tmp_path: Path) -> Iterator[None]:
    """A file to swap to."""
    file = tmp_path / "swap"
    with file.open("wb") as made:
        os.posix_fallocate(made.fileno(), 0, SWAP_SIZE)
    file.chmod(0o600)
    if shutil.which("mkswap", path=SYSTEM_PATH) is None:
        pytest.skip("needs mkswap (util-linux)")
    subprocess.run(["/usr/sbin/mkswap", file], check=True, capture_output=True)
    turned_on = subprocess.run(["/usr/sbin/swapon", file], check=False, capture_output=True, text=True)
    if turned_on.returncode:
        pytest.skip(f"this machine does not swap to a file: {turned_on.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["/usr/sbin/swapoff", file], check=True)


@pytest.mark.usefixtures("swap")
def test_swapped_pages_are_carried_and_those_written_since(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("special_memory", "-O2"), tmp_path, "paged_out_again")) as tracee:
        assert procfs.swapped_size(tracee.pid) > 1 << 20
        with protected(tracee) as session:
            base = transported(captured_at_last(session, CaptureOrder()))
            session.acknowledge(base.position)
            (tmp_path / "second").touch()
            tracee.wait_for_line("again")
            assert procfs.swapped_size(tracee.pid) > 100 << 10
            delta = transported(captured_at_last(session, CaptureOrder(base=False, sequence=2)))
            tracee.kill()
    assert 100 <= sum(run.size for run in delta.runs) // delta.machine.page_size < 500
    with ended(restored([base, delta], tmp_path)) as tracee:
        tracee.tell()
        expect_ok(tracee)


# --- Refused -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "flags", "said"),
    [
        ("/mnt/pmem/log", ("rd", "wr", "sf"), "memory that is stored by touching it"),
        ("/dev/hugepages/pool", ("rd", "wr", "ht"), "huge pages of a file"),
        ("/memfd:pool (deleted)", ("rd", "wr", "ht"), "huge pages of a file"),
        ("/memfd:pool", ("rd", "wr", "mt"), "memory with tags (PROT_MTE)"),
        ("/usr/lib/libc.so.6", ("rd", "ex", "bt"), "code whose branch targets are guarded (PROT_BTI)"),
        ("/anon_hugepage (deleted)", ("rd", "wr", "ht"), "MiB of huge pages, which every checkpoint compares"),
    ],
)
def test_memory_that_this_machine_may_not_have_is_named(name: str, flags: tuple[str, ...], said: str) -> None:
    line = procfs.parse_maps_line(f"7f0000000000-7f0008000000 rw-p 00000000 00:11 99 {name}")
    reason = refusals.refuse_mapping(line, flags)
    assert reason is not None and said in reason
    row = row_of(reason)
    assert row is not None and row.verdict == Verdict.REFUSED


# --- System V shared memory ------------------------------------------------------------------------------------------


@contextlib.contextmanager
def segment_removed(identifier: int) -> Iterator[None]:
    """Leave no segment of a program behind, however the body ends."""
    try:
        yield
    finally:
        system_v_ipc.remove(identifier)


@pytest.mark.parametrize("is_left", [True, False], ids=["the segment was left", "another robot"])
def test_shared_memory_of_system_v_comes_back(is_left: bool, compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("special_memory", "-O2"), tmp_path, "segments")) as tracee:
        identifier = int(tracee.output.split()[0])
        with segment_removed(identifier):
            snapshot = captured_and_killed(tracee)
            assert identifier in system_v_ipc.segments()
            if not is_left:
                system_v_ipc.remove(identifier)
                assert identifier not in system_v_ipc.segments()
            with ended(restored(snapshot, tmp_path)) as tracee:
                tracee.tell()
                expect_ok(tracee)


PYTHON = getattr(sys, "_base_executable", sys.executable)
SEGMENT_ALONE = """\
import ctypes, os, time
libc = ctypes.CDLL(None, use_errno=True)
libc.shmat.restype = ctypes.c_void_p
identifier = libc.shmget(0, 16384, 0o1600)
place = ctypes.c_void_p(libc.shmat(identifier, None, 0))
words = (ctypes.c_uint64 * 2048).from_address(place.value)
words[0] = 1
print(identifier, flush=True)
while not os.path.exists("on"):
    time.sleep(0.01)
seen = words[0], words[1024]
words[0] = words[1024] = 9
print("after", *seen, flush=True)
while not os.path.exists("end"):
    time.sleep(0.01)
assert libc.shmctl(identifier, 0, None) == 0
"""
"""Writes its segment, without a key, once more after the capture."""


def test_a_segment_without_a_key_is_the_one_it_was_with_what_it_held(tmp_path: Path) -> None:
    with ended(start([PYTHON, "-c", SEGMENT_ALONE], tmp_path)) as program:
        program.wait_for_output(0)
        identifier = int(program.output)
        with segment_removed(identifier):
            snapshot = captured(program)
            (tmp_path / "on").touch()
            program.wait_for_line("after 1 0")
            program.kill()
            with ended(restored(snapshot, tmp_path)) as program:
                program.wait_for_line("after 1 0")
                (tmp_path / "end").touch()
                assert program.finish() == 0
            assert identifier not in system_v_ipc.segments()


SEGMENT_OF_RELATIVES = """\
import ctypes, os, time
libc = ctypes.CDLL(None, use_errno=True)
libc.shmat.restype = ctypes.c_void_p
identifier = libc.shmget(int(os.environ["KEY"]), 16384, 0o3600)
if os.environ["WHO"] == "both":
    place = libc.shmat(identifier, None, 0)
child = os.fork()
if os.environ["WHO"] == "each":
    place = libc.shmat(identifier, None, 0)
assert place != -1
words = (ctypes.c_uint64 * 2048).from_address(place)
if child:
    print(identifier, flush=True)
    while not words[1024]:
        time.sleep(0.001)
    words[0] = 1
def is_told(name):
    if os.fork() == 0:  # who is born and ends between two looks has it attached, too
        os._exit(0)
    os.wait() if not child else os.waitid(os.P_ALL, 0, os.WEXITED)
    return os.path.exists(name)
if not child:
    words[1024] = 1
    while not words[0]:
        time.sleep(0.001)
    open("ready", "w").close()
    turns = 0
    while not is_told("go"):
        words[1] += 1
        turns += 1
        time.sleep(0.005)
    words[2] = words[1] == turns
    os._exit(0)
os.wait()
print("turned", words[1] > 0, words[2], flush=True)
assert libc.shmctl(identifier, 0, None) == 0
"""
"""Two processes with one segment; the child counts in it, and gives birth, until it is told."""


@pytest.mark.parametrize("has_key", [False, True])
@pytest.mark.parametrize("who", ["both", "each"])
def test_relatives_have_one_segment_again(who: str, has_key: bool, tmp_path: Path) -> None:
    key = random.randrange(1, 1 << 31) if has_key else 0  # nobody else's, and not that of another run of this test
    told = {**os.environ, "WHO": who, "KEY": str(key)}
    program = start([PYTHON, "-c", SEGMENT_OF_RELATIVES], tmp_path, env=told, isolate=True)
    with contextlib.ExitStack() as after:
        program.wait_until((tmp_path / "ready").exists, "that both have it")
        identifier = int(program.output)
        after.enter_context(segment_removed(identifier))
        assert not probe(program.pid).reasons
        for life in range(3):
            with ended(program), protected(program) as session:
                taken = [transported(captured_at_last(session, CaptureOrder()))]
                session.acknowledge(taken[0].position)
                for sequence in (2, 3):
                    order = CaptureOrder(base=False, sequence=sequence, hold=sequence == 3)
                    taken.append(transported(captured_at_last(session, order)))
                    session.acknowledge(taken[-1].position)
                program.kill()
            if life == 1:
                system_v_ipc.remove(identifier)  # as on another robot
            program = restored(taken, tmp_path)
        with ended(program):
            program.tell()
            assert program.finish() == 0, program.complaints
            assert program.output.splitlines()[1:] == ["turned True 1"]
        assert identifier not in system_v_ipc.segments()


def test_a_segment_that_another_user_has_made_is_not_taken_for_the_one_that_was_left() -> None:
    """He could write to what the program has in it, also when he has given it away."""
    left = system_v_ipc.Segment(0x5EED, 7, 0o600, 4096, 0, 0, 0, creator=0, changed=1000)
    wanted = replace(left, creator=-1)
    assert system_v_memory._left_behind(wanted, [left]) is left
    assert system_v_memory._left_behind(replace(wanted, key=0), [replace(left, key=0)]) is not None
    assert system_v_memory._left_behind(replace(wanted, key=0), [replace(left, key=0, changed=1001)]) is None
    for other in (
        replace(left, creator=NOBODY),
        replace(left, uid=NOBODY),
        replace(left, permissions=0o666),
        replace(left, attached=1),
    ):
        assert system_v_memory._left_behind(wanted, [other]) is None


def test_a_key_that_somebody_else_has_is_said_so(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("special_memory", "-O2"), tmp_path, "segments")) as tracee:
        identifier = int(tracee.output.split()[0])
        with segment_removed(identifier):
            snapshot = captured_and_killed(tracee)
            key = system_v_ipc.segments()[identifier].key
    other = system_v_ipc.make(system_v_ipc.Segment(key, identifier + 1, 0o600, 4096, 0, 0, 0))
    with segment_removed(other):
        before, known = children(), set(system_v_ipc.segments())
        with pytest.raises(CheckpointError, match="belongs to another segment here"):
            restored(snapshot, tmp_path).kill()
        assert (children(), set(system_v_ipc.segments())) == (before, known)


def test_a_restore_that_fails_leaves_no_segment(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("special_memory", "-O2"), tmp_path, "segments")) as tracee:
        identifier = int(tracee.output.split()[0])
        with segment_removed(identifier):
            snapshot = captured_and_killed(tracee)
    (thread,) = snapshot.threads
    (tmp_path / "beside").mkdir()
    with ended(start(["/bin/sleep", "600"], tmp_path / "beside")) as other:
        beside = replace(snapshot, threads=(thread, replace(thread, tid=other.pid)))
        known = set(system_v_ipc.segments())
        with pytest.raises(CheckpointError, match="id is in use"):
            restored(beside, tmp_path).kill()
        assert set(system_v_ipc.segments()) == known


def test_the_first_segment_of_a_machine_is_read_as_all_others_are() -> None:
    """Its inode number is its id, 0: what was not touched through this mapping is in it all the same."""
    (line,) = procfs.parse_maps("7f0000000000-7f0000004000 rw-s 00000000 00:01 0                     /SYSV00000007 (deleted)\n")
    assert line.inode == 0
    assert is_shared_object(line)
