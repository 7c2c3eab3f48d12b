"""The keeper of a command that will need one, started before the command loads anything else.

Each of the two loads for longer than a small program's checkpoint takes; so they do at the same time. Little is imported
here, and nothing before there is something to start.
"""

from __future__ import annotations

import contextlib
import os
import sys
from typing import IO, TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    import socket
    import subprocess

WITH_A_KEEPER: Final = ("capture", "restore", "check")
"""Verbs that ask a keeper of their own."""
HELP: Final = frozenset({"-h", "--help"})


class Started(NamedTuple):
    """A keeper's process.

    Attributes:
        ours: our end of its channel's socket; when that is closed it lets go of what it traces, and ends.
        complaints: what it writes to standard error.
    """

    process: subprocess.Popen[bytes]
    ours: socket.socket
    complaints: IO[bytes]


_ahead: Final[list[Started]] = []


def start_for(words: list[str]) -> None:
    """Start the one that the verb of a command's words will ask; other verbs ask none."""
    if words and words[0] in WITH_A_KEEPER and not HELP.intersection(words):
        with contextlib.suppress(OSError):  # the verb tries it again, and tells
            _ahead.append(_started())


def taken() -> Started:
    """The one that was started ahead, or a new one; the caller's from now on."""
    return _ahead.pop() if _ahead else _started()


def forsake() -> None:
    """End one that nobody has taken, which has not been asked anything yet."""
    while _ahead:
        left = _ahead.pop()
        left.ours.close()
        left.complaints.close()
        left.process.kill()
        left.process.wait()


def _started() -> Started:
    import socket
    import subprocess

    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
    complaints = open(os.memfd_create("complaints"), "w+b")  # noqa: SIM115  # whoever takes it closes it
    with theirs:
        process = subprocess.Popen(
            [sys.executable, "-m", "checkpoint", "keeper", str(theirs.fileno())],
            pass_fds=(theirs.fileno(),),
            stdin=subprocess.DEVNULL,
            stderr=complaints,
            process_group=0,  # a Ctrl-C at the terminal is ours to act on
        )
    return Started(process, ours, complaints)
