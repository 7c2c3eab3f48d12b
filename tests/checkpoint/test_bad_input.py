"""Snapshots that must not be restored: each refused with a clear sentence within a moment, and nothing is started."""

from __future__ import annotations

import os
import random
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint import arch
from checkpoint.arch import extended
from checkpoint.engine import ProtectOrder
from checkpoint.errors import ChainError, CheckpointError, FormatError, ProbeError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.spawn import cpuid
from checkpoint.model import Resource, Snapshot
from checkpoint.snapshot import format
from checkpoint.store import chain
from tests.checkpoint.round_trip import ENGINE, Program, captured_and_killed, ended, restored, start, start_tracee
from tests.conftest import children

pytestmark = [pytest.mark.compiler, pytest.mark.root]

HERE = os.uname().machine
OTHERS = [name for name in (*arch.KNOWN, "riscv64") if name != HERE]
MORE = {"x86_64": "avx512f", "aarch64": "bf16"}[HERE]
"""An instruction set of newer processors."""
FLIPS = int(os.environ.get("FAILOVER_TEST_FLIPS", "150"))
"""Bits of a real snapshot that are flipped, one at a time."""


@pytest.fixture
def snapshot(compiled: Callable[..., Path], tmp_path: Path) -> Snapshot:
    """A real one."""
    with ended(start_tracee(compiled("heap", "-O2"), tmp_path)) as tracee:
        return captured_and_killed(tracee)


def _expect_nothing_started(snapshot: Snapshot, directory: Path, sentence: str) -> None:
    before = children()
    with pytest.raises(CheckpointError, match=sentence):
        restored(snapshot, directory).kill()
    assert children() == before


@pytest.mark.parametrize("architecture", [*OTHERS, ""])
def test_a_foreign_architecture_is_said_so(snapshot: Snapshot, tmp_path: Path, architecture: str) -> None:
    foreign = replace(snapshot, machine=replace(snapshot.machine, architecture=architecture))
    _expect_nothing_started(foreign, tmp_path, f"taken on {architecture}, this machine is {HERE}.*keeps its state itself")


@pytest.mark.parametrize("machine", OTHERS)
def test_a_processor_that_is_not_supported_is_said_so_before_anything_is_touched(
    compiled: Callable[..., Path], snapshot: Snapshot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, machine: str
) -> None:
    with ended(start_tracee(compiled("heap", "-O2"), tmp_path)) as tracee:
        monkeypatch.setattr(arch, "SUPPORTED", (machine,))
        sentence = f"the processor is {HERE}, and only {machine} is supported so far.*docs/decorator.md"
        for act in (lambda: ENGINE.probe(tracee.pid), lambda: ENGINE.protect(tracee.pid, ProtectOrder("/test/tracee"))):
            with pytest.raises(ProbeError, match=sentence):
                act()
        _expect_nothing_started(snapshot, tmp_path, sentence)
        tracee.tell()
        assert tracee.finish() == 0


def test_registers_that_are_not_kept_are_said_so_before_anything_is_touched(
    compiled: Callable[..., Path], snapshot: Snapshot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ended(start_tracee(compiled("heap", "-O2"), tmp_path)) as tracee:
        monkeypatch.setattr(extended, "UNKEPT", {cpuid.features()[0]: "wide ones", "absent": "others"})
        sentence = "the processor has wide ones, whose registers are not kept so far.*docs/decorator.md"
        for act in (lambda: ENGINE.probe(tracee.pid), lambda: ENGINE.protect(tracee.pid, ProtectOrder("/test/tracee"))):
            with pytest.raises(ProbeError, match=sentence):
                act()
        _expect_nothing_started(snapshot, tmp_path, sentence)
        tracee.tell()
        assert tracee.finish() == 0


def test_a_processor_that_lacks_a_feature_is_said_so(snapshot: Snapshot, tmp_path: Path) -> None:
    if MORE in snapshot.machine.features:
        pytest.skip(f"this processor has {MORE}")
    richer = replace(snapshot, machine=replace(snapshot.machine, features=(*snapshot.machine.features, MORE)))
    _expect_nothing_started(richer, tmp_path, MORE)


def test_a_thread_whose_id_is_taken_is_said_so(snapshot: Snapshot, tmp_path: Path) -> None:
    """By then the vessel has a thread already, which must not be left."""
    (thread,) = snapshot.threads
    with ended(start_tracee_beside(tmp_path)) as other:
        threads = (thread, replace(thread, tid=free_id()), replace(thread, tid=other.pid))
        _expect_nothing_started(replace(snapshot, threads=threads), tmp_path, f"thread {other.pid}: that id is in use")


def start_tracee_beside(directory: Path) -> Program:
    """Somebody who has an id."""
    (directory / "beside").mkdir()
    return start(["/bin/sleep", "600"], directory / "beside")


def free_id() -> int:
    """An id that nobody has, and that nobody is given soon."""
    return next(number for number in range(procfs.pid_max() - 1, 1, -1) if not Path(f"/proc/{number}").exists())


def test_a_snapshot_without_its_first_thread_is_said_so(snapshot: Snapshot, tmp_path: Path) -> None:
    (thread,) = snapshot.threads
    for threads in ((), (replace(thread, tid=thread.tid + 1),)):
        _expect_nothing_started(replace(snapshot, threads=threads), tmp_path, "first thread")


@pytest.mark.parametrize("registers", [{}, {"prstatus": bytes(8), "xstate": bytes(576)}, {"prstatus": bytes(216)}])
def test_a_thread_without_registers_is_said_so(snapshot: Snapshot, tmp_path: Path, registers: dict[str, bytes]) -> None:
    (thread,) = snapshot.threads
    threads = (thread, replace(thread, tid=thread.tid + 1, registers=registers))
    _expect_nothing_started(replace(snapshot, threads=threads), tmp_path, f"registers of its thread {thread.tid + 1}")


def test_a_resource_of_an_unknown_kind_is_named(snapshot: Snapshot, tmp_path: Path) -> None:
    newer = replace(snapshot, resources=(*snapshot.resources, Resource("teleporters", "fd 9", {})))
    _expect_nothing_started(newer, tmp_path, "teleporters")


def test_pages_altered_and_written_anew_do_not_add_up(snapshot: Snapshot) -> None:
    """The file's own digests are right: the state's digest is not."""
    contents = bytearray(snapshot.contents)
    contents[len(contents) // 2] ^= 1
    altered = format.decode(format.encode_bytes(replace(snapshot, contents=bytes(contents))))
    with pytest.raises(ChainError):
        chain.fold([altered])


def test_registers_altered_and_written_anew_do_not_add_up(snapshot: Snapshot) -> None:
    (thread,) = snapshot.threads
    registers = {**thread.registers, "prstatus": bytes(len(thread.registers["prstatus"]))}
    altered = format.decode(format.encode_bytes(replace(snapshot, threads=(replace(thread, registers=registers),))))
    with pytest.raises(ChainError):
        chain.fold([altered])


def test_flipped_bits_anywhere_in_a_real_snapshot_are_refused(snapshot: Snapshot) -> None:
    whole, dice = format.encode_bytes(snapshot), random.Random(11)
    for place in (dice.randrange(len(whole) * 8) for _ in range(FLIPS)):
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << place % 8
        with pytest.raises(FormatError):
            format.decode(bytes(damaged))


def test_a_real_snapshot_that_ends_too_early_is_refused(snapshot: Snapshot) -> None:
    whole, dice = format.encode_bytes(snapshot), random.Random(12)
    for size in (0, 1, len(whole) - 1, *(dice.randrange(len(whole)) for _ in range(50))):
        with pytest.raises(FormatError):
            format.decode(whole[:size])


def test_a_directory_an_empty_file_and_a_missing_one_are_no_snapshots(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    for path in (tmp_path, tmp_path / "empty", tmp_path / "missing"):
        with pytest.raises((CheckpointError, OSError)):
            format.decode(path)
