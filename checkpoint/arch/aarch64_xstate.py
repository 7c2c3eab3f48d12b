"""Extended register state of an aarch64 thread: several register sets one after the other, and their transfer to another machine.

The vector registers (NT_PRFPREG) come first, then the thread pointer, then the keys that sign return addresses: a program's
pointers are valid only with its own keys. The scalable vectors come last, because their length is the one that the thread uses. A
system call drops every part of them beyond the vector registers, so after a system call the vector registers follow once more.
The layout lists the sets that exist by their numbers in linux/elf.h.

Source: linux/elf.h; arch/arm64/kernel/ptrace.c; Documentation/arch/arm64/pointer-authentication.rst, sve.rst.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable, Collection, Iterator
from typing import Final

from checkpoint.arch.components import Component, Layout, decode_layout, encode_layout

__all__ = ["Component", "Layout", "decode_layout", "encode_layout"]

VECTORS: Final = 2
THREAD_POINTER: Final = 0x401
ADDRESS_KEYS: Final = 0x407
GENERIC_KEY: Final = 0x408
SCALABLE: Final = 0x405
COMPONENTS: Final = {
    VECTORS: "vector registers",
    THREAD_POINTER: "the thread pointer",
    ADDRESS_KEYS: "keys of pointer authentication (paca)",
    GENERIC_KEY: "the generic key of pointer authentication (pacg)",
    SCALABLE: "scalable vectors (SVE)",
}
"""By number: what a message calls it."""
_SIZES: Final = {VECTORS: 528, THREAD_POINTER: 8, ADDRESS_KEYS: 64, GENERIC_KEY: 16, SCALABLE: 0}
"""In bytes; those of scalable vectors are told by `_scalable_size`. Newer kernels tell a second word with the thread pointer, of
a processor with SME."""
_NEEDED: Final = {VECTORS: "fp", THREAD_POINTER: "fp", ADDRESS_KEYS: "paca", GENERIC_KEY: "pacg", SCALABLE: "sve"}
"""Features without which there is no such set; every processor that runs our kernels has the first.

The kernel tells a set only if it is asked for by number, so we ask for all of them, one by one."""
LOST_IN_CALLS: Final[int | None] = SCALABLE
"""The register set of which every system call may take a part. Source: sve.rst, "System call behaviour"."""
UNKEPT: Final = {"sme": "scalable matrices (SME: arm64.nosme)"}
"""Features of which a thread has registers that are not kept, and that a call of ours would clear: what a message calls each,
with the parameter that has the kernel leave it alone. Source: Documentation/arch/arm64/sme.rst; kernel-parameters.txt."""
PERMISSIONS: Final[tuple[tuple[str, str, tuple[int, ...]], ...]] = ()
"""Features that a process must ask for before it may use them: feature, call, arguments. None."""


_HEAD: Final = struct.Struct("<IIHHHH")
"""struct user_sve_header: size, greatest size, bytes of a vector, the most of these, flags, nothing."""
_WHOLE: Final = 1
"""A flag of it: all of the scalable vectors follow, not the vector registers alone."""


def sets(features: Callable[[], Collection[str]], vector_size: Callable[[], int]) -> tuple[tuple[int, int], ...]:
    """The register sets that make up the state, in order: number, and the bytes to offer for it. The last one may come short.

    Args:
        features: of this machine's processor.
        vector_size: bytes of its longest scalable vectors; asked where it has any.
    """
    here = features()
    found = [(number, size) for number, size in _SIZES.items() if _NEEDED[number] in here]
    return tuple((number, size or _scalable_size(vector_size())) for number, size in found)


def _registers_size(vector_size: int) -> int:
    """Bytes of 32 vectors (Z) and 17 of an eighth (P, FFR), which lie in this order in the set and in a signal's frame."""
    return 34 * vector_size + vector_size // 8


def _scalable_size(vector_size: int) -> int:
    """Bytes of the set: its head, the registers, two words of status. Source: asm/ptrace.h, SVE_PT_SIZE."""
    status = -(-_registers_size(vector_size) // 16) * 16
    return _HEAD.size + status + 16


def scalable_registers(content: bytes) -> tuple[int, bytes]:
    """Read a set that holds them all: bytes of a vector, and the registers."""
    vector_size = _HEAD.unpack_from(content)[2]
    return vector_size, content[_HEAD.size : _HEAD.size + _registers_size(vector_size)]


def is_lost_in_calls(content: bytes) -> bool:
    """Whether a system call would take a part of what `LOST_IN_CALLS` holds."""
    return bool(_HEAD.unpack_from(content)[4] & _WHOLE)


def parts(state: bytes, layout: Layout) -> Iterator[tuple[int, bytes]]:
    """The register sets to write: number and content.

    Args:
        layout: this machine's.
    """
    return ((one.number, content) for one in layout if (content := _content(state, one)))


def in_use(state: bytes) -> int:
    """Bits of what a thread uses beyond what all have: none is told."""
    return 0


def lacking(state: bytes, theirs: Layout, ours: Layout) -> Iterator[str]:
    """Names of the sets that cannot be had here."""
    known = {one.number: one.size for one in ours}
    for one in theirs:
        content, here = _content(state, one), known.get(one.number, 0)
        if one.number == SCALABLE:
            yield from _lacking_vectors(content, here)
        elif here != one.size and any(content):
            yield COMPONENTS.get(one.number, f"register set {one.number:#x}")


def _lacking_vectors(content: bytes, here: int) -> Iterator[str]:
    """Why a thread's scalable vectors cannot be restored here; a thread that has not used any can do without.

    Args:
        here: bytes of the set on this machine; 0: there is none.
    """
    if len(content) < _HEAD.size:
        return
    _, _, vector_size, _, flags, _ = _HEAD.unpack_from(content)
    if _scalable_size(vector_size) > here and (here or flags & _WHOLE):
        yield f"{COMPONENTS[SCALABLE]} of {8 * vector_size} bits"


def fitted(state: bytes, theirs: Layout, ours: Layout, example: bytes) -> bytes:
    """The same state as this machine lays it out, without the parts that are `lacking` here.

    Args:
        example: the state of any thread here: of that is what the other machine did not have. Scalable vectors are not: what a
            thread has of them without using any are its vector registers.
    """
    there = {one.number: one for one in theirs}
    wanted = [one for one in ours if one.number in there or one.number != SCALABLE]
    return b"".join(_content(state, there[one.number]) if one.number in there else _content(example, one) for one in wanted)


def key_rights(state: bytes, layout: Layout) -> int | None:
    """Rights by protection keys: None, they are not told."""
    return None


def _content(state: bytes, one: Component) -> bytes:
    """The content of one set; less than its size where it came short."""
    return state[one.offset : one.offset + one.size]


# --- What this processor has: asked by `checkpoint.linux.spawn.cpuid` ------------------------------------------------


def layout_here(features: Callable[[], Collection[str]], vector_size: Callable[[], int], run: Callable[[bytes], int]) -> Layout:
    """The sets of this machine, as `sets` has them read.

    Args:
        vector_size: as there.
        run: unused: /proc/cpuinfo tells enough.
    """
    found = sets(features, vector_size)
    offsets = itertools.accumulate((size for _, size in found), initial=0)
    return tuple(Component(number, offset, size) for (number, size), offset in zip(found, offsets, strict=False))
