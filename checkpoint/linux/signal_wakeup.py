"""Wait for a peer and for signals together, so that no signal comes too early or reaches the wrong thread.

A handler in Python runs between two instructions of Python, in the first thread. A signal that comes after the last of them and
before the kernel sleeps does not wake the thread. Nor does one that the kernel hands to another thread of ours: the handler would
run only when the peer sends something, or never. So each signal also leaves a byte in a socket, and the wait covers this socket,
too.

Source: signal(7), "Execution of signal handlers"; complete_signal() in kernel/signal.c; set_wakeup_fd in Python's signal module.
"""

from __future__ import annotations

import contextlib
import select
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Final

BYTES_AT_ONCE: Final = 4096
"""Taken out of the socket in one go; the rest is taken the next time."""


@contextlib.contextmanager
def waking() -> Iterator[Callable[[int], None]]:
    """Within, signals wake the function that is given: it returns when a descriptor is readable, and handlers run meanwhile.

    In a thread that is not the first one it only waits: Python's handlers never run there.
    """
    if threading.current_thread() is not threading.main_thread():
        yield await_readable
        return
    with told_of_signals() as heard:
        yield lambda descriptor: await_readable(descriptor, heard)


@contextlib.contextmanager
def told_of_signals() -> Iterator[socket.socket]:
    """A socket that never blocks, in which each signal leaves a byte within the body. For the first thread."""
    heard, told = socket.socketpair()
    with heard, told:
        for end in (heard, told):
            end.setblocking(False)
        before = signal.set_wakeup_fd(told.fileno(), warn_on_full_buffer=False)
        try:
            yield heard
        finally:
            signal.set_wakeup_fd(before)


def await_readable(descriptor: int, heard: socket.socket | None = None) -> None:
    """Wait until it is readable, or its other end has gone; each byte in ``heard`` lets Python run its handlers."""
    poll = select.poll()
    poll.register(descriptor, select.POLLIN)
    if heard is not None:
        poll.register(heard, select.POLLIN)
    while descriptor not in [ready for ready, _ in poll.poll()]:
        assert heard is not None  # we wait for no other descriptor
        heard.recv(BYTES_AT_ONCE)
