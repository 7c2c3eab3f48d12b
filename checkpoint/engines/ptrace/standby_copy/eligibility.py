"""Find the programs that can have no standby copy: other programs would see the advance work, or it is not implemented yet.

Such programs are restored from their chains, as usual.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from msgspec.structs import replace

from checkpoint.engines.ptrace.facts import memory_limits
from checkpoint.engines.ptrace.restore import mapping_kinds, memory
from checkpoint.errors import UnsupportedError
from checkpoint.linux.memory.tracker import MEMORY_PLACE
from checkpoint.model import Snapshot, Vma
from checkpoint.pages import page_set
from checkpoint.resources.events import aio
from checkpoint.resources.files import clean_private_pages, memfd
from checkpoint.resources.ipc import pseudo_terminals, system_v_memory
from checkpoint.resources.process import exited_processes, job_control, shared_with_parent
from checkpoint.snapshot import carried_files, process_tree

SHARE: Final = 2
"""Free memory must hold a copy so many times."""


def hindrances(state: Snapshot) -> Iterator[str]:
    """Why a program can have no ready copy, one sentence each: others would see its effects, or it is not covered yet."""
    if carried_files.without(state) is not state:
        yield "files travel with it"
    for view in process_tree.views(replace(state, cleared=(), runs=(), copies=(), differences=(), contents=b"")):
        yield from _of_process(view, is_kin=state.is_tree)


def _of_process(state: Snapshot, *, is_kin: bool) -> Iterator[str]:
    """The same of one process.

    Args:
        is_kin: there are others.
    """
    for vma in state.vmas:
        named = vma.file.path if vma.file is not None else vma.name or "memory"
        if system_v_memory.is_segment(vma):
            yield "it has System V shared memory"
        elif aio.is_ring(vma):
            yield "it has rings of asynchronous I/O"
        elif vma.shared and vma.file is not None and not (memory.is_only_read(vma) or (is_kin and _is_in_memory(vma))):
            yield f"it maps {named} shared"
        elif mapping_kinds.is_special(vma):
            yield f"it has huge or droppable pages ({named})"
    if exited_processes.of(state.resources, state.process.working_directory):
        yield "it holds remains of processes that have ended"
    if len(clean_private_pages.of(state.resources)):
        yield "it has memory that must stay untouched until it is used"
    if mapping_kinds.keys_of(state):
        yield "it uses protection keys"
    if is_kin:
        yield from _of_kin(state)


def _of_kin(state: Snapshot) -> Iterator[str]:
    """Reasons by state that must be set before others are born, and may have changed at the takeover."""
    if shared_with_parent.flags_of(state.resources) & shared_with_parent.CLONE_FILES:
        yield "processes of it share a table of descriptors"
    if job_control.stop_of(state.resources):
        yield "a process of it is stopped, or its parent has not been told that it continues"
    if any(held.kind == pseudo_terminals.KIND and held.facts.get("session") for held in state.resources):
        yield "it has a controlling terminal"


def _is_in_memory(vma: Vma) -> bool:
    """Whether it is shared memory that no name leads to."""
    if memory.is_anonymous_object(vma):
        return True
    assert vma.file is not None
    return memory.is_object_mapping(vma) and vma.file.path.startswith((memfd.PREFIX, MEMORY_PLACE))


def require_covered(state: Snapshot) -> None:
    """Refuse a program that can have no ready copy.

    Raises:
        UnsupportedError: with the reasons.
    """
    if reasons := tuple(dict.fromkeys(hindrances(state))):
        raise UnsupportedError(f"{state.component} can have no ready copy: {'; '.join(reasons)}", reasons)


def require_room(base: Snapshot) -> None:
    """Refuse a copy that takes more than its share of free memory: programs that run here need it more than one that may.

    Raises:
        UnsupportedError: with the reason.
    """
    size, free = page_set.total_size(page_set.extents(base.runs)), memory_limits.free()
    if SHARE * size > free:
        held, room = size / memory_limits.GB, free / memory_limits.GB
        reason = f"it holds {held:.2f} GB, more than half of the {room:.2f} GB that this machine has free"
        raise UnsupportedError(f"{base.component} can have no ready copy here: {reason}", (reason,))
