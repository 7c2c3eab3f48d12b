"""Find the file system of a path, as a process sees it. Source: proc_pid_mountinfo(5)."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Iterable
from typing import Final, NamedTuple

from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux.procfs import procfs

NETWORK_TYPES: Final = frozenset(
    ("nfs", "nfs4", "cifs", "smb3", "smbfs", "9p", "ceph", "afs", "coda", "lustre", "glusterfs", "ocfs2", "gfs2", "beegfs")
)
"""File systems that other machines see, too."""
_ESCAPED: Final = re.compile(rb"\\([0-3][0-7]{2})")
"""Blanks, newlines and backslashes of a mount point, as octal numbers."""

USER_SPACE: Final = "fuse."
"""A process serves such a file system, and nothing tells what is behind it: sshfs is one."""


def network_mount(pid: int, path: str) -> str:
    """The type of the network file system that a path lies on; "" if it lies on none, as far as can be told."""
    kind = type_of_mount(pid, path)
    return kind if kind in NETWORK_TYPES or kind.startswith(USER_SPACE) else ""


def type_of_mount(pid: int, path: str) -> str:
    """The type of the file system that a path lies on; "" if that cannot be told."""
    return _at(_mounts(pid), path)


def is_mount_point(path: str) -> bool:
    """Whether something is mounted at a path, as we see it: also a directory of the same file system (a bind mount)."""
    return os.path.realpath(path) in dict(_mounts(os.getpid()))


def innermost(mounts: Iterable[Mount], path: str) -> str:
    """The number of the innermost mount above a path, which is what is found there; "" without one."""
    return _at([(one.point, one.number) for one in mounts], path)


def _at(mounts: list[tuple[str, str]], path: str) -> str:
    """The entry of the innermost mount above a path; of several at one point the last one counts."""
    above = [(point, told) for point, told in mounts if path == point or path.startswith(point.rstrip("/") + "/")]
    return max(reversed(above), key=lambda mount: len(mount[0]))[1] if above else ""


def _mounts(pid: int) -> list[tuple[str, str]]:
    """(mount point, type) of each mount, oldest first."""
    return [(one.point, one.kind) for one in mounts_of(pid)]


class Mount(NamedTuple):
    """A mount: its number, ``major:minor`` of its device, its path and the type of its file system."""

    number: str
    device: str
    point: str
    kind: str


def mounts_of(pid: int) -> list[Mount]:
    """Each mount that a process sees, oldest first; nothing of one that is gone.

    Of one with a root directory of its own (chroot) the kernel tells what lies below that, and from there: then ours count, if it
    lives among them.
    """
    root = ""
    with contextlib.suppress(OSError):  # not ours to look at: then what it sees counts
        root = os.readlink(f"/proc/{pid}/root").rstrip("/")
        if root and os.readlink(f"/proc/{pid}/ns/mnt") == os.readlink("/proc/self/ns/mnt"):
            pid, root = os.getpid(), ""
    try:
        lines = procfs.read_bytes(pid, "mountinfo").split(b"\n")
    except (ProbeError, ProcessGoneError):
        return []
    found = []
    for line in filter(None, lines):
        before, _, after = line.partition(b" - ")
        words = before.split(b" ")
        point, kind = (root + unescaped(words[4])).rstrip("/") or "/", os.fsdecode(after.split(b" ")[0])
        found.append(Mount(os.fsdecode(words[0]), os.fsdecode(words[2]), point, kind))
    return found


def unescaped(point: bytes) -> str:
    """A mount point as mountinfo tells it, as a path."""
    return os.fsdecode(_ESCAPED.sub(lambda found: bytes((int(found[1], 8),)), point))
