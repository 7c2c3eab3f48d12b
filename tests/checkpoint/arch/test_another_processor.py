"""A program whose snapshot comes from a processor with another register layout, or with more registers."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.arch import x86_64_xstate as xstate
from checkpoint.arch.x86_64_xstate import Component, Layout
from checkpoint.errors import CheckpointError
from checkpoint.linux.spawn import cpuid
from checkpoint.model import Snapshot
from tests.checkpoint.round_trip import captured_and_killed, ended, expect_ok, restored, start_tracee
from tests.conftest import children

Compiled = Callable[..., Path]

INTEL: Layout = (
    Component(2, 576, 256),
    Component(5, 1088, 64),
    Component(6, 1152, 512),
    Component(7, 1664, 1024),
    Component(9, 2688, 8),
)
"""A server processor of Intel's with AVX-512 and protection keys."""
AMD: Layout = (Component(2, 576, 256), Component(9, 2432, 8))
OLD: Layout = (Component(2, 576, 256),)
AVX_512 = (5, 6, 7)


def size_of(layout: Layout) -> int:
    """Bytes of a state that is laid out so."""
    return max(one.offset + one.size for one in layout)


def state_with(layout: Layout, contents: dict[int, bytes]) -> bytes:
    """A thread's state in which these components are in use."""
    made = bytearray(size_of(layout))
    made[:160] = bytes(range(160))
    for one in layout:
        content = contents.get(one.number, b"")
        made[one.offset : one.offset + len(content)] = content
    made[512:520] = (3 | sum(1 << number for number in contents)).to_bytes(8, "little")
    return bytes(made)


def test_components_move_to_where_this_processor_has_them() -> None:
    there = state_with(INTEL, {2: b"\x07" * 256, 9: b"\x0c" + bytes(7)})
    here = xstate.fitted(there, INTEL, AMD, bytes(size_of(AMD)))
    assert here == state_with(AMD, {2: b"\x07" * 256, 9: b"\x0c" + bytes(7)})
    assert not list(xstate.lacking(there, INTEL, AMD))
    assert xstate.fitted(here, AMD, INTEL, bytes(size_of(INTEL))) == there


def test_components_at_rest_need_not_be_had() -> None:
    default = xstate.PKRU_OF_LINUX.to_bytes(8, "little")
    there = state_with(INTEL, {2: b"\x07" * 256, 9: default, **dict.fromkeys(AVX_512, b"")})
    assert not list(xstate.lacking(there, INTEL, OLD))
    assert xstate.fitted(there, INTEL, OLD, bytes(size_of(OLD))) == state_with(OLD, {2: b"\x07" * 256})


def test_components_in_use_are_named() -> None:
    there = state_with(INTEL, {5: b"\x01", 6: b"\x01", 9: b"\x0c"})
    assert list(xstate.lacking(there, INTEL, OLD)) == [xstate.COMPONENTS[number] for number in (5, 6, 9)]
    assert list(xstate.lacking(there, INTEL, INTEL)) == []
    unknown = bytearray(there)
    unknown[512 + 2] |= 1 << 3
    assert list(xstate.lacking(bytes(unknown), INTEL, INTEL)) == ["APX registers"]


def test_amx_tiles_in_use_are_named_wherever_they_come_back() -> None:
    layout = (*INTEL, Component(17, 2752, 64), Component(18, 2816, 8192))
    assert list(xstate.lacking(state_with(layout, {17: b"\x01", 18: b"\x01"}), layout, layout)) == ["AMX settings", "AMX tiles"]
    assert not list(xstate.lacking(state_with(layout, {17: b"", 18: b""}), layout, layout))


def test_a_thread_from_a_processor_without_keys_begins_with_what_linux_gives() -> None:
    here = xstate.fitted(state_with(OLD, {2: b"\x07"}), OLD, AMD, bytes(size_of(AMD)))
    assert here == state_with(AMD, {2: b"\x07", 9: xstate.PKRU_OF_LINUX.to_bytes(8, "little")})


def test_a_layout_survives_its_way_through_bytes() -> None:
    assert xstate.decode_layout(xstate.encode_layout(INTEL)) == INTEL
    assert xstate.decode_layout(b"torn") == ()


of_x86 = pytest.mark.skipif(os.uname().machine != "x86_64", reason="registers of x86-64")


@of_x86
def test_this_processor_tells_its_layout() -> None:
    layout = cpuid.xstate_layout()
    assert layout[0] == Component(2, 576, 256)  # AVX, the same everywhere


# --- With a program ----------------------------------------------------------------------------------------------------


def of_a_wide_processor(snapshot: Snapshot, more: dict[int, bytes]) -> Snapshot:
    """The same, captured on a processor of Intel's with AVX-512 that has these components in use."""
    (thread,) = snapshot.threads
    ours = xstate.decode_layout(thread.registers["xstate_layout"])
    wide = bytearray(xstate.fitted(thread.registers["xstate"], ours, INTEL, bytes(size_of(INTEL))))
    for one in INTEL:
        if one.number in more:
            wide[one.offset : one.offset + one.size] = more[one.number].ljust(one.size, b"\0")
            wide[512] |= 1 << one.number
    registers = {**thread.registers, "xstate": bytes(wide), "xstate_layout": xstate.encode_layout(INTEL)}
    return replace(snapshot, threads=(replace(thread, registers=registers),))


@pytest.fixture
def snapshot(compiled: Compiled, tmp_path: Path) -> Snapshot:
    """Of a program that holds numbers in its AVX registers."""
    with ended(start_tracee(compiled("avx", "-O2"), tmp_path)) as tracee:
        return captured_and_killed(tracee)


@of_x86
@pytest.mark.compiler
@pytest.mark.root
def test_a_program_comes_to_a_narrower_processor_with_its_registers(snapshot: Snapshot, tmp_path: Path) -> None:
    wide = of_a_wide_processor(snapshot, dict.fromkeys(AVX_512, b""))
    with ended(restored(wide, tmp_path)) as tracee:
        os.kill(tracee.pid, signal.SIGUSR1)
        expect_ok(tracee)


@of_x86
@pytest.mark.compiler
@pytest.mark.root
def test_a_program_that_is_using_what_this_processor_lacks_is_said_so(snapshot: Snapshot, tmp_path: Path) -> None:
    if any(one.number in AVX_512 for one in cpuid.xstate_layout()):
        pytest.skip("this processor has AVX-512")
    before = children()
    with pytest.raises(CheckpointError, match=r"is using AVX-512 masks, .*ZMM31\), which this machine lacks"):
        restored(of_a_wide_processor(snapshot, {5: b"\x01", 7: b"\x02"}), tmp_path).kill()
    assert children() == before
