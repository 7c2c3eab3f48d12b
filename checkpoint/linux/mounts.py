"""Which file system a path lies on, as a process sees it. Source: proc_pid_mountinfo(5)."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Final

NETWORK_TYPES: Final = frozenset(
    ("nfs", "nfs4", "cifs", "smb3", "smbfs", "9p", "ceph", "afs", "coda", "lustre", "glusterfs", "ocfs2", "gfs2", "beegfs")
)
"""File systems that other machines see, too."""
_ESCAPED: Final = re.compile(rb"\\([0-3][0-7]{2})")
"""Blanks, newlines and backslashes of a mount point, as octal numbers."""

USER_SPACE: Final = "fuse."
"""Of those that a process serves nobody can tell what is behind them: sshfs is one."""


def network_mount(pid: int, path: str) -> str:
    """The type of the network file system that a path lies on; "" if it lies on none, as far as can be told."""
    kind = type_of_mount(pid, path)
    return kind if kind in NETWORK_TYPES or kind.startswith(USER_SPACE) else ""


def type_of_mount(pid: int, path: str) -> str:
    """The type of the file system that a path lies on; "" if that cannot be told."""
    return _type_at(_mounts(pid), path)


def is_mount_point(path: str) -> bool:
    """Whether something is mounted at a path, as we see it: also a directory of the same file system (a bind mount)."""
    return os.path.realpath(path) in dict(_mounts(os.getpid()))


def _type_at(mounts: list[tuple[str, str]], path: str) -> str:
    """Of the innermost mount above a path; of several at one point the last one counts."""
    above = [(point, kind) for point, kind in mounts if path == point or path.startswith(point.rstrip("/") + "/")]
    return max(reversed(above), key=lambda mount: len(mount[0]))[1] if above else ""


def _mounts(pid: int) -> list[tuple[str, str]]:
    """(mount point, type) of each mount, oldest first."""
    try:
        lines = Path(f"/proc/{pid}/mountinfo").read_bytes().split(b"\n")
    except OSError:
        return []
    found = []
    for line in filter(None, lines):
        before, _, after = line.partition(b" - ")
        found.append((unescaped(before.split(b" ")[4]), os.fsdecode(after.split(b" ")[0])))
    return found


def unescaped(point: bytes) -> str:
    """A mount point as mountinfo tells it, as a path."""
    return os.fsdecode(_ESCAPED.sub(lambda found: bytes((int(found[1], 8),)), point))
