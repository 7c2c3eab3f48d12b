"""Ctrl-C while a command still loads ends it at once and quietly, with exit status 130, as shells say of it.

Every entry (`__main__`) begins with this, before the imports that take time; nothing has been done yet that would need an end.
"""

from __future__ import annotations

import os
import signal
from types import FrameType
from typing import Final

INTERRUPTED: Final = 128 + signal.SIGINT


def begin() -> None:
    """From here on Ctrl-C ends this process; not where it was told to ignore it."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


def loaded() -> None:
    """From here on Ctrl-C is a KeyboardInterrupt: the command is ready to take it."""
    if signal.getsignal(signal.SIGINT) is _end:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _end(_number: int, _frame: FrameType | None) -> None:
    os._exit(INTERRUPTED)
