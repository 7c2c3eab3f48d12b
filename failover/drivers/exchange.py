"""How messages about names travel: datagrams between this user's processes on a robot; from robot to robot by one of them.

The first process that can listens for other robots (*the door* of its robot): at the host of the replication link, one port above
it, by CURVE. It also sends what goes to other robots. The others on its robot reach them through its tables. When it ends,
another one becomes the door.

An address is ``ROBOT/FILE``, with the file in the directory of `failover.drivers.here`; of another robot: its door.
"""

from __future__ import annotations

import contextlib
import os
import select
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Final

from failover.core.naming import scan
from failover.core.naming.scan import MULTICAST, Message, Send
from failover.drivers.here import Here, TeamNow, host_and_port
from failover.errors import DriverError

if TYPE_CHECKING:
    from failover.drivers import sockets

ENDING: Final = "names"
"""Of the files of name services; what goes to all goes to these."""

TURN_MAX: Final = 256
"""Messages taken at once, before what is due is looked at."""

BUFFER_SIZE: Final = 4 << 20
"""Bytes asked for the queue of datagrams; the kernel gives what it allows."""

QUEUED: Final = 16
"""Messages that wait for a robot that is not connected: the first digest is to arrive as soon as it is."""

DOOR_RETRY_NS: Final = 5_000_000_000
"""Until one that is not the door tries again to be."""


class Exchange:
    """The sockets of one process for messages about names; used by one thread."""

    def __init__(self, here: Here, file: str) -> None:
        """
        Args:
            file: of this process, in the directory where drivers meet; no other process uses it.

        Raises:
            DriverError: it cannot be made.
        """
        self.here = here
        self.address = f"{here.robot}/{file}"
        self.lost = 0
        self._path = here.directory / file
        self._door: Door | None = None
        self._door_tried_ns: int | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        for option in (socket.SO_SNDBUF, socket.SO_RCVBUF):
            self._socket.setsockopt(socket.SOL_SOCKET, option, BUFFER_SIZE)
        self._path.unlink(missing_ok=True)
        try:
            os.fchmod(self._socket.fileno(), 0o600)  # the file gets this mode, whatever the umask lets others do
            self._socket.bind(os.fspath(self._path))
        except OSError as error:
            self._socket.close()
            raise DriverError(f"cannot make {self._path}: {error.strerror}") from error

    @property
    def is_door(self) -> bool:
        """Whether this process talks to other robots."""
        return self._door is not None

    def neighbours(self) -> list[Path]:
        """The name services of this robot, without this process; none where this process has no descriptor left to look."""
        try:
            found = sorted(self.here.directory.glob(f"*.{ENDING}"))
        except OSError:
            self.lost += 1  # the next scan tells them
            return []
        return [path for path in found if path != self._path]

    def know(self, here: Here) -> None:
        """Go on with these members and keys: a door is made anew with them."""
        self.here = here
        if self._door is not None:
            self._door.close()
            self._door = self._door_tried_ns = None

    def be_door(self, now_ns: int, retry_ns: int = DOOR_RETRY_NS) -> bool:
        """Try to become the door of this robot, once in ``retry_ns``; whether it has become it just now."""
        if self._door is not None or self.here.team is None:
            return False
        if self._door_tried_ns is not None and now_ns - self._door_tried_ns < retry_ns:
            return False
        self._door_tried_ns = now_ns
        with contextlib.suppress(DriverError):
            self._door = Door(self.here)
        return self._door is not None

    def send(self, sends: list[Send]) -> int:
        """Send what is due; the number of neighbours that took one to all."""
        reached = 0
        told: set[tuple[str, int]] = set()
        for one in sends:
            robot, _, file = one.to.partition("/")
            if one.to == MULTICAST:
                content = scan.encode(one.message)
                reached += sum(self._send_local(path, content) for path in self.neighbours())
            elif robot == self.here.robot:
                self._send_local(self.here.directory / Path(file).name, scan.encode(one.message))
            elif self._door is not None and (robot, id(one.message)) not in told:
                told.add((robot, id(one.message)))  # all processes of a robot have one door
                self._door.send(robot, scan.encode(one.message))
        return reached

    def _send_local(self, path: Path, content: bytes) -> bool:
        try:
            self._socket.sendto(content, os.fspath(path))
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)  # its process was killed
            return False
        except OSError:
            self.lost += 1  # gone meanwhile, or its queue is full: the next scan tells it again
            return False
        return True

    def receive(self, timeout_ns: int, wake: int = -1) -> list[Message]:
        """What has come, once there is something or the time is over; ``wake``: a descriptor that ends the wait, too."""
        poller = select.poll()
        for descriptor in (self._socket.fileno(), wake, *(self._door.descriptors() if self._door is not None else ())):
            if descriptor >= 0:
                poller.register(descriptor, select.POLLIN)
        found = self._door.receive() if self._door is not None else []
        poller.poll(0 if found else max(-(-timeout_ns // 1_000_000), 0))
        if self._door is not None:
            found += self._door.receive()
        for _ in range(TURN_MAX):
            try:
                found.append(self._socket.recv(scan.MESSAGE_SIZE_MAX + 1))
            except BlockingIOError:
                break
        return [message for content in found if (message := scan.decode(content)) is not None]

    def close(self) -> None:
        """Be reached no more."""
        self._path.unlink(missing_ok=True)
        self._socket.close()
        if self._door is not None:
            self._door.close()


class Door:
    """The one process of a robot that other robots' name services reach."""

    def __init__(self, here: Here) -> None:
        """
        Raises:
            DriverError: another process is the door, or the host is not this robot's.
        """
        from failover.drivers import sockets

        assert here.team is not None
        self._sockets = sockets
        self._here = here
        self._team = here.team
        self._context = sockets.context()
        self._peers: dict[str, sockets.Connection] = {}
        self._now = TeamNow(here)
        try:
            self._gate = sockets.Gate(self._context, here.keys)
            self._listening, _ = sockets.listen_team(self._context, here, host_and_port(here.team, here.robot)[1])
        except DriverError:
            sockets.close(self._context)
            raise
        except sockets.ZMQ_ERROR as error:
            sockets.close(self._context)
            raise DriverError(f"cannot listen for other robots: {error}") from error

    def descriptors(self) -> tuple[int, int]:
        """Readable after something has come; to be followed by `receive`."""
        return self._gate.socket.fileno(), self._listening.fileno()

    def send(self, robot: str, content: bytes) -> None:
        """To the door of another robot, if it is connected; else the next scan tells it."""
        if robot not in self._team.robots:
            return
        if robot not in self._peers:
            host, port = host_and_port(self._team, robot)
            address = f"tcp://{self._sockets.bracketed(host)}:{port}"
            self._peers[robot] = self._sockets.Connection(self._context, address, self._here, robot, queued=QUEUED)
        self._peers[robot].mend()
        self._sockets.send(self._peers[robot].socket, content)

    def receive(self) -> list[bytes]:
        """What other robots have sent."""
        if self._now.look():
            self._gate.know(self._now.here.keys)  # who counts no more is refused now; the door is made anew at the next turn
        self._gate.serve()
        found: list[bytes] = []
        for _ in range(TURN_MAX):
            if (message := self._sockets.receive(self._listening)) is None:
                break
            if self._gate.owner(message[2]):
                found.append(message[1])
        return found

    def close(self) -> None:
        """Let another process be the door."""
        for connection in self._peers.values():
            connection.close()
        self._sockets.close(self._context)
