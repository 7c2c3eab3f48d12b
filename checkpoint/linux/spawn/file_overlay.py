"""Show a program its missing files at their expected paths: in memory, in its own mounts, invisible to other programs.

A child calls this module between its creation and its execve. Other programs see only an empty directory, which is made with the
rights of the program's user and over which the files are mounted. Everything but the mount itself is done with those rights: a
user that puts a link in the way can cause no write that he could not make himself.

Source: mount(2), tmpfs(5), seteuid(2), setgroups(2).
"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator, Sequence
from pathlib import Path

from msgspec import Struct

from checkpoint.linux.abi import PAGE_SIZE
from checkpoint.linux.spawn import namespaces

PART_SIZE = 1 << 20
"""Bytes copied at a time."""
ROOM = 64 << 20
"""Bytes that the program may add in memory to what was brought; without a limit it were half of the machine's."""


class User(Struct, frozen=True):
    """Whose program it is; ``groups``: the supplementary ones."""

    uid: int
    gid: int
    groups: tuple[int, ...] = ()


class BroughtFile(Struct, frozen=True):
    """One file.

    Attributes:
        path: where the program expects it, absolute.
        content: where its content is kept on this machine.
        mode: permissions.
    """

    path: str
    content: str
    mode: int


def show(files: Sequence[BroughtFile], user: User, *, own_mounts: bool) -> None:
    """Have the files there, unless the first one, which is started, is there already: that was installed, and is used.

    Args:
        own_mounts: the caller has a mount namespace of its own.

    Raises:
        OSError: they cannot be shown; says why.
    """
    if not files or os.path.lexists(files[0].path):
        return
    if not own_mounts:
        reason = "is not here, and its brought copy can be shown only to a program with mounts of its own (isolate = true)"
        raise OSError(errno.ENOENT, reason, files[0].path)
    contents = [os.open(file.content, os.O_RDONLY | os.O_CLOEXEC) for file in files]
    with _as_user(user):
        place = _place_for(files, user)
    size = sum(os.fstat(content).st_size for content in contents) + len(files) * PAGE_SIZE
    namespaces.mount_memory(place, user.uid, user.gid, size + ROOM)
    os.close(place)
    with _as_user(user):
        for file, content in zip(files, contents, strict=True):
            _copy(file, content)
    for content in contents:
        os.close(content)


@contextlib.contextmanager
def _as_user(user: User) -> Iterator[None]:
    """Touch files with the rights of the program's user, and with none that our own groups have."""
    uid, gid, groups = os.geteuid(), os.getegid(), os.getgroups()
    others = user.uid != uid
    if others:
        os.setgroups(user.groups)
    os.setegid(user.gid)
    os.seteuid(user.uid)
    try:
        yield
    finally:
        os.seteuid(uid)
        os.setegid(gid)
        if others:
            os.setgroups(groups)


def _place_for(files: Sequence[BroughtFile], user: User) -> int:
    """A descriptor of an empty directory of the user's that all files are below; it is made if need be.

    Raises:
        OSError: there is something else, which mounting would hide.
    """
    folder = Path(os.path.commonpath([os.path.dirname(file.path) for file in files]))
    missing = [one for one in (folder, *folder.parents) if not os.path.lexists(one)]
    if missing:
        folder = missing[-1]
        folder.mkdir(mode=0o755)
    place = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    if os.fstat(place).st_uid != user.uid or os.listdir(place):
        os.close(place)
        raise OSError(errno.EEXIST, "holds other files, or belongs to another user: install the program there", str(folder))
    return place


def _copy(file: BroughtFile, content: int) -> None:
    os.makedirs(os.path.dirname(file.path), mode=0o755, exist_ok=True)
    target = os.open(file.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, file.mode)
    try:
        offset = 0
        while part := os.pread(content, PART_SIZE, offset):
            offset += os.write(target, part)
        os.fchmod(target, file.mode)
    finally:
        os.close(target)
