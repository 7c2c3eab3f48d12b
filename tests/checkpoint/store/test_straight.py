"""Bases that go straight from a program's memory to a file, and from a file straight into a program's memory."""

from __future__ import annotations

import os
import random
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from checkpoint.engine import CaptureOrder, RestoreOptions, Session
from checkpoint.engines.ptrace.capture.tree import CapturedTree
from checkpoint.errors import CaptureError, ChainError, FormatError
from checkpoint.keeper.messages import Capture
from checkpoint.keeper.server import Keeper
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.spawn.vessel import Birth, discard, spawn_vessel
from checkpoint.model import PageRun, Snapshot, Vma, VmaKind
from checkpoint.pages import page_set
from checkpoint.runtime import parallel
from checkpoint.snapshot import compression, format
from checkpoint.snapshot.layout import FRAME_SIZE, Codec
from checkpoint.store import chain
from checkpoint.store.base_in_process import UnreadBase
from checkpoint.store.base_on_disk import stored_base
from tests.checkpoint.round_trip import (
    ENGINE,
    Program,
    at_last,
    captured_at_last,
    ended,
    expect_ok,
    protected,
    restored_from,
    start_tracee,
    written_and_killed,
)

SIZE = 6 << 20

SCRIPT = f"""#!{sys.executable}
import ctypes, mmap, os, random, sys, time
size, zeros = {SIZE}, bytes({SIZE})
dice = random.Random(8)
chance = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
chance.write(dice.randbytes(size))
alike = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
alike.write(dice.randbytes(mmap.PAGESIZE) * (size // mmap.PAGESIZE))
zero = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
zero.write(zeros)
mixed = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
for page in range(0, size, 2 * mmap.PAGESIZE):
    mixed[page : page + 2 * mmap.PAGESIZE] = dice.randbytes(mmap.PAGESIZE) + zeros[: mmap.PAGESIZE]
with open("file", "wb") as file:
    file.write(b"." * size)
with open("file", "rb") as file:
    emptied = mmap.mmap(file.fileno(), size, flags=mmap.MAP_PRIVATE, prot=mmap.PROT_READ | mmap.PROT_WRITE)
emptied.write(zeros)
places = [chance, alike, zero, mixed, emptied]
before = [bytes(place) for place in places]
addresses = [ctypes.addressof(ctypes.c_char.from_buffer(place)) for place in places]
hidden = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE)
hidden.write(before[0])
closed = ctypes.addressof(ctypes.c_char.from_buffer(hidden))
protect = ctypes.CDLL(None).mprotect
protect(ctypes.c_void_p(closed), ctypes.c_size_t(size), 0)
print(*addresses, closed, flush=True)
print("ready", flush=True)
while not os.path.exists(sys.argv[1]):
    time.sleep(0.01)
protect(ctypes.c_void_p(closed), ctypes.c_size_t(size), 3)
wrong = [name for name, place, old in zip(("chance", "alike", "zero", "mixed", "emptied"), places, before) if bytes(place) != old]
wrong += [] if bytes(hidden) == before[0] else ["hidden"]
print(*wrong or ["ok"], flush=True)
"""
"""Memory of every kind, from what does not compress to what is zero, in a file's place, and closed to the program itself."""


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Program]:
    script = tmp_path / "script"
    script.write_text(SCRIPT)
    script.chmod(0o755)
    with ended(start_tracee(script, tmp_path)) as tracee:
        yield tracee


def addresses_in(program: Program) -> dict[str, int]:
    numbers = map(int, program.output.splitlines()[0].split())
    return dict(zip(("chance", "alike", "zero", "mixed", "emptied", "hidden"), numbers, strict=True))


@pytest.mark.parametrize("threads", [1, 3])
def test_what_is_written_straight_is_what_the_program_has(program: Program, tmp_path: Path, threads: int) -> None:
    with protected(program) as session, open(tmp_path / "base", "wb", buffering=0) as file:
        base = at_last(lambda: session.capture_standing(CaptureOrder(generation=3, sequence=9, hold=True)))
        assert isinstance(base, UnreadBase)
        told, size = base.write(file, threads)
        whole = chain.fold([format.decode(tmp_path / "base")])  # which proves its position
        assert (told.position, size) == (whole.position, (tmp_path / "base").stat().st_size)
        assert (told.position.generation, told.position.sequence) == (3, 9)
        memory, position = Memory(program.pid), 0
        for run in whole.runs:
            here = memory.read_pages(np.array([[run.start, run.end]], np.uint64))
            assert memoryview(whole.contents)[position : position + run.size] == here[: run.size]
            position += run.size
    kernel = [vma for vma in whole.vmas if vma.kind is VmaKind.VDSO]
    for start, size in ((vma.start, vma.size) for vma in kernel):
        assert page_set.place_in(page_set.extents(whole.runs), start, size) is not None, "another kernel wants it"
    for address in addresses_in(program).values():
        assert page_set.place_in(page_set.extents(whole.runs), address, SIZE) is not None
    program.tell()
    expect_ok(program)


def test_frames_are_stored_as_they_are_where_they_do_not_compress(program: Program, tmp_path: Path) -> None:
    from checkpoint.snapshot import frames
    from checkpoint.snapshot.byte_sources import opened

    written_and_killed(program, tmp_path / "base")
    with opened(tmp_path / "base") as reader:
        preamble, _ = format.outlined(reader)
        codecs = [frame.head.codec for frame in frames.frames_of(reader, preamble)]
    assert codecs.count(Codec.RAW) >= 2 * (SIZE // FRAME_SIZE - 1)
    assert codecs.count(Codec.ZSTD) >= 2 * (SIZE // FRAME_SIZE - 1)


def test_what_comes_straight_from_a_file_is_what_was_there_and_zeros_take_no_memory(program: Program, tmp_path: Path) -> None:
    places = addresses_in(program)
    written_and_killed(program, tmp_path / "base")
    with ended(restored_from(tmp_path / "base", tmp_path)) as again:
        assert count_of_pages(again.pid, places["zero"]) == 0
        assert count_of_pages(again.pid, places["mixed"]) == SIZE // abi.PAGE_SIZE // 2
        assert count_of_pages(again.pid, places["emptied"]) == SIZE // abi.PAGE_SIZE
        again.tell()
        expect_ok(again)


def count_of_pages(pid: int, address: int) -> int:
    """How many of a place's pages are there."""
    with open(f"/proc/{pid}/pagemap", "rb") as file:
        file.seek(address // abi.PAGE_SIZE * 8)
        entries = np.frombuffer(file.read(SIZE // abi.PAGE_SIZE * 8), np.uint64)
    return int((entries >> np.uint64(62) != 0).sum())


@pytest.mark.parametrize("is_followed", [False, True])
def test_who_was_captured_so_runs_on_and_deltas_continue_what_was_acknowledged(
    program: Program, tmp_path: Path, is_followed: bool
) -> None:
    with protected(program) as session:
        chain_ = [captured_at_last(session, CaptureOrder())] if is_followed else []
        for snapshot in chain_:
            session.acknowledge(snapshot.position)
        base = at_last(lambda: session.capture_standing(CaptureOrder(sequence=2, hold=True)))
        assert isinstance(base, UnreadBase)
        with open(tmp_path / "base", "wb", buffering=0) as file:
            told, _ = base.write(file, 1)
        session.acknowledge(told.position)
        for sequence in (3, 4):
            chain_.append(captured_at_last(session, CaptureOrder(base=False, sequence=sequence)))
            session.acknowledge(chain_[-1].position)
        assert [snapshot.is_base for snapshot in chain_] == [True] + [False] * (len(chain_) - 1)
        assert chain.fold(chain_).position == chain_[-1].position
    program.tell()
    expect_ok(program)


def test_a_page_that_cannot_be_read_is_said_so_and_nothing_is_called_a_snapshot(program: Program, tmp_path: Path) -> None:
    def read(piece: page_set.Words, buffer: memoryview) -> None:
        raise CaptureError("cannot read memory")

    with protected(program) as session, open(tmp_path / "base", "wb", buffering=0) as file:
        base = at_last(lambda: session.capture_standing(CaptureOrder(hold=True)))
        assert isinstance(base, UnreadBase)
        with pytest.raises(CaptureError, match="cannot read memory"):
            replace(base, read=read).write(file, 2)
    with pytest.raises(FormatError):
        format.read_header(tmp_path / "base")


FAMILIES = {
    "a child": "os.fork() or time.sleep(600)",
    "a child that nobody waited for": "os.fork() or os._exit(3); time.sleep(0.3)",
}


@pytest.mark.parametrize("is_seen_late", [False, True])
@pytest.mark.parametrize("born", FAMILIES.values(), ids=FAMILIES)
def test_pages_of_several_processes_are_read_at_once(
    tmp_path: Path, born: str, is_seen_late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = tmp_path / "script"
    script.write_text(f"#!{sys.executable}\nimport os, time\n{born}\nprint('ready', flush=True)\ntime.sleep(600)\n")
    script.chmod(0o755)
    with ended(start_tracee(script, tmp_path)) as family:
        with protected(family) as session:
            if is_seen_late:  # as where it is born between the last look and the freeze
                admit, looks = CapturedTree.admit, iter((lambda *_, **__: None,))
                monkeypatch.setattr(CapturedTree, "admit", lambda *args, **named: next(looks, admit)(*args, **named))
            base = at_last(lambda: session.capture_standing(CaptureOrder(hold=True)))
        assert isinstance(base, Snapshot)
        assert base.is_tree
        for member in base.members:
            os.kill(member.process.pid, signal.SIGKILL)


@pytest.fixture
def base_file(program: Program, tmp_path: Path) -> Path:
    written_and_killed(program, tmp_path / "base")
    return tmp_path / "base"


def test_a_damaged_frame_leaves_no_program(base_file: Path, tmp_path: Path) -> None:
    content = bytearray(base_file.read_bytes())
    content[-100_000] ^= 1  # among the last frames: most pages are in the vessel by then
    base_file.write_bytes(content)
    _expect_no_program(base_file, FormatError, "does not match its digest")


def test_pages_that_are_not_those_of_the_position_leave_no_program(base_file: Path) -> None:
    whole = format.decode(base_file)
    contents = bytearray(whole.contents)
    contents[-1] ^= 1
    base_file.write_bytes(format.encode_bytes(replace(whole, contents=bytes(contents))))
    _expect_no_program(base_file, ChainError, "the pages do not add up")


def _expect_no_program(file: Path, error: type[Exception], match: str) -> None:
    born = spawn_vessel(Birth())
    with stored_base(file) as base, pytest.raises(error, match=match):
        ENGINE.restore(born.pid, base, RestoreOptions())
    assert not Path(f"/proc/{born.pid}").exists(), "it was ended, and reaped by its tracer"


def test_a_file_that_others_see_is_not_touched_by_a_restore_that_fails(tmp_path: Path) -> None:
    """What is written to a shared mapping is in its file at once: all frames are proved before."""
    script = tmp_path / "script"
    script.write_text(
        f"#!{sys.executable}\nimport mmap, os, random, time\n"
        f"with open('shown', 'w+b') as file:\n    file.write(b'A' * {FRAME_SIZE})\n    file.flush()\n"
        f"    shown = mmap.mmap(file.fileno(), {FRAME_SIZE})\nshown[:] = b'A' * {FRAME_SIZE}\n"
        f"chance = mmap.mmap(-1, {12 * FRAME_SIZE}, flags=mmap.MAP_PRIVATE)\nchance.write(os.urandom({12 * FRAME_SIZE}))\n"
        "print('ready', flush=True)\ntime.sleep(600)\n"
    )
    script.chmod(0o755)
    with ended(start_tracee(script, tmp_path)) as program:
        written_and_killed(program, tmp_path / "base")
    (tmp_path / "shown").write_bytes(b"Z" * FRAME_SIZE)
    content = bytearray((tmp_path / "base").read_bytes())
    content[-100_000] ^= 1
    (tmp_path / "base").write_bytes(content)
    born = spawn_vessel(Birth())
    try:
        with stored_base(tmp_path / "base") as base, pytest.raises(FormatError, match="does not match its digest"):
            ENGINE.restore(born.pid, base, RestoreOptions(accept_changed=(str(tmp_path / "shown"),)))
    finally:
        discard(born)
    assert (tmp_path / "shown").read_bytes() == b"Z" * FRAME_SIZE


def test_a_page_that_nobody_can_read_is_left_out_by_a_copy(program: Program, tmp_path: Path) -> None:
    """As guard pages are where the kernel installs them and does not tell (Linux 6.13)."""

    def read(piece: page_set.Words, buffer: memoryview) -> None:
        raise CaptureError("cannot read memory")

    class Unreadable:
        """A session one page of which cannot be read where it stands."""

        def __init__(self, session: Session) -> None:
            self.capture = session.capture
            self._standing = session.capture_standing

        def capture_standing(self, order: CaptureOrder) -> Snapshot | UnreadBase:
            base = self._standing(order)
            assert isinstance(base, UnreadBase)
            return replace(base, read=read)

    with protected(program) as session, open(tmp_path / "base", "wb") as file:
        order, request = CaptureOrder(hold=True), Capture(base=True, generation=1, sequence=1, hold=True)
        keeper = Keeper(None, ENGINE)  # type: ignore[arg-type]  # nobody is answered
        file.write(b"of a try before this one")
        file.flush()
        keeper._made(Unreadable(session), order, file.fileno(), request)  # type: ignore[arg-type]
    assert chain.fold([format.decode(tmp_path / "base")])
    program.tell()
    expect_ok(program)


def test_a_file_that_claims_more_than_anybody_holds_is_refused_at_once(base_file: Path, tmp_path: Path) -> None:
    outline, size = format.read_outline(base_file), 1 << 44
    run = PageRun(1 << 45, (1 << 45) + size)
    claims = replace(outline, runs=(run,), vmas=(Vma(run.start, run.end, 3, False, VmaKind.ANONYMOUS),))
    with pytest.raises(FormatError, match="the limit here is"):
        format.begin(claims, size)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(format, "check_contents_size", lambda _: None)
        preamble, sections = format.begin(claims, size)
    (tmp_path / "claims").write_bytes(preamble.pack() + sections)
    with pytest.raises(FormatError, match="the limit here is"), stored_base(tmp_path / "claims"):
        pass


def test_what_is_no_base_or_not_the_state_that_it_names_is_refused_at_once(base_file: Path, tmp_path: Path) -> None:
    whole = format.decode(base_file)
    delta = replace(whole, parent=replace(whole.position, sequence=0), runs=(), contents=b"")
    (tmp_path / "delta").write_bytes(format.encode_bytes(delta))
    with pytest.raises(ChainError, match="is not a base"), stored_base(tmp_path / "delta"):
        pass
    other = replace(whole, epoch=whole.epoch + 1)
    (tmp_path / "other").write_bytes(format.encode_bytes(other))
    with pytest.raises(ChainError, match="the state is not that of"), stored_base(tmp_path / "other"):
        pass


def test_single_bytes_of_a_stored_base_are_those_of_the_whole(base_file: Path) -> None:
    whole, dice = format.decode(base_file), random.Random(4)
    with stored_base(base_file) as base:
        position = 0
        for run in whole.runs:
            for _ in range(4):
                size = dice.randrange(1, min(run.size, 2 * FRAME_SIZE) + 1)
                offset = dice.randrange(run.size - size + 1)
                expected = bytes(memoryview(whole.contents)[position + offset : position + offset + size])
                assert base.content_at(run.start + offset, size) == expected
            position += run.size
        last = whole.runs[-1]
        assert base.content_at(last.end - 1, 2) is None
        assert base.content_at(last.end, 1) is None


def test_places_in_a_set_are_told_by_the_bytes_before_them() -> None:
    some = np.array([[0x1000, 0x3000], [0x5000, 0x6000]], np.uint64)
    cases = {(0x1000, 1): 0, (0x2FFF, 1): 0x1FFF, (0x5000, 0x1000): 0x2000, (0x2FFF, 2): None, (0x3000, 1): None}
    cases |= {(0xFFF, 1): None, (0x6000, 1): None, (0x4FFF, 1): None}
    assert {(address, size): page_set.place_in(some, address, size) for address, size in cases} == cases


@pytest.mark.parametrize("size", [4095, 4097])
def test_what_decompresses_to_another_size_is_refused(size: int) -> None:
    packed = compression.compressor().compress(bytes(4096))
    with pytest.raises(FormatError, match=f"here: compressed bytes declare 4096 bytes where {size} belong"):
        compression.decompress_into(memoryview(bytearray(size)), packed, "here")


@pytest.mark.parametrize("keep", [5, 20, -1])
def test_what_cannot_be_decompressed_is_refused(keep: int) -> None:
    packed = compression.compressor().compress(random.Random(1).randbytes(4096))
    with pytest.raises(FormatError, match="here: "):
        compression.decompress_into(memoryview(bytearray(4096)), packed[:keep], "here")


def test_rows_hold_so_many_pieces_and_the_last_one_the_rest() -> None:
    assert list(parallel.in_rows(range(7), 3)) == [(0, 1, 2), (3, 4, 5), (6,)]
    assert list(parallel.in_rows([], 3)) == []
