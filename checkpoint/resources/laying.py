"""Carried files (rule ``carry``) on the side that restores: laid down as they were at the checkpoint, before the program runs.

1. Everything is built aside, in ``.failover-new-…`` beside the carried path, from the snapshot alone. Whatever fails until
   here has changed nothing.
2. What stands at the path and is not as the checkpoint has it, whosever it is and however new, is kept: it moves as a whole to
   ``.failover-kept-NAME/TIME-POSITION`` beside the path, and a note says so. The newest `KEPT_COUNT` of those stay.
   A file that somebody else holds open for writing is never replaced: the restore is refused, by that process's name.
3. What was built takes its place in the same instant (RENAME_EXCHANGE of renameat2(2)), also for a whole folder. Where that
   cannot be, because the folder is a mount point or its parent is not writable, each name in it is moved by itself.

Nothing is forced to the disk: should the power go, the checkpoint is still in the store and is laid down again.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from checkpoint import carried
from checkpoint.carried import Entry, Tree
from checkpoint.errors import MismatchError, RestoreError
from checkpoint.linux.eyes import Eyes, own_uid, seeing_as
from checkpoint.linux.mounts import is_mount_point
from checkpoint.model import Snapshot
from checkpoint.resources import writers
from checkpoint.resources.remembered import Identity
from checkpoint.validity import place as position_text

KEPT_COUNT: Final = 4
"""Sets of replaced files that are kept for each carried path; the oldest goes when there are more."""
AT_FDCWD: Final = -100
RENAME_EXCHANGE: Final = 2
_LIBC: Final = ctypes.CDLL(None, use_errno=True)

Pieces = Mapping[int, list[tuple[int, memoryview]]]
"""By place: (offset in the file, bytes in whole pages)."""


@dataclass(frozen=True, slots=True)
class Laid:
    """What was laid down.

    Attributes:
        notes: a sentence for each difference.
        identities: device and inode of each carried file, then and now.
    """

    notes: tuple[str, ...] = ()
    identities: Mapping[Identity, Identity] = field(default_factory=dict)


def lay_down_for(state: Snapshot, pid: int, *, own_eyes: bool) -> Laid:
    """Put all carried files of a base where they belong, before its program runs; see `lay_down`.

    Args:
        pid: what is to become the program, or ourselves.
        own_eyes: with the rights of the program's own user, not with ours.
    """
    if not carried.paths_of(state):
        return Laid()
    theirs = state.process.credentials
    eyes = Eyes(theirs.uids[3], theirs.gids[3], theirs.groups) if own_eyes else None
    return lay_down(state, eyes, writers.family(os.getpid()) | writers.family(pid))


def lay_down(state: Snapshot, eyes: Eyes | None, spared: frozenset[int]) -> Laid:
    """Put all carried files of a base where they belong.

    Args:
        eyes: with whose rights; None: our own.
        spared: processes that may hold the files open: those that restore.

    Raises:
        MismatchError: another process writes to what is to be replaced.
        RestoreError: there is no room, or no right; what stood there stands there still.
    """
    trees, pieces = carried.trees_of(state), carried.pieces(state)
    for tree in trees:
        _require_unwritten(state, tree, spared)
    notes: list[str] = []
    identities: dict[Identity, Identity] = {}
    for tree in trees:
        try:
            with seeing_as(eyes):
                laying = _Laying(tree, pieces, position_text(state.position))
                notes += laying.run()
                identities |= laying.identities()
        except OSError as error:
            raise RestoreError(
                f"cannot lay down {tree.path}, which {state.component} carries ({error.filename or 'there'}: {error.strerror}); "
                "see to room and rights there"
            ) from error
    return Laid(tuple(notes), identities)


def _require_unwritten(state: Snapshot, tree: Tree, spared: frozenset[int]) -> None:
    """Raises MismatchError: somebody would go on writing to files that the program takes for its own."""
    for path in _files_below(tree.path):
        if writers.may_be_written(path) and (pid := writers.writer_of(path, spared)):
            reason = f"{path}, which the program carries, is held open for writing by pid {pid}: end that first"
            raise MismatchError(f"cannot restore {state.component} here: {reason}", (reason,))


def _files_below(path: str) -> Iterator[str]:
    if os.path.isfile(path) and not os.path.islink(path):
        yield path
    for folder, _, names in os.walk(path):
        for name in names:
            full = os.path.join(folder, name)
            if not os.fsencode(os.path.relpath(full, path)).startswith(carried.OWN_PREFIX) and os.path.isfile(full):
                yield full


@dataclass(slots=True)
class _Laying:
    """One tree on its way to its path."""

    tree: Tree
    pieces: Pieces
    position: str

    def run(self) -> list[str]:
        """A note for each difference.

        Raises:
            OSError: it does not work; what stood there stands there still.
        """
        path, entries = self.tree.path, self.tree.entries
        if self._is_there():
            self._give_attributes(path)
            return []
        held_size = sum(len(content) for one in {entry.place for entry in entries} for _, content in self.pieces.get(one, []))
        if reason := carried.lack_of_room(path, held_size):
            raise RestoreError(f"cannot lay down {path}: {reason}")
        os.makedirs(os.path.dirname(path), exist_ok=True)
        inside = os.path.isdir(path) and is_mount_point(path)
        try:
            aside = self._aside(path if inside else os.path.dirname(path))
        except PermissionError:
            if not os.path.isdir(path):
                raise
            inside, aside = True, self._aside(path)
        try:
            return self._replaced(os.path.join(aside, "new"), inside=inside)
        finally:
            shutil.rmtree(aside, ignore_errors=True)

    def identities(self) -> dict[Identity, Identity]:
        """Device and inode of everything, then and now."""
        now = [(entry, os.lstat(_at(self.tree.path, entry))) for entry in self.tree.entries]
        return {(entry.device, entry.inode): (about.st_dev, about.st_ino) for entry, about in now}

    def _aside(self, place: str) -> str:
        return tempfile.mkdtemp(prefix=os.fsdecode(carried.OWN_PREFIX) + "new-", dir=place)

    def _replaced(self, new: str, *, inside: bool) -> list[str]:
        """Build it aside, then let it take its place."""
        path, entries = self.tree.path, self.tree.entries
        notes = self._build(new) if entries else []
        if inside:
            kept = self._swap_names(new)
            if entries:
                _give(path, entries[0])
        else:
            kept = self._swap_whole(new)
        if kept:
            notes.append(f"{path} was not as the checkpoint has it; what stood there is kept in {kept}")
        return notes

    def _swap_whole(self, new: str) -> str:
        """Let a file or folder take the place of another; where that is kept, "" if there was none."""
        path, entries = self.tree.path, self.tree.entries
        if not os.path.lexists(path):
            if entries:
                os.rename(new, path)
            return ""
        kept = self._kept(os.path.dirname(path))
        target = os.path.join(kept, os.path.basename(path))
        if entries and _exchange(new, path):
            os.rename(new, target)
        else:
            os.rename(path, target)
            if entries:
                os.rename(new, path)
        return kept

    def _swap_names(self, new: str) -> str:
        """Let each name of a folder take the place of another, for the folder itself cannot move."""
        path = self.tree.path
        standing = [name for name in os.listdir(path) if not os.fsencode(name).startswith(carried.OWN_PREFIX)]
        kept = self._kept(path) if standing else ""
        for name in standing:
            os.rename(os.path.join(path, name), os.path.join(kept, name))
        for name in os.listdir(new) if self.tree.entries else ():
            os.rename(os.path.join(new, name), os.path.join(path, name))
        return kept

    def _kept(self, place: str) -> str:
        """A new folder for what is replaced, and no more than `KEPT_COUNT` of them."""
        above = os.path.join(place, f"{os.fsdecode(carried.OWN_PREFIX)}kept-{os.path.basename(self.tree.path)}")
        with contextlib.suppress(FileExistsError):
            os.mkdir(above, 0o700)
        if not _is_own(above):
            above = tempfile.mkdtemp(prefix=f"{os.path.basename(above)}-", dir=place)
        now_ns = time.time_ns()
        stamp = time.strftime("%Y%m%dT%H%M%S", time.gmtime(now_ns // 1_000_000_000)) + f".{now_ns // 1_000_000 % 1000:03}Z"
        for old in sorted(os.listdir(above))[: 1 - KEPT_COUNT]:
            shutil.rmtree(os.path.join(above, old), ignore_errors=True)
        kept = os.path.join(above, f"{stamp}-{self.position}")
        os.mkdir(kept, 0o700)
        return kept

    # Building

    def _build(self, new: str) -> list[str]:
        """Make everything at another path; a note for each owner that it could not be given."""
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
        return self._give_attributes(new)

    def _give_attributes(self, top: str) -> list[str]:
        """Owners, modes, times: what lies in a folder first, for it changes the folder's times."""
        strangers = [self._called(entry) for entry in reversed(self.tree.entries) if not _give(_at(top, entry), entry)]
        if not strangers:
            return []
        more = f" and {len(strangers) - 1} more" if len(strangers) > 1 else ""
        return [f"{strangers[0]}{more} belongs to whom the program runs as, not to its former owner: only root gives files away"]

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
        if (about.st_mode, about.st_uid, about.st_gid) != (entry.mode, entry.uid, entry.gid):
            return False
        if stat.S_ISLNK(entry.mode):
            return os.fsencode(os.readlink(path)) == entry.target
        if not entry.is_file:
            return True
        links = sum(other.place == entry.place for other in self.tree.entries)
        return about.st_size == entry.size and about.st_nlink == links and _holds(path, entry, self.pieces.get(entry.place, []))


def _is_own(folder: str) -> bool:
    """Whether it is no link and nobody else's, who would have us remove, or could see, what is in it."""
    about = os.lstat(folder)
    return stat.S_ISDIR(about.st_mode) and about.st_uid == own_uid() and not about.st_mode & (stat.S_IWGRP | stat.S_IWOTH)


def _exchange(one: str, other: str) -> bool:
    """Let two names change places in one instant; False where this file system or kernel cannot.

    Raises:
        OSError: it fails for another reason.
    """
    if _LIBC.renameat2(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE) == 0:
        return True
    number = ctypes.get_errno()
    if number in (errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP):
        return False
    raise OSError(number, os.strerror(number), other)


def _at(top: str, entry: Entry) -> str:
    return os.path.join(top, os.fsdecode(entry.name)) if entry.name else top


def _names_below(path: str) -> Iterator[bytes]:
    """All names below a folder, relative to it, but our own."""
    top = os.fsencode(path)
    for folder, folders, files in os.walk(top):
        for name in (*folders, *files):
            relative = os.path.relpath(os.path.join(folder, name), top)
            if not relative.startswith(carried.OWN_PREFIX):
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


def _holds(path: str, entry: Entry, pieces: list[tuple[int, memoryview]]) -> bool:
    """Whether a file has exactly this content."""
    if entry.size > sum(len(content) for _, content in pieces) + carried.FIXED_SIZE:
        return False  # mostly holes: made anew rather than read
    expected = bytearray(entry.size)
    for offset, content in pieces:
        expected[offset : min(offset + len(content), entry.size)] = content[: max(entry.size - offset, 0)]
    return Path(path).read_bytes() == expected


def _give(path: str, entry: Entry) -> bool:
    """Give a name its owner, mode, attributes and time; whether it has its owner now."""
    is_its = True
    about = os.lstat(path)
    if (about.st_uid, about.st_gid) != (entry.uid, entry.gid):
        try:
            os.lchown(path, entry.uid, entry.gid)
        except PermissionError:
            is_its = False
    if not stat.S_ISLNK(entry.mode):
        os.chmod(path, stat.S_IMODE(entry.mode))
        for name, value in entry.attributes:
            with contextlib.suppress(OSError):  # a file system without: content and rights are what counts
                os.setxattr(path, name, value)
    os.utime(path, ns=(entry.mtime_ns, entry.mtime_ns), follow_symlinks=False)
    return is_its
