"""Processor descriptions as data; `cpu`, `stubs`, `extended` and `levels` are the modules of this machine's processor.

Each processor has files with the same names in the same order. docs/processors.md says how to add a processor. On a machine whose
processor has no files here, `cpu` and the others are the modules of x86-64. The package does not use them there:
`why_unsupported` and `number_of` prevent it.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Mapping
from types import ModuleType
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:  # the others have the same names
    from checkpoint.arch import x86_64 as cpu
    from checkpoint.arch import x86_64_levels as levels
    from checkpoint.arch import x86_64_stub as stubs
    from checkpoint.arch import x86_64_xstate as extended

__all__ = ["SUPPORTED", "cpu", "extended", "levels", "number_of", "stubs", "why_unsupported"]

KNOWN: Final = ("x86_64", "aarch64")
"""Processors with files here, as uname(2) calls them."""
UNPROVED: Final[tuple[str, ...]] = ()
"""Processors of `KNOWN` on which some parts are not proved yet."""
EMULATED: Final = ("aarch64",)
"""Processors of `KNOWN` that were proved under software emulation only, because no machine was at hand."""
TRY_UNPROVED: Final = "FAILOVER_TRY_UNPROVED_PROCESSOR"
"""Variable of the environment with which developers run a processor that is not proved yet; never for a program that matters."""
SUPPORTED: Final = tuple(name for name in KNOWN if name not in UNPROVED or os.environ.get(TRY_UNPROVED))

EVERY_LEVEL: Final = ("x86-64-v1", "x86-64-v2", "x86-64-v3", "x86-64-v4", "armv8-a")
"""The levels of all of them (`levels.LEVELS`): one file of configuration may serve a mixed team."""

_MACHINE: Final = os.uname().machine
_HERE: Final = _MACHINE if _MACHINE in KNOWN else KNOWN[0]

_PARTS: Final = {"cpu": "", "stubs": "_stub", "extended": "_xstate", "levels": "_levels"}
_NUMBERS: Final[Mapping[str, Mapping[str, int]]] = {
    "x86_64": {"get_robust_list": 274, "ioprio_get": 252, "ioprio_set": 251, "kcmp": 312, "userfaultfd": 323},
    "aarch64": {"get_robust_list": 100, "ioprio_get": 31, "ioprio_set": 30, "kcmp": 272, "userfaultfd": 282},
}


if not TYPE_CHECKING:

    def __getattr__(name: str) -> ModuleType:
        """This machine's files, read at their first use: a witness never uses them."""
        if name not in _PARTS:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = found = importlib.import_module(f"{__name__}.{_HERE}{_PARTS[name]}")
        return found


def number_of(call: str) -> int | None:
    """The number on this machine of one of the calls that we make for ourselves; None where that is not known."""
    return _NUMBERS.get(_MACHINE, {}).get(call)


def why_unsupported() -> str:
    """Why unmodified programs cannot be kept on this kind of processor; "": they can.

    `checkpoint.linux.spawn.cpuid` asks this machine's processor for the rest.
    """
    if _MACHINE in SUPPORTED:
        return ""
    return (
        f"the processor is {_MACHINE}, and only {', '.join(SUPPORTED)} is supported so far: use such a machine, or have the "
        "program keep its state itself, which works on any (docs/decorator.md)"
    )
