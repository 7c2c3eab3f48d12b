"""The threads of a process as /proc lists them."""

from __future__ import annotations

import os
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


def thread_ids(pid: int) -> list[int]:
    """The ids of its threads, the first one first; of a process that is named by its spokesman that one, its first has ended.

    Source: first_tid() in fs/proc/base.c: the kernel lists the first thread first.
    """
    try:
        first, *others = map(int, os.listdir(f"/proc/{pid}/task"))
    except (FileNotFoundError, ProcessLookupError) as error:
        raise ProcessGoneError(f"there is no process {pid} any more") from error
    except ValueError as error:  # nobody is listed: it is just going
        raise ProcessGoneError(f"there is no process {pid} any more") from error
    return sorted([first, *others] if first == pid else others, key=lambda tid: (tid != pid, tid))
