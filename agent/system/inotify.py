"""A descriptor that tells that a file's times were set: how a program wakes the main loop with one system call.

It needs no socket, no file and no right beyond those that it has to write a board. The kernel keeps one event of a kind in a row:
a program that sets the times without end fills no queue. A descriptor for locks and sizes is open in such programs anyway.
Sources: inotify(7), utimensat(2); `fsnotify_change` in Linux: both times set at once are IN_ATTRIB, a write is not.
"""

from __future__ import annotations

import ctypes
import os
from typing import Final

from agent.system.timers import check

IN_ATTRIB: Final = 0x4
IN_CLOEXEC: Final = os.O_CLOEXEC
IN_NONBLOCK: Final = os.O_NONBLOCK

EVENTS_SIZE: Final = 4 << 10
"""Bytes: room for all events of some files that the kernel does not merge; what is left over wakes once more."""

_libc = ctypes.CDLL(None, use_errno=True)


class Touches:
    """Readable (`fileno`) since the times of one of some files were set, until `heed`."""

    def __init__(self, *files: int) -> None:
        """Watch the files that these descriptors have open.

        Raises:
            OSError: the user has too many such descriptors (fs.inotify.max_user_instances), or the kernel has none.
        """
        self._descriptor = int(_libc.inotify_init1(IN_CLOEXEC | IN_NONBLOCK))
        check(self._descriptor, "inotify_init1")
        try:
            for file in files:
                check(_libc.inotify_add_watch(self._descriptor, b"/proc/self/fd/%d" % file, IN_ATTRIB), "inotify_add_watch")
        except OSError:
            self.close()
            raise

    def fileno(self) -> int:
        """For epoll."""
        return self._descriptor

    def heed(self) -> None:
        """What was told until now is being seen to; nothing, if it has been already."""
        try:  # not `suppress`: the loop does this for each urgent put
            os.read(self._descriptor, EVENTS_SIZE)
        except BlockingIOError:
            return

    def close(self) -> None:
        """Give the descriptor back."""
        os.close(self._descriptor)
