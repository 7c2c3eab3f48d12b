"""The state of a thread beyond its general registers: several register sets, one after the other, and how it gets elsewhere.

Vector registers (NT_PRFPREG) come first, the thread pointer next, then what signs return addresses: a program's pointers are
valid with its own keys only. The layout says which sets there are, by their numbers in linux/elf.h.

Source: linux/elf.h; arch/arm64/kernel/ptrace.c; Documentation/arch/arm64/pointer-authentication.rst.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Collection, Iterator
from typing import Final

from checkpoint.arch.components import Component, Layout, decode_layout, encode_layout

__all__ = ["Component", "Layout", "decode_layout", "encode_layout"]

VECTORS: Final = 2
THREAD_POINTER: Final = 0x401
ADDRESS_KEYS: Final = 0x407
GENERIC_KEY: Final = 0x408
COMPONENTS: Final = {
    VECTORS: "vector registers",
    THREAD_POINTER: "the thread pointer",
    ADDRESS_KEYS: "keys of pointer authentication (paca)",
    GENERIC_KEY: "the generic key of pointer authentication (pacg)",
}
"""By number: what a message calls it."""
_SIZES: Final = {VECTORS: 528, THREAD_POINTER: 8, ADDRESS_KEYS: 64, GENERIC_KEY: 16}
"""In bytes. Newer kernels tell a second word with the thread pointer, of a processor with SME."""
_NEEDED: Final = {VECTORS: "fp", THREAD_POINTER: "fp", ADDRESS_KEYS: "paca", GENERIC_KEY: "pacg"}
"""Features without which there is no such set; every processor that runs our kernels has the first."""
"""The kernel tells a set only to who asks for it by number, so all of them are asked for, one by one."""
UNKEPT: Final = {"sve": "scalable vectors (SVE: arm64.nosve)", "sme": "scalable matrices (SME: arm64.nosme)"}
"""Features of which a thread has registers that are not kept, and that a call of ours would clear: what a message calls each,
with the parameter that has the kernel leave it alone. Source: Documentation/arch/arm64/sve.rst; kernel-parameters.txt."""
PERMISSIONS: Final[tuple[tuple[str, str, tuple[int, ...]], ...]] = ()
"""What a process asks for before it may use some of it: feature, call, arguments. Nothing."""


def sets(features: Callable[[], Collection[str]]) -> tuple[tuple[int, int], ...]:
    """The register sets that make up the state, in order: number, and the bytes to offer for it.

    Args:
        features: of this machine's processor.
    """
    here = features()
    return tuple((number, size) for number, size in _SIZES.items() if _NEEDED[number] in here)


def parts(state: bytes, layout: Layout) -> Iterator[tuple[int, bytes]]:
    """The register sets to write: number and content.

    Args:
        layout: this machine's.
    """
    return ((one.number, _content(state, one)) for one in layout)


def in_use(state: bytes) -> int:
    """Bits of what a thread uses beyond what all have: none is told."""
    return 0


def lacking(state: bytes, theirs: Layout, ours: Layout) -> Iterator[str]:
    """Names of the sets that cannot be had here."""
    known = {one.number: one.size for one in ours}
    for one in theirs:
        if known.get(one.number) != one.size and any(_content(state, one)):
            yield COMPONENTS.get(one.number, f"register set {one.number:#x}")


def fitted(state: bytes, theirs: Layout, ours: Layout, example: bytes) -> bytes:
    """The same state as this machine lays it out. What is `lacking` here is left out.

    Args:
        example: the state of any thread here: of that is what the other machine did not have.
    """
    there = {one.number: one for one in theirs}
    return b"".join(_content(state, there[one.number]) if one.number in there else _content(example, one) for one in ours)


def key_rights(state: bytes, layout: Layout) -> int | None:
    """Rights by protection keys: None, they are not told."""
    return None


def _content(state: bytes, one: Component) -> bytes:
    return state[one.offset : one.offset + one.size]


# --- What this processor has: asked by ``checkpoint.linux.processor`` ---------------------------------------------------


def layout_here(features: Callable[[], Collection[str]], run: Callable[[bytes], int]) -> Layout:
    """The sets of this machine, as `sets` has them read.

    Args:
        run: unused: /proc/cpuinfo tells enough.
    """
    found = sets(features)
    offsets = itertools.accumulate((size for _, size in found), initial=0)
    return tuple(Component(number, offset, size) for (number, size), offset in zip(found, offsets, strict=False))
