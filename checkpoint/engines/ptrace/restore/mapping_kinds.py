"""Restore mappings that mmap(2) alone does not make: huge and droppable pages, protection keys, seals.

The restore tries huge pages and droppable pages first. Where the kernel has none, it uses ordinary pages and adds a note.

Source: mmap(2), pkeys(7), mseal(2); Documentation/admin-guide/mm/hugetlbpage.rst.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

from checkpoint.arch import extended
from checkpoint.capability import Area, by_rule, preserved
from checkpoint.linux import abi
from checkpoint.linux.procfs.vm_flags import DROPPABLE, GIGANTIC, HUGE, SEALED, key_in
from checkpoint.linux.spawn import cpuid
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Snapshot, Vma, VmaKind
from checkpoint.resources.refusals import HUGE_NAME

CAPABILITIES: Final = (
    by_rule(
        Area.MEMORY,
        "huge pages (MAP_HUGETLB), up to 64 MiB each if they are private",
        "huge pages again if enough are free there; otherwise, and if processes of the program share them, ordinary "
        "pages, and a note says so",
        "which its processes share, are ordinary ones here",
    ),
    preserved(
        Area.MEMORY,
        "advice: transparent huge pages, DONTFORK, WIPEONFORK, DONTDUMP, merging; droppable and sealed mappings",
        "as it was; memory that is excluded from core dumps is carried all the same, droppable memory begins empty",
    ),
    preserved(
        Area.MEMORY,
        "protection keys (pkeys)",
        "the same keys and rights, if the other processor has keys; a key that guards nothing and allows nothing is free",
        "it has memory with protection keys",
    ),
)

MAP_DROPPABLE: Final = 0x08
MAP_HUGETLB: Final = 0x40000
HUGE_SHIFT: Final = 26
HUGE_BITS, GIGANTIC_BITS = 21, 30
"""Logarithms of 2 MiB and 1 GiB."""
KEY_DENIES: Final = 1
"""The two bits of a key in PKRU as every thread begins with them: no access."""
FIRST_KEY, LAST_KEY = 1, 15


def is_huge(vma: Vma) -> bool:
    """Whether it is memory of huge pages without a file."""
    return HUGE in vma.flags and vma.name.startswith(HUGE_NAME)


def is_special(vma: Vma) -> bool:
    """Whether `map_special` must make it."""
    return is_huge(vma) or DROPPABLE in vma.flags


def map_special(table: CallTable, vma: Vma, protection: int, flags: int) -> None:
    """Map it as it was, or of ordinary pages: nothing else is at its place yet.

    Args:
        flags: of mmap(2), for ordinary pages.
    """
    flags |= abi.MAP_FIXED_NOREPLACE
    arguments = (vma.start, vma.size, protection)
    if is_huge(vma):
        bits = GIGANTIC_BITS if GIGANTIC in vma.flags else HUGE_BITS
        lost = f"{vma.size >> 20} MiB of huge pages at {vma.start:#x} are ordinary ones here"
        table.attempt(lost, "mmap", *arguments, flags | MAP_HUGETLB | bits << HUGE_SHIFT, -1, 0)
    else:
        lost = f"memory at {vma.start:#x} is not droppable here"
        table.attempt(lost, "mmap", *arguments, flags & ~(abi.MAP_PRIVATE | abi.MAP_SHARED) | MAP_DROPPABLE, -1, 0)
    table.attempt("", "mmap", *arguments, flags, -1, 0)  # there is something already, if that has worked


def ordinary_by_now(vmas: Iterable[Vma]) -> Iterator[str]:
    """Which shared memory was of huge pages, and is a part of what relatives have in common: of ordinary ones, that is."""
    for vma in vmas:
        if vma.kind is VmaKind.ANONYMOUS and vma.name.startswith(HUGE_NAME):
            yield f"{vma.size >> 20} MiB of huge pages at {vma.start:#x}, which its processes share, are ordinary ones here"


def seal(table: CallTable, vma: Vma) -> None:
    """Seal a mapping, as the last thing that is done to it."""
    if SEALED in vma.flags:
        table.attempt(f"memory at {vma.start:#x} is not sealed here", "mseal", vma.start, vma.size, 0)


# --- Protection keys -------------------------------------------------------------------------------------------------


def keys_of(state: Snapshot) -> frozenset[int]:
    """The protection keys that the program has: they guard memory, or a thread has a right by them."""
    guarding = {key_in(vma.flags) for vma in state.vmas} - {0}
    told = state.threads[0].registers.get("xstate_layout", b"") if state.threads else b""
    layout = extended.decode_layout(told) or cpuid.xstate_layout()
    for thread in state.threads:
        rights = extended.key_rights(thread.registers.get("xstate", b""), layout)
        if rights is not None:
            guarding |= {key for key in range(FIRST_KEY, LAST_KEY + 1) if rights >> 2 * key & 3 != KEY_DENIES}
    return frozenset(guarding)


def refuse(state: Snapshot) -> Iterator[str]:
    """Why its keys cannot be had here."""
    if "ospke" not in cpuid.features() and any(key_in(vma.flags) for vma in state.vmas):
        yield "it has memory with protection keys, which this processor or kernel lacks: use one that has them"


def allocate_keys(table: CallTable, keys: frozenset[int]) -> None:
    """Add the calls that allocate them: the kernel gives the lowest that is free, so those between are given back."""
    for key in range(FIRST_KEY, max(keys, default=0) + 1):
        table.call(f"allocate protection key {key}", "pkey_alloc", 0, 0, least=key, most=key)
    for key in range(FIRST_KEY, max(keys, default=0)):
        if key not in keys:
            table.call(f"give protection key {key} back", "pkey_free", key)


def protect(table: CallTable, vmas: Iterable[Vma]) -> None:
    """Add the calls that put mappings under their keys."""
    for vma in vmas:
        if key := key_in(vma.flags):
            what = f"put {vma.start:#x} under protection key {key}"
            table.call(what, "pkey_mprotect", vma.start, vma.size, vma.protection, key)
