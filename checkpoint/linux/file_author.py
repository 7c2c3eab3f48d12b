"""Find which user may have written a snapshot's file: that user's rights bound the rights with which it may be restored.

A snapshot itself says which user it runs as. Root could grant that, so root must know which user wrote the file. The check judges
the opened file, never its name alone: its owner, its mode, its links, the other processes that have it open for writing, and
whether its mount shows true owners. A file of root counts as written by root only where no other user chose which file is at that
path.

Sources: path_resolution(7), symlink(7), inode(7) (sticky bit), fcntl(2) (leases), mount(8) (nosuid).
"""

from __future__ import annotations

import errno
import fcntl
import os
import pwd
import signal
import stat
from pathlib import Path
from typing import Final

from msgspec import Struct

from checkpoint.errors import AuthorError
from checkpoint.linux.procfs import mounts
from checkpoint.snapshot.credentials import Owner

ROOT: Final = 0
WRITABLE_BY_OTHERS: Final = 0o022
"""Group and others; a list of access (ACL) that lets others write shows in the group's bits."""
LINKS_MAX: Final = 40
"""Symbolic links on the way to one file, as the kernel counts them."""
IN_MEMORY: Final = ("tmpfs", "ramfs", "devtmpfs")
"""File systems that the kernel keeps itself: their owners are true, also on a mount without set-user-ID."""
OVERFLOW_GID: Final = Path("/proc/sys/kernel/overflowgid")
"""The group of a user without an account: a file's own group may be that of a directory (set-group-ID), and proves nothing."""


class Author(Struct, frozen=True):
    """Whose word a file is.

    Attributes:
        owner: None: root, which may ask for everything.
        name: of the account, with its number.
        why: one half of a sentence: what shows that.
    """

    owner: Owner | None
    name: str
    why: str


def author_of(file: int, path: str) -> Author:
    """Whose word an open snapshot is, if root restores it.

    Args:
        file: open for reading.
        path: by which it was opened.

    Raises:
        AuthorError: more than one user may have written or chosen it, or the system cannot tell which.
    """
    about = os.fstat(file)
    if not stat.S_ISREG(about.st_mode):
        raise _unknown(path, "it is no regular file, so its author cannot be known")
    if not about.st_nlink:
        raise _unknown(path, "no name leads to it any more, so its author cannot be known")
    if about.st_mode & WRITABLE_BY_OTHERS:
        raise _unknown(
            path, f"others than its owner may write to it (mode {stat.S_IMODE(about.st_mode):o})", f"chmod go-w {path}"
        )
    if _is_being_written(file, path):
        raise _unknown(path, "a process has it open for writing", f"end that process first (fuser -v {path} shows it)")
    if about.st_uid != ROOT:
        return _author(about.st_uid, f"{path} belongs to {named(about.st_uid)}")
    if not _tells_true_owners(file, path):
        why = "it lies on a mount without set-user-ID (nosuid), so its owner proves nothing"
        raise _unknown(path, why)
    return _chosen_by(about, path)


def named(uid: int) -> str:
    """A user, as messages call him."""
    try:
        return f"{pwd.getpwuid(uid).pw_name} (uid {uid})"
    except KeyError:
        return f"uid {uid}"


def account_of(uid: int) -> Owner:
    """A user with the groups of the account, as a login would give them."""
    try:
        account = pwd.getpwuid(uid)
    except KeyError:
        return Owner(uid, int(OVERFLOW_GID.read_text()), ())
    return Owner(uid, account.pw_gid, tuple(os.getgrouplist(account.pw_name, account.pw_gid)))


def _author(uid: int, why: str) -> Author:
    return Author(account_of(uid), named(uid), why)


def _unknown(path: str, why: str, cure: str = "") -> AuthorError:
    first = f"{cure}, or " if cure else "copy it to a directory of root's, as root, "
    first = first if cure else f"{first}if you know where it comes from, or "
    return AuthorError(f"cannot tell whose rights {path} may have: {why}; {first}trust it with all rights of root (--trust)")


def _is_being_written(file: int, path: str) -> bool:
    """Whether a process has the file open, or mapped, for writing: a change of owner or mode does not take that back.

    The kernel grants a lease to read only where none has. Of a file system without leases, or of a network, that is not known.
    """
    try:
        fcntl.fcntl(file, fcntl.F_SETSIG, signal.SIGURG)  # a process that opens it meanwhile waits for us; SIGIO would kill us
        fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_RDLCK)
        fcntl.fcntl(file, fcntl.F_SETLEASE, fcntl.F_UNLCK)
    except OSError as error:
        return error.errno == errno.EAGAIN and not mounts.network_mount(os.getpid(), os.path.realpath(path))
    return False


def _tells_true_owners(file: int, path: str) -> bool:
    """Whether the owners of a mount are this system's word: what users may mount (udisks, fusermount) is without set-user-ID."""
    if not os.fstatvfs(file).f_flag & os.ST_NOSUID:
        return True
    return mounts.type_of_mount(os.getpid(), os.path.realpath(path)) in IN_MEMORY


def _chosen_by(about: os.stat_result, path: str) -> Author:
    """The user besides root that could have put this file of root's, or another one, at its path.

    Each directory and link on the way is looked at.

    Raises:
        AuthorError: several users may have, or any user.
    """
    choosers: dict[int, str] = {}
    place, pending, links, shared = "/", os.path.join(os.getcwd(), path).split("/"), 0, ""
    try:
        while pending:
            part = pending.pop(0)
            if part in ("", "."):
                continue
            if part == "..":
                place = os.path.dirname(place)
                continue
            folder = os.stat(place)
            if folder.st_mode & WRITABLE_BY_OTHERS and not folder.st_mode & stat.S_ISVTX:
                raise _unknown(
                    path, f"every user with write access to {place} could have put another file there", f"chmod go-w {place}"
                )
            shared = shared or (place if folder.st_mode & WRITABLE_BY_OTHERS else "")
            choosers.setdefault(folder.st_uid, place)
            full = os.path.join(place, part)
            found = os.lstat(full)
            if stat.S_ISLNK(found.st_mode):
                links += 1
                choosers.setdefault(found.st_uid, full)
                if links > LINKS_MAX:
                    raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), full)
                target = os.readlink(full)
                place = "/" if target.startswith("/") else place
                pending = [*target.split("/"), *pending]
            else:
                place = full
        reached = os.stat(place, follow_symlinks=False)
    except OSError as error:
        raise _unknown(path, f"cannot examine {error.filename} ({error.strerror})") from error
    if (reached.st_dev, reached.st_ino) != (about.st_dev, about.st_ino):
        raise _unknown(path, "another file has just taken its place")
    if about.st_nlink > 1 and shared:
        raise _unknown(path, f"it has {about.st_nlink} names, and any user may have made the one in {shared}")
    choosers.pop(ROOT, None)
    if not choosers:
        return Author(None, "root", f"{path} belongs to root")
    if len(choosers) > 1:
        who = " and ".join(f"{named(uid)} (by {where})" for uid, where in choosers.items())
        raise _unknown(path, f"{who} could each have put another file there")
    ((uid, where),) = choosers.items()
    return _author(uid, f"{named(uid)} may put another file of root's in the place of {path} ({where} is theirs)")
