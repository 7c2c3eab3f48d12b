"""A program whose snapshot comes from a kernel with another vdso: it reads the clocks through this kernel's."""

from __future__ import annotations

import os
import random
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.arch import cpu, stubs
from checkpoint.engines.ptrace.restore.memory import content_at
from checkpoint.errors import CheckpointError
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.spawn import vdso
from checkpoint.linux.spawn.vdso import Function
from checkpoint.model import Snapshot, Vma, VmaKind
from tests.checkpoint.engines.ptrace.capture.test_trees import captured_and_ended
from tests.checkpoint.round_trip import (
    CaptureOrder,
    Program,
    captured,
    captured_and_killed,
    captured_at_last,
    ended,
    expect_ok,
    protected,
    restored,
    start,
    start_tracee,
)
from tests.conftest import children

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]

FOREIGN = os.environ.get("FAILOVER_TEST_VDSO")
"""A file with the image of another kernel: its vdso64.so, or cut out of it."""
BREAKPOINT = {"x86_64": b"\xcc", "aarch64": b"\x00\x00\x20\xd4"}[cpu.NAME]
"""An instruction that ends whoever comes to it."""
READ_CLOCK = next(name for name in stubs.VDSO_CALLS if name.endswith("_clock_gettime"))
"""What the C library's clock_gettime(2) calls."""
ATTEMPTS = 400
"""Captures after which a program that reads clocks all the time has been met while it does."""


FAMILY = """
import os, time
from pathlib import Path
child = os.fork()
print("child" if child == 0 else "parent", flush=True)
while not Path("go").exists():
    assert time.monotonic() <= time.monotonic()
    time.sleep(0.01)
if child:
    assert os.waitpid(child, 0)[1] == 0
    print("ok", flush=True)
"""


def image_of(snapshot: Snapshot) -> Vma:
    """The mapping of the kernel's own image."""
    return next(vma for vma in snapshot.vmas if vma.kind is VmaKind.VDSO)


def functions_of(snapshot: Snapshot) -> tuple[Function, ...]:
    """Its functions."""
    image = image_of(snapshot)
    return vdso.functions(content_at(snapshot, image.start, image.size) or b"")


def of_another_kernel(snapshot: Snapshot) -> Snapshot:
    """The same, as if its kernel had another vdso than ours."""
    return replace(snapshot, machine=replace(snapshot.machine, vdso_digest=bytes(32), kernel="2.6.18"))


def written_over(snapshot: Snapshot, address: int, content: bytes) -> Snapshot:
    """The same with other memory."""
    whole, position = bytearray(snapshot.contents), 0
    for run in snapshot.runs:
        if run.start <= address < run.end:
            place = position + address - run.start
            whole[place : place + len(content)] = content
        position += run.size
    return replace(snapshot, contents=bytes(whole))


def with_deadly_functions(snapshot: Snapshot) -> Snapshot:
    """The same with an old vdso of which every instruction ends the program: nobody may come to it any more."""
    for function in functions_of(snapshot):
        if function.name in stubs.VDSO_CALLS:
            place = image_of(snapshot).start + function.offset
            snapshot = written_over(snapshot, place, BREAKPOINT * (function.size // len(BREAKPOINT)))
    return snapshot


def laid_out_otherwise(snapshot: Snapshot) -> Snapshot:
    """The same with a page less of the kernel's data: no vdso of ours fits into its place."""
    first = next(vma for vma in snapshot.vmas if vma.kind is VmaKind.VVAR)
    shorter = replace(first, start=first.start + snapshot.machine.page_size)
    return replace(snapshot, vmas=tuple(shorter if vma is first else vma for vma in snapshot.vmas))


def outside_the_image(program: Program) -> Snapshot:
    """A snapshot of a program whose only thread is not just reading a clock."""
    return captured_where(program, inside=False)


def captured_where(program: Program, *, inside: bool) -> Snapshot:
    """A snapshot of a program that just reads a clock, or does not."""
    with protected(program) as session:
        for _ in range(ATTEMPTS):
            snapshot = captured_at_last(session, CaptureOrder())
            image = image_of(snapshot)
            place = cpu.decode_registers(snapshot.threads[0].registers["prstatus"])[cpu.INSTRUCTION_POINTER]
            if (image.start <= place < image.end) is inside:
                return snapshot
    raise AssertionError(f"not met {'inside' if inside else 'outside'} the vdso in {ATTEMPTS} captures")


@pytest.mark.parametrize("change", [of_another_kernel, laid_out_otherwise])
def test_a_program_of_another_kernel_reads_the_clocks_of_this_one(
    change: Callable[[Snapshot], Snapshot], compiled: Compiled, tmp_path: Path
) -> None:
    with ended(start_tracee(compiled("clock_reader", "-O2"), tmp_path)) as tracee:
        snapshot = outside_the_image(tracee)
        assert {function.name for function in functions_of(snapshot)} >= {READ_CLOCK}
    with ended(restored(with_deadly_functions(change(snapshot)), tmp_path)) as tracee:
        tracee.tell()
        expect_ok(tracee)


def test_a_program_that_goes_to_and_fro_carries_one_old_image(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("clock_reader", "-O2"), tmp_path)) as tracee:
        snapshot = with_deadly_functions(of_another_kernel(outside_the_image(tracee)))
    counts = []
    for change in (of_another_kernel, lambda same: same, laid_out_otherwise, of_another_kernel):
        with ended(restored(snapshot, tmp_path)) as tracee:
            counts.append(len(procfs.parse_maps(procfs.read_text(tracee.pid, "maps"))))
            snapshot = change(captured_and_killed(tracee))
    assert len(set(counts)) == 1
    with ended(restored(snapshot, tmp_path)) as tracee:
        tracee.tell()
        expect_ok(tracee)


def test_a_thread_that_was_just_reading_a_clock_reads_it_to_the_end(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("clock_reader", "-O2"), tmp_path, "1000")) as tracee:
        snapshot = captured_where(tracee, inside=True)
    with ended(restored(of_another_kernel(snapshot), tmp_path)) as tracee:
        tracee.tell()
        expect_ok(tracee)


def test_a_thread_that_would_take_zeros_for_the_time_is_said_so(compiled: Compiled, tmp_path: Path) -> None:
    """It stands before the first instruction of time(2), which reads the kernel's data without looking whether they are good."""
    if "__vdso_time" not in stubs.VDSO_CALLS:
        pytest.skip("every function of this processor's image looks")
    with ended(start_tracee(compiled("clock_reader", "-O2"), tmp_path)) as tracee:
        snapshot = captured(tracee)
    (offset,) = (function.offset for function in functions_of(snapshot) if function.name == "__vdso_time")
    (thread,) = snapshot.threads
    registers = cpu.decode_registers(thread.registers["prstatus"])
    registers |= {cpu.INSTRUCTION_POINTER: image_of(snapshot).start + offset, cpu.ARGUMENTS[0]: 0, cpu.CALL_NUMBER: cpu.NO_CALL}
    inside = replace(thread, registers={**thread.registers, "prstatus": cpu.encode_registers(registers)}, interrupted="")
    before = children()
    with pytest.raises(CheckpointError, match="reading a clock"):
        restored(of_another_kernel(replace(snapshot, threads=(inside,))), tmp_path).kill()
    assert children() == before


def test_a_snapshot_without_the_old_image_is_said_so(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("heap", "-O2"), tmp_path)) as tracee:
        snapshot = captured_and_killed(tracee)
    blank = written_over(snapshot, image_of(snapshot).start, bytes(4096))
    before = children()
    with pytest.raises(CheckpointError, match=r"vdso.*2\.6\.18.*does not hold the old one"):
        restored(of_another_kernel(blank), tmp_path).kill()
    assert children() == before


# --- With the image of a real other kernel ---------------------------------------------------------------------------


@pytest.fixture(params=["ours", "foreign"])
def image(request: pytest.FixtureRequest) -> bytes:
    """The image of a vdso: our own, and the one that FAILOVER_TEST_VDSO names, of any other kernel for this processor."""
    if request.param == "ours":
        (line,) = (line for line in procfs.parse_maps(procfs.read_text(os.getpid(), "maps")) if line.name == "[vdso]")
        return Memory(os.getpid()).read(line.start, line.size)
    if FOREIGN is None:
        pytest.skip("FAILOVER_TEST_VDSO names no image of another kernel")
    return Path(FOREIGN).read_bytes()


def with_image(snapshot: Snapshot, image: bytes) -> Snapshot:
    """The same, born with another kernel's vdso."""
    place = image_of(snapshot)
    assert len(image) == place.size, "of the same size as ours, which every kernel's of these years is"
    return written_over(of_another_kernel(snapshot), place.start, image)


def test_functions_that_are_looked_up_late_in_an_old_image_are_this_kernels(
    image: bytes, compiled: Compiled, tmp_path: Path
) -> None:
    with ended(start_tracee(compiled("vdso_user", "-O2"), tmp_path)) as tracee:
        snapshot = with_image(outside_the_image(tracee), image)
    with ended(restored(with_deadly_functions(snapshot), tmp_path)) as tracee:
        tracee.tell()
        expect_ok(tracee)


def test_a_thread_comes_out_of_an_old_image_by_a_system_call(image: bytes, compiled: Compiled, tmp_path: Path) -> None:
    """It stands before the first instruction of clock_gettime, which reads the time of a kernel that is not there."""
    with ended(start_tracee(compiled("vdso_user", "-O2"), tmp_path)) as tracee:
        landed, reading = (int(word, 16) for word in tracee.output.split()[:2])
        snapshot = with_image(outside_the_image(tracee), image)
    (offset,) = (function.offset for function in functions_of(snapshot) if function.name == READ_CLOCK)
    (thread,) = snapshot.threads
    registers = cpu.decode_registers(thread.registers["prstatus"])
    stack = registers[cpu.STACK_POINTER] - 1024 & ~15
    registers |= {cpu.INSTRUCTION_POINTER: image_of(snapshot).start + offset, cpu.STACK_POINTER: stack}
    registers |= {cpu.ARGUMENTS[0]: time.CLOCK_MONOTONIC, cpu.ARGUMENTS[1]: reading, cpu.CALL_NUMBER: cpu.NO_CALL}
    if "x30" in registers:
        registers["x30"] = landed
    state = {**thread.registers, "prstatus": cpu.encode_registers(registers)}
    snapshot = written_over(snapshot, stack, landed.to_bytes(8, "little"))
    snapshot = replace(snapshot, threads=(replace(thread, registers=state, interrupted=""),))
    with ended(restored(snapshot, tmp_path)) as tracee:
        expect_ok(tracee)


@pytest.mark.parametrize("seed", range(20))
def test_a_torn_image_has_no_functions_and_raises_nothing(seed: int) -> None:
    dice = random.Random(seed)
    (line,) = (line for line in procfs.parse_maps(procfs.read_text(os.getpid(), "maps")) if line.name == "[vdso]")
    whole = bytearray(Memory(os.getpid()).read(line.start, line.size))
    for _ in range(50):
        torn = bytearray(whole)
        for _ in range(8):
            torn[dice.randrange(1024)] = dice.randrange(256)
        for function in vdso.functions(bytes(torn)):
            assert 0 <= function.offset <= function.offset + function.size <= len(torn)


def test_several_processes_of_another_kernel_go_on_by_this_ones_vdso(tmp_path: Path) -> None:
    program = start([sys.executable, "-c", FAMILY], tmp_path, isolate=True)
    with ended(program):
        program.wait_until(lambda: len(program.output.splitlines()) == 2, "both")
        snapshot = captured_and_ended(program)
    assert snapshot.is_tree
    with ended(restored(of_another_kernel(snapshot), tmp_path)) as back:
        back.tell()
        expect_ok(back)
