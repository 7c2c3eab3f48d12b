"""End a command that is still loading at Ctrl-C, at once and quietly, with exit status 130, as shells report it.

Every entry point (`__main__`) begins with this, before the imports that take time; nothing has been done yet that would need a
clean-up.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import signal
import sys
import threading
from types import FrameType
from typing import Final

INTERRUPTED: Final = 128 + signal.SIGINT
STREAMS: Final = ("stdin", "stdout", "stderr")


def begin() -> None:
    """From here on Ctrl-C ends this process; not where it was told to ignore it. Every standard stream leads somewhere."""
    for number, name in enumerate(STREAMS):
        if getattr(sys, name) is None:  # it was closed: the next file that is opened would be taken for it
            _lead_nowhere(number, name)
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def _lead_nowhere(number: int, name: str) -> None:
    descriptor = os.open(os.devnull, os.O_RDWR)
    if descriptor != number:
        os.dup2(descriptor, number)
        os.close(descriptor)
    os.set_inheritable(number, True)
    setattr(sys, name, os.fdopen(number, "w" if number else "r"))


def loaded() -> None:
    """From here on Ctrl-C is a KeyboardInterrupt: the command is ready to take it."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def left(status: int) -> int:
    """End this process with a status, as the interpreter would, but without taking apart what it has loaded: that takes 10 ms.

    Where something stands against it (other threads, output that no reader takes) it answers the status, for the long way.
    """
    if threading.active_count() > 1:
        return status
    atexit._run_exitfuncs()
    with contextlib.suppress(OSError, ValueError):
        for stream in (sys.stdout, sys.stderr):
            if stream is not None:
                stream.flush()
        os._exit(status)
    return status


def _end(_number: int, _frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)
