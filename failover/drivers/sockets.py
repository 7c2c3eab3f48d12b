"""ZeroMQ for programs: messages between robots, by CURVE alone. The only ``zmq`` import of ``failover``.

A server with CURVE and without an answer to ZAP admits any key: `Gate` answers, and admits only the keys of the team file. ZeroMQ
asks once, when a connection is made, and notes the key with each message: whose that is now is looked up then. No socket sends
ZMTP heartbeats: one that comes while the receive queue is full ends the process (libzmq issue 4767).

Source: rfc.zeromq.org/spec/25 (CURVE), /27 (ZAP); zmq_setsockopt(3).
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from typing import Any, Final

import zmq
from zmq.utils import z85

from failover.core.messaging.envelope import MESSAGE_SIZE_MAX
from failover.drivers.here import Here, TeamNow
from failover.errors import DriverError

HIGH_WATER: Final = 1_000
"""Messages of one connection inside ZeroMQ."""

RECONNECT_FIRST_MS: Final = 50
RECONNECT_MOST_MS: Final = 2_000

RETRANSMIT_LIMIT_MS: Final = 3_000
"""A connection whose bytes stay unacknowledged so long is dead (TCP_USER_TIMEOUT)."""

HANDSHAKE_LIMIT_MS: Final = 5_000

ONE_TIME_LIMIT_MS: Final = 30_000
"""The handshake of an invitation: it happens once, on machines that may be starting, and a failure costs a person's time."""

HANDSHAKE_FAILED: Final = (
    zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)

ZAP_ADDRESS: Final = "inproc://zeromq.zap.01"
ZAP_DOMAIN: Final = b"failover"

_NOW: Final = int(zmq.NOBLOCK)
_NOW_AND_MORE: Final = int(zmq.NOBLOCK | zmq.SNDMORE)
_READABLE: Final = int(zmq.POLLIN)
"""As plain numbers: zmq's own are objects that each ``&`` and ``|`` makes anew, for some microseconds."""

Context = zmq.Context[zmq.Socket[bytes]]
Socket = zmq.Socket[bytes]
ZMQ_ERROR: Final = zmq.ZMQError
"""What ZeroMQ raises where there is no descriptor or memory left."""


def context() -> Context:
    """One of this process's own; its sockets belong to the thread that makes them."""
    return zmq.Context()


def close(context: Context, linger_ms: int = 0) -> None:
    """Close all sockets of a context, after so many ms in which what was sent may leave."""
    context.destroy(linger=linger_ms)


def listen_team(context: Context, here: Here, port: int = 0) -> tuple[Socket, str]:
    """Take messages of the team's robots, each told apart by its key. Needs a `Gate` in the same context.

    Args:
        port: 0: any free one.

    Returns:
        The socket, and its address.

    Raises:
        DriverError: the address cannot be had.
    """
    socket = _limited(context.socket(zmq.ROUTER))
    socket.curve_server = True
    socket.curve_secretkey = here.secret.encode()
    socket.zap_domain = ZAP_DOMAIN
    _bound(socket, f"tcp://{bracketed(here.host)}:{port or '*'}")
    return socket, socket.getsockopt_string(zmq.LAST_ENDPOINT)


def prove_anew(socket: Socket, here: Here) -> str:
    """Prove this robot's key as it is now, once `listen_again` has the address. Connections that stand are not touched.

    Returns:
        The address, at which nobody listens until then.
    """
    address = socket.getsockopt_string(zmq.LAST_ENDPOINT)
    socket.curve_secretkey = here.secret.encode()
    with contextlib.suppress(zmq.ZMQError):  # an earlier key has ended that
        socket.unbind(address)
    return address


def listen_again(socket: Socket, address: str) -> bool:
    """Try once; False: ZeroMQ, which lets an address go some time after it was told to, or another program has it still."""
    try:
        socket.bind(address)
    except zmq.ZMQError:
        return False
    return True


class Connection:
    """A way to one process of another robot. It is made anew where keys have changed, and where a handshake failed.

    Attributes:
        socket: the same for as long as this lives.
    """

    def __init__(self, context: Context, address: str, here: Here, robot: str, *, queued: int = 0) -> None:
        """
        Args:
            address: ``tcp://HOST:PORT`` of that robot.
            queued: so many messages wait while there is no connection; 0: what is sent then is refused.

        Raises:
            DriverError: the keys of this robot or of that one are not here.
        """
        self._address, self._robot = address, robot
        self._secret, self._keys = here.secret, _keys_of(here, robot)
        if not self._keys:
            raise DriverError(f"cannot reach {address}: {here.alone or f'{robot} is not in team.toml'}")
        self.socket = _limited(context.socket(zmq.DEALER))
        if queued:
            self.socket.setsockopt(zmq.SNDHWM, queued)
        else:
            self.socket.setsockopt(zmq.IMMEDIATE, 1)
        self.socket.setsockopt(zmq.RECONNECT_IVL, RECONNECT_FIRST_MS)
        self.socket.setsockopt(zmq.RECONNECT_IVL_MAX, RECONNECT_MOST_MS)
        self.monitor = self.socket.get_monitor_socket(HANDSHAKE_FAILED)
        self._connect()

    def know(self, here: Here) -> None:
        """Go on with these keys; one who is no member any more is not connected to anew."""
        secret, keys = here.secret, _keys_of(here, self._robot)
        if (secret, set(keys)) != (self._secret, set(self._keys)):
            self._secret, self._keys = secret, keys
            self._connect()

    def mend(self) -> None:
        """A handshake has failed: ZeroMQ does not try again where our key was refused, and the peer may use its other one."""
        if has_message(self.monitor) and self.pause_ms() == 0:
            self._keys = (*self._keys[1:], *self._keys[:1])
            self._connect()

    def pause_ms(self) -> int:
        """How long `mend` waits after the last connection was begun: a peer that refuses us is not asked without a pause."""
        return max(RECONNECT_FIRST_MS - (time.monotonic_ns() - self._begun_ns) // 1_000_000, 0)

    def _connect(self) -> None:
        with contextlib.suppress(zmq.ZMQError):  # the first time there is nothing to end
            self.socket.disconnect(self._address)
        self._begun_ns = time.monotonic_ns()
        while has_message(self.monitor):
            self.monitor.recv_multipart()
        if self._keys:
            self.socket.curve_publickey = zmq.curve_public(self._secret.encode())
            self.socket.curve_secretkey = self._secret.encode()
            self.socket.curve_serverkey = self._keys[0].encode()
            self.socket.connect(self._address)

    def close(self) -> None:
        """Watch no more; the socket goes with its context."""
        self.socket.disable_monitor()
        self.monitor.close(0)


def _keys_of(here: Here, robot: str) -> tuple[str, ...]:
    member = here.team.robots.get(robot) if here.team is not None else None
    return member.keys if member is not None else ()


def has_message(socket: Socket) -> bool:
    """Whether a listening socket has one more."""
    return bool(int(socket.getsockopt(zmq.EVENTS)) & _READABLE)


def receive(socket: Socket) -> tuple[bytes, bytes, str] | None:
    """The next message of a listening socket: (whose, content, key of its sender, Z85); None: there is none.

    A message of several parts is dropped: nothing of ours sends one.
    """
    while True:
        try:
            whose = socket.recv(_NOW)
        except zmq.Again:
            return None
        frame = socket.recv(copy=False)  # only a frame says whose key it was; all parts of a message are there
        if not frame.more:
            return whose, frame.bytes, _user(frame)
        while socket.getsockopt(zmq.RCVMORE):
            socket.recv()


def _user(frame: zmq.Frame) -> str:
    try:
        return str(frame.get("User-Id"))
    except (zmq.ZMQError, UnicodeDecodeError):
        return ""


def answer(socket: Socket, whose: bytes, content: bytes) -> bool:
    """Send to one who has sent; False: it is gone, or takes nothing."""
    try:
        socket.send(whose, _NOW_AND_MORE)
        socket.send(content, _NOW)
    except zmq.ZMQError:
        return False
    return True


def send(socket: Socket, content: bytes) -> bool:
    """Send by a way made with `connect`; False: there is no connection, or its queue is full."""
    try:
        socket.send(content, _NOW)
    except zmq.Again:
        return False
    return True


class TeamWay:
    """A way to a driver of another robot, with a context of its own."""

    def __init__(self, address: str, here: Here, robot: str) -> None:
        """
        Raises:
            DriverError: the team's keys are not here.
        """
        self._now = TeamNow(here)
        self._context = context()
        self._limit_ms = -1
        try:
            self._connection = Connection(self._context, address, here, robot)
        except DriverError:
            close(self._context)
            raise
        self._socket = self._connection.socket

    def _renew(self) -> None:
        if self._now.look():
            self._connection.know(self._now.here)
        self._connection.mend()

    @property
    def closed(self) -> bool:
        """Whether it was let go."""
        return self._socket.closed

    def send(self, content: bytes) -> bool:
        """Send at once; False: there is no connection, or its queue is full."""
        self._renew()
        return send(self._socket, content)

    def await_sent(self, content: bytes, timeout_ns: int) -> bool:
        """Send as soon as there is a connection; False: there was none within the time."""
        return self.send(content) or (self.await_open(timeout_ns, -1) and self.send(content))

    @property
    def is_lost(self) -> bool:
        """Whether there is no connection. ZeroMQ connects again by itself."""
        return not int(self._socket.getsockopt(zmq.EVENTS)) & zmq.POLLOUT

    def await_open(self, timeout_ns: int, wake: int) -> bool:
        """Whether there is a connection within the time; ``wake``: a descriptor that ends the wait, too."""
        until_ns = time.monotonic_ns() + timeout_ns
        while True:
            self._renew()
            left_ns = max(until_ns - time.monotonic_ns(), 0)
            pause_ns = self._connection.pause_ms() * 1_000_000
            found = self._ready(zmq.POLLOUT, min(left_ns, pause_ns or left_ns), wake, mending=not pause_ns)
            if self._socket in found or wake in found or not left_ns:
                return self._socket in found

    def _ready(self, events: int, timeout_ns: int, wake: int, *, mending: bool = False) -> set[Any]:
        """Which of the socket, ``wake`` and, with ``mending``, the news of failed handshakes are ready within the time."""
        poller = zmq.Poller()
        poller.register(self._socket, events)
        if mending:
            poller.register(self._connection.monitor, zmq.POLLIN)
        if wake >= 0:
            poller.register(wake, zmq.POLLIN)
        return {one for one, _ in poller.poll(max(-(-timeout_ns // 1_000_000), 0))}

    def await_message(self, timeout_ns: int, wake: int = -1) -> bytes | None:
        """What comes; None: nothing within the time, or `wake` can be read."""
        if wake >= 0:
            return self._socket.recv(zmq.NOBLOCK) if self._socket in self._ready(zmq.POLLIN, timeout_ns, wake) else None
        limit_ms = max(-(-timeout_ns // 1_000_000), 0)
        if limit_ms != self._limit_ms:
            self._socket.setsockopt(zmq.RCVTIMEO, limit_ms)
            self._limit_ms = limit_ms
        try:
            return self._socket.recv()
        except zmq.Again:
            return None

    def close(self, linger_ms: int = 0) -> None:
        """Let it go, after so many ms in which what was sent may leave."""
        if not self.closed:
            self._connection.close()
        self._context.destroy(linger=linger_ms)


class OneTimeListener:
    """Takes messages of the owner of one key, by CURVE: for an invitation (`failover.config.invitation`)."""

    def __init__(self, host: str, port: int, robot: str, secret: bytes, admitted: bytes) -> None:
        """
        Args:
            secret, admitted: secret CURVE keys of 32 bytes: ours, and that of the one side which may connect.

        Raises:
            DriverError: the address cannot be had.
        """
        self._context = context()
        self._socket = _limited(self._context.socket(zmq.ROUTER))
        self._socket.setsockopt(zmq.HANDSHAKE_IVL, ONE_TIME_LIMIT_MS)
        self._socket.curve_server = True
        self._socket.curve_secretkey = z85.encode(secret)
        self._socket.zap_domain = ZAP_DOMAIN
        self._gate = Gate(self._context, {_public(admitted).decode(): robot})
        try:
            _bound(self._socket, f"tcp://{bracketed(host)}:{port or '*'}")
        except DriverError:
            self.close()
            raise
        self.port = int(self._socket.getsockopt_string(zmq.LAST_ENDPOINT).rpartition(":")[2])

    @property
    def refused(self) -> int:
        """How many handshakes proved no knowledge of the admitted key."""
        return self._gate.refused

    def next(self, timeout_ms: int) -> tuple[bytes, bytes] | None:
        """(whose, content) of the next message; None: nothing came, or a stranger was refused."""
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLIN)
        poller.register(self._gate.socket, zmq.POLLIN)
        poller.poll(max(timeout_ms, 0))
        self._gate.serve()
        found = receive(self._socket)
        return found[:2] if found is not None else None

    def answer(self, whose: bytes, content: bytes) -> bool:
        """Send to one who has sent; False: it is gone."""
        return answer(self._socket, whose, content)

    def close(self) -> None:
        """Listen no more."""
        close(self._context)


class OneTimeWay:
    """A way to a `OneTimeListener`."""

    def __init__(self, host: str, port: int, secret: bytes, listener: bytes) -> None:
        """
        Args:
            secret, listener: secret CURVE keys of 32 bytes: ours, and that of the other side.
        """
        self._context = context()
        self._socket = _limited(self._context.socket(zmq.DEALER))
        self._socket.setsockopt(zmq.IMMEDIATE, 1)
        self._socket.setsockopt(zmq.HANDSHAKE_IVL, ONE_TIME_LIMIT_MS)
        self._socket.curve_publickey = _public(secret)
        self._socket.curve_secretkey = z85.encode(secret)
        self._socket.curve_serverkey = _public(listener)
        self._monitor = self._socket.get_monitor_socket(HANDSHAKE_FAILED)
        self._socket.connect(f"tcp://{bracketed(host)}:{port}")

    def await_open(self, timeout_ms: int) -> bool:
        """Whether the handshake succeeds in the time; False at once where the other side refuses it."""
        poller = zmq.Poller()
        poller.register(self._socket, zmq.POLLOUT)
        poller.register(self._monitor, zmq.POLLIN)
        return bool(dict(poller.poll(timeout_ms)).get(self._socket, 0) & zmq.POLLOUT)

    def send(self, content: bytes) -> bool:
        """Send; False: there is no connection."""
        return send(self._socket, content)

    def await_message(self, timeout_ms: int) -> bytes | None:
        """What comes; None: nothing in the time."""
        return self._socket.recv() if self._socket.poll(timeout_ms, zmq.POLLIN) else None

    def close(self, linger_ms: int = 0) -> None:
        """Let it go, after so many ms in which what was sent may leave."""
        self._socket.disable_monitor()
        self._monitor.close(0)
        self._context.destroy(linger=linger_ms)


def _public(secret: bytes) -> bytes:
    return zmq.curve_public(z85.encode(secret))


class Gate:
    """Admits the robots of the team, by their keys, to all CURVE sockets of one context."""

    def __init__(self, context: Context, keys: Mapping[str, str]) -> None:
        """
        Args:
            keys: public key, Z85 → robot.
        """
        self._robots = keys
        self.socket = context.socket(zmq.REP)
        self.socket.bind(ZAP_ADDRESS)
        self.refused = 0

    def know(self, keys: Mapping[str, str]) -> None:
        """From now on these count, also on connections that stand."""
        self._robots = keys

    def owner(self, key: str) -> str:
        """The robot that a key proves; "" for none."""
        return self._robots.get(key, "")

    def serve(self) -> None:
        """Answer what was asked; to be called when `socket` can be read."""
        while True:
            try:
                version, request, _domain, _address, _identity, mechanism, *credentials = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            key = z85.encode(credentials[0]) if mechanism == b"CURVE" and len(credentials) == 1 else b""
            robot = self.owner(key.decode())
            self.refused += not robot
            status = (b"200", b"OK", key) if robot else (b"400", b"this key is not in team.toml", b"")
            self.socket.send_multipart([version, request, *status, b""])


def bracketed(host: str) -> str:
    """A host as it stands before a port."""
    return f"[{host}]" if ":" in host else host


def _limited(socket: Socket) -> Socket:
    socket.setsockopt(zmq.LINGER, 0)
    socket.setsockopt(zmq.SNDHWM, HIGH_WATER)
    socket.setsockopt(zmq.RCVHWM, HIGH_WATER)
    socket.setsockopt(zmq.MAXMSGSIZE, MESSAGE_SIZE_MAX)
    socket.setsockopt(zmq.HANDSHAKE_IVL, HANDSHAKE_LIMIT_MS)
    socket.setsockopt(zmq.TCP_MAXRT, RETRANSMIT_LIMIT_MS)
    socket.setsockopt(zmq.IPV6, 1)
    if socket.type == zmq.ROUTER:
        socket.setsockopt(zmq.ROUTER_MANDATORY, 1)
    return socket


def _bound(socket: Socket, address: str) -> Socket:
    try:
        socket.bind(address)
    except zmq.ZMQError as error:
        socket.close(0)
        raise DriverError(f"cannot listen at {address}: {error.strerror}") from error
    return socket
