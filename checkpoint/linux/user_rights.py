"""Open files with a user's rights instead of our own, so that a user gets no access to a file that he may not read or write.

Only file access changes: the process keeps its identity, so it can continue to trace. Source: setfsuid(2), which also takes the
superuser's rights over files away, and gives them back (capabilities(7)); it affects the calling thread.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from msgspec import Struct

from checkpoint.linux.procfs import procfs
from checkpoint.snapshot.credentials import Owner

_LIBC: Final = ctypes.CDLL(None, use_errno=True)
ROOT: Final = 0


class Eyes(Struct, frozen=True):
    """Whose rights count for files."""

    uid: int
    gid: int
    groups: tuple[int, ...] = ()


def eyes_for(pid: int, owner: Owner | None) -> Eyes:
    """With whose rights files are opened for a process: its owner's. It chooses their names, and may have other rights by now.

    Args:
        owner: None: not known; those that the process has now.

    Raises:
        ProcessGoneError: it has ended.
    """
    if owner is not None and owner.groups is not None:
        return Eyes(owner.uid, owner.gid, owner.groups)
    status = procfs.status(pid)
    return Eyes(status.uids[3] if owner is None else owner.uid, status.gids[3], status.groups)


def own_uid() -> int:
    """The user whose rights to files count just now; new files belong to him. Source: setfsuid(2), which always answers."""
    return int(_LIBC.setfsuid(-1)) & 0xFFFFFFFF


def own_eyes() -> Eyes | None:
    """Our own rights; None: root's."""
    return Eyes(os.geteuid(), os.getegid(), tuple(os.getgroups())) if os.geteuid() != ROOT else None


@contextmanager
def seeing_as(eyes: Eyes | None) -> Iterator[None]:
    """Use a user's rights to files in the body; nothing changes for None, for root, and where we are not root.

    The body must import nothing for the first time: modules are files, too, that this user may not be able to read.
    """
    if eyes is None or eyes.uid == ROOT or os.geteuid() != ROOT:
        yield
        return
    groups = os.getgroups()
    os.setgroups(eyes.groups)
    _LIBC.setfsgid(eyes.gid)
    _LIBC.setfsuid(eyes.uid)
    try:
        yield
    finally:
        _LIBC.setfsuid(ROOT)
        _LIBC.setfsgid(os.getegid())
        os.setgroups(groups)
