"""How much memory the control groups of this process leave to it: the smallest remainder in any of them, up to the outermost.

The module reads both versions, because machines mix them. A group that sets no limit, or that cannot be read, does not count.
Memory that the kernel uses for files counts as free: the kernel releases it before it kills a process.

Source: cgroups(7), cgroup-v2.rst ("Memory Interface Files") and cgroup-v1/memory.rst of the kernel, proc_pid_mountinfo(5).
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from checkpoint.linux.procfs.procfs import lines_of

UNLIMITED: Final = 1 << 60
"""Version 1 says "no limit" by a number that is about the largest there is; this is less, and more than any machine has."""
_CACHED: Final = {2: ("inactive_file", "active_file"), 1: ("total_inactive_file", "total_active_file")}


class _Hierarchy(NamedTuple):
    """Where one version's groups are found: the group that is mounted, and where."""

    version: int
    root: str
    point: Path


def left(free_swap: int, proc: Path = Path("/proc/self")) -> int:
    """Bytes that programs in this process's groups can still have, swap included; `UNLIMITED` where no group says less.

    Args:
        free_swap: bytes of swap that are free on this machine.
    """
    try:
        mounts = (proc / "mountinfo").read_text(errors="surrogateescape")
        groups = (proc / "cgroup").read_text(errors="surrogateescape")
    except OSError:
        return UNLIMITED
    limits = [UNLIMITED]
    for hierarchy in _hierarchies(mounts):
        for group in _groups(hierarchy, groups):
            with contextlib.suppress(OSError, ValueError):
                limits.append(_left_of_2(group, free_swap) if hierarchy.version == 2 else _left_of_1(group, free_swap))
    return max(min(limits), 0)


def _hierarchies(mounts: str) -> Iterator[_Hierarchy]:
    for line in lines_of(mounts):
        before, _, after = line.partition(" - ")
        _, _, _, root, point, *_ = before.split(" ")
        kind, _, options = after.split(" ", 2)
        if kind == "cgroup2":
            yield _Hierarchy(2, root, Path(point))
        elif kind == "cgroup" and "memory" in options.split(","):
            yield _Hierarchy(1, root, Path(point))


def _groups(hierarchy: _Hierarchy, groups: str) -> Iterator[Path]:
    """The directories of our group and of those around it that can be seen, from the inside out."""
    for line in lines_of(groups):
        _, controllers, path = line.split(":", 2)
        if (hierarchy.version == 2) if not controllers else (hierarchy.version == 1 and "memory" in controllers.split(",")):
            inside = os.path.relpath(path, hierarchy.root)
            group = hierarchy.point if inside.startswith("..") else hierarchy.point / inside
            yield from (one for one in (group, *group.parents) if one.is_relative_to(hierarchy.point))


def _left_of_2(group: Path, free_swap: int) -> int:
    limit = _number(group / "memory.max")
    if limit >= UNLIMITED:
        return UNLIMITED
    swap = free_swap
    with contextlib.suppress(OSError):  # a kernel without swap has no such file
        swap = min(swap, _number(group / "memory.swap.max") - _number(group / "memory.swap.current"))
    return limit - _number(group / "memory.current") + _cached(group, 2) + max(swap, 0)


def _left_of_1(group: Path, free_swap: int) -> int:
    limit, cached, whole = _number(group / "memory.limit_in_bytes"), _cached(group, 1), UNLIMITED
    with contextlib.suppress(OSError):  # memory and swap together; only where swap is counted
        whole = _number(group / "memory.memsw.limit_in_bytes") - _number(group / "memory.memsw.usage_in_bytes") + cached
    return min(limit - _number(group / "memory.usage_in_bytes") + cached + free_swap, whole)


def _number(file: Path) -> int:
    told = file.read_text().strip()
    return UNLIMITED if told == "max" else int(told)


def _cached(group: Path, version: int) -> int:
    """Bytes of files that the kernel can let go."""
    told = dict(line.split(" ", 1) for line in (group / "memory.stat").read_text().splitlines())
    return sum(int(told.get(name, 0)) for name in _CACHED[version])
