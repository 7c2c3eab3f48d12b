"""Unix sockets whose file got another name beside the one that bind(2) was told: by rename(2), or link(2) and unlink(2).

So a program puts its listener where clients look for it, ready and with its rights, at one stroke (supervisord, OpenSSH). The
kernel follows a file that is renamed; of one that was linked it tells the name that is gone, and the other is looked for beside
that. A restore binds the old name, links the file to the other one, and removes the old one.

Source: unix(7), rename(2), link(2); d_path() in fs/d_path.c.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Mapping
from itertools import islice
from typing import Final

from checkpoint.linux import procfs
from checkpoint.model import Fact

ENTRIES_MAX: Final = 4096
"""Of a directory so many are looked through for another name."""


def name_beside(outlook: str, path: str, about: os.stat_result) -> str:
    """The name that a file has in the directory of one that it had; "" without one.

    Args:
        outlook: what leads to where the program's paths begin.
    """
    directory = os.path.dirname(path)
    try:
        with os.scandir(f"{outlook}{directory}") as entries:
            for entry in islice(entries, ENTRIES_MAX):
                if entry.inode() == about.st_ino and entry.stat(follow_symlinks=False).st_dev == about.st_dev:
                    return os.path.join(directory, entry.name)
    except OSError:  # it is gone, or closed to us
        return ""
    return ""


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
