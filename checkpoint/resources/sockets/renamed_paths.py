"""Find unix sockets whose file has another name beside the one given to bind(2): by rename(2), or link(2) and unlink(2).

In this way programs put a listener where clients look for it, ready and with its rights, in one step (supervisord, OpenSSH). The
kernel follows a file that is renamed. For a file that was linked it reports the lost name, and the search looks for the other one
beside it. A caller that may not ask the kernel for the file, but only for its number, looks beside the name for both. A restore
binds the old name, links the file to the other one, and removes the old one.

Source: unix(7), rename(2), link(2); d_path() in fs/d_path.c.
"""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Callable, Mapping
from itertools import islice
from typing import Final

from checkpoint.linux.net.unix_diag import BoundFile
from checkpoint.linux.procfs import procfs
from checkpoint.model import Fact

ENTRIES_MAX: Final = 4096
"""Entries of a directory that are looked through for another name."""


def name_beside(outlook: str, path: str, may_be: Callable[[int], bool], device: int) -> str:
    """The name that a file has in the directory of one that it had; "" without one.

    Args:
        outlook: the path at which the program's paths begin.
        may_be: whether an inode of its file system's ``device`` is its.
    """
    directory = os.path.dirname(path)
    try:
        with os.scandir(f"{outlook}{directory}") as entries:
            for entry in islice(entries, ENTRIES_MAX):
                if may_be(entry.inode()) and _is_socket_of(entry.stat(follow_symlinks=False), device):
                    return os.path.join(directory, entry.name)
    except OSError:  # it is gone, or closed to us
        return ""
    return ""


def _is_socket_of(about: os.stat_result, device: int) -> bool:
    return about.st_dev == device and stat.S_ISSOCK(about.st_mode)


def socket_at(path: str) -> os.stat_result | None:
    """The stat(2) of a path, if it is a socket."""
    with contextlib.suppress(OSError):
        about = os.stat(path)
        return about if stat.S_ISSOCK(about.st_mode) else None
    return None


def by_number(outlook: str, path: str, file: BoundFile | None) -> tuple[str, os.stat_result | None]:
    """Where a file lies, and its stat(2); None if it has no name here.

    An ordinary user may not ask a socket for its file, but for the number of that. Where the file is nowhere beside the name
    that it was bound to, the kernel does not tell him whether it has another name far away or none.

    Args:
        path: the name that it was bound to; it counts where the number says nothing: on a file system that tells others.
    """
    about = socket_at(f"{outlook}{path}")
    if file is None or _device_of(f"{outlook}{os.path.dirname(path)}") != file.device:
        return path, about
    if about is not None and about.st_dev == file.device and file.may_be(about.st_ino):
        return path, about
    other = name_beside(outlook, path, file.may_be, file.device)
    return (other, socket_at(f"{outlook}{other}")) if other else (path, None)


def _device_of(path: str) -> int:
    with contextlib.suppress(OSError):
        return os.stat(path).st_dev
    return 0


def beside(path: str, told: str) -> str:
    """The path of a file by the last part of the name that bind(2) was told."""
    return os.path.join(os.path.dirname(os.path.normpath(path)), os.path.basename(os.path.normpath(told)))


def place_of(facts: Mapping[str, Fact], told: str) -> str:
    """Where the file of a socket lay when it was bound; only of one that has another name."""
    return beside(str(facts["path"]), told)


def is_moved(facts: Mapping[str, Fact]) -> bool:
    """Whether its file has another name beside that; snapshots of before do not tell."""
    return bool(facts.get("moved", False))


def leads_to(path: str, about: os.stat_result) -> bool:
    """Whether a path leads to a certain file."""
    with contextlib.suppress(OSError):
        found = os.lstat(path)
        return (found.st_dev, found.st_ino) == (about.st_dev, about.st_ino)
    return False


def has_moved(pid: int, told: str, path: str, about: os.stat_result | None, root: str, working: str) -> bool:
    """Whether the name that bind(2) was told leads to its file no more."""
    assert about is not None
    if root:  # a link there may begin at it, which does not lead us the same way
        return os.path.basename(told) != os.path.basename(path)
    if os.path.isabs(told):
        return not leads_to(f"{procfs.outlook(pid)}{told}", about)
    is_below = f"/{os.path.normpath(path)}".endswith(f"/{os.path.normpath(told)}")
    return not is_below and ".." not in told.split("/") and not leads_to(f"{procfs.outlook(pid)}{working}/{told}", about)


def lies_beside(pid: int, told: str, bound: str, root: str) -> bool:
    """Whether a file that was moved was bound in the directory in which it lies."""
    if not os.path.isabs(told):
        return bound.endswith(f"/{os.path.normpath(told)}")
    if root:
        return bound == os.path.normpath(f"{root}{told}")
    with contextlib.suppress(OSError):
        outlook = procfs.outlook(pid)
        return os.path.samefile(f"{outlook}{os.path.dirname(told)}", f"{outlook}{os.path.dirname(bound)}")
    return False
