"""Identify the files behind a process's mappings, so that another machine can tell whether it has the same files."""

from __future__ import annotations

import contextlib
import os
import stat
import struct
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Final

from msgspec.structs import replace

from checkpoint.errors import CaptureError
from checkpoint.linux import abi
from checkpoint.linux.memory.tracker import MEMORY_PLACE, NOT_CARRIED, is_shared_object
from checkpoint.linux.procfs import procfs, vm_flags
from checkpoint.linux.procfs.procfs import DELETED, MapsLine
from checkpoint.model import FileIdentity, Resource, Vma, VmaKind
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Mappings, Words
from checkpoint.resources.files import linked_names, regular
from checkpoint.resources.refusals import HUGE_NAME
from checkpoint.runtime.identity_memo import Memo

_ADVICE: Final = frozenset(("gd", "dc", "dd", "wf", "hg", "nh", "lo", "lf", "nr", "sr", "rr", "mg"))
KEPT_FLAGS: Final = _ADVICE | {vm_flags.HUGE, vm_flags.GIGANTIC, vm_flags.SEALED, vm_flags.DROPPABLE} | vm_flags.KEYS
"""Codes that a restore gives back."""
ROOT: Final = 0
VSYSCALL: Final = "[vsyscall]"
SHARED_ANONYMOUS: Final = "/dev/zero (deleted)"
KINDS: Final = {
    "[heap]": VmaKind.HEAP,
    "[stack]": VmaKind.STACK,
    "[vdso]": VmaKind.VDSO,
    "[vvar]": VmaKind.VVAR,
    "[vvar_vclock]": VmaKind.VVAR,
    VSYSCALL: VmaKind.VSYSCALL,
}


class Identities:
    """Identities of one process's files; each file is looked at once while it stays mapped.

    Attributes:
        kin: all processes of its component, where it is one of several: they may share its anonymous memory, so that it is told
            which is which, and know a file by a name that is left.
    """

    def __init__(self, pid: int, names: Mapping[str, str]) -> None:
        """
        Args:
            names: of files that it has from elsewhere: by the path that the kernel shows, the one that the program knows.
        """
        self._pid = pid
        self._names = names
        self.kin: frozenset[int] = frozenset()
        self.detached: Collection[tuple[int, int]] = frozenset()
        self._mapped_twice: frozenset[int] = frozenset()
        self._known: dict[tuple[int, int, str], FileIdentity] = {}
        self._without_name: dict[tuple[int, int, str], tuple[int, frozenset[int]]] = {}
        self._found = Memo[tuple[Vma, ...]]()
        self._build_id_of: tuple[tuple[int, ...], bytes] = ((), b"")
        self._sees_sizes = False
        """Whether sizes are read: only a mapped shared object itself tells its size."""

    def vmas(self, lines: Sequence[MapsLine], flags: Mapping[int, tuple[str, ...]], guards: Words) -> tuple[Vma, ...]:
        """The mappings as the model has them.

        Args:
            flags: VmFlags by start, possibly older than ``lines``.
            guards: guard pages of all of them.
        """
        found = self._found.of(lines, flags, self.kin, make=lambda: self._every(lines, flags))
        if self._sees_sizes:
            self._found.forget()
        if not len(guards):
            return found
        return Mappings(
            replace(vma, guards=page_set.page_runs(page_set.intersection(guards, page_set.extents((vma,))))) for vma in found
        )

    def _every(self, lines: Sequence[MapsLine], flags: Mapping[int, tuple[str, ...]]) -> tuple[Vma, ...]:
        mapped = {_key(line) for line in lines}
        self._known = {key: identity for key, identity in self._known.items() if key in mapped}
        self._without_name = {key: looked for key, looked in self._without_name.items() if key in mapped}
        self._mapped_twice = _mapped_twice(lines)
        self._sees_sizes = any(map(is_shared_object, lines))
        return Mappings(self._vma(line, flags.get(line.start, ())) for line in lines if line.name != VSYSCALL)

    def _vma(self, line: MapsLine, flags: tuple[str, ...]) -> Vma:
        is_told = self._is_told(line)
        living = self._living_name(line)
        is_shared_huge = is_told and line.name.startswith(HUGE_NAME)
        is_file = not is_shared_huge and line.has_file and line.name not in NOT_CARRIED and not line.name.startswith("/dev/zero")
        if is_shared_huge:  # by relatives, which can have it as ordinary memory alone
            flags = tuple(flag for flag in flags if flag not in (vm_flags.HUGE, vm_flags.GIGANTIC))
        return Vma(
            start=line.start,
            end=line.end,
            protection=line.protection,
            shared=line.shared,
            kind=VmaKind.FILE if is_file else KINDS.get(line.name, VmaKind.ANONYMOUS),
            offset=line.offset,
            name=living or self._names.get(line.name, line.name),
            file=self.of_mapping(line, living) if is_file else _of_shared(line) if is_told else None,
            flags=tuple(flag for flag in flags if flag in KEPT_FLAGS or (flag == vm_flags.MAY_WRITE and is_file and line.shared)),
        )

    def _is_told(self, line: MapsLine) -> bool:
        """Whether the snapshot must tell which shared memory without a file this is: it is mapped in other places, too."""
        return line.shared and (bool(self.kin) or line.inode in self._mapped_twice)

    def of_mapping(self, line: MapsLine, living: str = "") -> FileIdentity:
        """The file behind a mapping.

        Args:
            living: a name that is left of it, in place of the one by which it was mapped.
        """
        key = _key(line)
        if key not in self._known or is_shared_object(line):  # the size of such a one is told by nothing else
            deleted = line.name.endswith(DELETED) and not living
            path = living or line.name.removesuffix(DELETED)
            place = f"{procfs.outlook(self._pid)}{living}" if living else self._place(line)
            is_memory = is_shared_object(line) and bool(line.protection & abi.PROT_WRITE or not living)
            identity = self._identity(path, place, deleted, is_memory=is_memory)
            if not identity.inode and key in self._known:  # the program runs by now, and has just unmapped it
                return self._known[key]
            if deleted and not identity.inode:  # an ordinary user may not look at it, but is told which it is
                identity = replace(identity, device=line.device, inode=line.inode)
            self._known[key] = identity
        return self._known[key]

    def _living_name(self, line: MapsLine) -> str:
        """The name by which shared memory of a file is told, where it is not the one by which it was mapped; "" for all others.

        A private mapping of a deleted file is told by its pages alone.
        """
        is_gone = line.name.endswith(DELETED)
        if not line.shared or not line.name.startswith("/") or not (is_gone or line.name.startswith(MEMORY_PLACE)):
            return ""
        if (line.device, line.inode) in self.detached:
            return ""
        path, file, key = line.name.removesuffix(DELETED), (line.device, line.inode), _key(line)
        try:
            about = os.stat(f"/proc/{self._pid}/map_files/{line.start:x}-{line.end:x}")
        except OSError:  # an ordinary user may not look there
            stamp = _changed_at(f"{procfs.outlook(self._pid)}{os.path.dirname(path)}")
            if not is_gone or os.path.dirname(path) == "/" or self._without_name.get(key) == (stamp, self.kin):
                return ""
            found = linked_names.name_of(path, file, self._holders(), mapped_on=line.device)
            if not found:
                self._without_name[key] = stamp, self.kin
            return found
        if about.st_nlink <= (0 if is_gone else 1):
            return ""
        found = linked_names.name_of(path, (about.st_dev, about.st_ino), self._holders())
        return found if found != line.name else ""

    def _holders(self) -> tuple[int, ...]:
        return self._pid, *sorted(self.kin - {self._pid})

    def _place(self, line: MapsLine) -> str:
        """A path to the very file that is mapped: its name may lead by now to another file, which we may read and it may not."""
        is_detached = (line.device, line.inode) in self.detached
        named = f"{procfs.outlook(self._pid)}{line.name.removesuffix(DELETED) if is_detached else line.name}"
        with contextlib.suppress(OSError):  # it is gone, or closed to us
            about = os.stat(named)
            if (about.st_dev, about.st_ino) == (line.device, line.inode):
                return named
        must_be_exact = os.geteuid() == ROOT or line.name.endswith(DELETED)
        return f"/proc/{self._pid}/map_files/{line.start:x}-{line.end:x}" if must_be_exact else named

    def executable(self) -> FileIdentity:
        """The program itself."""
        target = os.readlink(f"/proc/{self._pid}/exe")
        deleted = target.endswith(DELETED)
        return self._identity(target.removesuffix(DELETED), f"/proc/{self._pid}/exe", deleted)

    def as_known(self, held: Resource) -> Resource:
        """A resource with the path by which the program knows it, where it is a file from elsewhere."""
        path = held.facts.get("path")
        if not isinstance(path, str) or path not in self._names:
            return held
        return replace(held, facts={**held.facts, "path": self._names[path]})

    def open(self, path: str, digest: bytes) -> int:
        """A descriptor of a file that the process runs, or has at that path; no name need lead to it any more.

        Raises:
            CaptureError: there is none.
        """
        for place in self._places(path, digest):
            with contextlib.suppress(OSError):  # the next place may do
                descriptor = os.open(place, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
                if stat.S_ISREG(os.fstat(descriptor).st_mode):
                    return descriptor
                os.close(descriptor)
        raise CaptureError(f"cannot open {path} of pid {self._pid}: no name leads to it any more, nor has the process it mapped")

    def _places(self, path: str, digest: bytes) -> Iterator[str]:
        """Where a file of the process may be opened, the surest first."""
        lines = procfs.parse_maps(procfs.read_text(self._pid, "maps"))
        if self.executable().digest == digest:
            yield f"/proc/{self._pid}/exe"
        for line in lines:
            known = self._known.get(_key(line))
            if known is not None and known.digest == digest:
                yield f"/proc/{self._pid}/map_files/{line.start:x}-{line.end:x}"
        yield f"{procfs.outlook(self._pid)}{path}"

    def _identity(self, path: str, through: str, deleted: bool, *, is_memory: bool = False) -> FileIdentity:
        try:
            about = os.stat(through)
        except OSError:
            return FileIdentity(path, deleted=deleted)
        version = about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns
        return FileIdentity(
            path=self._names.get(path, path),
            device=about.st_dev,
            inode=about.st_ino,
            mode=about.st_mode,
            size=about.st_size,
            mtime_ns=about.st_mtime_ns,
            build_id=b"" if is_memory else self._build_id(through, version),
            digest=b"" if is_memory else regular.digest_at(through, version),
            deleted=deleted,
        )

    def _build_id(self, path: str, version: tuple[int, ...]) -> bytes:
        """The build id of a file. That of the program itself is told at each capture, and read again for another version only."""
        if self._build_id_of[0] != version or not self._build_id_of[1]:
            self._build_id_of = version, build_id(path)
        return self._build_id_of[1]


def _changed_at(directory: str) -> int:
    """When a name came to a directory, or left it, for the last time."""
    try:
        return os.stat(directory).st_mtime_ns
    except OSError:
        return 0


def _mapped_twice(lines: Iterable[MapsLine]) -> frozenset[int]:
    """Inode numbers of shared memory without a file that lies at several places (mremap(2)); pieces side by side are one."""
    ends: dict[int, tuple[int, int]] = {}
    found = set()
    for line in lines:
        if line.shared and line.name == SHARED_ANONYMOUS:
            if ends.get(line.inode, (line.start, line.offset)) != (line.start, line.offset):
                found.add(line.inode)
            ends[line.inode] = line.end, line.offset + line.size
    return frozenset(found)


def _of_shared(line: MapsLine) -> FileIdentity:
    """The identity that tells anonymous shared memory (MAP_SHARED) from other such memory."""
    return FileIdentity(line.name.removesuffix(DELETED), line.device, line.inode, deleted=True)


def _key(line: MapsLine) -> tuple[int, int, str]:
    return line.device, line.inode, line.name


_HEADER: Final = struct.Struct("<16sHHIQQQIHHHHHH")
_PROGRAM_HEADER: Final = struct.Struct("<IIQQQQQQ")
PT_NOTE: Final = 4
NT_GNU_BUILD_ID: Final = 3
NOTE_LIMIT: Final = 1 << 16
"""Bytes of one note segment that are looked at."""


def build_id(path: str) -> bytes:
    """The GNU build id of a 64-bit ELF file, b"" where there is none. Source: elf(5)."""
    try:
        with open(path, "rb") as file:
            header = file.read(_HEADER.size)
            if len(header) < _HEADER.size or header[:5] != b"\x7fELF\x02":
                return b""
            fields = _HEADER.unpack(header)
            file.seek(fields[5])
            table = file.read(fields[9] * fields[10])
            for index in range(fields[10]):
                kind, _, offset, _, _, size, _, _ = _PROGRAM_HEADER.unpack_from(table, index * fields[9])
                if kind == PT_NOTE and size <= NOTE_LIMIT:
                    file.seek(offset)
                    if found := _build_id_in(file.read(size)):
                        return found
    except (OSError, struct.error):
        return b""
    return b""


def _build_id_in(notes: bytes) -> bytes:
    place = 0
    while place + 12 <= len(notes):
        name_size, size, kind = struct.unpack_from("<III", notes, place)
        name_at = place + 12
        content_at = name_at + -(-name_size // 4) * 4
        if kind == NT_GNU_BUILD_ID and notes[name_at : name_at + 4] == b"GNU\0":
            return notes[content_at : content_at + size]
        place = content_at + -(-size // 4) * 4
    return b""
