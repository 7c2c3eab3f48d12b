"""Tables of system calls inside a vessel: all made at one stop, and an unexpected result named."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator

import pytest

from checkpoint.arch import aarch64, cpu, stubs
from checkpoint.engines.ptrace.restore.memory import kernel_pages
from checkpoint.engines.ptrace.restore.process import OPTIONS
from checkpoint.errors import RestoreError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.spawn import vessel
from checkpoint.linux.spawn.vessel import Birth
from checkpoint.linux.trace import call_table
from checkpoint.linux.trace.call_table import AREA_SIZE, CallTable, Stub
from checkpoint.linux.trace.tracee import Tracee

MIB = 1 << 20


@contextlib.contextmanager
def stub_in_a_vessel() -> Iterator[Stub]:
    born = vessel.spawn_vessel(Birth())
    try:
        tracee = Tracee(born.pid)
        tracee.seize(OPTIONS)
        tracee.freeze()
        mappings = procfs.parse_maps(procfs.read_text(born.pid, "maps"))
        stub = Stub(tracee, call_table.find_hole([(line.start, line.end) for line in mappings], AREA_SIZE))
        vdso = kernel_pages(mappings)[-1]
        stub.install(vdso.start + cpu.call_in(tracee.memory.read(vdso.start, vdso.size)), MIB)
        yield stub
    finally:
        vessel.discard(born)


def test_a_thousand_calls_are_made_at_one_stop() -> None:
    with stub_in_a_vessel() as stub:
        table = CallTable(stub.base)
        for _ in range(500):
            table.close(table.open("/dev/null", os.O_RDONLY))
        kept = table.open("/dev/zero", os.O_RDONLY)
        assert stub.run(table) == ()
        assert os.readlink(f"/proc/{stub.tracee.pid}/fd/{kept}") == "/dev/zero"


def test_a_call_with_an_unexpected_result_stops_the_table_and_is_named() -> None:
    with stub_in_a_vessel() as stub:
        table = CallTable(stub.base)
        table.open("/nowhere/to/be/found", os.O_RDONLY)
        table.open("/dev/null", os.O_RDONLY)
        with pytest.raises(RestoreError, match=r"cannot open /nowhere/to/be/found: No such file"):
            stub.run(table)
        assert sorted(os.listdir(f"/proc/{stub.tracee.pid}/fd")) == ["0", "1", "2"]


def test_an_attempt_that_fails_is_a_note_and_the_table_goes_on() -> None:
    with stub_in_a_vessel() as stub:
        table = CallTable(stub.base)
        table.attempt("the file is not there", "openat", -100, table.place_path("/nowhere"), os.O_RDONLY)
        table.open("/dev/null", os.O_RDONLY)
        (note,) = stub.run(table)
        assert note.startswith("the file is not there: No such file")


def test_single_calls_work_while_every_signal_is_blocked_and_ignored() -> None:
    with stub_in_a_vessel() as stub:
        tracee, registers = stub.tracee, stub.tracee.registers()
        tracee.set_signal_mask(abi.ALL_SIGNALS)
        mappings = procfs.parse_maps(procfs.read_text(tracee.pid, "maps"))
        vdso = kernel_pages(mappings)[-1]
        place = vdso.start + cpu.call_in(tracee.memory.read(vdso.start, vdso.size))
        umask = {"x86_64": 95, "aarch64": 166}[cpu.NAME]
        call_table.single_call(tracee, registers, place, umask, 0o77)
        assert call_table.single_call(tracee, registers, place, umask, 0o22) == 0o77
        assert int(procfs.parse_fields(procfs.read_text(tracee.pid, "status"))["SigCgt"], 16) >> (signal.SIGTRAP - 1) & 1 == 0


@pytest.mark.parametrize("has_stood_before", [True, False])
def test_a_single_call_is_made_by_who_was_executing_when_it_was_stopped(has_stood_before: bool) -> None:
    """As a vessel that was slow: its parent knows by a descriptor that closes in the middle of execve(2)."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        os.read(read_end, 1)
        os.execv("/bin/sleep", ["sleep", "1000"])
    try:
        tracee = Tracee(child)
        tracee.seize(OPTIONS)
        os.write(write_end, b"x")
        if has_stood_before:
            os.waitid(os.P_PID, child, os.WSTOPPED | os.WNOWAIT)
            tracee.freeze()
        else:
            tracee.await_stop()
        vdso = kernel_pages(procfs.parse_maps(procfs.read_text(child, "maps")))[-1]
        place = vdso.start + cpu.call_in(tracee.memory.read(vdso.start, vdso.size))
        assert call_table.single_call(tracee, tracee.registers(), place, stubs.SYSTEM_CALLS["getpid"]) == child
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(read_end)
        os.close(write_end)


def test_a_vessel_dies_in_the_middle_when_its_tracer_does() -> None:
    read_end, write_end = os.pipe()
    born = vessel.spawn_vessel(Birth())
    tracer = os.fork()
    if tracer == 0:
        tracee = Tracee(born.pid)
        tracee.seize(OPTIONS)
        tracee.freeze()
        os.write(write_end, b"x")
        signal.pause()
        os._exit(0)
    os.read(read_end, 1)
    os.close(read_end)
    os.close(write_end)
    os.kill(tracer, signal.SIGKILL)
    os.waitpid(tracer, 0)
    _, status = os.waitpid(born.pid, 0)
    assert os.WTERMSIG(status) == signal.SIGKILL


def test_a_hole_is_far_from_everything() -> None:
    taken = [(0x10000000000 - 0x1000, 0x10000000000), (0x7FF000000000, 0x7FF000001000)]
    start = call_table.find_hole(taken, AREA_SIZE)
    assert all(end + MIB <= start or start + AREA_SIZE + MIB <= begin for begin, end in taken)


def test_a_hole_lies_within_the_address_space_of_a_small_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a Raspberry Pi: 39 bits; a program that is not position-independent, one that is, libraries and the stack."""
    monkeypatch.setattr(call_table, "cpu", aarch64)
    program, position_independent = (0x40_0000, 0x4000_0000), (0x55_5555_5000, 0x55_9555_5000)
    taken = [program, position_independent, (0x7F_B000_0000, 0x7F_B800_0000), (0x7F_FFFD_E000, 0x7F_FFFF_F000)]
    start = call_table.find_hole(taken, AREA_SIZE)
    assert start % 0x10000 == 0
    assert program[1] + (1 << 30) <= start and start + AREA_SIZE + (1 << 30) <= position_independent[0]
    with pytest.raises(RestoreError, match="no 64 MiB of address space"):
        call_table.find_hole([(0, 1 << 39)], AREA_SIZE)


def test_no_hole_is_an_error_in_words() -> None:
    with pytest.raises(RestoreError, match="no 64 MiB of address space"):
        call_table.find_hole([(0, 1 << 47)], AREA_SIZE)
