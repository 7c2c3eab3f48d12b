"""List the files that a program needs on every machine: its executable and mapped files, and by choice files that it only reads.

Pure: it uses the snapshot alone. Other modules find out which of them a machine has, and where the rest comes from.
"""

from __future__ import annotations

import stat
from collections.abc import Iterable, Iterator
from typing import Final

from msgspec import Struct

from checkpoint.model import Fact, FileIdentity, Snapshot, Vma, VmaKind
from checkpoint.snapshot import carried_files
from checkpoint.snapshot.process_tree import views

OPEN_FILES: Final = "files"
"""The kind of resource that open files are, `checkpoint.resources.files.regular`."""

PROGRAM: Final = "program"
"""The kind of resource of `checkpoint.engines.cooperative.program_files`."""

MEMORY_PLACE: Final = "/dev/shm/"
"""Files here are memory with a name: they cannot be brought along."""

WRITE: Final = 2
ACCESS_MODE: Final = 3
PATH_ONLY: Final = 0o10000000
"""Bits of mmap(2)'s protection, and of open(2)'s flags: O_ACCMODE, O_PATH."""


class Need(Struct, frozen=True):
    """One file.

    Attributes:
        path: as the program names it.
        size: bytes.
        digest: blake3 of its content, 32 bytes; b"" where it was not taken (too large, or closed to us): it cannot be brought.
        exact: another version at the path will not do. Of a program that is started again it will: it was installed there.
    """

    path: str
    size: int
    digest: bytes
    exact: bool = True


def needs(state: Snapshot, *, opened: bool = True) -> tuple[Need, ...]:
    """Every file that a program must find again, one for each path.

    Args:
        opened: also those that it has open for reading only.
    """
    if not state.threads:
        return tuple(Need(file.path, file.size, file.digest, exact=False) for file in program_of(state))
    found: list[Need] = []
    for view in views(state):
        found.append(_need(view.process.executable))
        found += [_need(vma.file) for vma in view.vmas if vma.file is not None and _is_run(vma)]
        if opened:
            found += _opened(view)
    carry = carried_files.paths_of(state)
    return tuple({need.path: need for need in found if not _is_below(need.path, carry)}.values())


class ProgramFile(Struct, frozen=True):
    """One file that a program of the cooperative engine is started again from; ``mode``: permissions of it."""

    path: str
    size: int
    digest: bytes
    mode: int


def program_of(state: Snapshot) -> tuple[ProgramFile, ...]:
    """The files that start a program again (`checkpoint.engines.cooperative.program_files`), the first by its command."""
    held = next((one for one in state.resources if one.kind == PROGRAM), None)
    files = held.facts.get("files") if held is not None else None
    found = []
    for fact in files if isinstance(files, list) else ():
        match fact:
            case [str(path), int(size), bytes(digest), int(mode)] if path.startswith("/") and ".." not in path.split("/"):
                found.append(ProgramFile(path, size, digest, mode & 0o755))
    return tuple(found)


def _is_below(path: str, folders: tuple[str, ...]) -> bool:
    """Whether a file travels with the snapshot, as one of those that the program carries."""
    return any(path == folder or path.startswith(folder + "/") for folder in folders)


def names_of_contents(files: Iterable[Need], contents: str) -> dict[str, str]:
    """The paths by which a program knows its files, by those that they have as contents (`checkpoint.store.content_store`).

    Args:
        contents: directory of the contents, "" if there is none.
    """
    if not contents:
        return {}
    return {f"{contents}/{need.digest.hex()}": need.path for need in files if need.digest}


def _need(file: FileIdentity) -> Need:
    return Need(file.path, file.size, file.digest)


def _is_run(vma: Vma) -> bool:
    """Whether it is mapped from a file with a name, and only to be read: files that the program writes do not count here."""
    file = vma.file
    if vma.kind is not VmaKind.FILE or file is None or file.deleted or not stat.S_ISREG(file.mode):
        return False
    return not (vma.shared and vma.protection & WRITE) and not file.path.startswith(MEMORY_PLACE)


def _opened(state: Snapshot) -> Iterator[Need]:
    for held in state.resources:
        facts = held.facts
        if held.kind != OPEN_FILES or facts.get("deleted") or not facts.get("digest"):
            continue
        flags, mode, size = (_number(facts.get(name)) for name in ("flags", "mode", "size"))
        digest, path = facts["digest"], facts.get("path")
        is_read = stat.S_ISREG(mode) and not flags & (ACCESS_MODE | PATH_ONLY)
        if is_read and isinstance(digest, bytes) and isinstance(path, str):
            yield Need(path, size, digest)


def _number(fact: Fact) -> int:
    return fact if isinstance(fact, int) else 0
