"""Restore carried files (rule ``carry``) as they were at the checkpoint, before the program runs.

1. The restore builds everything of every path aside, in ``.failover-new-…`` beside the path, from the snapshot alone. A failure
   up to here has changed nothing.
2. If the content at a path differs from the checkpoint, it is kept, with any owner and any age: it moves as a whole to
   ``.failover-kept-NAME/TIME-POSITION`` beside the path, and a note says so. The newest `KEPT_COUNT` of those stay. A file that
   another process holds open for writing is never replaced: the restore is refused, and names that process.
3. The new content takes its place in the same instant (RENAME_EXCHANGE of renameat2(2)), also for a whole folder. Where that is
   impossible, because the folder is a mount point or its parent is not writable, each name in it is moved by itself. When one
   move fails, all moves, of every path, are taken back (`checkpoint.resources.carried.reversible_moves`).

The restore does not force anything to the disk: after a power failure the checkpoint is still in the store and is restored again.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Final

from msgspec import Struct, field

from checkpoint.errors import MismatchError, RestoreError
from checkpoint.linux.procfs.mounts import is_mount_point
from checkpoint.linux.user_rights import ROOT, Eyes, own_uid, seeing_as
from checkpoint.model import Snapshot
from checkpoint.resources.carried.attributes import DESCRIPTORS, give, path_of
from checkpoint.resources.carried.file_numbers import Identity
from checkpoint.resources.carried.reversible_moves import Moves
from checkpoint.resources.files import other_writers
from checkpoint.snapshot import carried_files
from checkpoint.snapshot.carried_files import Entry, Tree
from checkpoint.snapshot.validity import place as position_text

KEPT_COUNT: Final = 4
"""Sets of replaced files that are kept for each carried path; the oldest goes when there are more."""

Pieces = Mapping[int, list[tuple[int, memoryview]]]
"""By place: (offset in the file, bytes in whole pages)."""


class Laid(Struct, frozen=True):
    """The result of laying down files.

    Attributes:
        notes: a sentence for each difference.
        identities: device and inode of each carried file, then and now.
    """

    notes: tuple[str, ...] = ()
    identities: Mapping[Identity, Identity] = field(default_factory=dict)


def lay_down_for(state: Snapshot, pid: int, *, own_eyes: bool) -> Laid:
    """Put all carried files of a base where they belong, before its program runs; see `lay_down`.

    Args:
        pid: the process that is to become the program, or our own.
        own_eyes: with the rights of the program's own user, not with ours.
    """
    if not carried_files.paths_of(state):
        return Laid()
    theirs = state.process.credentials
    eyes = Eyes(theirs.uids[3], theirs.gids[3], theirs.groups) if own_eyes else None
    return lay_down(state, eyes, other_writers.family(os.getpid()) | other_writers.family(pid))


def lay_down(state: Snapshot, eyes: Eyes | None, spared: frozenset[int]) -> Laid:
    """Put all carried files of a base where they belong.

    Args:
        eyes: with whose rights; None: our own.
        spared: processes that may hold the files open: those that restore.

    Raises:
        MismatchError: another process writes to what is to be replaced.
        RestoreError: there is no room, or no right; what stood there stands there still.
    """
    trees, pieces = _outermost(carried_files.trees_of(state)), carried_files.pieces(state)
    for tree in trees:
        _require_unwritten(state, tree, spared)
    layings = [_Laying(tree, pieces, position_text(state.position)) for tree in trees]
    with seeing_as(eyes):
        try:
            return _laid(state, layings)
        except BaseException as error:
            if stuck := [where for laying in reversed(layings) for where in laying.take_back()]:
                raise RestoreError(
                    f"cannot write the carried files of {state.component} ({error}), nor undo it: {'; '.join(stuck)}"
                ) from error
            raise
        finally:
            for laying in layings:
                laying.clear()


def _laid(state: Snapshot, layings: Sequence[_Laying]) -> Laid:
    """All of them: each step of every tree before the next step of any."""
    for laying in layings:
        with _told(state, laying):
            laying.compare()
    wanted = [(laying.tree.path, laying.held_size) for laying in layings if not laying.stands]
    if reason := carried_files.lack_of_room(wanted):
        raise RestoreError(f"cannot write the carried files of {state.component}: {reason}")
    for step in (_Laying.build, _Laying.swap, _Laying.settle):
        for laying in layings:
            with _told(state, laying):
                step(laying)
    identities: dict[Identity, Identity] = {}
    for laying in layings:
        with _told(state, laying):
            identities |= laying.identities()
    for laying in layings:
        laying.forget_oldest()
    return Laid(tuple(note for laying in layings for note in laying.notes), identities)


@contextlib.contextmanager
def _told(state: Snapshot, laying: _Laying) -> Iterator[None]:
    """Turn what the kernel says into one sentence."""
    try:
        yield
    except OSError as error:
        where = laying.called(os.fsdecode(error.filename or "there"))
        raise RestoreError(
            f"cannot write {laying.tree.path}, which {state.component} carries ({where}: {error.strerror}); "
            "see to room and rights there"
        ) from error


def _outermost(trees: Sequence[Tree]) -> list[Tree]:
    """The paths that no other one holds.

    Raises:
        RestoreError: two of them would have different things at one path.
    """
    found: list[Tree] = []
    for tree in sorted(trees, key=lambda one: one.path):
        above = next((one for one in found if f"{tree.path}/".startswith(f"{one.path}/")), None)
        if above is None:
            found.append(tree)
        elif _names_at(above, tree.path) != {os.fsencode(_at(tree.path, entry)) for entry in tree.entries}:
            raise RestoreError(f"cannot write {tree.path} in {above.path}: each is carried by itself; correct carry_at")
    return found


def _names_at(tree: Tree, path: str) -> set[bytes]:
    """The names of a tree at a path and below it."""
    names = {os.fsencode(_at(tree.path, entry)) for entry in tree.entries}
    return {name for name in names if (name + b"/").startswith(os.fsencode(path) + b"/")}


def _require_unwritten(state: Snapshot, tree: Tree, spared: frozenset[int]) -> None:
    """Raises MismatchError: another program would go on writing to files that the program takes for its own."""
    if reason := next(_writers_below(tree.path, spared, {}), ""):
        raise MismatchError(f"cannot restore {state.component} here: {reason}", (reason,))


def written_by_others(state: Snapshot, spared: frozenset[int], owners: Mapping[int, str] = MappingProxyType({})) -> Iterator[str]:
    """Which carried files, as they lie here, another program holds open for writing, so that they would not be laid down.

    Args:
        spared: processes that do not count.
        owners: which component a process belongs to, by pid.
    """
    for tree in carried_files.trees_of(state):
        yield from _writers_below(tree.path, spared, owners)


def _writers_below(place: str, spared: frozenset[int], owners: Mapping[int, str]) -> Iterator[str]:
    for path in _files_below(place):
        if other_writers.may_be_written(path) and (pid := other_writers.writer_of(path, spared)):
            holder = other_writers.told(pid, owners)
            yield f"{path}, which the program carries, is held open for writing by {holder}: end that first"


def _files_below(path: str) -> Iterator[str]:
    if os.path.isfile(path) and not os.path.islink(path):
        yield path
    for folder, _, names in os.walk(path):
        for name in names:
            full = os.path.join(folder, name)
            if not os.fsencode(os.path.relpath(full, path)).startswith(carried_files.OWN_PREFIX) and os.path.isfile(full):
                yield full


class _Laying(Struct):
    """One tree on its way to its path: `compare`, `build`, `swap`, `settle`, `forget_oldest`; then, however it ends, `clear`.

    Until `forget_oldest`, `take_back` undoes it. Each of them raises OSError when it does not work.

    Attributes:
        stands: all of it is at its path already.
        notes: a sentence for each difference.
    """

    tree: Tree
    pieces: Pieces
    position: str
    stands: bool = False
    notes: list[str] = field(default_factory=list)
    _inside: bool = False
    _aside: str = ""
    _held: int = -1
    _seen: dict[bytes, Identity] = field(default_factory=dict)
    _kept: str = ""
    _made: list[str] = field(default_factory=list)
    _moves: Moves = field(default_factory=Moves)
    _is_stuck: bool = False

    @property
    def held_size(self) -> int:
        """Bytes that its files hold."""
        places = {entry.place for entry in self.tree.entries}
        return sum(len(content) for place in places for _, content in self.pieces.get(place, []))

    def compare(self) -> None:
        """Find out whether anything is to be done."""
        self.stands = self._is_there()

    def build(self) -> None:
        """Make everything aside, beside the path; in it, where it is a mount point or what is beside it may not be changed."""
        path = self.tree.path
        if self.stands:
            return
        self._make_folders(os.path.dirname(path))
        self._inside = os.path.isdir(path) and is_mount_point(path)
        try:
            self._make_aside(path if self._inside else os.path.dirname(path))
        except PermissionError:
            if not os.path.isdir(path):
                raise
            self._inside = True
            self._make_aside(path)
        if self.tree.entries:
            self._build(self._new)
            self.notes += self._give_attributes(self._new)

    def swap(self) -> None:
        """Let what was built take its place."""
        if self.stands:
            return
        if self._inside:
            self._swap_names()
        else:
            self._swap_whole()
        if self._kept:
            self.notes.append(f"{self.tree.path} differed from the checkpoint; its former content is kept in {self._kept}")

    def settle(self) -> None:
        """Give what did not move itself its attributes."""
        if self.stands:
            for entry in reversed(self.tree.entries):
                give(self.tree.path, entry, entry.name, self._seen[entry.name])
        elif self._inside and self.tree.entries:
            about = os.stat("..", dir_fd=self._held)
            give(self.tree.path, self.tree.entries[0], b"", (about.st_dev, about.st_ino))

    def identities(self) -> dict[Identity, Identity]:
        """Device and inode of everything, then and now."""
        now = [(entry, os.lstat(_at(self.tree.path, entry))) for entry in self.tree.entries]
        return {(entry.device, entry.inode): (about.st_dev, about.st_ino) for entry, about in now}

    def forget_oldest(self) -> None:
        """Keep no more than `KEPT_COUNT` sets of what was replaced."""
        if self._kept:
            above = os.path.dirname(self._kept)
            for old in sorted(os.listdir(above))[:-KEPT_COUNT]:
                shutil.rmtree(os.path.join(above, old), ignore_errors=True)

    def take_back(self) -> tuple[str, ...]:
        """Let everything stand where it stood; a sentence for each thing that does not."""
        if stuck := self._moves.take_back():
            self._is_stuck = True
            return tuple(map(self.called, stuck))
        with contextlib.suppress(OSError):  # earlier sets are in it
            if self._kept:
                os.rmdir(self._kept)
                os.rmdir(os.path.dirname(self._kept))
        self.clear()
        with contextlib.suppress(OSError):  # another program has put something there
            for folder in reversed(self._made):
                os.rmdir(folder)
        return ()

    def clear(self) -> None:
        """Remove what was built and is not needed; never what may hold something that stood at the path."""
        if self._held >= 0:
            if not self._is_stuck:
                self._remove_aside()
            os.close(self._held)
            self._held = -1

    def called(self, path: str) -> str:
        """The name that all programs use for a path of ours."""
        return path.replace(path_of(self._held), self._aside) if self._held >= 0 else path

    def _remove_aside(self) -> None:
        new = self._new
        with contextlib.suppress(OSError):  # it is what we made, and no harm where it lies
            if os.path.isdir(new) and not os.path.islink(new):
                shutil.rmtree(new)
            elif os.path.lexists(new):
                os.unlink(new)
            os.rmdir(self._aside)

    @property
    def _new(self) -> str:
        return os.path.join(path_of(self._held), "new")

    def _make_folders(self, folder: str) -> None:
        """Make the directories that are missing above the path."""
        missing = []
        while not os.path.lexists(folder):
            missing.append(folder)
            folder = os.path.dirname(folder)
        for one in reversed(missing):
            os.mkdir(one)
            self._made.append(one)

    def _make_aside(self, place: str) -> None:
        """Make a folder that only we can change. A user who may write beside it can redirect its name, so we do not use that."""
        self._aside = tempfile.mkdtemp(prefix=os.fsdecode(carried_files.OWN_PREFIX) + "new-", dir=place)
        self._held = os.open(self._aside, os.O_PATH | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
        if not _is_own(path_of(self._held)) or os.listdir(path_of(self._held)):
            raise PermissionError(errno.EPERM, "another folder has its name already", self._aside)

    def _swap_whole(self) -> None:
        """Let a file or folder take the place of another."""
        path, entries, new = self.tree.path, self.tree.entries, self._new
        if os.path.lexists(path):
            self._make_kept(os.path.dirname(path))
            target = os.path.join(self._kept, os.path.basename(path))
            if entries and self._moves.exchange(new, path):
                self._moves.rename(new, target)
                return
            self._moves.rename(path, target)
        if entries:
            self._moves.rename(new, path)

    def _swap_names(self) -> None:
        """Let each name of a folder take the place of another, for the folder itself cannot move."""
        path = self.tree.path
        standing = [name for name in os.listdir(path) if not os.fsencode(name).startswith(carried_files.OWN_PREFIX)]
        if standing:
            self._make_kept(path)
        for name in standing:
            self._moves.rename(os.path.join(path, name), os.path.join(self._kept, name))
        for name in os.listdir(self._new) if self.tree.entries else ():
            self._moves.rename(os.path.join(self._new, name), os.path.join(path, name))

    def _make_kept(self, place: str) -> None:
        """A new folder for replaced files."""
        above = os.path.join(place, f"{os.fsdecode(carried_files.OWN_PREFIX)}kept-{os.path.basename(self.tree.path)}")
        with contextlib.suppress(FileExistsError):
            os.mkdir(above, 0o700)
        if not _is_own(above):
            above = tempfile.mkdtemp(prefix=f"{os.path.basename(above)}-", dir=place)
        now_ns = time.time_ns()
        stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime(now_ns // 1_000_000_000)) + f".{now_ns // 1_000_000 % 1000:03}Z"
        kept = os.path.join(above, f"{stamp}-{self.position}")
        os.mkdir(kept, 0o700)
        self._kept = kept

    # Building

    def _build(self, new: str) -> None:
        """Make everything at another path."""
        made: dict[int, str] = {}
        for entry in self.tree.entries:
            path = _at(new, entry)
            if entry.is_directory:
                os.mkdir(path, 0o700)
            elif stat.S_ISLNK(entry.mode):
                os.symlink(entry.target, os.fsencode(path))
            elif stat.S_ISFIFO(entry.mode):
                os.mkfifo(path, 0o600)
            elif entry.place in made:
                os.link(made[entry.place], path)
            else:
                made[entry.place] = path
                _write(path, entry, self.pieces.get(entry.place, []))

    def _give_attributes(self, top: str) -> list[str]:
        """Owners, modes, times, of what lies in a folder before its own; a note for owners that could not be given.

        Raises:
            PermissionError: where root restores for a user: that user would be given another one's file.
        """
        strangers = [self._called(entry) for entry in reversed(self.tree.entries) if not give(top, entry, entry.name)]
        if not strangers:
            return []
        if os.geteuid() == ROOT:
            raise PermissionError(errno.EPERM, f"it would belong to uid {own_uid()}, not to its owner", strangers[0])
        more = f" and {len(strangers) - 1} more" if len(strangers) > 1 else ""
        return [
            f"{strangers[0]}{more} belongs to the user that the program runs as, not to its former owner: "
            "only root gives files away"
        ]

    def _called(self, entry: Entry) -> str:
        return _at(self.tree.path, entry)

    # Comparing

    def _is_there(self) -> bool:
        """Whether all of it stands there already, content and all, and nothing besides."""
        path, entries = self.tree.path, self.tree.entries
        names = {b""} if os.path.lexists(path) else set()
        if entries and entries[0].is_directory and os.path.isdir(path):
            names |= set(_names_below(path))
        return names == {entry.name for entry in entries} and all(self._is_same(entry) for entry in entries)

    def _is_same(self, entry: Entry) -> bool:
        path = _at(self.tree.path, entry)
        about = os.lstat(path)
        self._seen[entry.name] = about.st_dev, about.st_ino
        if (about.st_mode, about.st_uid, about.st_gid) != (entry.mode, entry.uid, entry.gid):
            return False
        if stat.S_ISLNK(entry.mode):
            return os.fsencode(os.readlink(path)) == entry.target
        if not entry.is_file:
            return True
        links = sum(other.place == entry.place for other in self.tree.entries)
        if about.st_size != entry.size or about.st_nlink != links:
            return False
        return _holds(path, entry, self.pieces.get(entry.place, []), self._seen[entry.name])


def _is_own(folder: str) -> bool:
    """Whether it is no link and ours alone: another owner would have us remove, or could see, its content."""
    about = os.stat(folder) if folder.startswith(DESCRIPTORS) else os.lstat(folder)
    return stat.S_ISDIR(about.st_mode) and about.st_uid == own_uid() and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _at(top: str, entry: Entry) -> str:
    return os.path.join(top, os.fsdecode(entry.name)) if entry.name else top


def _names_below(path: str) -> Iterator[bytes]:
    """All names below a folder, relative to it, but our own."""
    top = os.fsencode(path)
    for folder, folders, files in os.walk(top):
        for name in (*folders, *files):
            relative = os.path.relpath(os.path.join(folder, name), top)
            if not relative.startswith(carried_files.OWN_PREFIX):
                yield relative


def _write(path: str, entry: Entry, pieces: list[tuple[int, memoryview]]) -> None:
    """Make a regular file; what no piece holds is a hole."""
    file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        for offset, content in pieces:
            rest = content[: max(entry.size - offset, 0)]
            while rest:
                count = os.pwrite(file, rest, offset)
                rest, offset = rest[count:], offset + count
        os.ftruncate(file, entry.size)
    except OSError as error:
        error.filename = path
        raise
    finally:
        os.close(file)


def _holds(path: str, entry: Entry, pieces: list[tuple[int, memoryview]], identity: Identity) -> bool:
    """Whether a file, which must be that one still, has exactly this content."""
    if entry.size > sum(len(content) for _, content in pieces) + carried_files.FIXED_SIZE:
        return False  # mostly holes: made anew rather than read
    expected = bytearray(entry.size)
    for offset, content in pieces:
        expected[offset : min(offset + len(content), entry.size)] = content[: max(entry.size - offset, 0)]
    with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        about = os.fstat(file.fileno())
        return (about.st_dev, about.st_ino) == identity and file.read() == expected
