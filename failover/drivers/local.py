"""Messages between processes of one robot: a unix stream socket; before each message stands its size, four bytes, big-endian.

No thread carries them: a call is one ``send`` and one ``recv`` on each side. The kernel says which user is at the other end.

Source: unix(7), SO_PEERCRED; epoll(7); socket(7), SO_RCVTIMEO, SO_SNDTIMEO.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
import struct
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from failover.core.messaging.envelope import MESSAGE_SIZE_MAX
from failover.errors import DriverError

SCHEME: Final = "local://"

CONNECTIONS_MAX: Final = 1_024
"""Programs of this user that are connected to one driver at once."""

UNSENT_MAX: Final = 1 << 20
"""Bytes that wait for one who does not read; what comes on top is not sent: who misses an answer sends again."""

CHUNK: Final = 256 << 10
SIZE_SIZE: Final = 4
MS: Final = 1_000_000
CONNECT_AGAIN_MS: Final = 20
"""Between two tries to reach a driver that does not listen."""

SEND_LIMIT_S: Final = 1
"""How long a driver may take nothing, because it hangs; then the connection is given up, with what was half sent."""

_CREDENTIALS: Final = struct.Struct("3i")
_TIME: Final = struct.Struct("@ll")


class Poller:
    """Waits for descriptors."""

    def __init__(self) -> None:
        self._epoll = select.epoll()
        self._known: set[int] = set()

    def add(self, descriptor: int, *, reading: bool = True, writing: bool = False) -> None:
        """From now on it is waited for, until it can be read or written; or for neither."""
        events = reading * select.EPOLLIN | writing * select.EPOLLOUT
        if not events:  # epoll tells that the other end has gone, whatever it was asked for
            self.remove(descriptor)
        elif descriptor in self._known:
            self._epoll.modify(descriptor, events)
        else:
            self._epoll.register(descriptor, events)
            self._known.add(descriptor)

    def remove(self, descriptor: int) -> None:
        """It is closed next."""
        if descriptor in self._known:
            self._known.discard(descriptor)
            self._epoll.unregister(descriptor)

    def wait(self, timeout_ns: int | None) -> list[int]:
        """Those that can be read or written, once there is one or the time is over."""
        return [
            descriptor for descriptor, _ in self._epoll.poll(None if timeout_ns is None else max(-(-timeout_ns // MS), 0) / 1_000)
        ]

    def close(self) -> None:
        """Wait no more."""
        self._epoll.close()


class Framed:
    """Bytes as they come → messages.

    Raises of `take`:
        DriverError: what comes is no message.
    """

    def __init__(self) -> None:
        self._rest = bytearray()

    def take(self, content: bytes) -> list[bytes]:
        """The messages that are complete with these bytes."""
        rest = self._rest
        if not rest and len(content) > SIZE_SIZE and len(content) == SIZE_SIZE + int.from_bytes(content[:SIZE_SIZE], "big"):
            return [content[SIZE_SIZE:]]  # as nearly all come
        rest += content
        found: list[bytes] = []
        at = 0
        while len(rest) - at >= SIZE_SIZE:
            size = int.from_bytes(rest[at : at + SIZE_SIZE], "big")
            if size > MESSAGE_SIZE_MAX:
                raise DriverError(f"a message of {size} bytes is announced; {MESSAGE_SIZE_MAX} are the most")
            if len(rest) - at - SIZE_SIZE < size:
                break
            found.append(bytes(rest[at + SIZE_SIZE : at + SIZE_SIZE + size]))
            at += SIZE_SIZE + size
        del rest[:at]
        return found


def framed(content: bytes) -> bytes:
    """A message as it goes over the socket."""
    return len(content).to_bytes(SIZE_SIZE, "big") + content


# --- The driver's side ------------------------------------------------------------------------------------------------


def listen(path: Path) -> socket.socket:
    """Take connections of this robot's programs.

    Raises:
        DriverError: the file cannot be made.
    """
    listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
    path.unlink(missing_ok=True)
    try:
        os.fchmod(listening.fileno(), 0o600)  # the file gets this mode, whatever the umask lets others do
        listening.bind(os.fspath(path))
        listening.listen(CONNECTIONS_MAX)
    except OSError as error:
        listening.close()
        raise DriverError(f"cannot listen at {path}: {error.strerror}") from error
    return listening


def uid_of(end: socket.socket) -> int:
    """The user at the other end, as the kernel says."""
    _, uid, _ = _CREDENTIALS.unpack(end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return int(uid)


class Connection:
    """One program that is connected. ``uid``: its user, as the kernel says."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self.uid = uid_of(end)
        self.descriptor = end.fileno()
        self._end = end
        self._framed = Framed()
        self._unsent = bytearray()

    @property
    def has_unsent(self) -> bool:
        """Whether something waits until the other end reads."""
        return bool(self._unsent)

    def receive(self) -> list[bytes] | None:
        """What has come; None: the other end is gone, or sends what is no message."""
        try:
            content = self._end.recv(CHUNK)
            return self._framed.take(content) if content else None
        except BlockingIOError:
            return []
        except (OSError, DriverError):
            return None

    def send(self, content: bytes) -> bool:
        """Send, at once or when the other end reads; False: it is gone, or does not read."""
        if len(self._unsent) > UNSENT_MAX:
            return False
        whole = framed(content)
        if self._unsent:
            self._unsent += whole
            return True
        try:
            sent = self._end.send(whole, socket.MSG_NOSIGNAL)
        except BlockingIOError:
            sent = 0
        except OSError:
            return False
        if sent < len(whole):
            self._unsent += whole[sent:]
        return True

    def flush(self) -> None:
        """Send what waits, as far as the other end takes it."""
        with contextlib.suppress(OSError):  # gone: the next read tells
            del self._unsent[: self._end.send(self._unsent, socket.MSG_NOSIGNAL) if self._unsent else 0]

    def close(self) -> None:
        """Let it go."""
        self._end.close()


def close_all(connections: Sequence[Connection], linger_ms: int) -> None:
    """Close them, after so many ms in which what waits to be sent may leave."""
    until_ns = time.monotonic_ns() + linger_ms * MS
    poller = select.poll()
    unsent = {one.descriptor: one for one in connections if one.has_unsent}
    for descriptor in unsent:
        poller.register(descriptor, select.POLLOUT)
    while unsent and (left_ns := until_ns - time.monotonic_ns()) > 0:
        for descriptor, events in poller.poll(left_ns / MS):
            unsent[descriptor].flush()
            if events & (select.POLLERR | select.POLLHUP) or not unsent[descriptor].has_unsent:
                poller.unregister(descriptor)
                del unsent[descriptor]
    for one in connections:
        one.close()


# --- The caller's side ------------------------------------------------------------------------------------------------


class LocalWay:
    """A way to a driver of this robot. It need not be there yet, and may come again after its end."""

    def __init__(self, path: str) -> None:
        self._path = path
        self._end: socket.socket | None = None
        self._framed = Framed()
        self._came: list[bytes] = []
        self._limit_ms = 0
        self.closed = False

    def _open(self) -> socket.socket | None:
        if self._end is None and not self.closed:
            try:
                end = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_CLOEXEC)
            except OSError:  # no descriptor is free: it is tried again like a driver that is not there
                return None
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, _TIME.pack(SEND_LIMIT_S, 0))
            try:
                end.connect(self._path)
            except OSError:
                end.close()
                return None
            self._end, self._framed, self._limit_ms = end, Framed(), 0
        return self._end

    def _lose(self) -> None:
        """Let the connection go; what the driver said before its end is read first, or it would do it again."""
        if (end := self._end) is None:
            return
        self._end = None
        with contextlib.closing(end), contextlib.suppress(OSError, DriverError):
            end.setblocking(False)
            while content := end.recv(CHUNK):
                self._came += self._framed.take(content)

    def send(self, content: bytes) -> bool:
        """Send at once; False: the driver does not listen."""
        end = self._open()
        if end is None:
            return False
        try:
            end.sendall(framed(content))
        except OSError:
            self._lose()
            return False
        return True

    def await_sent(self, content: bytes, timeout_ns: int) -> bool:
        """Send as soon as the driver listens; False: it did not within the time."""
        until = time.monotonic_ns() + timeout_ns
        while not self.send(content):
            left_ns = until - time.monotonic_ns()
            if left_ns <= 0 or not self.await_open(left_ns, -1):
                return False
        return True

    def await_open(self, timeout_ns: int, wake: int) -> bool:
        """Whether the driver listens within the time; ``wake``: a descriptor that ends the wait, too."""
        until = time.monotonic_ns() + timeout_ns
        while self._open() is None:
            left_ms = (until - time.monotonic_ns()) // MS
            if left_ms <= 0 or _readable(wake, min(left_ms, CONNECT_AGAIN_MS)):
                return False
        return True

    def await_message(self, timeout_ns: int, wake: int = -1) -> bytes | None:
        """What comes; None: nothing within the time, or `wake` can be read, or the driver has ended: then `is_lost`."""
        if self._came:
            return self._came.pop(0)
        until = time.monotonic_ns() + timeout_ns
        while (end := self._end) is not None:
            timeout_ms = max(-(-timeout_ns // MS), 1)
            if wake < 0:
                self._limit(end, timeout_ms)
            elif not _readable(end.fileno(), timeout_ms, wake):
                return None
            try:
                content = end.recv(CHUNK)
                self._came = self._framed.take(content)
            except BlockingIOError:
                return None
            except (OSError, DriverError):
                content = b""
            if not content:
                self._lose()
            elif self._came:
                return self._came.pop(0)
            timeout_ns = until - time.monotonic_ns()
            if timeout_ns <= 0:
                return None
        return None

    @property
    def is_lost(self) -> bool:
        """Whether there is no connection."""
        return self._end is None

    def _limit(self, end: socket.socket, limit_ms: int) -> None:
        """How long `recv` waits: the kernel is told only when it changes."""
        if limit_ms != self._limit_ms:
            end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, _TIME.pack(limit_ms // 1_000, limit_ms % 1_000 * 1_000))
            self._limit_ms = limit_ms

    def close(self, linger_ms: int = 0) -> None:
        """Let it go; what was sent arrives."""
        self.closed = True
        self._lose()


def _readable(descriptor: int, timeout_ms: int, wake: int = -1) -> bool:
    """Whether it can be read within the time; below 0: never. ``wake``: ends the wait, too."""
    poller = select.poll()
    for one in (descriptor, wake):
        if one >= 0:
            poller.register(one, select.POLLIN)
    return any(found == descriptor for found, _ in poller.poll(timeout_ms))
