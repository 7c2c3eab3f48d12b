"""Extended register state of a thread (XSAVE), and its conversion for a processor with another layout or fewer components.

The kernel reports the state in the standard form: a legacy region, a header that lists the components in use, and each component
at its offset. The offsets depend on the processor: PKRU is at 2,688 with Intel and at 2,432 with AMD. The conversion can omit a
component that is not in use or holds its initial value.

Source: Intel SDM volume 1, chapter 13; volume 2, CPUID leaf 0DH; AMD APM volume 3, CPUID Fn0000_000D; pkeys(7).
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Collection, Iterator
from typing import Final

from checkpoint.arch.components import Component, Layout, decode_layout, encode_layout

__all__ = ["Component", "Layout", "decode_layout", "encode_layout"]

XSTATE: Final = 0x202
"""NT_X86_XSTATE of linux/elf.h: the register set, in XSAVE's own standard form."""
XSTATE_SIZE: Final = 16384
"""Bytes offered for it: AMX's 11,008 fit."""
COMPONENTS: Final = {
    0: "x87",
    1: "SSE",
    2: "AVX",
    3: "MPX bounds",
    4: "MPX settings",
    5: "AVX-512 masks",
    6: "AVX-512 upper halves (ZMM)",
    7: "AVX-512 upper registers (ZMM16 to ZMM31)",
    9: "protection keys (PKRU)",
    11: "shadow stack",
    17: "AMX settings",
    18: "AMX tiles",
    19: "APX registers",
}
"""By number: what a message calls it."""
LEGACY_SIZE: Final = 512
LEGACY_USED: Final = 464
"""Bytes of the legacy region that are registers; the kernel uses the rest for itself (arch/x86/include/uapi/asm/sigcontext.h)."""
FIRST_EXTENDED: Final = 2
"""Components 0 and 1 lie in the legacy region."""
PKRU: Final = 9
PKRU_OF_LINUX: Final = 0x55555554
"""The value with which every thread begins: only key 0 is allowed. Source: arch/x86/mm/pkeys.c, init_pkru_value."""
HIGHEST: Final = 62
AMX: Final = (17, 18)
"""Only for a process that has asked for it, and 8 KiB a thread: kept while its tiles are released, as between computations."""
LOST_IN_CALLS: Final[int | None] = None
"""The register set of which every system call may take a part: none."""
UNKEPT: Final[dict[str, str]] = {}
"""Features of which a thread has registers that are not kept: none. All that XSAVE knows is kept."""
PERMISSIONS: Final = (("amx_tile", "arch_prctl", (0x1023, 18)),)
"""Features that a process must ask for first: feature, call, arguments (ARCH_REQ_XCOMP_PERM: the tiles of AMX).

Source: Documentation/arch/x86/xstate.rst.
"""


def sets(features: Callable[[], Collection[str]], vector_size: Callable[[], int]) -> tuple[tuple[int, int], ...]:
    """The register sets that make up the state, in order: number, and the bytes to offer for it. The last one may come short.

    Args:
        features: of this machine's processor.
        vector_size: unused: bytes of its longest scalable vectors.
    """
    return ((XSTATE, XSTATE_SIZE),)


def is_lost_in_calls(content: bytes) -> bool:
    """Whether a system call would take a part of what `LOST_IN_CALLS` holds: never."""
    return False


def parts(state: bytes, layout: Layout) -> Iterator[tuple[int, bytes]]:
    """The register sets to write: number and content.

    Args:
        layout: this machine's.
    """
    return iter(((XSTATE, state),))


def in_use(xstate: bytes) -> int:
    """The bits of the components that are in use (XSTATE_BV)."""
    return int.from_bytes(xstate[LEGACY_SIZE : LEGACY_SIZE + 8], "little")


def lacking(xstate: bytes, theirs: Layout, ours: Layout) -> Iterator[str]:
    """Names of the components that are in use and cannot be had here."""
    known = {one.number: one for one in ours}
    for one in _extended_in_use(xstate, theirs):
        here = known.get(one.number) if one.number not in AMX else None
        if (here is None or here.size != one.size) and not _is_as_at_first(one.number, _content(xstate, one)):
            yield _name_of(one.number)
    told = {one.number for one in theirs}
    for number in range(FIRST_EXTENDED, HIGHEST):
        if in_use(xstate) >> number & 1 and number not in told:
            yield _name_of(number)


def fitted(xstate: bytes, theirs: Layout, ours: Layout, example: bytes) -> bytes:
    """The same state as this processor lays it out, without the parts that are `lacking` here.

    Args:
        example: the state of any thread here: of its size, with the kernel's own words.
    """
    known = {one.number: one for one in ours}
    made = bytearray(len(example))
    made[:LEGACY_USED] = xstate[:LEGACY_USED]
    made[LEGACY_USED:LEGACY_SIZE] = example[LEGACY_USED:LEGACY_SIZE]
    used = in_use(xstate) & ((1 << FIRST_EXTENDED) - 1)
    for one in _extended_in_use(xstate, theirs):
        here = known.get(one.number)
        if here is not None and here.size == one.size and here.offset + here.size <= len(made):
            made[here.offset : here.offset + here.size] = _content(xstate, one)
            used |= 1 << one.number
    if PKRU in known and PKRU not in {one.number for one in theirs}:
        made[known[PKRU].offset : known[PKRU].offset + 4] = PKRU_OF_LINUX.to_bytes(4, "little")
        used |= 1 << PKRU
    made[LEGACY_SIZE : LEGACY_SIZE + 8] = used.to_bytes(8, "little")
    return bytes(made)


def key_rights(xstate: bytes, layout: Layout) -> int | None:
    """PKRU: two bits for each protection key, no access and no writing; None where it is not in use or not told."""
    found = next((one for one in layout if one.number == PKRU), None)
    if found is None or not in_use(xstate) >> PKRU & 1:
        return None
    return int.from_bytes(xstate[found.offset : found.offset + 4], "little")


def _extended_in_use(xstate: bytes, layout: Layout) -> Iterator[Component]:
    """The components that are in use and inside the bytes told."""
    used = in_use(xstate)
    return (one for one in layout if used >> one.number & 1 and one.offset + one.size <= len(xstate))


def _name_of(number: int) -> str:
    """Its name in messages."""
    return COMPONENTS.get(number, f"component {number}")


def _content(xstate: bytes, one: Component) -> bytes:
    return xstate[one.offset : one.offset + one.size]


def _is_as_at_first(number: int, content: bytes) -> bool:
    """Whether a component holds what a thread finds there when it begins."""
    return not any(content) or (number == PKRU and int.from_bytes(content[:4], "little") == PKRU_OF_LINUX)


# --- What this processor has: asked by `checkpoint.linux.spawn.cpuid` ------------------------------------------------

ASK: Final = bytes.fromhex(
    "53"  #        push rbx
    "89f0"  #      mov  eax, esi     leaf
    "89d1"  #      mov  ecx, edx     subleaf
    "0fa2"  #      cpuid
    "8907"  #      mov  [rdi], eax
    "895f04"  #    mov  [rdi+4], ebx
    "894f08"  #    mov  [rdi+8], ecx
    "89570c"  #    mov  [rdi+12], edx
    "5b"  #        pop  rbx
    "c3"  #        ret
)
"""``cpuid(words, leaf, subleaf)`` as a function of C: eax, ebx, ecx and edx as four 32-bit words."""
ASK_ENABLED: Final = bytes.fromhex(
    "31c9"  #        xor  ecx, ecx
    "0f01d0"  #      xgetbv
    "48c1e220"  #    shl  rdx, 32
    "4809d0"  #      or   rax, rdx
    "c3"  #          ret
)
"""The components that the kernel has turned on (XCR0), as a function of C. Only where /proc/cpuinfo says "xsave"."""
LEAF_XSTATE: Final = 0xD


def layout_here(features: Callable[[], Collection[str]], vector_size: Callable[[], int], run: Callable[[bytes], int]) -> Layout:
    """The components of this machine's processor; () where there are none.

    Args:
        vector_size: unused, see `sets`.
        run: the address of instructions, in memory that is not writable.

    Raises:
        OSError: by `run`: the system forbids code of our own.
    """
    if "xsave" not in features():
        return ()
    words = (ctypes.c_uint32 * 4)()
    place = run(ASK + ASK_ENABLED)
    instructions = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint32, ctypes.c_uint32)(place)
    enabled = ctypes.CFUNCTYPE(ctypes.c_uint64)(place + len(ASK))

    def ask(leaf: int, subleaf: int) -> tuple[int, int, int, int]:
        instructions(ctypes.addressof(words), leaf, subleaf)
        first, second, third, fourth = words
        return first, second, third, fourth

    return read_layout(ask, enabled())


def read_layout(ask: Callable[[int, int], tuple[int, int, int, int]], enabled: int) -> Layout:
    """The components that a processor has and its kernel has turned on.

    Args:
        ask: CPUID of a leaf and subleaf.
        enabled: their bits (XCR0).
    """
    found = []
    for number in range(FIRST_EXTENDED, HIGHEST):
        size, offset, _, _ = ask(LEAF_XSTATE, number) if enabled >> number & 1 else (0, 0, 0, 0)
        if size:
            found.append(Component(number, offset, size))
    return tuple(found)
