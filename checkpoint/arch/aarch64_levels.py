"""Feature levels of aarch64 for fleets with different processors, and the variables that limit libraries to a level.

Data only. The levels cannot limit a library that asks the processor itself (getauxval) and has no variable for it. The C
library and the compiler's run-time choose features in this way for the life of the program (`_CHOSEN_BY_ALL`); a level cannot
exclude them.

Source: Arm Architecture Reference Manual; numpy's "CPU dispatcher"; OpenBLAS, driver/others/dynamic_arm64.c; OPENSSL_armcap;
libgcc, config/aarch64/lse-init.c; glibc, sysdeps/aarch64/multiarch/memcpy.c.
"""

from __future__ import annotations

from typing import Final

V8: Final = "armv8-a"
LEVELS: Final = (V8,)
DEFAULT: Final = V8
"""The features that every 64-bit ARM processor has."""

_CHOSEN_BY_ALL: Final = frozenset(["atomics", "mops"])
"""By the atomic operations of all code that gcc has compiled, and by memcpy(3)."""
_FLAGS: Final = {V8: frozenset(["asimd", "fp"]) | _CHOSEN_BY_ALL}
"""Names in /proc/cpuinfo."""
_NUMPY_BEYOND: Final = {V8: "ASIMDHP ASIMDDP ASIMDFHM SVE"}
_OPENBLAS: Final = {V8: "ARMV8"}


def flags_of(level: str) -> frozenset[str]:
    """Names in /proc/cpuinfo that a program of a level may rely on where it was started."""
    return _FLAGS[level]


def glibc_hwcaps(level: str) -> str:
    """The value of the tunable glibc.cpu.hwcaps: there is none for this processor."""
    return ""


def variables(level: str) -> dict[str, str]:
    """Variables for libraries that choose by themselves. A variable that the user has set stays as it is."""
    return {
        "LD_BIND_NOW": "1",
        "NPY_DISABLE_CPU_FEATURES": _NUMPY_BEYOND[level],
        "OPENBLAS_CORETYPE": _OPENBLAS[level],
        "OPENSSL_armcap": "0",
    }
