"""List the threads of a process from /proc."""

from __future__ import annotations

import contextlib
import os
import weakref
from typing import Final

from checkpoint.errors import ProcessGoneError

FIRST_LINKS: Final = 2
"""Links of an empty /proc/PID/task: its own, and its parent's. Each thread is one more."""


def thread_count(pid: int) -> int:
    """How many threads a process has, those included that are about to end.

    Source: proc_task_getattr() in fs/proc/base.c.
    """
    try:
        return os.stat(f"/proc/{pid}/task").st_nlink - FIRST_LINKS
    except (FileNotFoundError, ProcessLookupError) as error:
        raise ProcessGoneError(f"there is no process {pid} any more") from error


class ThreadCount:
    """As `thread_count`, of one process again and again: its directory stays open, and is closed with this at the latest."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._directory = -1
        self._close: weakref.finalize[..., ThreadCount] | None = None

    def read(self) -> int:
        """How many there are. Raises as `thread_count`."""
        if self._close is None:
            count = thread_count(self._pid)
            with contextlib.suppress(OSError):  # we have no descriptor left
                self._directory = os.open(f"/proc/{self._pid}/task", os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
                self._close = weakref.finalize(self, os.close, self._directory)
            return count
        count = os.fstat(self._directory).st_nlink - FIRST_LINKS
        if count < 1:  # the open directory keeps its own links when no thread is left
            raise ProcessGoneError(f"there is no process {self._pid} any more")
        return count

    def close(self) -> None:
        """Give the descriptor back."""
        if self._close is not None:
            self._close()
            self._close = None


def thread_ids(pid: int) -> list[int]:
    """The ids of its threads, the first one first; of a process that is named by its spokesman that one, its first has ended.

    Source: first_tid() in fs/proc/base.c: the kernel lists the first thread first.
    """
    try:
        first, *others = map(int, os.listdir(f"/proc/{pid}/task"))
    except (FileNotFoundError, ProcessLookupError) as error:
        raise ProcessGoneError(f"there is no process {pid} any more") from error
    except ValueError as error:  # no thread is listed: the process is just ending
        raise ProcessGoneError(f"there is no process {pid} any more") from error
    return sorted([first, *others] if first == pid else others, key=lambda tid: (tid != pid, tid))
