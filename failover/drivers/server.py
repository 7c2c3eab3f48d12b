"""Runs a driver: its sockets, its name service, and the loop in which one message after the other is carried out."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final, Self, TypeVar

import msgspec
from msgspec import Struct

from checkpoint.linux.signal_wakeup import BYTES_AT_ONCE, told_of_signals
from failover.boards import boottime
from failover.core.messaging import envelope as envelopes
from failover.core.messaging.by_hand import Typed
from failover.core.messaging.envelope import Encoding, Envelope, Fault
from failover.core.messaging.mailbox import SENDERS_MAX
from failover.core.naming.records import Record, pack
from failover.core.naming.scan import Terms
from failover.core.naming.tables import BODY_SIZE_MAX
from failover.core.naming.tree import robot_of
from failover.core.naming.worlds import is_simulated
from failover.drivers import local
from failover.drivers.actor import Actor, Whose
from failover.drivers.call_rights import CallRights
from failover.drivers.carried_out import CarriedOut
from failover.drivers.declare import Declaration, declaration_of
from failover.drivers.here import Here, TeamNow, here, hold, stem
from failover.drivers.name_service import NameService
from failover.errors import EnvelopeError, NotCommittedError
from failover.fencing.epoch import epoch
from failover.kept_state.component import kept_of

if TYPE_CHECKING:
    from failover.drivers import sockets
    from failover.drivers.keeping import Keeping

T = TypeVar("T")
S = TypeVar("S", bound="Serving")

TURN_MAX: Final = 256
"""Messages taken in between two that are carried out."""

UNSENT_MAX: Final = 4 << 20
"""Bytes of answers that wait for one who does not read; then the connection is closed."""

LINGER_MS: Final = 1_000
"""How long the last answers may take to leave: who misses one sends the message again."""

BY_HAND_NUMBERS: Final = 1_000_000_000
"""Of messages of other robots that name no sender."""

HANDS_MAX: Final = 64
"""Connections of people at once."""

CHUNK: Final = 64 << 10

LISTEN_FIRST_NS: Final = 5_000_000
LISTEN_MOST_NS: Final = 1_000_000_000
"""Between two tries to listen again with another key; the pause doubles from first to most."""

log = logging.getLogger("failover.drivers")


class Peer(Struct, frozen=True):
    """One of another robot, by ZeroMQ's name for its connection. ``key``: with which that was made, Z85."""

    identity: bytes
    key: str


class Near(Struct, frozen=True):
    """One of this robot, by the descriptor of its connection. ``uid``: its user, as the kernel says."""

    descriptor: int
    number: int
    uid: int


class Hand(Struct, frozen=True):
    """One who types into a connection, by its descriptor. ``uid``: its user."""

    descriptor: int
    number: int
    uid: int


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
    with stopped_by_signals(lambda: Serving(cls)) as serving, serving:
        for line in serving.addresses_told():
            print(line, file=sys.stderr, flush=True)
        serving.serve()
    return serving.instance  # type: ignore[no-any-return]


class Serving:
    """A driver with open sockets; a context manager. `serve` runs until `stop` is called, from any thread or signal."""

    def __init__(
        self,
        cls: type,
        place: Here | None = None,
        terms: Terms = Terms(),  # noqa: B008  frozen
        epoch: Callable[[], int] = epoch,
    ) -> None:
        """
        Args:
            epoch: of the primacy under which this process runs now; 0 without an agent.

        Raises:
            DriverError: it cannot take messages.
        """
        declaration = declaration_of(cls)
        self.here = place or here()
        self._now = TeamNow(self.here)
        self._epoch, self._epoch_told = epoch, 0
        self._name = stem(declaration.path, self.here.directory)
        self._skew = boottime.skew_ns()
        self._rights = CallRights(self.here.rules, declaration.path)
        self._hands: dict[Hand, Typing] = {}
        self._near: dict[Near, local.Connection] = {}
        self._encodings: dict[Whose, Encoding] = {}
        """Of those whose newest message was not in JSON: they are answered as they write."""
        self._readers: dict[int, Callable[[], None]] = {}
        self._numbers = 0
        self._is_over = False
        self._wake = -1
        with contextlib.ExitStack() as stack:
            self._keeping = self._begin(cls, declaration, stack)
            lock = hold(self.here, declaration.path)
            stack.callback(os.close, lock)
            self._wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
            stack.callback(os.close, self._wake)
            self._open(declaration, stack)
            self.service = NameService(self.here, self.record_of(declaration), terms, epoch, self._others(), self.wake)
            stack.callback(self.service.close)
            self.instance, self._actor = self._made(cls, declaration, f"{self.here.robot}/{self._name}")
            self._actor.fence = self._fence
            if self._keeping is not None:
                self._wait_for(self._keeping.fileno(), functools.partial(self._hear_kept, self._keeping))
                self._keeping.resumed()
            self.service.start()
            self._stack = stack.pop_all()

    def _begin(self, cls: type, declaration: Declaration, stack: contextlib.ExitStack) -> Keeping | None:
        """The kept state, if there is one: before anything is opened, as a warm driver on a standby waits here."""
        if not kept_of(cls):
            return None
        from failover.drivers.keeping import Keeping

        keeping = Keeping(cls, declaration)
        stack.callback(keeping.close)
        return keeping

    def _others(self) -> Sequence[Record]:
        """What this process registers besides its own record."""
        return ()

    def _made(self, cls: type, declaration: Declaration, who: str) -> tuple[Any, Actor]:
        """The driver, and what hands it its messages."""
        if self._keeping is not None:
            return self._keeping.instance, Actor(self._keeping.instance, declaration, who, self._keeping)
        instance = cls()
        carried_out = CarriedOut(self.here.file(declaration.path, "done"), declaration.path)
        return instance, Actor(instance, declaration, who, carried_out=carried_out)

    def _open(self, declaration: Declaration, stack: contextlib.ExitStack) -> None:
        path = declaration.path
        self._poller = local.Poller()
        stack.callback(self._poller.close)
        self._wait_for(self._wake, self._woken)
        calls, hand = self.here.file(path, "calls"), self.here.file(path, "hand")
        self._addresses = [f"{local.SCHEME}{calls}"]
        self._team: sockets.Socket | None = None
        self._withdrawn = ""
        """The address at which it is to listen again; "": it does."""
        self._listen_ns = self._listen_pause_ns = 0
        self._is_deaf_told = False
        if self.here.team is not None:
            self._open_team(stack)
        for file, accept in ((calls, self._accept_near), (hand, self._accept_hand)):
            listener = local.listen(file)
            stack.callback(file.unlink, missing_ok=True)
            stack.callback(listener.close)
            self._wait_for(listener.fileno(), functools.partial(accept, listener))
        self._addresses.append(f"unix://{hand}")

    def _open_team(self, stack: contextlib.ExitStack) -> None:
        """ZeroMQ, with its thread, only where other robots may call."""
        from failover.drivers import sockets

        self._sockets = sockets
        context = sockets.context()
        stack.callback(sockets.close, context, LINGER_MS)
        self._gate = sockets.Gate(context, self.here.keys)
        self._team, address = sockets.listen_team(context, self.here)
        self._addresses.append(address)
        self._wait_for(self._gate.socket.fileno(), self._admit)
        self._wait_for(self._team.fileno(), self._take_team)

    def _wait_for(self, descriptor: int, read: Callable[[], None]) -> None:
        self._readers[descriptor] = read
        self._poller.add(descriptor)

    def record_of(self, declaration: Declaration) -> Record:
        """With the schemas of its verbs, if a record has room for them; else with their names."""
        record = Record(
            declaration.path,
            kind="simulated" if is_simulated(declaration.path) else "driver",
            addresses=tuple(self._addresses),
            aliases=declaration.aliases,
            verbs=declaration.schemas(),
            epoch=self._epoch(),
            labels=dict(declaration.labels),
        )
        if len(pack(record)) <= BODY_SIZE_MAX:
            return record
        verbs: dict[str, Any] = {verb.name: {"role": verb.marked.role} for verb in declaration.shown}
        return msgspec.structs.replace(record, verbs=verbs)

    def addresses_told(self) -> list[str]:
        """For the person who started it: where it takes messages, and whether other robots reach it."""
        lines = [f"{self.service.record.path} takes messages at {', '.join(self._addresses)}"]
        return lines + (
            [f"only programs of this user on {self.here.robot} reach it: {self.here.alone}"] if self.here.alone else []
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for typing in self._hands.values():
            typing.connection.close()
        local.close_all(list(self._near.values()), LINGER_MS)
        self._stack.close()

    def stop(self) -> None:
        """End `serve` after the message in hand."""
        self._is_over = True
        self.wake()

    def wake(self) -> None:
        """Have `serve` look at its actor, from any thread or signal."""
        if self._wake >= 0:
            with contextlib.suppress(OSError):
                os.eventfd_write(self._wake, 1)

    def now_ns(self) -> int:
        """The clock of this process's hops."""
        return boottime.now_ns(self._skew)

    def _fence(self, told: int) -> str:
        """Why this copy may not act any more: another one runs under a later epoch, as a sender or the names say."""
        own = self._epoch()
        if own != self._epoch_told:
            self._epoch_told = own
            self.service.look()
        if not own:
            return ""
        path = self.service.record.path
        rival = self.service.rival
        if rival is not None and rival.record.epoch > max(own, told):
            return f"{path} runs on {rival.robot} under epoch {rival.record.epoch}; this copy has epoch {own}"
        return f"{path} runs elsewhere under epoch {told}; this copy has epoch {own}" if told > own else ""

    # --- The loop ---------------------------------------------------------------------------------------------------------

    def serve(self) -> None:
        """Carry out messages until `stop`."""
        while not self._is_over:
            for ready in self._poller.wait(self._wait_ns()):
                if (read := self._readers.get(ready)) is not None:  # an earlier one of this turn may have closed it
                    read()
            self._act()

    def _act(self) -> None:
        """Carry out what is due now."""
        self._act_for(self._actor)

    def _act_for(self, actor: Actor) -> None:
        self._send(actor, actor.handle(self.now_ns))
        actor.count()
        actor.sample(self._publish, self.now_ns)

    def _addressed(self, to: str) -> Actor | None:
        """Who is to get a message; None: nothing here has that name."""
        return self._actor

    def _due_ns(self, now_ns: int) -> int | None:
        """How long until something is to be done although nothing comes; None: for ever."""
        return self._actor.wait_ns(now_ns)

    def _wait_ns(self) -> int | None:
        """How long the next wait may take. ZeroMQ's descriptor tells of news once, and an answer that left may have used it."""
        if self._team is not None and self._sockets.has_message(self._team):
            for _ in range(TURN_MAX):
                self._take_team()
                if not self._sockets.has_message(self._team):
                    break
            return 0
        now_ns = self.now_ns()
        wait_ns = self._due_ns(now_ns)
        if not self._withdrawn:
            return wait_ns
        if now_ns >= self._listen_ns:
            self._listen_again()
        left_ns = max(self._listen_ns - now_ns, 0)
        return left_ns if wait_ns is None else min(wait_ns, left_ns)

    def _woken(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._wake)
        self._look_at_team()

    def _hear_kept(self, keeping: Keeping) -> None:
        try:
            keeping.heard()
        except NotCommittedError as error:  # the next message that is carried out ends the driver with it
            log.warning("%s", error)
            self._close(keeping.fileno())

    def _admit(self) -> None:
        """Who connects has perhaps come into the team, or has another key, just now."""
        self._look_at_team()
        self._gate.serve()

    def _look_at_team(self) -> None:
        """Go on with the members and keys that the team has now."""
        before = self._now.here
        if not self._now.look():
            return
        here = self.here = self._now.here
        self._gate.know(here.keys)
        if self._team is not None and here.secret != before.secret:
            self._withdrawn = self._sockets.prove_anew(self._team, here)
            self._listen_pause_ns = LISTEN_FIRST_NS
            self._listen_again()

    def _listen_again(self) -> None:
        """Try to take messages of other robots again, with another key; the driver goes on meanwhile."""
        assert self._team is not None
        if self._sockets.listen_again(self._team, self._withdrawn):
            self._withdrawn = ""
            return
        self._listen_ns = self.now_ns() + self._listen_pause_ns
        if self._listen_pause_ns == LISTEN_MOST_NS and not self._is_deaf_told:
            self._is_deaf_told = True
            log.error(
                "no other robot reaches this driver: another program has taken %s while this robot's key was replaced; end "
                "that one, and the driver listens there again by itself",
                self._withdrawn,
            )
        self._listen_pause_ns = min(2 * self._listen_pause_ns, LISTEN_MOST_NS)

    def _take_team(self) -> None:
        """One message of another robot, if one has come; `_wait_ns` takes those behind it."""
        assert self._team is not None
        if (message := self._sockets.receive(self._team)) is not None:
            identity, content, key = message
            self._look_at_team()
            if robot := self._gate.owner(key):
                self._came(content, Peer(identity, key), robot)

    def _accept_near(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            end, _ = listener.accept()
            if len(self._near) >= local.CONNECTIONS_MAX:
                end.close()
                return
            self._numbers += 1
            connection = local.Connection(end)
            near = Near(connection.descriptor, self._numbers, connection.uid)
            self._near[near] = connection
            self._wait_for(connection.descriptor, functools.partial(self._read_near, near, connection))

    def _read_near(self, near: Near, connection: local.Connection) -> None:
        if connection.has_unsent:
            connection.flush()
            self._poller.add(near.descriptor, writing=connection.has_unsent)
        found = connection.receive()
        if found is None:
            del self._near[near]
            self._encodings.pop(near, None)
            self._close(near.descriptor)
            connection.close()
            return
        for content in found:
            self._came(content, near, None)

    def _close(self, descriptor: int) -> None:
        """Wait for it no more: it is closed next, and the kernel gives its number to another one."""
        del self._readers[descriptor]
        self._poller.remove(descriptor)

    def _came(self, content: bytes, whose: Near | Hand | Peer, robot: str | None) -> None:
        """One message. ``robot``: which its key proves; None: it came from this robot."""
        now_ns = self.now_ns()
        try:
            envelope = envelopes.decode(content)
        except EnvelopeError as error:
            self._publish(whose, Envelope(error=Fault("no_message", str(error))))
            return
        self._note_encoding(whose, envelopes.encoding_of(content))
        if robot is not None and not envelope.sender:
            envelope = msgspec.structs.replace(envelope, sender=f"{robot}/by-hand-{hash(whose) % BY_HAND_NUMBERS}")
        if robot is not None and robot_of(envelope.sender) != robot:
            self._publish(
                whose,
                envelopes.refusal(envelope, "wrong_sender", f"{envelope.sender!r} is no process of {robot}, whose key this is"),
            )
            return
        actor = self._addressed(envelope.to)
        if actor is None:
            why = f"nothing that {self.service.record.path} speaks for is called {envelope.to[:200]!r}: look the name up anew"
            self._publish(whose, envelopes.refusal(envelope, "wrong_driver", why))
            return
        if fault := actor.turned_away(envelope):  # before its rights: those of the copy that acts count
            said = envelopes.refusal(envelope, fault.kind, fault.sentence)
            self._publish(whose, msgspec.structs.replace(said, epoch=self._epoch_told))
            return
        uid = None if isinstance(whose, Peer) else whose.uid
        if not envelope.verb.startswith("_") or envelope.verb == "_subscribe":
            denied = self._rights_of(actor).refusal(uid, robot, envelope.by)
            if denied:
                self._publish(whose, envelopes.refusal(envelope, "denied", denied))
                return
        self._send(actor, actor.came(envelope, whose, now_ns, len(content)))

    def _rights_of(self, actor: Actor) -> CallRights:
        """Who may call it."""
        return self._rights

    def _note_encoding(self, whose: Whose, encoding: Encoding) -> None:
        if encoding != "json":
            self._encodings.pop(whose, None)  # the one that wrote last is forgotten last
            self._encodings[whose] = encoding
            if len(self._encodings) > SENDERS_MAX:
                del self._encodings[next(iter(self._encodings))]
        elif self._encodings:
            self._encodings.pop(whose, None)

    def _send(self, actor: Actor, answers: list[Envelope]) -> None:
        for one in answers:
            whose = actor.route(one.to)
            if whose is not None:
                self._publish(whose, msgspec.structs.replace(one, epoch=self._epoch_told) if self._epoch_told else one)

    def _publish(self, whose: Whose, envelope: Envelope) -> bool:
        """Send to one, if it is there and takes it now: who misses an answer to what matters sends it again."""
        content = envelopes.encode_answer(envelope, self._encodings.get(whose, "json"))
        if isinstance(whose, Near):
            connection = self._near.get(whose)
            if connection is None:
                return False
            is_sent = connection.send(content)
            if connection.has_unsent:
                self._poller.add(whose.descriptor, writing=True)
            return is_sent
        if isinstance(whose, Hand):
            return self._write(whose, content + b"\n")
        assert isinstance(whose, Peer)
        if not self._gate.owner(whose.key):
            return False
        return self._team is not None and self._sockets.answer(self._team, whose.identity, content)

    # --- By hand ----------------------------------------------------------------------------------------------------------

    def _accept_hand(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):
            connection, _ = listener.accept()
            if len(self._hands) >= HANDS_MAX:
                connection.close()
                return
            connection.setblocking(False)
            self._numbers += 1
            hand = Hand(connection.fileno(), self._numbers, local.uid_of(connection))
            self._hands[hand] = Typing(connection, Typed(), bytearray())
            self._wait_for(hand.descriptor, functools.partial(self._read_hand, hand))

    def _read_hand(self, hand: Hand) -> None:
        """What a person has typed."""
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
        self._close(hand.descriptor)
        typing.connection.close()


@contextlib.contextmanager
def stopped_by_signals(make: Callable[[], S]) -> Iterator[S]:
    """SIGTERM and Ctrl-C end the driver after the message in hand, also where they come right before the wait for one.

    Callers may reach it before ``make`` has returned: until then they end the process, with status 0.
    """
    if threading.current_thread() is not threading.main_thread():
        yield make()
        return
    made: list[S] = []

    def heed(*_: object) -> None:
        if not made:
            raise SystemExit(0)
        made[0].stop()

    with told_of_signals() as heard:
        before = {number: signal.signal(number, heed) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            made.append(make())
            made[0]._wait_for(heard.fileno(), functools.partial(_discard, heard))
            yield made[0]
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


def _discard(heard: socket.socket) -> None:
    with contextlib.suppress(BlockingIOError):
        heard.recv(BYTES_AT_ONCE)
