"""Feature levels of x86-64 for fleets with different processors, and the variables that limit libraries to a level.

Data only. The levels cannot limit a library that asks the processor itself (CPUID) and has no variable for it.

Source: System V ABI (AMD64 supplement), "micro-architecture levels"; glibc manual, "Hardware Capability Tunables", and
sysdeps/x86/cpu-tunables.c, whose names changed with 2.33 (a glibc ignores the names that it does not know); numpy's "CPU
dispatcher"; OpenBLAS, driver/others/dynamic.c; OPENSSL_ia32cap(3); Go's internal/cpu.
"""

from __future__ import annotations

from typing import Final

V1, V2, V3, V4 = "x86-64-v1", "x86-64-v2", "x86-64-v3", "x86-64-v4"
LEVELS: Final = (V1, V2, V3, V4)
DEFAULT: Final = V2
"""The features that every server processor since 2009 has."""

_ADDED: Final = {
    V1: frozenset(["cmov", "cx8", "mmx", "sse", "sse2"]),
    V2: frozenset(["cx16", "lahf_lm", "popcnt", "sse4_1", "sse4_2", "ssse3"]),
    V3: frozenset(["abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe", "xsave"]),
    V4: frozenset(["avx512bw", "avx512cd", "avx512dq", "avx512f", "avx512vl"]),
}
"""Flags of /proc/cpuinfo that a level has beyond the one before."""

_GLIBC_BEYOND: Final = {
    V1: "SSE3 SSSE3 SSE4_1 SSE4_2 POPCNT",
    V2: "AVX AVX_Usable AVX2 AVX2_Usable AVX_Fast_Unaligned_Load BMI1 BMI2 F16C FMA FMA_Usable LZCNT MOVBE",
    V3: "AVX512F AVX512F_Usable AVX512BW AVX512CD AVX512DQ AVX512DQ_Usable AVX512VL",
    V4: "AVX512ER AVX512PF FMA4 FMA4_Usable XOP RTM XSAVEC",
}
"""Names of glibc.cpu.hwcaps for what comes above a level, of old and new ones."""
_NUMPY_BEYOND: Final = {
    V1: "",
    V2: "AVX F16C FMA3 AVX2 X86_V3",
    V3: "AVX512F AVX512CD AVX512_SKX X86_V4",
    V4: "XOP FMA4 AVX512_KNL AVX512_KNM AVX512_CLX AVX512_CNL AVX512_ICL AVX512_SPR",
}
"""The same of NPY_DISABLE_CPU_FEATURES. A build of numpy cannot switch off the features that it needs at least, and says so."""
_OPENSSL_BEYOND: Final = {
    V1: ((0, 9, 19, 20, 23), ()),
    V2: ((12, 22, 28, 29), (3, 5, 8)),
    V3: ((), (16, 17, 28, 30, 31)),
    V4: ((1, 11, 25, 30), (18, 19, 21, 26, 27, 29, *range(32, 64))),
}
"""The same of OPENSSL_ia32cap: bits of CPUID.1:ECX, and of CPUID.7:EBX and ECX."""
_GO_BEYOND: Final = {V1: "", V2: "avx avx2 bmi1 bmi2 fma", V3: "", V4: "adx aes pclmulqdq"}
_OPENBLAS: Final = {V1: "Prescott", V2: "Nehalem", V3: "Haswell", V4: "SkylakeX"}
_MKL: Final = {V1: "SSE4_2", V2: "SSE4_2", V3: "AVX2", V4: "AVX512"}
_ONEDNN: Final = {V1: "SSE41", V2: "SSE41", V3: "AVX2", V4: "AVX512_CORE"}
_TORCH: Final = {V1: "default", V2: "default", V3: "avx2", V4: "avx512"}
ECX_SHIFT: Final = 32
"""The first word of OPENSSL_ia32cap is CPUID.1:EDX, and ECX above it."""


def flags_of(level: str) -> frozenset[str]:
    """Flags of /proc/cpuinfo that a program of a level may rely on."""
    return frozenset().union(*(_ADDED[one] for one in LEVELS[: LEVELS.index(level) + 1]))


def glibc_hwcaps(level: str) -> str:
    """The value of the tunable glibc.cpu.hwcaps."""
    return ",".join(f"-{name}" for name in _words(_GLIBC_BEYOND, level))


def variables(level: str) -> dict[str, str]:
    """Variables for libraries that choose by themselves. A variable that the user has set stays as it is."""
    return {
        "LD_BIND_NOW": "1",  # late binding saves registers by the size that it found at the start (dl-trampoline.h)
        "NPY_DISABLE_CPU_FEATURES": " ".join(_words(_NUMPY_BEYOND, level)),
        "OPENBLAS_CORETYPE": _OPENBLAS[level],
        "MKL_ENABLE_INSTRUCTIONS": _MKL[level],
        "ONEDNN_MAX_CPU_ISA": _ONEDNN[level],
        "ATEN_CPU_CAPABILITY": _TORCH[level],
        "OPENSSL_ia32cap": _openssl(level),
        "GODEBUG": ",".join(f"cpu.{name}=off" for name in _words(_GO_BEYOND, level)),
    }


def _beyond(level: str) -> tuple[str, ...]:
    return LEVELS[LEVELS.index(level) :]


def _words(table: dict[str, str], level: str) -> list[str]:
    return [word for one in _beyond(level) for word in table[one].split()]


def _openssl(level: str) -> str:
    first = sum(1 << bit + ECX_SHIFT for one in _beyond(level) for bit in _OPENSSL_BEYOND[one][0])
    second = sum(1 << bit for one in _beyond(level) for bit in _OPENSSL_BEYOND[one][1])
    return f"~{first:#x}:~{second:#x}"
