"""Locks of a board's file: bytes locked for an open file description, which the kernel gives back however its process ends.

Source: fcntl(2), F_OFD_SETLK.
"""

from __future__ import annotations

import errno
import fcntl
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

from checkpoint.segment.layout import lock_of
from failover.core.board.layout import TABLE_LOCK
from failover.errors import BoardError, FailoverError

TABLE_WAIT_S: Final = 5.0
"""A change of a table takes microseconds. A process that holds the lock for so long is stopped."""
PAUSE_S: Final = 0.001


def take(descriptor: int, byte: int) -> bool:
    """Lock a byte; False if another opening of the file has it."""
    try:
        fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, lock_of(fcntl.F_WRLCK, byte))
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES):
            return False
        raise
    return True


def give(descriptor: int, byte: int) -> None:
    """Unlock a byte, whether it was locked or not."""
    fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, lock_of(fcntl.F_UNLCK, byte))


def is_taken(descriptor: int, byte: int) -> bool:
    """Whether another opening of the file has a byte; of locks of this opening it says nothing."""
    found = fcntl.fcntl(descriptor, fcntl.F_OFD_GETLK, lock_of(fcntl.F_WRLCK, byte))
    return found[:2] != lock_of(fcntl.F_UNLCK, byte)[:2]


@contextmanager
def table(
    descriptor: int, what: str, error: type[FailoverError] = BoardError, patience_s: float = TABLE_WAIT_S
) -> Iterator[None]:
    """Hold the table lock of a file.

    Raises:
        BoardError, or ``error``: another process has held it for so long.
    """
    end = time.monotonic() + patience_s
    while not take(descriptor, TABLE_LOCK):
        if time.monotonic() >= end:
            raise error(f"{what}: another process has held the lock of the table for {patience_s:g} s; is it stopped?")
        time.sleep(PAUSE_S)
    try:
        yield
    finally:
        give(descriptor, TABLE_LOCK)
