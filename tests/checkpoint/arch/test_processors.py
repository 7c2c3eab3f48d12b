"""The modules of each processor: all have the same names that others use, in the same order, and correct machine code.

A program that runs on another processor is tested on a machine of that kind.
"""

from __future__ import annotations

import ast
import functools
import importlib
import shutil
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from checkpoint import arch
from checkpoint.arch import aarch64, aarch64_xstate, x86_64
from checkpoint.arch.calls import Call, EntryCalls, TablePlaces
from checkpoint.arch.components import Component, Layout
from checkpoint.linux.trace import syscall_batch
from checkpoint.linux.trace.syscall_batch import Plan

SOURCES = Path(__file__).parents[3] / "checkpoint"
PARTS = {"cpu": "", "stubs": "_stub", "extended": "_xstate", "levels": "_levels"}
EINTR = -4 & (1 << 64) - 1
OBJDUMP = "aarch64-linux-gnu-objdump"


@functools.cache
def names_used() -> dict[str, set[str]]:
    """What the sources outside of ``checkpoint/arch`` use of each part."""
    used: dict[str, set[str]] = {part: set() for part in PARTS}
    for path in SOURCES.rglob("*.py"):
        text = path.read_text()
        if "from checkpoint.arch import" not in text:
            continue
        nodes = list(ast.walk(ast.parse(text)))
        imported = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module == "checkpoint.arch"]
        part_of = {alias.asname or alias.name: alias.name for node in imported for alias in node.names if alias.name in PARTS}
        for node in nodes:
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in part_of:
                used[part_of[node.value.id]].add(node.attr)
    return used


def names_in_order(name: str) -> list[str]:
    """What a file defines, or takes over from another, by its place in the file."""
    found: list[str] = []
    for node in ast.parse((SOURCES / "arch" / f"{name}.py").read_text()).body:
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found.append(node.target.id)
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.append(node.name)
        elif isinstance(node, ast.ImportFrom):
            found += [alias.name for alias in node.names]
    return found


@pytest.mark.parametrize("processor", arch.KNOWN)
@pytest.mark.parametrize("part", PARTS)
def test_what_others_use_of_a_processor_is_in_each_ones_file_in_the_same_order(part: str, processor: str) -> None:
    used = names_used()[part]
    assert used, "somebody uses each part"
    ours, first = (names_in_order(f"{name}{PARTS[part]}") for name in (processor, arch.KNOWN[0]))
    assert used <= set(ours)
    assert [name for name in ours if name in used] == [name for name in first if name in used]
    importlib.import_module(f"checkpoint.arch.{processor}{PARTS[part]}")


def test_the_levels_of_all_processors_are_known_on_every_machine() -> None:
    each = [importlib.import_module(f"checkpoint.arch.{name}{PARTS['levels']}").LEVELS for name in arch.KNOWN]
    assert [level for levels in each for level in levels] == list(arch.EVERY_LEVEL)


def test_registers_are_the_same_after_they_were_read_and_written() -> None:
    content = struct.pack("<34Q", *(number << 32 | number for number in range(34)))
    decoded = aarch64.decode_registers(content)
    assert aarch64.encode_registers(decoded) == content
    assert aarch64.stand_of(content) == (decoded["pc"], decoded["x0"], -1)
    assert aarch64.words_of(content)[aarch64.REGISTER_NAMES.index("sp")] == decoded["sp"]


def test_a_call_that_a_stop_has_ended_is_made_again_with_the_argument_that_its_result_has_covered() -> None:
    waiting = dict.fromkeys(aarch64.REGISTER_NAMES, 0) | {
        "x0": EINTR,
        "x8": 22,
        "pc": 0x1004,
        "call": aarch64.NO_CALL,
    }
    found = aarch64.recalled(waiting, 22, 99 << 32 | 5)
    assert (aarch64.call_number(found), aarch64.mark_of(found), found[aarch64.ENDED_ARGUMENTS[0]]) == (22, 99, 5)
    again = aarch64.made_again(found, 7)
    assert aarch64.encode_registers(again) == aarch64.encode_registers({**waiting, "x0": 7 << 32 | 5, "pc": 0x1000})
    pointer = aarch64.recalled(waiting, aarch64.SYSCALLS["rt_sigtimedwait"], 0xFFFF_1234_5678)
    assert not aarch64.has_room_for_mark(pointer)
    assert aarch64.made_again(pointer, 0)["x0"] == 0xFFFF_1234_5678


@pytest.mark.parametrize(
    ("call", "arguments", "may"),
    [
        ("nanosleep", {}, True),
        ("clock_nanosleep", {"x1": 0}, True),
        ("clock_nanosleep", {"x1": 1}, False),  # TIMER_ABSTIME
        ("futex", {"x1": 128, "x3": 0x1000}, True),  # FUTEX_WAIT | FUTEX_PRIVATE_FLAG
        ("futex", {"x1": 128, "x3": 0}, False),
        ("futex", {"x1": 9, "x3": 0x1000}, False),  # FUTEX_WAIT_BITSET
        ("read", {}, False),
    ],
)
def test_only_a_wait_with_a_relative_time_is_asked_for_what_the_kernel_remembers(
    call: str, arguments: dict[str, int], may: bool
) -> None:
    registers = dict.fromkeys(aarch64.REGISTER_NAMES, 0) | {"x8": aarch64.SYSCALLS[call], **arguments}
    assert aarch64.may_go_on(registers) == may


def test_the_kernel_of_x86_64_makes_a_call_again_that_is_marked_in_its_number() -> None:
    waiting = dict.fromkeys(x86_64.REGISTER_NAMES, 0) | {"rax": EINTR, "orig_rax": 232, "rip": 0x1002}
    assert x86_64.made_again(x86_64.recalled(waiting, 232, 5), 7) == {
        **waiting,
        "rax": x86_64.ERESTARTNOHAND,
        "orig_rax": 7 << 32 | 232,
    }


def test_a_system_call_is_found_where_an_instruction_begins() -> None:
    across = b"\x00" + aarch64.SYSCALL + b"\x00" * 3
    assert aarch64.call_in(across) == -1
    assert aarch64.call_in(across + aarch64.SYSCALL) == len(across)
    assert aarch64.call_in(aarch64.SYSCALL) == 0
    assert x86_64.call_in(b"\x90\x0f\x05") == 1


def test_the_end_of_a_programs_addresses_follows_from_its_highest_mapping() -> None:
    assert aarch64.user_end(0xFFFF_EFF2_4000) == 1 << 48
    assert aarch64.user_end(0x7F_FFFF_F000) == 1 << 39
    assert aarch64.user_end(1 << 39) == 1 << 39


def test_the_state_goes_to_a_processor_that_has_more_and_not_to_one_that_has_less() -> None:
    plain = tuple(Component(number, place, size) for number, place, size in ((2, 0, 528), (0x401, 528, 8)))
    signing = (*plain, Component(0x407, 536, 64), Component(0x408, 600, 16))
    state, example = bytes(range(1, 133)) * 4 + b"\x01" * 8, bytes(range(77)) * 8
    assert list(aarch64_xstate.lacking(state, plain, signing)) == []
    grown = aarch64_xstate.fitted(state, plain, signing, example)
    assert grown == state + example[536:616]
    assert len(list(aarch64_xstate.lacking(grown, signing, plain))) == 2
    assert b"".join(part for _, part in aarch64_xstate.parts(grown, signing)) == grown


PLAIN = (Component(aarch64_xstate.VECTORS, 0, 528), Component(aarch64_xstate.THREAD_POINTER, 528, 8))
PLAIN_STATE = bytes(range(1, 133)) * 4 + b"\x01" * 8


def with_vectors_of(size: int) -> Layout:
    """What a processor tells whose longest scalable vectors have so many bytes."""
    return aarch64_xstate.layout_here(lambda: ("fp", "sve"), lambda: size, lambda _: 0)


def scalable(vector_size: int, *, whole: bool) -> bytes:
    """NT_ARM_SVE of a thread."""
    registers = bytes(34 * vector_size + vector_size // 8) if whole else PLAIN_STATE[:528]
    return struct.pack("<IIHHHH", 16 + len(registers), 8768, vector_size, 256, whole, 0) + registers


@pytest.mark.parametrize(
    ("vector_size", "whole", "here", "lacks"),
    [
        (32, True, 64, False),
        (64, True, 64, False),
        (64, True, 32, True),
        (64, False, 32, True),  # it may have asked for them, and reckons with them between two calls
        (16, True, 0, True),
        (16, False, 0, False),
    ],
)
def test_scalable_vectors_go_to_where_as_long_ones_can_be_had(vector_size: int, whole: bool, here: int, lacks: bool) -> None:
    theirs, ours = with_vectors_of(vector_size), with_vectors_of(here) if here else PLAIN
    state = PLAIN_STATE + scalable(vector_size, whole=whole)
    found = list(aarch64_xstate.lacking(state, theirs, ours))
    assert found == [f"scalable vectors (SVE) of {8 * vector_size} bits"] * lacks
    if not lacks:
        fitted = aarch64_xstate.fitted(state, theirs, ours, PLAIN_STATE + scalable(here, whole=False) * bool(here))
        assert fitted == (state if here else PLAIN_STATE)
        assert b"".join(part for _, part in aarch64_xstate.parts(fitted, ours)) == fitted


def test_who_comes_from_a_processor_without_scalable_vectors_keeps_its_vector_registers() -> None:
    ours = with_vectors_of(64)
    fitted = aarch64_xstate.fitted(PLAIN_STATE, PLAIN, ours, bytes(536) + scalable(64, whole=False))
    assert list(aarch64_xstate.parts(fitted, ours)) == [(2, PLAIN_STATE[:528]), (0x401, PLAIN_STATE[528:])]


@pytest.mark.parametrize("vector_size", [16, 64, 256])
def test_a_frame_has_room_for_scalable_vectors_and_leads_to_them(vector_size: int) -> None:
    lost = scalable(vector_size, whole=True)
    place, content = aarch64.frame_of_lost(0x20400, lost)
    offered = dict(aarch64_xstate.sets(lambda: ("fp", "sve"), lambda: vector_size))[aarch64_xstate.SCALABLE]
    assert place + len(content) <= 0x20400 + aarch64.frame_size(offered)
    magic, size, begin, further = struct.unpack_from("<IIQI", content)
    assert (magic, size, begin) == (0x45585401, 32, place + 48) and begin % 16 == further % 16 == 0
    assert content[32:48] == content[-16:] == bytes(16), "terminators"
    magic, size, told = struct.unpack_from("<IIH", content, begin - place)
    assert (magic, told) == (0x53564501, vector_size)
    assert size % 16 == 0 and further == size + 16 == len(content) - 48
    assert aarch64.frame_of_lost(0x20400, b"") == (place, bytes(16))


PLACES = TablePlaces(
    state=0x20020, ended=2, done=0x20028, serial=0x20030, mask=0x20038, timeout=0x20040, empty_set=0x20050, resume=0x20058,
    registers=0x20060, results=0x200C0, frame=0x20400,
)  # fmt: skip
LONGEST = Call("ppoll", tuple((1 << 64) - 0x1234_5678_9ABC_DEF0 - number for number in range(5)))


def disassembled(code: bytes, tmp_path: Path) -> list[str]:
    """The instructions, by binutils of that processor."""
    if shutil.which(OBJDUMP) is None:
        pytest.skip(f"needs {OBJDUMP}, which is not installed here: apt-get install binutils-aarch64-linux-gnu")
    file = tmp_path / "code"
    file.write_bytes(code)
    told = subprocess.run([OBJDUMP, "-D", "-b", "binary", "-m", "aarch64", file], capture_output=True, text=True, check=True)
    lines = [line.split("\t") for line in told.stdout.splitlines()]
    return [" ".join(part.strip() for part in line[2:]).split(" //")[0] for line in lines if len(line) > 2]


def test_a_batch_of_the_longest_calls_fits_at_its_desk() -> None:
    frame = aarch64.frame_size(0)
    for size, limit in ((aarch64.LARGE_DESK_SIZE, syscall_batch.CALL_LIMIT), (aarch64.SMALL_DESK_SIZE + frame, 4)):
        code = aarch64.batch_code(0x10000, [LONGEST] * limit, PLACES)
        assert len(code) + len(syscall_batch.MAGIC) <= size
        plan = Plan(size, limit)
        assert plan.outputs < size - frame


def test_constants_are_set_by_as_few_instructions_as_it_takes(tmp_path: Path) -> None:
    calls = [Call("close", (value,)) for value in (0, -1, -100, 0x12345, 0xFFFF_0000_1234_0000, 1 << 63)]
    lines = disassembled(aarch64.batch_code(0x10000, calls, PLACES), tmp_path)
    before = [lines[index - 1] for index, line in enumerate(lines) if line == "svc #0x0"]
    assert before[:6] == ["mov x8, #0x39"] * 6
    first = [line for line in lines if line.startswith(("mov x0, #", "movk x0"))]
    assert first[:3] == ["mov x0, #0x0", "mov x0, #0xffffffffffffffff", "mov x0, #0xffffffffffffff9c"]
    assert first[3:5] == ["mov x0, #0x2345", "movk x0, #0x1, lsl #16"]


def test_a_batch_gives_everything_back_by_a_frame_of_its_own(tmp_path: Path) -> None:
    lines = disassembled(aarch64.batch_code(0x10000, [LONGEST], PLACES), tmp_path)
    assert lines[-2:] == ["mov x8, #0x8b", "svc #0x0"]
    stored = [line.split(",")[0] for line in lines if line.startswith(("str x", "str q"))]
    assert {f"str q{number}" for number in range(32)} <= set(stored)
    assert {f"str x{number}" for number in range(31) if f"x{number}" not in aarch64.CLOBBERED} <= set(stored)


def test_an_entry_stores_nothing_and_goes_on_by_constants(tmp_path: Path) -> None:
    calls = EntryCalls(LONGEST, LONGEST, LONGEST, LONGEST)
    registers = dict.fromkeys(aarch64.REGISTER_NAMES, 0) | {"pc": 0x1234, "sp": 0x5678, "x30": 0x9ABC}
    code = aarch64.entry_code(0x10000, calls, registers, 0x55, 10**8, bytes(range(256)) * 2 + bytes(16))
    lines = disassembled(code[aarch64.ENTRY_CODE_OFFSET :], tmp_path)
    assert not [line for line in lines if line.startswith(("str", "stp"))]
    assert struct.pack("<QQQ", 0x9ABC, 0x5678, 0x1234) in code
    assert aarch64.ENTRY_CODE_OFFSET % 16 == 0


def test_the_machine_code_is_what_stands_beside_it(tmp_path: Path) -> None:
    told = (SOURCES / "arch" / "aarch64_stub.py").read_text().splitlines()
    rows = [line.strip().split('"  # ') for line in told if line.startswith('    "') and '"  # ' in line]
    seen = disassembled(bytes.fromhex("".join(code.strip('"') for code, _ in rows)), tmp_path)
    assert [comment.split(": ")[-1].split()[0] for _, comment in rows] == [line.split()[0] for line in seen]


@pytest.mark.parametrize("processor", arch.KNOWN)
def test_numbers_of_our_own_calls_are_those_of_the_processor(processor: str) -> None:
    cpu, stubs = (importlib.import_module(f"checkpoint.arch.{processor}{PARTS[part]}") for part in ("cpu", "stubs"))
    for name, number in arch._NUMBERS[processor].items():
        assert number == stubs.SYSTEM_CALLS.get(name, cpu.SYSCALLS.get(name)), name


def test_every_processor_knows_the_same_calls_to_make() -> None:
    """Whoever fills a table names a call, whatever the processor; but for those that only one has."""
    of_one = {"arch_prctl"}
    names = [set(importlib.import_module(f"checkpoint.arch.{name}_stub").SYSTEM_CALLS) - of_one for name in arch.KNOWN]
    assert all(found == names[0] for found in names)


def test_a_number_that_is_not_known_is_never_made_up(monkeypatch: pytest.MonkeyPatch) -> None:
    assert arch.number_of("kcmp") is not None
    assert arch.number_of("no such call") is None
    monkeypatch.setattr(arch, "_MACHINE", "riscv64")
    assert arch.number_of("kcmp") is None


def test_who_needs_no_registers_loads_no_processors_file() -> None:
    told = "import sys, agent.worker.witness; print([name for name in sys.modules if name.startswith('checkpoint.arch.')])"
    seen = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True, cwd=SOURCES.parent)
    assert seen.stdout == "[]\n"
