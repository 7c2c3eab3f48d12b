"""Start programs that may move between different processors so that libraries use only code for a common processor level.

`environment` tells the C library and other libraries. The agreed level stays in the program's environment, where a capture finds
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from checkpoint.arch import levels as arch
from checkpoint.arch import stubs

VARIABLE: Final = "FAILOVER_PORTABLE"
"""Holds the level, for later looks at the program."""
TUNABLES: Final = "GLIBC_TUNABLES"
HWCAPS: Final = "glibc.cpu.hwcaps"
LEVELS: Final = arch.LEVELS
"""The levels of this machine's processor, the lowest first."""
DEFAULT: Final = arch.DEFAULT


def environment(given: Mapping[str, str], level: str) -> dict[str, str]:
    """Variables of a program that is to move between processors of a level and above.

    Variables that are set already stay. The C library's tunables are many in one variable: ours are added to them.
    """
    tunables = [one for one in given.get(TUNABLES, "").split(":") if one]
    others = [one for one in tunables if not one.startswith(f"{HWCAPS}=")]
    chosen = [one.partition("=")[2] for one in tunables if one.startswith(f"{HWCAPS}=")]
    hwcaps = ",".join(filter(None, (*chosen, arch.glibc_hwcaps(level))))
    tuned = (*others, *([f"{HWCAPS}={hwcaps}"] if hwcaps else []))
    ours = {**({TUNABLES: ":".join(tuned)} if tuned else {}), VARIABLE: level}
    return {**arch.variables(level), **given, **ours}


def level_in(environ: bytes) -> str:
    """The level that a program was started for, by its /proc/PID/environ; "" where none was agreed."""
    marks = (one.partition(b"=")[2] for one in environ.split(b"\0") if one.startswith(VARIABLE.encode() + b"="))
    level = next(marks, b"").decode(errors="replace")
    return level if level in LEVELS else ""


def features_used(features: tuple[str, ...], level: str) -> tuple[str, ...]:
    """The features of a processor by which a program may have chosen its code."""
    if not level:
        return features
    beyond = stubs.INSTRUCTION_SETS - arch.flags_of(level)
    return tuple(feature for feature in features if feature not in beyond)


def lacking(needed: tuple[str, ...], here: tuple[str, ...]) -> tuple[str, ...]:
    """Instruction sets that a program may use and a processor has not, in alphabetical order."""
    return tuple(sorted(set(needed) & stubs.INSTRUCTION_SETS - set(here)))
