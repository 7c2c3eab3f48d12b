"""Capture carried files (rule ``carry``): find the files below the carried paths, and which of their pages changed.

One scan, during the freeze::

    names, kinds, sizes, times    of everything below each path: 2 to 3 µs a name
    content                       only of files that changed since they were last read: 0.2 to 0.4 ms for each MiB

A file counts as unchanged when device, inode, size and both times are the same. There are two exceptions: it had been changed so
shortly before it was read that a later write could have left the times the same (`GRAIN_NS`), or the process has it mapped:
writes to a mapping show late, or never, in its times. Large amounts are read beforehand, while the program runs
(`CarriedTrees.prepare`), and read again if they changed meanwhile. A copy of all content stays in our memory, so that the capture
sends only changed pages (4 KiB), and loses nothing if a snapshot is not acknowledged.
"""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from checkpoint.capability import Area, by_rule, refused
from checkpoint.engine import CARRIED_SIZE_MAX, Terms
from checkpoint.errors import CaptureError
from checkpoint.linux import abi
from checkpoint.linux.memory import digest_tracker
from checkpoint.linux.memory.tracker import NONE
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.mounts import network_mount
from checkpoint.linux.user_rights import Eyes, eyes_for, own_eyes, seeing_as
from checkpoint.model import PageRun, Position, Resource, Vma
from checkpoint.pages import merge, page_set
from checkpoint.pages.page_set import PageMap, Words
from checkpoint.resources.carried.content import (
    Content,
    Key,
    attributes_of,
    digests_of,
    held_size_of,
    pages_of,
    places_of,
    version_of,
)
from checkpoint.snapshot import carried_files
from checkpoint.snapshot.carried_files import Entry, Tree, is_carriable

FROZEN_SIZE_MAX: Final = 64 << 20
"""Bytes that are read while the program stands still: 15 to 30 ms. Beyond, the capture is refused."""
ENTRIES_MAX: Final = 8192
"""Names below all carried paths: 25 ms of standing still."""
PATHS_MAX: Final = 32
"""Carried paths of one component."""
LARGE_SIZE: Final = 1 << 20
"""Bytes that are worth a look while the program runs."""
GRAIN_NS: Final = 20_000_000
"""Two writes within a tick of the kernel's clock (10 ms at most) may leave a file with equal times.

Source: current_time() in fs/inode.c; kernels before 6.13 know no finer times."""

FOLDER_FLAGS: Final = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC

CAPABILITIES: Final = (
    by_rule(
        Area.FILES,
        "files and folders that the program writes",
        "carried (`--carry`) as they were at the instant of its memory, block by changed block: docs/files.md",
    ),
    refused(
        Area.FILES,
        "in a carried folder: sockets, devices, network mounts, other file systems; more than the limits of carrying allow",
        "carry less, or name a folder without them",
        "which is not carried: keep it outside that folder",
        "is to be carried and is neither a file nor a folder",
        "another file system is mounted at or above",
        "no file of that size is carried",
        "which is no absolute path of a file or folder",
        "which is a link, or behind one",
        "can give no file to at another robot",
        "lies on a network mount",
        "is to be carried and cannot be read",
    ),
)

KINDS_LEFT_OUT: Final = {stat.S_IFSOCK: "socket", stat.S_IFCHR: "device", stat.S_IFBLK: "device"}


class Name(NamedTuple):
    """One name below a carried path, as it was found."""

    tree: int
    name: bytes
    about: os.stat_result

    @property
    def key(self) -> Key:
        """Device and inode of the file that it names."""
        return self.about.st_dev, self.about.st_ino

    @property
    def kind(self) -> int:
        """The file's kind, see inode(7)."""
        return stat.S_IFMT(self.about.st_mode)


class Seen(Struct, frozen=True):
    """The result of one look.

    Attributes:
        names: of each path, a directory before what is in it.
        links: where symbolic links lead to, by path and name.
        unreadable: why something could not be looked at.
    """

    names: tuple[Name, ...] = ()
    links: Mapping[tuple[int, bytes], bytes] = field(default_factory=dict)
    unreadable: tuple[str, ...] = ()


class Parcel(Struct, frozen=True):
    """A snapshot's part about carried files.

    Attributes:
        addresses, content: of the pages that it carries.
        cleared: pages that have gone since its parent.
    """

    resources: tuple[Resource, ...]
    vmas: tuple[Vma, ...]
    addresses: Words
    content: memoryview
    cleared: tuple[PageRun, ...]


NO_PARCEL: Final = Parcel((), (), np.empty(0, dtype=np.uint64), memoryview(b""), ())
"""The parcel of a program without carried files."""


class CarriedTrees(Struct):
    """Follows the carried paths of one process; every call from one thread.

    Invariants: ``_at`` knows the pages of every position that is, or can still be, acknowledged, and ``_newest`` those of the
    last snapshot that was handed out. Two files never have the same place at the same time.

    Attributes:
        paths: absolute, as the process names them.
        eyes: with whose rights they are read; None: our own.
        size_max: bytes that they may hold together.
        giver: with whose rights they are laid down at another robot, where only that user's own can be; None: root's.
    """

    pid: int
    paths: tuple[str, ...]
    eyes: Eyes | None = None
    size_max: int = CARRIED_SIZE_MAX
    giver: Eyes | None = None
    _root: int = -1
    _known: dict[Key, Content] = field(default_factory=dict)
    _place_of: dict[tuple[int, bytes], int] = field(default_factory=dict)
    _now: PageMap = field(default_factory=PageMap.empty)
    _now_of: tuple[Content, ...] = ()
    _newest: PageMap = field(default_factory=PageMap.empty)
    _at: dict[Position | None, PageMap] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raises CaptureError: the process has gone."""
        try:
            self._root = os.open(procfs.outlook(self.pid), os.O_PATH | os.O_DIRECTORY | os.O_CLOEXEC)
        except OSError as error:
            raise CaptureError(f"cannot look at the files of pid {self.pid}: {error.strerror}") from error

    def close(self) -> None:
        """Forget everything."""
        if self._root >= 0:
            os.close(self._root)
            self._root = -1

    def refuse(self) -> tuple[str, ...]:
        """Why these paths cannot be carried as they are now; the program may run."""
        reasons = [reason for path in self.paths if (reason := self._refuse_path(path))]
        if len(self.paths) > PATHS_MAX:
            reasons.append(f"{len(self.paths)} paths are to be carried; {PATHS_MAX} are the limit: name a folder that holds them")
        with contextlib.suppress(CaptureError):  # it changes while we look; more is found out when it stands still
            reasons += self.reasons(self._look(mapped_shared(self.pid), frozen=False))
        return tuple(reasons)

    def _refuse_path(self, path: str) -> str:
        if not is_carriable(path):
            return f"{path!r} is to be carried, which is no absolute path of a file or folder: name it in full"
        if kind := network_mount(self.pid, path):
            return f"{path} lies on a network mount ({kind}), which is not carried: every robot sees it there; leave it out"
        return ""

    def prepare(self, mapped: Iterable[int]) -> None:
        """Read what is much while the program runs, so that little is left for when it stands still.

        Args:
            mapped: as for `look`.
        """
        if sum(content.version[2] for content in self._known.values()) >= LARGE_SIZE or not self._known:
            with contextlib.suppress(CaptureError):  # it changes while we look: it will stand still in a moment
                self._look(frozenset(mapped), frozen=False)

    def look(self, mapped: Iterable[int]) -> Seen:
        """See everything as it is now: the program stands still.

        Args:
            mapped: inodes of the files that it has mapped to be shared.

        Raises:
            CaptureError: too much changed a moment ago; or another program changes the tree meanwhile.
        """
        return self._look(frozenset(mapped), frozen=True)

    def _look(self, mapped: frozenset[int], *, frozen: bool) -> Seen:
        """See everything. Remembers all that it reads, whether or not it becomes a snapshot.

        Raises:
            CaptureError: a file that was there a moment ago has gone.
        """
        with seeing_as(self.eyes):
            try:
                if behind := tuple(filter(None, map(self._refuse_link, self.paths))):
                    return Seen(unreadable=behind)
                names = [name for index in range(len(self.paths)) for name in self._below(index)]
                links = {(one.tree, one.name): os.readlink(self._place(one)) for one in names if one.kind == stat.S_IFLNK}
                self._read_stale(names, mapped, FROZEN_SIZE_MAX if frozen else self.size_max)
            except PermissionError as error:
                return Seen(unreadable=(self._unreadable(error),))
            except OSError as error:
                raise CaptureError(
                    f"cannot capture pid {self.pid}: its carried files change while failover reads them ({self._path_of(error)}: "
                    f"{error.strerror}); try again, and let no other program write there"
                ) from error
        return Seen(tuple(names), links)

    def _refuse_link(self, path: str) -> str:
        """Why a path means another one; asked at each look, for a folder may have become a link."""
        top, parts = f"/proc/self/fd/{self._root}", path.strip("/").split("/")
        for count in range(1, len(parts) + 1):
            try:
                about = os.lstat("/".join((top, *parts[:count])))
            except (FileNotFoundError, NotADirectoryError):
                return ""  # nothing stands there
            if stat.S_ISLNK(about.st_mode):
                return f"{path} is to be carried, which is a link, or behind one: name it as {os.path.realpath(path)}"
        return ""

    # Names

    def _below(self, index: int) -> Iterator[Name]:
        """A path itself and what lies below it, a directory before what is in it; no more than `ENTRIES_MAX`, and one."""
        first = Name(index, b"", os.stat_result(range(10)))
        try:
            first = Name(index, b"", os.lstat(self._place(first)))
        except FileNotFoundError:
            return
        yield first
        folders = [b""] if first.kind == stat.S_IFDIR else []
        count = 1
        while folders and count <= ENTRIES_MAX:
            prefix = folders.pop()
            folder = os.open(self._place(Name(index, prefix, first.about)), FOLDER_FLAGS)
            try:
                with os.scandir(folder) as listed:
                    for one in listed:
                        name = prefix + os.fsencode(one.name)
                        if name.startswith(carried_files.OWN_PREFIX):
                            continue
                        count += 1
                        found = Name(index, name, one.stat(follow_symlinks=False))
                        yield found
                        if stat.S_ISDIR(found.about.st_mode):
                            folders.append(name + b"/")
            finally:
                os.close(folder)

    def _place(self, name: Name) -> bytes:
        """Its path, as we open it."""
        top = b"/proc/self/fd/%d" % self._root + os.fsencode(self.paths[name.tree])
        return top + b"/" + name.name if name.name else top

    def _called(self, name: Name) -> str:
        return os.path.join(self.paths[name.tree], os.fsdecode(name.name)).rstrip("/")

    def _path_of(self, error: OSError) -> str:
        """The process's own name for it."""
        return os.fsdecode(error.filename or b"").removeprefix(f"/proc/self/fd/{self._root}")

    def _unreadable(self, error: OSError) -> str:
        return f"{self._path_of(error)} is to be carried and cannot be read ({error.strerror}): see to its rights"

    # Contents

    def _read_stale(self, names: Sequence[Name], mapped: frozenset[int], size_max: int) -> None:
        """Read the files that changed since they were last read.

        Raises:
            CaptureError: that would be more than ``size_max``.
        """
        now_ns = time.clock_gettime_ns(time.CLOCK_REALTIME)
        stale = {one.key: one for one in names if stat.S_ISREG(one.about.st_mode) and not self._is_known(one.about, mapped)}
        read_size = sum(held_size_of(name.about) for name in stale.values())
        if read_size > size_max:
            if read_size > self.size_max:
                return  # `reasons` tells
            raise CaptureError(
                f"cannot capture pid {self.pid}: {read_size >> 20} MiB of its carried files changed a moment ago; at most "
                f"{size_max >> 20} MiB are read at a time: carry fewer or smaller files"
            )
        places = self._places(stale, names)
        for key, name in stale.items():
            content = self._read(name, places[key], now_ns)
            self._known[key] = replace(content, is_settled=False) if key[1] in mapped else content

    def _is_known(self, about: os.stat_result, mapped: frozenset[int]) -> bool:
        held = self._known.get((about.st_dev, about.st_ino))
        return held is not None and held.is_settled and held.version == version_of(about) and about.st_ino not in mapped

    def _places(self, stale: Mapping[Key, Name], names: Sequence[Name]) -> dict[Key, int]:
        """A place for each file: that which it had, also under another name; else that of its name; else a free one."""
        places = {key: self._known[key].place for key in stale if key in self._known}
        fresh = {key: name for key, name in stale.items() if key not in places}
        if not fresh:
            return places
        standing = {name.key for name in names}
        self._known = {key: content for key, content in self._known.items() if key in standing}
        taken = {content.place for content in self._known.values()}
        free = (place for place in range(carried_files.PLACE_COUNT) if place not in taken)
        for key, name in fresh.items():
            before = self._place_of.get((name.tree, name.name), carried_files.NO_PLACE)
            places[key] = before if before != carried_files.NO_PLACE and before not in taken else next(free)
            taken.add(places[key])
        return places

    def _read(self, name: Name, place: int, now_ns: int) -> Content:
        """Raises OSError: it cannot be read, or is not what it was."""
        file = os.open(self._place(name), os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
        try:
            about = os.fstat(file)
            if not stat.S_ISREG(about.st_mode) or (about.st_dev, about.st_ino) != name.key:
                raise FileNotFoundError(errno.ENOENT, "it was replaced", self._place(name))
            is_settled = now_ns - about.st_ctime_ns > GRAIN_NS
            raw = pages_of(file, about, carried_files.start_of(place))
            return Content(version_of(about), place, raw, is_settled, attributes_of(file))
        finally:
            os.close(file)

    # The snapshot's part, while the program runs on

    def reasons(self, seen: Seen) -> tuple[str, ...]:
        """Why the files of a look cannot be carried."""
        reasons = list(seen.unreadable)
        devices = {name.tree: name.about.st_dev for name in seen.names if not name.name}
        for name in seen.names:
            if reason := self._refuse_name(name, devices[name.tree]):
                reasons.append(reason)
        if len(seen.names) > ENTRIES_MAX:
            reasons.append(f"more than {ENTRIES_MAX} names lie below {', '.join(self.paths)}: carry a folder with fewer")
        held_size = sum({name.key: held_size_of(name.about) for name in seen.names}.values())
        if held_size > self.size_max:
            reasons.append(
                f"the files to be carried hold {held_size >> 20} MiB, the limit is {self.size_max >> 20} MiB: carry less, or "
                "raise carry_limit of the component"
            )
        return tuple(reasons)

    def _refuse_name(self, name: Name, device: int) -> str:
        if name.kind in KINDS_LEFT_OUT:
            return f"{self._called(name)} is a {KINDS_LEFT_OUT[name.kind]}, which is not carried: keep it outside that folder"
        if not name.name and name.kind not in (stat.S_IFREG, stat.S_IFDIR):
            return f"{self._called(name)} is to be carried and is neither a file nor a folder: name another path"
        if name.about.st_dev != device:
            return f"another file system is mounted at or above {self._called(name)}: name its own path as one to be carried"
        giver = self.giver
        if giver is not None and not (name.about.st_uid == giver.uid and name.about.st_gid in (giver.gid, *giver.groups)):
            return (
                f"{self._called(name)} belongs to uid {name.about.st_uid}, gid {name.about.st_gid}, which uid {giver.uid} can "
                "give no file to at another robot: give that user the file (chown), or carry paths without it"
            )
        if name.about.st_size >= carried_files.STRETCH and name.kind == stat.S_IFREG:
            return f"{self._called(name)} looks larger than {carried_files.STRETCH >> 30} GiB: no file of that size is carried"
        return ""

    def parcel(self, seen: Seen, parent: Position | None) -> Parcel:
        """The next snapshot's part about a look, relative to a position (None: to nothing)."""
        trees = self._trees(seen)
        contents = tuple(sorted(self._known.values(), key=lambda content: content.place))
        if self._now_of != contents:
            self._now, self._now_of = digests_of(contents), contents
        if parent is None:
            written, cleared = page_set.extents_of_addresses(self._now.addresses, abi.PAGE_SIZE), NONE
        else:
            written, cleared = self._changes(self._at.get(parent, PageMap.empty()))
        sources = PageMap(self._now.addresses, places_of(contents)).without(written, NONE)[0]
        content = merge.gathered([one.raw.content for one in contents], sources, abi.PAGE_SIZE)
        resources = tuple(tree.resource() for tree in trees)
        mappings = carried_files.mappings_of(trees, abi.PAGE_SIZE)
        return Parcel(resources, mappings, sources.addresses, content, page_set.page_runs(cleared))

    def _trees(self, seen: Seen) -> tuple[Tree, ...]:
        """The files of a look, as a snapshot tells them; files that have gone are forgotten."""
        standing = {name.key for name in seen.names if name.kind == stat.S_IFREG}
        self._known = {key: content for key, content in self._known.items() if key in standing}
        self._place_of = {(name.tree, name.name): self._known[name.key].place for name in seen.names if name.kind == stat.S_IFREG}
        entries: list[list[Entry]] = [[] for _ in self.paths]
        sizes: list[dict[Key, int]] = [{} for _ in self.paths]
        for name in seen.names:
            entries[name.tree].append(self._entry(name, seen))
            if name.key in self._known:
                sizes[name.tree][name.key] = len(self._known[name.key].filled.addresses) * abi.PAGE_SIZE
        of_trees = zip(self.paths, entries, sizes, strict=True)
        return tuple(Tree(path, tuple(below), sum(held.values())) for path, below, held in of_trees)

    def _entry(self, name: Name, seen: Seen) -> Entry:
        about = name.about
        entry = Entry(name.name, about.st_mode, about.st_uid, about.st_gid, about.st_mtime_ns, *name.key)
        if name.kind == stat.S_IFLNK:
            return replace(entry, target=seen.links[name.tree, name.name])
        if name.kind != stat.S_IFREG:
            return entry
        content = self._known[name.key]
        return replace(entry, size=about.st_size, place=content.place, attributes=content.attributes)

    def _changes(self, acknowledged: PageMap) -> tuple[Words, Words]:
        """The differences from the standby's state, and from the last snapshot, whose sum is the base of the next sum."""
        written, cleared = NONE, NONE
        for before in {id(one): one for one in (acknowledged, self._newest)}.values():
            if before is not self._now:
                scan = digest_tracker.compared(before, self._now)
                written, cleared = page_set.union(written, scan.written), page_set.union(cleared, scan.cleared)
        return written, cleared

    def settle(self, position: Position) -> None:
        """The last look has become the snapshot with this position."""
        self._newest = self._at[position] = self._now

    def keep(self, positions: Iterable[Position | None]) -> None:
        """No delta will be relative to any other position."""
        self._at = {position: self._at[position] for position in positions if position in self._at}


def followed(pid: int, terms: Terms) -> CarriedTrees | None:
    """An object that follows the carried files of a process; None where it has none.

    Raises:
        ProcessGoneError, CaptureError: it has ended.
    """
    carry = terms.carry
    if not carry.paths:
        return None
    eyes = eyes_for(pid, terms.owner)
    giver = eyes if terms.owner is not None else own_eyes()
    return CarriedTrees(pid, carry.paths, eyes, carry.size_max, giver)


def mapped_shared(pid: int) -> frozenset[int]:
    """Inodes of the files that a process has mapped to be shared."""
    lines = procfs.parse_maps(procfs.read_text(pid, "maps"))
    return frozenset(line.inode for line in lines if line.shared)
