"""Refuse shared memory that other programs also have: data that they exchange cannot move with one of them.

The check covers memory files, files in /dev/shm and deleted files. Other files that are mapped shared lie on a disk, where every
robot has its own.

Source: proc_pid_maps(5).
"""

from __future__ import annotations

import os
import re
import time
from collections.abc import Collection, Iterable, Iterator
from functools import lru_cache
from typing import Final

from checkpoint.capability import Area, refused
from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux.memory.tracker import ANONYMOUS, MEMORY_PLACE
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.procfs import DELETED, MapsLine

CAPABILITIES: Final = (
    refused(
        Area.MEMORY,
        "shared memory that another process has mapped, too",
        "protect the program after the other process has ended",
        "which stays behind: protect the program",
    ),
)

_MAPPED: Final = re.compile(rb"^\S+ ...s \S+ (\S+ [1-9]\d*) +(/dev/shm/.*|.* \(deleted\))$", re.MULTILINE)
"""Device and inode number, and the name."""
FOREBEARS: Final = 8
"""Of a process that are looked at: who is born while a component is looked at has few."""


def refuse(pid: int, lines: Iterable[MapsLine], kin: Collection[int] = ()) -> Iterator[str]:
    """Why shared memory of a process cannot be kept: one sentence for each object that another one has mapped as well.

    Args:
        lines: its mappings.
        kin: all processes of its component.
    """
    asker = min(kin, default=pid)
    for key, name in dict(_objects_of(lines)).items():
        mappers = _mappers(asker, time.monotonic_ns() // 1_000_000_000).get(key, ())
        others = [other for other in mappers if other != pid and other not in kin and not _belongs(other, {pid, *kin})]
        if others:
            yield (
                f"the shared memory {name} is mapped by pid {others[0]} too, which stays behind: protect the "
                "program when that has ended"
            )


def _belongs(other: int, kin: Collection[int]) -> bool:
    """Whether a process was born of these since they were looked at, or has ended since."""
    forebear, is_there = other, False
    try:
        for _ in range(FOREBEARS):
            if forebear in kin:
                return True
            forebear, is_there = procfs.stat(forebear).ppid, True
    except ProcessGoneError:
        return not is_there  # else it is a forebear that has ended, or there is none
    return False


def _objects_of(lines: Iterable[MapsLine]) -> Iterator[tuple[bytes, str]]:
    """As `_objects`, of mappings that have been read."""
    for line in lines:
        is_object = line.name.startswith(MEMORY_PLACE) or (line.name.endswith(DELETED) and line.name != ANONYMOUS)
        if line.shared and line.inode and is_object:
            yield b"%02x:%02x %d" % (os.major(line.device), os.minor(line.device), line.inode), line.name


def _objects(pid: int) -> Iterator[tuple[bytes, bytes]]:
    for key, name in _MAPPED.findall(procfs.read_bytes(pid, "maps")):
        if os.fsdecode(name) != ANONYMOUS:
            yield key, name


@lru_cache(maxsize=1)
def _mappers(asker: int, second: int) -> dict[bytes, list[int]]:
    """Who has mapped which object: processes by device and inode number.

    Args:
        asker: a process of the component about which it is asked: each looks for itself.
        second: of our clock; all that is asked within one second looks once.
    """
    found: dict[bytes, list[int]] = {}
    for other in os.listdir("/proc"):
        if not other.isdigit() or int(other) == os.getpid():
            continue
        try:
            objects = dict(_objects(int(other)))
        except (ProbeError, ProcessGoneError):  # another user's, or ended meanwhile
            continue
        for key in objects:
            found.setdefault(key, []).append(int(other))
    return found
