"""Find the processor on which a thread runs or will run: on ours it waits until we sleep, if we have real-time priority.

Source: proc_pid_stat(5), field 39.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import weakref
from typing import Final

from checkpoint.errors import CheckpointError
from checkpoint.linux.procfs import procfs

PROCESSOR: Final = 39 - 3
"""Its place among the fields after the name, which is the second and may hold anything."""
NONE: Final = -1

_our_processor = ctypes.PyDLL(None).sched_getcpu


class Whereabouts:
    """The whereabouts of one thread; its file stays open, for it is read while the program stands still."""

    def __init__(self, tid: int) -> None:
        self._tid = tid
        self._file = NONE
        self._close: weakref.finalize[..., Whereabouts] | None = None

    def prepare(self) -> None:
        """Open the file; without it nothing is known. It is closed with this, at the latest."""
        if self._close is None:
            with contextlib.suppress(CheckpointError, OSError):
                self._file = procfs.opened(self._tid, f"task/{self._tid}/stat")
                self._close = weakref.finalize(self, os.close, self._file)

    def are_ours(self) -> bool:
        """Whether it is on our processor, as far as that is known."""
        if self._file == NONE:
            return False
        try:
            told = os.pread(self._file, procfs.READ_SIZE, 0)
        except OSError:  # it has ended
            return False
        fields = told[told.rfind(b")") + 2 :].split(b" ", PROCESSOR + 1)
        return len(fields) > PROCESSOR and int(fields[PROCESSOR]) == _our_processor()

    def close(self) -> None:
        """Give the descriptor back."""
        if self._close is not None:
            self._close()
            self._file, self._close = NONE, None
