"""Programs that are started for a level of processors: what their libraries choose, and where they may resume."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from checkpoint.arch import aarch64_levels, aarch64_stub, cpu
from checkpoint.arch.x86_64_levels import flags_of
from checkpoint.errors import CheckpointError
from checkpoint.linux.spawn import cpuid
from checkpoint.program import cpu_baseline
from tests.checkpoint.round_trip import ENGINE, captured_and_killed, ended, expect_ok, restored, start

Compiled = Callable[..., Path]

LOOKED_AT = 0x300
"""Bytes of a function in which it would show what it is made of."""
WIDE = re.compile(r"%[yz]mm")
LEVEL, BEYOND = {
    "x86_64": ("x86-64-v2", ("avx512f", "amx_tile", "xop")),
    "aarch64": ("armv8-a", ("asimddp", "bf16", "sha512")),
}[cpu.NAME]
"""A level, and instruction sets of processors that have more."""
CHOICES = """
import ctypes, glob, os
import numpy
features = numpy._core._multiarray_umath.__cpu_features__
print(*(name for name, has in features.items() if has and name in {dispatched}))
library = ctypes.CDLL(glob.glob(os.path.join(os.path.dirname(numpy.__file__), "..", "numpy.libs", "libscipy_openblas*"))[0])
core = library.scipy_openblas_get_corename64_
core.restype = ctypes.c_char_p
print(core().decode())
"""


of_x86 = pytest.mark.skipif(cpu.NAME != "x86_64", reason="levels of x86-64")


@of_x86
def test_what_is_set_already_stays() -> None:
    mine = {"OPENBLAS_CORETYPE": "Core2", "GLIBC_TUNABLES": "glibc.malloc.check=3:glibc.cpu.hwcaps=-ERMS", "HOME": "/root"}
    found = cpu_baseline.environment(mine, "x86-64-v3")
    assert found["OPENBLAS_CORETYPE"] == "Core2" and found["HOME"] == "/root"
    malloc, hwcaps = found["GLIBC_TUNABLES"].split(":")
    assert malloc == "glibc.malloc.check=3"
    assert hwcaps.startswith("glibc.cpu.hwcaps=-ERMS,-AVX512F,") and "-AVX2" not in hwcaps
    assert cpu_baseline.environment(found, "x86-64-v3")["GLIBC_TUNABLES"].count("glibc.cpu.hwcaps") == 1


def test_the_level_is_found_again() -> None:
    for level in cpu_baseline.LEVELS:
        block = b"\0".join(f"{name}={value}".encode() for name, value in cpu_baseline.environment({}, level).items())
        assert cpu_baseline.level_in(block) == level
    assert cpu_baseline.level_in(b"HOME=/root\0FAILOVER_PORTABLE=pentium\0") == ""
    assert cpu_baseline.level_in(b"XFAILOVER_PORTABLE=x86-64-v2\0") == ""


def test_of_a_processor_whose_c_library_takes_no_advice_what_is_set_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cpu_baseline, "arch", aarch64_levels)
    found = cpu_baseline.environment({"OPENBLAS_CORETYPE": "CORTEXA57"}, aarch64_levels.V8)
    assert found["OPENBLAS_CORETYPE"] == "CORTEXA57" and cpu_baseline.TUNABLES not in found
    mine = {cpu_baseline.TUNABLES: "glibc.malloc.check=3"}
    assert cpu_baseline.environment(mine, aarch64_levels.V8)[cpu_baseline.TUNABLES] == "glibc.malloc.check=3"


def test_each_level_has_what_the_one_below_has_and_more() -> None:
    for low, high in zip(cpu_baseline.LEVELS, cpu_baseline.LEVELS[1:], strict=False):
        assert flags_of(low) < flags_of(high)


@of_x86
def test_features_beyond_the_level_do_not_count() -> None:
    wide = ("avx", "avx2", "avx512f", "erms", "fpu", "sse4_2")
    assert cpu_baseline.features_used(wide, "") == wide
    assert cpu_baseline.lacking(cpu_baseline.features_used(wide, "x86-64-v3"), ("avx", "sse4_2")) == ("avx2",)
    assert cpu_baseline.lacking(cpu_baseline.features_used(wide, "x86-64-v2"), ("sse4_2",)) == ()


def test_what_every_library_chooses_by_itself_counts_at_every_level(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of aarch64: the atomic operations of its compilers."""
    monkeypatch.setattr(cpu_baseline, "arch", aarch64_levels)
    monkeypatch.setattr(cpu_baseline, "stubs", aarch64_stub)
    used = cpu_baseline.features_used(("asimd", "asimddp", "atomics", "fp", "sha512"), aarch64_levels.V8)
    assert used == ("asimd", "atomics", "fp")
    assert cpu_baseline.lacking(used, ("asimd", "fp")) == ("atomics",)


# --- With programs -----------------------------------------------------------------------------------------------------


def _wide_functions(output: str) -> list[str]:
    """Of the functions that ``chosen`` has listed those that use registers of AVX or AVX-512."""
    found = []
    for line in output.splitlines():
        if line == "ready":
            break
        name, library, offset = line.split()
        begin = int(offset, 16)
        window = [f"--start-address={begin:#x}", f"--stop-address={begin + LOOKED_AT:#x}"]
        code = subprocess.run(["objdump", "-d", *window, library], capture_output=True, text=True, check=True).stdout
        until_return = code.partition("\tret")[0] + code.partition("\tret")[2].partition("\tret")[0]
        if WIDE.search(until_return):
            found.append(name)
    return found


needs_wide = pytest.mark.skipif("avx2" not in cpuid.features(), reason="this processor has no AVX2 to do without")
needs_objdump = pytest.mark.skipif(shutil.which("objdump") is None, reason="needs objdump (binutils)")


@needs_wide
@needs_objdump
@pytest.mark.compiler
def test_the_c_library_chooses_no_code_beyond_the_level(compiled: Compiled, tmp_path: Path) -> None:
    chosen = {}
    for level in ("x86-64-v4", "x86-64-v2"):
        directory = tmp_path / level
        directory.mkdir()
        with ended(
            start([compiled("chosen", "-O2", "-ldl"), "go"], directory, env=cpu_baseline.environment({}, level))
        ) as program:
            program.wait_for_line("ready")
            chosen[level] = _wide_functions(program.output)
            program.tell()
            expect_ok(program)
    assert chosen["x86-64-v2"] == []
    assert len(chosen["x86-64-v4"]) >= 6


@needs_wide
def test_numpy_and_openblas_choose_no_code_beyond_the_level() -> None:
    pytest.importorskip("numpy", minversion="2.4")
    script = CHOICES.replace("{dispatched}", "('X86_V3', 'X86_V4', 'AVX512_ICL', 'AVX512_SPR')")

    def choices(environment: dict[str, str]) -> list[str]:
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment)
        assert not done.stderr
        return done.stdout.splitlines()

    plain = {name: value for name, value in os.environ.items() if name not in ("OPENBLAS_CORETYPE", "NPY_DISABLE_CPU_FEATURES")}
    assert "X86_V3" in choices(plain)[0]
    assert choices(cpu_baseline.environment(plain, "x86-64-v2")) == ["", "Nehalem"]


@pytest.mark.compiler
@pytest.mark.root
def test_a_portable_program_goes_on_where_a_processor_has_less(compiled: Compiled, tmp_path: Path) -> None:
    """Its snapshot asks for nothing beyond its level, so the widest processor's is good enough here; another program's is not."""
    wide = tuple(sorted({*cpuid.features(), *BEYOND}))
    for level, is_refused in ((LEVEL, False), ("", True)):
        directory = tmp_path / (level or "plain")
        directory.mkdir()
        environment = cpu_baseline.environment({}, level) if level else {}
        with ended(start([compiled("heap", "-O2"), "go"], directory, env=environment)) as program:
            program.wait_for_line("ready")
            kept = next(finding.text for finding in ENGINE.probe(program.pid).findings if finding.name == "processor")
            assert (level or "not started with failover run --portable") in kept
            snapshot = captured_and_killed(program)
        used = cpu_baseline.features_used(wide, level)
        assert snapshot.machine.features == cpu_baseline.features_used(cpuid.features(), level)
        there = replace(snapshot, machine=replace(snapshot.machine, features=used))
        lacking = next((name for name in used if name not in cpuid.features()), "")
        if is_refused and lacking:
            with pytest.raises(CheckpointError, match=rf"lacks .*{lacking}.* --portable"):
                restored(there, directory).kill()
            continue
        with ended(restored(there, directory)) as program:
            program.tell()
            expect_ok(program)
