"""Starts the keeper of a command that will need one, before the command loads anything else.

Command and keeper each load for longer than a small program's checkpoint takes, so they load at the same time. Little is imported
here, and nothing before there is something to start.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from typing import IO, TYPE_CHECKING, Final, NamedTuple, Protocol

import checkpoint

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable

WITH_A_KEEPER: Final = ("capture", "restore", "check")
"""Verbs that ask a keeper of their own."""
HELP: Final = frozenset({"-h", "--help"})


class Child(Protocol):
    """A process of ours, as `subprocess.Popen` is one."""

    pid: int

    def wait(self, timeout: float | None = None) -> int: ...

    def kill(self) -> None: ...


class Started(NamedTuple):
    """A keeper's process.

    Attributes:
        ours: our end of its channel's socket; when that is closed it lets go of its tracees, and ends.
        complaints: its standard error.
    """

    process: Child
    ours: socket.socket
    complaints: IO[bytes]


_ahead: Final[list[Started]] = []


def start_for(words: list[str]) -> None:
    """Start the one that the verb of a command's words will ask; other verbs ask none.

    Only as the first thing that a command does: the keeper is its child as it is now, which takes half the time of another
    interpreter, and must not find anything in it that a command has made.
    """
    if words and words[0] in WITH_A_KEEPER and not HELP.intersection(words):
        with contextlib.suppress(OSError):  # the verb tries it again, and tells
            _ahead.append(_started(_forked))


def taken() -> Started:
    """The one that was started ahead, or a new one; the caller's from now on."""
    return _ahead.pop() if _ahead else _started(_spawned)


def forsake() -> None:
    """End one that no command has taken. It has not been asked anything yet."""
    while _ahead:
        left = _ahead.pop()
        left.ours.close()
        left.complaints.close()
        left.process.kill()
        left.process.wait()


def _started(born: Callable[[socket.socket, IO[bytes]], Child]) -> Started:
    import socket

    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
    complaints = open(os.memfd_create("complaints"), "w+b")  # noqa: SIM115  # the caller that takes it closes it
    with theirs:
        return Started(born(theirs, complaints), ours, complaints)


def _spawned(theirs: socket.socket, complaints: IO[bytes]) -> Child:
    import subprocess

    return subprocess.Popen(
        [sys.executable, "-P", "-m", checkpoint.__name__, "keeper", str(theirs.fileno())],
        pass_fds=(theirs.fileno(),),
        stdin=subprocess.DEVNULL,
        stderr=complaints,
        process_group=0,  # a Ctrl-C at the terminal is ours to act on
    )


def _forked(theirs: socket.socket, complaints: IO[bytes]) -> Child:
    pid = os.fork()
    if pid:
        return _Forked(pid)
    status = 1
    try:
        status = _as_keeper(theirs.fileno(), complaints.fileno())
    except BaseException:  # noqa: BLE001  # nothing of the command may be done twice
        sys.excepthook(*sys.exc_info())
    finally:
        sys.stderr.flush()
        os._exit(status)


def _as_keeper(theirs: int, complaints: int) -> int:
    """Be in the child the keeper that `_spawned` starts."""
    import fcntl

    os.setpgid(0, 0)
    theirs, complaints = (fcntl.fcntl(one, fcntl.F_DUPFD_CLOEXEC, 3) for one in (theirs, complaints))  # 0 to 2 may be among them
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(complaints, 2)
    for other in map(int, os.listdir("/proc/self/fd")):
        if other > 2 and other != theirs:
            with contextlib.suppress(OSError):  # that of the listing
                os.close(other)
    from checkpoint.__main__ import run

    return run(["keeper", str(theirs)])


class _Forked:
    """See `Child`."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._status: int | None = None

    def wait(self, timeout: float | None = None) -> int:
        """Reap it; its exit status, as `subprocess.Popen.wait` tells it, and raises."""
        if self._status is None:
            if timeout is not None and not self._has_ended(timeout):
                import subprocess

                raise subprocess.TimeoutExpired("keeper", timeout)
            try:
                self._status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
            except ChildProcessError:  # the parent of this command ignores SIGCHLD, and so do we
                self._status = 0
        return self._status

    def _has_ended(self, timeout: float) -> bool:
        import select

        try:
            end = os.pidfd_open(self.pid)
        except ProcessLookupError:
            return True
        try:
            return bool(select.select([end], [], [], timeout)[0])
        finally:
            os.close(end)

    def kill(self) -> None:
        """End it now."""
        if self._status is None:
            os.kill(self.pid, signal.SIGKILL)
