"""Decide which bases may be written into their vessel before all of their pages are verified.

The restore writes a base that lies in files into its vessel frame by frame (`checkpoint.store.base_on_disk`). Only after the last
frame does it know whether all frames were those that were captured. If not, it gives the vessel up, and nothing of the vessel may
remain.
"""

from __future__ import annotations

from checkpoint.engines.ptrace.restore import checks, memory, vdso
from checkpoint.linux import abi
from checkpoint.linux.procfs.vm_flags import MAY_WRITE
from checkpoint.model import Snapshot, Vma
from checkpoint.resources.ipc import system_v_memory
from checkpoint.runtime import parallel
from checkpoint.snapshot import carried_files
from checkpoint.store.base_on_disk import StoredBase


def held_or_stored(base: Snapshot | StoredBase) -> tuple[Snapshot, StoredBase | None]:
    """A base with its pages, or without them and where they are."""
    if isinstance(base, Snapshot):
        return base, None
    if _may_be_proved_later(base.outline):
        return base.outline, base
    return base.whole(parallel.thread_count()), None


def _may_be_proved_later(outline: Snapshot) -> bool:
    """Whether the pages of a base may go into the vessel before all of them were proved, and none is wanted before.

    Not where something outlives a vessel that is given up: files that travel with the program, a directory that is made for it,
    memory that others see, a file that is written to by being mapped. A program of another kernel needs the old vdso early.
    """
    leaves_nothing = not any(map(_outlives, outline.vmas)) and not checks.missing_directories(outline)
    is_of_this_kernel = vdso.fits(outline, checks.own_kernel_pages())
    return not outline.is_tree and leaves_nothing and is_of_this_kernel and carried_files.without(outline) is outline


def _outlives(vma: Vma) -> bool:
    """Whether other processes see writes to a mapping."""
    if system_v_memory.is_segment(vma):
        return True
    return vma.shared and memory.is_file_mapping(vma) and bool(vma.protection & abi.PROT_WRITE or MAY_WRITE in vma.flags)
