"""Runs a driver: its sockets, its name service, and the loop in which one message after the other is carried out."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from typing import Any, Final, TypeVar

from msgspec import Struct

from failover.boards import boottime
from failover.core.messaging import envelope as envelopes
from failover.core.messaging.by_hand import Typed
from failover.core.messaging.envelope import Envelope, Fault
from failover.core.naming.records import Record, pack
from failover.core.naming.scan import Terms
from failover.core.naming.tables import BODY_SIZE_MAX
from failover.core.naming.tree import robot_of
from failover.drivers import sockets
from failover.drivers.actor import Actor, Whose
from failover.drivers.declare import Declaration, declaration_of
from failover.drivers.here import Here, here, hold, stem
from failover.drivers.name_service import NameService
from failover.errors import DriverError, EnvelopeError
from failover.kept_state.component import kept_of

T = TypeVar("T")

TURN_MAX: Final = 256
"""Messages taken in between two that are carried out."""

UNSENT_MAX: Final = 4 << 20
"""Bytes of answers that wait for one who does not read; then the connection is closed."""

HANDS_MAX: Final = 64
"""Connections of people at once."""

CHUNK: Final = 64 << 10

log = logging.getLogger("failover.drivers")


class Peer(Struct, frozen=True):
    """One who has sent by ZeroMQ. ``team``: by tcp."""

    team: bool
    identity: bytes


class Hand(Struct, frozen=True):
    """One who types into a connection, by its descriptor."""

    descriptor: int
    number: int


class Typing(Struct):
    """A connection of a person.

    Attributes:
        unsent: what the connection has not taken yet.
        waiting: messages without an answer.
        is_over: no more will come (``nc -N``).
    """

    connection: socket.socket
    typed: Typed
    unsent: bytearray
    waiting: int = 0
    is_over: bool = False


def run(cls: type[T]) -> T:
    """Make the driver and carry out its messages until SIGTERM or Ctrl-C.

    Returns:
        The driver, after its last message.

    Raises:
        DriverError: it cannot take messages.
        NameFormatError: its path belongs to another robot.
    """
    if kept_of(cls):
        raise DriverError(
            f"{cls.__name__} keeps attributes (failover.kept), and a driver keeps none yet: what it knows ends with it; "
            "failover program run keeps them"
        )
    serving = Serving(cls)
    with serving, _signals(serving):
        for line in serving.addresses_told():
            print(line, file=sys.stderr, flush=True)
        serving.serve()
    return serving.instance  # type: ignore[no-any-return]


class Serving:
    """A driver with open sockets; a context manager. `serve` runs until `stop` is called, from any thread or signal."""

    def __init__(self, cls: type, place: Here | None = None, terms: Terms = Terms()) -> None:  # noqa: B008  frozen
        """
        Raises:
            DriverError: it cannot take messages.
        """
        declaration = declaration_of(cls)
        self.here = place or here()
        self._name = stem(declaration.path, self.here.directory)
        self._skew = boottime.skew_ns()
        self._hands: dict[Hand, Typing] = {}
        self._numbers = 0
        self._is_over = False
        with contextlib.ExitStack() as stack:
            lock = hold(self.here, declaration.path)
            stack.callback(os.close, lock)
            self._wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
            stack.callback(os.close, self._wake)
            self._open(declaration, stack)
            self.service = NameService(self.here, self.record_of(declaration), terms)
            stack.callback(self.service.close)
            self.instance, self._actor = self._made(cls, declaration, f"{self.here.robot}/{self._name}")
            self.service.start()
            self._stack = stack.pop_all()

    def _made(self, cls: type, declaration: Declaration, who: str) -> tuple[Any, Actor]:
        """The driver, and what hands it its messages."""
        instance = cls()
        return instance, Actor(instance, declaration, who)

    def _open(self, declaration: Declaration, stack: contextlib.ExitStack) -> None:
        path = declaration.path
        self._context = sockets.context()
        stack.callback(sockets.close, self._context)
        self._local = sockets.listen_local(self._context, os.fspath(self.here.file(path, "ipc")))
        stack.callback(self.here.file(path, "ipc").unlink, missing_ok=True)
        self._poller = sockets.Poller()
        self._poller.add(self._local)
        self._poller.add(self._wake)
        self._team: sockets.Socket | None = None
        self._gate: sockets.Gate | None = None
        self._addresses = [f"ipc://{self.here.file(path, 'ipc')}"]
        if self.here.team is not None:
            robots = {name: robot.public_key for name, robot in self.here.team.robots.items()}
            self._gate = sockets.Gate(self._context, robots)
            self._team, address = sockets.listen_team(self._context, self.here)
            self._addresses.append(address)
            self._poller.add(self._gate.socket)
            self._poller.add(self._team)
        hand = self.here.file(path, "hand")
        hand.unlink(missing_ok=True)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK | socket.SOCK_CLOEXEC)
        stack.callback(self._listener.close)
        self._listener.bind(os.fspath(hand))
        stack.callback(hand.unlink, missing_ok=True)
        self._listener.listen(HANDS_MAX)
        self._poller.add(self._listener.fileno())
        self._addresses.append(f"unix://{hand}")

    def record_of(self, declaration: Declaration) -> Record:
        """With the schemas of its verbs, if a record has room for them; else with their names."""
        record = Record(
            declaration.path,
            addresses=tuple(self._addresses),
            aliases=declaration.aliases,
            verbs=declaration.schemas(),
            labels=dict(declaration.labels),
        )
        if len(pack(record)) <= BODY_SIZE_MAX:
            return record
        verbs: dict[str, Any] = {name: {"role": verb.marked.role} for name, verb in declaration.verbs.items()}
        return Record(record.path, addresses=record.addresses, aliases=record.aliases, verbs=verbs, labels=record.labels)

    def addresses_told(self) -> list[str]:
        """For the person who started it: where it takes messages, and whether other robots reach it."""
        lines = [f"{self.service.record.path} takes messages at {', '.join(self._addresses)}"]
        return lines + (
            [f"only programs of this user on {self.here.robot} reach it: {self.here.alone}"] if self.here.alone else []
        )

    def __enter__(self) -> Serving:
        return self

    def __exit__(self, *_: object) -> None:
        for typing in self._hands.values():
            typing.connection.close()
        self._stack.close()

    def stop(self) -> None:
        """End `serve` after the message in hand."""
        self._is_over = True
        self.wake()

    def wake(self) -> None:
        """Have `serve` look at its actor, from any thread or signal."""
        with contextlib.suppress(OSError):
            os.eventfd_write(self._wake, 1)

    def now_ns(self) -> int:
        """The clock of this process's hops."""
        return boottime.now_ns(self._skew)

    # --- The loop ---------------------------------------------------------------------------------------------------------

    def serve(self) -> None:
        """Carry out messages until `stop`."""
        while not self._is_over:
            for ready in self._poller.wait(self._actor.wait_ns(self.now_ns())):
                if isinstance(ready, int):
                    self._read(ready)
                elif self._gate is not None and ready is self._gate.socket:
                    self._gate.serve()
                else:
                    self._take(ready)
            self._send(self._actor.handle(self.now_ns))
            self._actor.sample(self._publish, self.now_ns)

    def _take(self, listening: sockets.Socket) -> None:
        """All messages that have come by ZeroMQ, up to `TURN_MAX`."""
        is_team = listening is self._team
        for _ in range(TURN_MAX):
            message = sockets.receive(listening, is_team=is_team)
            if message is None:
                return
            identity, content, robot = message
            self._came(content, Peer(is_team, identity), robot)
            if not sockets.has_message(listening):
                return

    def _came(self, content: bytes, whose: Whose, robot: str | None) -> None:
        """One message. ``robot``: which its key proves; None: it came from this robot."""
        now_ns = self.now_ns()
        try:
            envelope = envelopes.decode(content)
        except EnvelopeError as error:
            self._publish(whose, Envelope(error=Fault("no_message", str(error))))
            return
        if robot is not None and robot_of(envelope.sender) != robot:
            self._publish(
                whose,
                envelopes.refusal(envelope, "wrong_sender", f"{envelope.sender!r} is no process of {robot}, whose key this is"),
            )
            return
        self._send(self._actor.came(envelope, whose, now_ns))

    def _send(self, answers: list[Envelope]) -> None:
        for one in answers:
            whose = self._actor.route(one.to)
            if whose is not None:
                self._publish(whose, one)

    def _publish(self, whose: Whose, envelope: Envelope) -> bool:
        """Send to one, if it is there and takes it now: who misses an answer to what matters sends it again."""
        content = envelopes.encode(envelope)
        if isinstance(whose, Hand):
            return self._write(whose, content + b"\n")
        assert isinstance(whose, Peer)
        listening = self._team if whose.team else self._local
        return listening is not None and sockets.answer(listening, whose.identity, content)

    # --- By hand ----------------------------------------------------------------------------------------------------------

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            connection, _ = self._listener.accept()
            if len(self._hands) >= HANDS_MAX:
                connection.close()
                return
            connection.setblocking(False)
            self._numbers += 1
            self._hands[Hand(connection.fileno(), self._numbers)] = Typing(connection, Typed(), bytearray())
            self._poller.add(connection.fileno())

    def _read(self, descriptor: int) -> None:
        """What came by a descriptor: a person's connection, what that person typed, or the order to end."""
        if descriptor == self._listener.fileno():
            self._accept()
            return
        hand = next((one for one in self._hands if one.descriptor == descriptor), None)
        if hand is None:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._wake)
            return
        typing = self._hands[hand]
        try:
            content = typing.connection.recv(CHUNK) if not typing.is_over else b""
            found = typing.typed.take(content)
        except BlockingIOError:
            found = []
        except EnvelopeError as error:
            self._publish(hand, Envelope(error=Fault("no_message", str(error))))
            typing.is_over, found = True, []
        except OSError:
            self._drop(hand)
            return
        else:
            typing.is_over |= not content
        for one in found:
            typing.waiting += 1
            self._came(one, hand, None)
        self._flush(hand, typing)

    def _write(self, hand: Hand, content: bytes) -> bool:
        typing = self._hands.get(hand)
        if typing is None:
            return False
        typing.waiting -= 1
        typing.unsent += content
        self._flush(hand, typing)
        return hand in self._hands

    def _flush(self, hand: Hand, typing: Typing) -> None:
        """Send what the connection takes, and close it after the last answer."""
        if hand not in self._hands:
            return
        try:
            del typing.unsent[: typing.connection.send(typing.unsent) if typing.unsent else 0]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(hand)
            return
        if len(typing.unsent) > UNSENT_MAX or (typing.is_over and typing.waiting <= 0 and not typing.unsent):
            self._drop(hand)
        else:
            self._poller.add(hand.descriptor, reading=not typing.is_over, writing=bool(typing.unsent))

    def _drop(self, hand: Hand) -> None:
        typing = self._hands.pop(hand)
        self._poller.add(hand.descriptor, reading=False)
        typing.connection.close()


@contextlib.contextmanager
def _signals(serving: Serving) -> Iterator[None]:
    """SIGTERM and Ctrl-C end the driver after the message in hand."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, lambda *_: serving.stop()) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
