"""Restore memory files of memfd_create(2) with name, content, size and seals; several open files may lead to the same one.

Memory that was mapped shared without a file, and was opened through /proc/self/map_files, is restored as a memory file, too.

Facts: ``descriptors``; ``name``; ``flags`` of open(2); ``offset``, ``size``; ``mode``; ``device`` and ``inode``, which open files
and mappings of the same one have in common; ``seals`` of F_ADD_SEALS; ``content``: a list of [offset, bytes], with one of its
open files, empty with the others.

Source: memfd_create(2), fcntl(2).
"""

from __future__ import annotations

import fcntl
import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from checkpoint.capability import Area, preserved, refused
from checkpoint.errors import CaptureError
from checkpoint.linux.memory.digest_tracker import filled_extents
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptor import Descriptor
from checkpoint.linux.procfs.descriptors import copy_of
from checkpoint.linux.trace.call_table import CallTable
from checkpoint.model import Fact, Resource
from checkpoint.program import scratch_name
from checkpoint.resources import other_holders
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.restore_context import Rebuilding, number_of

KIND: Final = "memory_files"

CAPABILITIES: Final = (
    preserved(Area.FILES, "memory files (memfd)", "with name, content, size and seals, up to 16 MiB"),
    preserved(Area.MEMORY, "scratch memory", "a memory file named failover-scratch: mapped again, filled with zeros"),
    refused(
        Area.FILES,
        "memory files over 16 MiB, of huge pages, or sealed against writing and mapped; shared memory that is both opened "
        "and mapped",
        "use a file in /dev/shm",
        "of huge pages, which are not kept",
        "MiB, which is the limit",
        "sealed against writing and mapped",
        "opened through /proc/self/map_files and mapped",
    ),
)

PREFIX: Final = "/memfd:"
ANONYMOUS: Final = "/dev/zero (deleted)"
"""The kernel's name for shared memory without a file."""
CONTENT_LIMIT: Final = 16 << 20
"""Bytes of one that a snapshot carries: it is copied while the program stands still."""
HUGE: Final = 2 << 20
"""Block size of one that is made of huge pages."""
MFD_ALLOW_SEALING: Final = 2
F_ADD_SEALS: Final = 1033
F_GET_SEALS: Final = 1034
F_SEAL_WRITE: Final = 8
O_PATH: Final = 0o10000000
REOPENED: Final = os.O_ACCMODE | os.O_APPEND | os.O_NONBLOCK


def is_memory_file(one: Descriptor) -> bool:
    """Whether a descriptor is one."""
    is_memory = one.target.startswith(PREFIX) or (one.target == ANONYMOUS and not one.links)
    return stat.S_ISREG(one.mode) and is_memory and not one.flags & O_PATH


def observe(held: OpenFile, opened: Sequence[OpenFile]) -> Mapping[str, Fact]:
    """Its seals, and its content if this is the first open file of it.

    Raises:
        CaptureError: it cannot be looked into.
    """
    first = next((one for one in opened if _key(one.first) == _key(held.first)), held)  # one on its way may be open nowhere
    try:
        with copy_of(held.pid, held.first.number) as descriptor:
            about, seals = os.fstat(descriptor), fcntl.fcntl(descriptor, F_GET_SEALS)
        stored = 0 if held.first.target == scratch_name.MAPPED else about.st_blocks * 512
        content = _content(held) if first is held and 0 < stored <= CONTENT_LIMIT else []
    except OSError as error:
        raise CaptureError(f"cannot look into the memory file {held.name} of pid {held.pid}: {error.strerror}") from error
    return {"seals": seals, "content": content, "stored": stored, "huge": about.st_blksize >= HUGE}


def _key(one: Descriptor) -> tuple[int, int]:
    return one.device, one.inode


def _content(held: OpenFile) -> list[Fact]:
    file = os.open(f"/proc/{held.pid}/fd/{held.first.number}", os.O_RDONLY | os.O_CLOEXEC)
    try:
        return [[first, os.pread(file, last - first, first)] for first, last in filled_extents(file)]
    finally:
        os.close(file)


def describe(held: OpenFile, surroundings: Surroundings) -> Resource | None:
    """The memory file as it was observed."""
    first = held.first
    if not is_memory_file(first):
        return None
    facts: dict[str, Fact] = {
        "descriptors": held.numbers,
        "name": first.target.removeprefix(PREFIX).removesuffix(procfs.DELETED).lstrip("/"),
        "flags": first.flags & ~os.O_CLOEXEC,
        "offset": first.offset,
        "size": first.size,
        "mode": first.mode,
        "device": first.device,
        "inode": first.inode,
    }
    return Resource(KIND, held.name, facts | {name: held.observed.get(name, 0) for name in ("seals", "content")})


def refuse(held: OpenFile, surroundings: Surroundings) -> str | None:
    """Why a memory file cannot be kept."""
    if not is_memory_file(held.first):
        return None
    seen, what = held.observed, f"{held.name} is {held.first.target}, a memory file"
    if seen.get("huge"):
        return f"{what} of huge pages, which are not kept: let the program use ordinary ones"
    if number_of(seen.get("stored", 0)) > CONTENT_LIMIT:
        return f"{what} of more than {CONTENT_LIMIT >> 20} MiB, which is the limit: let the program use a file with a name"
    if number_of(seen.get("seals", 0)) & F_SEAL_WRITE and _is_mapped(held):
        return f"{what} that is sealed against writing and mapped, which is not kept: let the program unmap it"
    if held.first.target == ANONYMOUS and _is_mapped(held):
        return f"{what} that was opened through /proc/self/map_files and mapped, which is not kept: let the program close it"
    if (held.first.device, held.first.inode) in (surroundings.detached or ()):
        return None
    return other_holders.refuse(held, "a memory file")


def _is_mapped(held: OpenFile) -> bool:
    major_minor = f"{os.major(held.first.device):02x}:{os.minor(held.first.device):02x}"
    pattern = rf"^\S+ ...s \S+ {major_minor} {held.first.inode} "
    return re.search(pattern, procfs.read_text(held.pid, "maps"), re.MULTILINE) is not None


# --- Restore -----------------------------------------------------------------------------------------------------------


def make(table: CallTable, name: str, mode: int, size: int) -> int:
    """Make an empty one."""
    made = table.obtain(f"make the memory file {name}", "memfd_create", table.place_path(name), MFD_ALLOW_SEALING)
    table.call(f"set the mode of the memory file {name}", "fchmod", made, mode & 0o7777)
    table.call(f"size the memory file {name}", "ftruncate", made, size)
    return made


def make_whole(table: CallTable, held: Resource) -> int:
    """Make one that no process has mapped, filled and sealed."""
    facts = held.facts
    made = make(table, str(facts["name"]), number_of(facts["mode"]), number_of(facts["size"]))
    _fill(table, held, made)
    if seals := number_of(facts["seals"]):
        table.call("seal a memory file", "fcntl", made, F_ADD_SEALS, seals)
    return made


def _fill(table: CallTable, held: Resource, made: int) -> None:
    for offset, piece in _pieces(held.facts["content"]):
        size, what = len(piece), f"fill the memory file of {held.name}"
        table.call(what, "pwrite64", made, table.place(piece), size, offset, least=size, most=size)


def rebuild(table: CallTable, held: Resource, rebuilding: Rebuilding) -> int:
    """Open it as it was; made and filled if this is the first open file of it, and no mapping has made it."""
    facts = held.facts
    key = _key_of(held)
    is_new = key not in rebuilding.objects
    if is_new:
        made = make(table, str(facts["name"]), number_of(facts["mode"]), number_of(facts["size"]))
        rebuilding.keep(table, key, made)
    _fill(table, held, rebuilding.objects[key])
    opened = _opened(table, rebuilding.objects[key], number_of(facts["flags"]), is_new)
    offset = number_of(facts["offset"])
    table.call(f"set the offset of {held.name}", "lseek", opened, offset, os.SEEK_SET, least=offset, most=offset)
    return opened


def _opened(table: CallTable, made: int, flags: int, is_new: bool) -> int:
    """An open file of it: as it was made, which does not keep it from being executed, or opened again."""
    if not is_new or flags & os.O_ACCMODE != os.O_RDWR:
        return table.open(f"/proc/self/fd/{made}", flags & REOPENED)
    opened = table.obtain("open a memory file", "fcntl", made, fcntl.F_DUPFD, 0)
    table.call("set the flags of a memory file", "fcntl", opened, fcntl.F_SETFL, flags & (os.O_APPEND | os.O_NONBLOCK))
    return opened


def _pieces(content: Fact) -> Iterator[tuple[int, bytes]]:
    for piece in content if isinstance(content, list) else ():
        assert isinstance(piece, list) and isinstance(piece[1], bytes)
        yield number_of(piece[0]), piece[1]


def seal(table: CallTable, held: Sequence[Resource], rebuilding: Rebuilding) -> None:
    """Seal them, when they are filled and mapped: afterwards some of that is forbidden."""
    for key, seals in {_key_of(one): number_of(one.facts["seals"]) for one in held}.items():
        if seals:
            table.call("seal a memory file", "fcntl", rebuilding.objects[key], F_ADD_SEALS, seals)


def _key_of(held: Resource) -> tuple[int, int]:
    return number_of(held.facts["device"]), number_of(held.facts["inode"])
