"""Find a name that still leads to a file whose name of opening is gone: the inode is the file, not the name.

The kernel reports for each mapping and each descriptor the name by which it was opened. sem_open(3) makes a file under a
temporary name, maps it, links it to the real name and unlinks the temporary one: the mapping of the process that made the
semaphore looks deleted, the mappings of all others do not. The names that the other processes of the component have for the file
count first. Then the search looks beside the lost name, above it, and in the working directory of the process.

Source: d_path() in fs/d_path.c; link(2); sem_open() in nptl/sem_open.c of glibc.
"""

from __future__ import annotations

import contextlib
import os
import re
import stat
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Final

from checkpoint.errors import ProbeError, ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.procfs import DELETED

LEVELS: Final = 3
"""In how many directories, from its own upwards, another name of a deleted file is looked for."""
ENTRIES_MAX: Final = 10_000
"""Entries of each that are looked at: some milliseconds."""

File = tuple[int, int]
"""Device and inode number, as stat(2) tells them."""


def name_of(path: str, file: File, pids: Sequence[int], mapped_on: int = 0) -> str:
    """A name that leads to a file; "" where none is known.

    Args:
        path: the name that it had.
        pids: the process that has it, and then the other processes of the component.
        mapped_on: the device as the mappings tell it, where the file itself cannot be asked: btrfs and overlayfs have two
            numbers for one.
    """
    named = {name for pid in pids for name in _names_held(pid, file, mapped_on)}
    return min(named) if named else _name_near(path, file, pids[0])


def _names_held(pid: int, file: File, mapped_on: int) -> Iterator[str]:
    """The process's names of the file, as far as they lead to it."""
    outlook = procfs.outlook(pid)
    for name, is_it in (*_names_mapped(pid, file, mapped_on), *_names_opened(pid, file)):
        if not name.endswith(DELETED) and name.startswith("/") and is_it(f"{outlook}{name}"):
            yield name


def _names_mapped(pid: int, file: File, mapped_on: int) -> Iterator[tuple[str, Callable[[str], bool]]]:
    try:
        text = procfs.read_text(pid, "maps")
    except (ProbeError, ProcessGoneError):  # another user's, or it has just ended
        return
    for told in re.findall(rf"^\S+ \S+ \S+ \S+ {file[1]} .*$", text, re.MULTILINE):
        line = procfs.parse_maps_line(told)
        if mapped_on and line.device == mapped_on:
            yield line.name, lambda path: _number_at(path)[1] == file[1]
        else:
            yield line.name, lambda path: _number_at(path) == file


def _names_opened(pid: int, file: File) -> Iterator[tuple[str, Callable[[str], bool]]]:
    try:
        numbers = os.listdir(f"/proc/{pid}/fd")
    except OSError:
        return
    for number in numbers:
        if _number_at(f"/proc/{pid}/fd/{number}") == file:
            with contextlib.suppress(OSError):  # it has just been closed
                yield os.readlink(f"/proc/{pid}/fd/{number}"), lambda path: _number_at(path) == file


def _number_at(path: str) -> File:
    try:
        about = os.stat(path)
    except OSError:  # nothing is there, or we may not look
        return 0, 0
    return about.st_dev, about.st_ino


def _name_near(path: str, file: File, pid: int) -> str:
    """A hard link is most often made beside its file, and then renamed over another, or kept as a backup."""
    outlook = procfs.outlook(pid)
    for directory in dict.fromkeys((*_above(path), procfs.read_link(pid, "cwd"))):
        if found := _entry_of(outlook, directory, file):
            return found
    return ""


def _above(path: str) -> Iterator[str]:
    for _ in range(LEVELS):
        path = os.path.dirname(path)
        yield path


def _entry_of(outlook: str, directory: str, file: File) -> str:
    try:
        with os.scandir(f"{outlook}{directory}") as entries:
            names = [
                entry.name
                for entry in islice(entries, ENTRIES_MAX)
                if entry.inode() == file[1] and _is_regular_at(entry.stat(follow_symlinks=False), file[0])
            ]
    except OSError:  # it is gone, or closed to us
        return ""
    return os.path.join(directory, min(names)) if names else ""


def _is_regular_at(about: os.stat_result, device: int) -> bool:
    return about.st_dev == device and stat.S_ISREG(about.st_mode)
