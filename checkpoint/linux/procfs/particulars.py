"""Read the facts of /proc that a capture tells of a process and that seldom change: all of them in one go, again and again.

To open, read and close a file takes the interpreter ten times as long as the kernel takes to answer. So one table of calls
(`checkpoint.linux.batch_syscalls`) asks for all of them. Nothing is taken for granted from the last time: the kernel answers anew
at each `ask`. Only the *meaning* of the same bytes is remembered.

A question that fails, or an answer for which there is no room, is asked once more by itself, and that says why.

Source: proc_pid_cmdline(5), proc_pid_limits(5) …; proc_pid_ns(5).
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable
from typing import Any, Final, Protocol, TypeVar

import numpy as np

from checkpoint.linux.batch_syscalls import OwnCalls, row
from checkpoint.linux.procfs import procfs

FILES: Final = {
    "cmdline": 4096,
    "limits": 2048,
    "cgroup": 2048,
    "personality": 64,
    "oom_score_adj": 64,
    "coredump_filter": 64,
    "loginuid": 64,
    "sessionid": 64,
}
"""Files below /proc/PID, and the room for the answer of each.

Each tells of the process whatever it executes: none belongs to the memory it had when the file was opened, as ``auxv`` does
(proc_mem_open()).
"""
NAMESPACES: Final = ("pid", "net", "ipc", "uts", "cgroup", "mnt", "user", "time")
OF_CHILDREN: Final = ("pid", "time")
"""Namespaces of which children may have others."""
OURS: Final = "/proc/self/ns/"
LINKS: Final = {
    **dict.fromkeys(("exe", "cwd", "root"), 1024),
    **dict.fromkeys((f"ns/{kind}" for kind in NAMESPACES), 64),
    **dict.fromkeys((f"ns/{kind}_for_children" for kind in OF_CHILDREN), 64),
    **dict.fromkeys((f"{OURS}{kind}" for kind in NAMESPACES), 64),
}
"""Links below /proc/PID, or with their whole path, and the room for each."""
ALIGNMENT: Final = 8

Meaning = TypeVar("Meaning")


class Told(Protocol):
    """Answers about one process, by the names of files and links below /proc/PID."""

    def read(self, name: str) -> bytes:
        """The content of a file. Raises as `procfs.read_bytes`."""

    def link(self, name: str) -> str:
        """Where a link leads. Raises as `procfs.read_link`."""


class Afresh:
    """Asks for each fact when it is wanted: of a process that is looked at once."""

    def __init__(self, pid: int) -> None:
        self._pid = pid

    def read(self, name: str) -> bytes:
        """See `Told.read`."""
        return procfs.read_bytes(self._pid, name)

    def link(self, name: str) -> str:
        """See `Told.link`; of a link of our own, OSError."""
        return os.readlink(name) if name.startswith("/") else procfs.read_link(self._pid, name)


class Particulars:
    """The facts as they were at the last `ask`. Every call from one thread.

    Args:
        keeps_files: the files may stay open: a few descriptors; otherwise they are read one by one when they are wanted.
    """

    def __init__(self, pid: int, *, keeps_files: bool = True) -> None:
        self._afresh = Afresh(pid)
        self._pid = pid
        self._keeps_files = keeps_files
        self._table: _Table | None = None
        self._meant: dict[str, tuple[bytes, Any]] = {}

    def ask(self) -> None:
        """Have the kernel tell all of it as it is now."""
        if self._table is None:
            with contextlib.suppress(OSError):  # it has ended, or is not ours to look at: each question says so
                self._table = _Table(self._pid, FILES if self._keeps_files else {})
        if self._table is not None:
            self._table.ask()

    def read(self, name: str) -> bytes:
        """See `Told.read`."""
        found = self._table.told(name) if self._table is not None else None
        return self._afresh.read(name) if found is None else found

    def link(self, name: str) -> str:
        """See `Told.link`."""
        found = self._table.told(name) if self._table is not None else None
        return self._afresh.link(name) if found is None else os.fsdecode(found)

    def meaning(self, name: str, understand: Callable[[str], Meaning]) -> Meaning:
        """What the text of a file means; not worked out again while the file says the same. Raises as `read`."""
        text = self.read(name)
        known = self._meant.get(name)
        if known is None or known[0] != text:
            known = self._meant[name] = text, understand(os.fsdecode(text))
        meant: Meaning = known[1]
        return meant

    def close(self) -> None:
        """Give descriptors back."""
        if self._table is not None:
            self._table.close()
            self._table = None


class _Table:
    """The calls, and the memory that they write to.

    Args:
        files: that are to stay open, of `FILES`.

    Raises:
        OSError: the process has ended.
    """

    def __init__(self, pid: int, files: dict[str, int]) -> None:
        self._directory = os.open(f"/proc/{pid}", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        self._files: list[int] = []
        opened: dict[str, int] = {}
        for name in files:
            with contextlib.suppress(OSError):  # this kernel has none, or it is not ours to read
                opened[name] = os.open(name, os.O_RDONLY | os.O_CLOEXEC, dir_fd=self._directory)
                self._files.append(opened[name])
        sizes = {**{name: files[name] for name in opened}, **LINKS}
        self._places: dict[str, tuple[int, int, int]] = {}
        end = 0
        for index, (name, size) in enumerate(sizes.items()):
            self._places[name] = index, end, size
            end += -(-size // ALIGNMENT) * ALIGNMENT
        self._names = np.frombuffer(b"".join(name.encode() + b"\0" for name in LINKS), dtype=np.uint8).copy()
        self._answers = np.zeros(end, dtype=np.uint8)
        self._results = np.zeros(len(sizes), dtype=np.int64)
        self._view, self._result = self._answers.data, self._results.data
        self._calls = OwnCalls(self._rows(opened))

    def _rows(self, opened: dict[str, int]) -> list[tuple[int, ...]]:
        into, results, name_at = (int(one.ctypes.data) for one in (self._answers, self._results, self._names))
        rows = []
        for name, (index, begin, size) in self._places.items():
            to = results + 8 * index
            if name in opened:
                rows.append(row("pread64", opened[name], into + begin, size, 0, to=to))
            else:
                rows.append(row("readlinkat", self._directory, name_at, into + begin, size, to=to))
                name_at += len(name) + 1
        return rows

    def ask(self) -> None:
        self._calls.run()

    def told(self, name: str) -> bytes | None:
        """An answer; None for an error, for one that may be longer, and for what is not asked here."""
        place = self._places.get(name)
        if place is None:
            return None
        index, begin, size = place
        found = self._result[index]
        return bytes(self._view[begin : begin + found]) if 0 <= found < size else None

    def close(self) -> None:
        for descriptor in (self._directory, *self._files):
            os.close(descriptor)
