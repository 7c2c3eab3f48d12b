"""Restore what a process shares with its parent beyond a fork: its table of descriptors, its directories and umask.

clone(2) with CLONE_FILES or CLONE_FS makes such a process. The restore creates it in the same way; its parent fills its table.

Facts: ``descriptors`` (none); ``flags`` of clone(2) with which it was created.

Source: clone(2), kcmp(2).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Final

from msgspec.structs import replace

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.model import Resource, Snapshot
from checkpoint.resources.process import unshared_threads
from checkpoint.resources.restore_context import number_of

KIND: Final = "joint"
CLONE_FS: Final = 0x200
CLONE_FILES: Final = 0x400
CAPABILITIES: Final = (
    preserved(
        Area.PROCESS,
        "processes that share their table of descriptors, or directories and umask, with their parent (clone(2))",
        "they share them again; the record locks of such a table belong to the parent",
    ),
    refused(
        Area.PROCESS,
        "a root directory (chroot) that two processes share by CLONE_FS; a thread with its own table of descriptors in a "
        "process that shares its table with another process (CLONE_FILES)",
        "let the child make it its own (unshare), or run the program without the chroot",
        "it has its directories in common with its parent",
        "it has its open files in common with its parent",
    ),
)
_KINDS: Final = ((abi.KCMP_FILES, CLONE_FILES), (abi.KCMP_FS, CLONE_FS))


def describe(pid: int, parent: int) -> tuple[Resource, ...]:
    """The things that a process shares with its parent, which is of the same component.

    Raises:
        ProcessGoneError: one of them has ended.
    """
    flags = 0
    for kind, flag in _KINDS:
        order = abi.kcmp(pid, parent, kind)
        if order is not None and order < 0:
            raise ProcessGoneError(f"process {pid} or its parent {parent} has ended")
        flags |= flag if order == 0 else 0
    return (Resource(KIND, "shared with its parent", {"descriptors": [], "flags": flags}),) if flags else ()


def refuse(shared: Iterable[Resource], pid: int, of_threads: Iterable[Resource]) -> Iterator[str]:
    """Why it cannot keep what it shares with its parent.

    The process that enters a root directory first takes the other along, which still opens files. And its threads are born
    before its parent has filled the table of descriptors from which they take theirs.

    Args:
        of_threads: among them what its threads have for themselves.

    Raises:
        ProcessGoneError: it has ended.
    """
    root = procfs.read_link(pid, "root")
    if root != "/" and flags_of(shared) & CLONE_FS:
        yield f"it has its directories in common with its parent, in the root directory {root} (chroot), which is not kept yet"
    if flags_of(shared) & CLONE_FILES and unshared_threads.has_own_table(of_threads):
        yield "it has its open files in common with its parent, and a thread of it has others, which is not kept yet"


def flags_of(resources: Iterable[Resource]) -> int:
    """The flags of clone(2) for a process that has these."""
    return next((number_of(held.facts["flags"]) for held in resources if held.kind == KIND), 0)


def without_descriptors(view: Snapshot) -> Snapshot:
    """A process whose table of descriptors is filled by its parent."""
    return replace(view, resources=tuple(held for held in view.resources if not held.facts["descriptors"]))
