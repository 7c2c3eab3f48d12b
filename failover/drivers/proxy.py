"""What a program calls drivers by: the name is looked up, and messages are sent until they are answered.

    with failover.proxy("engine") as engine:
        engine.call("set", duty=0.4)
        print(engine.call("read"))
        for amperes in engine.stream("current"):
            ...

A call is sent again until it is answered or its time is over; the driver carries it out once. Calls of one proxy are carried out
in order. A proxy may be used by several threads; one call goes on at a time.
"""

from __future__ import annotations

import itertools
import os
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec
from msgspec import UNSET, Struct

from failover.boards import boottime
from failover.config import accounts
from failover.core.messaging import envelope as envelopes
from failover.core.messaging.envelope import Envelope, Hop
from failover.core.messaging.mailbox import MS, RESEND_FIRST_NS, Outbox
from failover.core.naming.tree import Place
from failover.drivers.actor import LEASE_NS
from failover.drivers.here import Here, here, lives
from failover.drivers.local import SCHEME, LocalWay
from failover.drivers.lookup import lookup
from failover.drivers.name_service import new_boot
from failover.errors import CallRefusedError, DriverError, EnvelopeError, NameUnknownError, NoAnswerError

if TYPE_CHECKING:
    from failover.drivers.sockets import TeamWay

TIMEOUT_S: Final = 5.0
"""How long a call waits unless told otherwise."""

SECOND_NS: Final = 1_000_000_000

_NUMBERS: Final = itertools.count(1)

T = TypeVar("T")


class _Role(Struct, frozen=True):
    """Of one verb, as ``_describe`` tells it."""

    role: str = ""


class _Described(Struct, frozen=True):
    """What is read of an answer to ``_describe``."""

    verbs: dict[str, _Role] = {}


def proxy(name: str) -> Proxy:
    """The driver of that name: a path, an alias, or an address.

    Raises:
        NameFormatError, NameUnknownError, NameAmbiguousError: it names nothing, or several things.
        DriverError: it is on another robot, and no key of the team can be read here.
    """
    place = here()
    return Proxy(place, lookup(place, name))


class Proxy:
    """One driver, as another process calls it; a context manager."""

    def __init__(self, here: Here, place: Place) -> None:
        """
        Raises:
            DriverError: it is on another robot that cannot be reached.
        """
        self.here = here
        self.place = place
        self.path = place.record.path
        self.last: Envelope | None = None
        """The newest answer, with its hops."""
        program = Path(sys.argv[0] if sys.argv and sys.argv[0] else "python").stem
        self.sender = f"{here.robot}/{program}-{os.getpid()}-{next(_NUMBERS)}"
        self._by = accounts.name_of(os.geteuid()) if place.robot != here.robot else ""
        self._outbox = Outbox(self.sender, new_boot())
        self._lock = threading.Lock()
        self._skew = boottime.skew_ns()
        self._address = address_of(here, place)
        self._way = way_to(here, self._address, place.robot)

    def _connect(self, place: Place) -> None:
        """By another address, if it has one now."""
        address = address_of(self.here, place)
        if address != self._address:
            way = way_to(self.here, address, place.robot)
            self._way.close()
            self.place, self._address, self._way = place, address, way

    def close(self) -> None:
        """Let the connection go."""
        self._way.close()

    def __enter__(self) -> Proxy:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def now_ns(self) -> int:
        """The clock of this process's hops."""
        return boottime.now_ns(self._skew)

    def call(self, verb: str, body: Any = None, /, *, timeout: float = TIMEOUT_S, **fields: Any) -> Any:
        """Have a verb carried out, and return what it returns.

        Args:
            body: the arguments as a table, or the only one; or each by its name as ``fields``.
            timeout: seconds; after them the driver does not begin it any more.

        Raises:
            CallRefusedError: it was not carried out, or failed; says why.
            NoAnswerError: no answer came in time. Whether it was carried out is not known.
            EnvelopeError: no message can say this body.
            MailboxFullError: too many earlier calls have had no answer.
        """
        envelope = Envelope(
            to=self.path, verb=verb, body=self._body(body, fields), by=self._by, reliable=True, deadline_ms=timeout * 1_000
        )
        with self._lock:
            answer = self._answered(envelope, round(timeout * SECOND_NS))
        self.last = answer
        if answer.error is not UNSET:
            raise CallRefusedError(answer.error.sentence or answer.error.kind, answer.error.kind)
        return None if answer.ok is UNSET else answer.ok

    def told(self, verb: str, kind: type[T], body: Any = None, /, *, timeout: float = TIMEOUT_S) -> T:
        """`call` for a verb whose answer has a form of failover's own: the answer, checked. Fields of newer drivers are left out.

        Raises:
            DriverError: the answer has another form; names the verb and what is wrong.
            CallRefusedError, NoAnswerError: as `call`.
        """
        found = self.call(verb, body, timeout=timeout)
        try:
            return msgspec.convert(found, kind)
        except (msgspec.ValidationError, RecursionError) as error:
            raise DriverError(
                f"{self.path} answered {verb} in a form that failover does not know: {error}; "
                "end that driver, or start it with the failover of this robot"
            ) from error

    def _body(self, body: Any, fields: Mapping[str, Any]) -> Any:
        if fields and body is not None:
            raise EnvelopeError("write the body as a table, or each field by its name, and not both")
        said = fields or body
        try:
            said = msgspec.to_builtins(said, str_keys=True)
        except (TypeError, ValueError, RecursionError) as error:
            raise EnvelopeError(f"no message can say this body: {error}") from error
        envelopes.check(said)
        return UNSET if said is None else said

    def _answered(self, envelope: Envelope, timeout_ns: int) -> Envelope:
        now_ns = self.now_ns()
        until_ns = now_ns + timeout_ns
        posted = self._outbox.post(msgspec.structs.replace(envelope, hops=(Hop(self.sender, now_ns),)), now_ns)
        self._outbox.committed()
        busy = ""
        turns = 0
        while now_ns < until_ns:
            due = self._outbox.due(now_ns)
            if turns and due:
                self._look_again(until_ns - now_ns)
            for one in due:
                self._way.await_sent(self._encoded(one), min(until_ns - now_ns, RESEND_FIRST_NS))
            turns += 1
            next_ns = self._outbox.next_ns()
            content = self._way.await_message(max(min(until_ns, next_ns or until_ns) - now_ns, 0))
            now_ns = self.now_ns()
            answer = _decoded(content) if content is not None else None
            if answer is None:
                if self._way.is_lost:  # the driver has ended: it is asked anew once it is there again
                    self._outbox.connected(now_ns)
                continue
            self._outbox.answered(answer)
            if answer.re == posted.id:
                if answer.error is UNSET or answer.error.kind != "busy":
                    return answer
                busy = answer.error.sentence
        raise NoAnswerError(self._no_answer(envelope.verb, timeout_ns, busy))

    def _encoded(self, envelope: Envelope) -> bytes:
        """As it leaves now. Of one that is sent again the first stamp stays."""
        return envelopes.encode(envelopes.left(envelope, self.now_ns()))

    def _look_again(self, limit_ns: int) -> None:
        """It has not answered: it may have been started anew, at another address."""
        try:
            self._connect(lookup(self.here, self.path, limit_ns))
        except (NameUnknownError, DriverError):
            return  # it is waited for where it was

    def _no_answer(self, verb: str, timeout_ns: int, busy: str) -> str:
        said = f"{self.path} did not answer {verb!r} within {timeout_ns / SECOND_NS:g} s"
        if busy:
            return f"{said}: it is busy: {busy}"
        if self.place.robot == self.here.robot and not lives(self.here, self.path):
            return f"{said}: its process has ended; start it again"
        return f"{said}; it may still carry it out"

    def stream(self, name: str) -> Iterator[Any]:
        """The values of a stream, one after the other, while they are asked for; those that cannot be taken in time are lost.

        Raises:
            CallRefusedError: the driver has no such stream, or it failed at it.
            DriverError: it does not say which streams it has.
        """
        if self.told("_describe", _Described).verbs.get(name, _Role()).role != "stream":
            raise CallRefusedError(f"{self.path} has no stream {name!r}", "unknown_verb")
        way = way_to(self.here, self._address, self.place.robot)
        asked = Envelope(
            to=self.path, verb="_subscribe", body={"stream": name}, sender=f"{self.sender}-{next(_NUMBERS)}", by=self._by
        )
        again_ns = self.now_ns()
        try:
            while True:
                now_ns = self.now_ns()
                if now_ns >= again_ns and way.await_sent(envelopes.encode(asked), SECOND_NS):
                    again_ns = now_ns + LEASE_NS // 3
                content = way.await_message(max(again_ns - now_ns, MS))
                again_ns = 0 if way.is_lost else again_ns
                value = _decoded(content) if content is not None else None
                if value is None:
                    continue
                is_denied = value.error is not UNSET and value.error.kind == "denied"
                if value.verb != name and not is_denied:
                    continue
                if value.error is not UNSET:
                    raise CallRefusedError(value.error.sentence, value.error.kind)
                yield None if value.ok is UNSET else value.ok
        finally:
            way.send(envelopes.encode(msgspec.structs.replace(asked, verb="_unsubscribe")))
            way.close(LINGER_MS)


LINGER_MS: Final = 100
"""How long the farewell of a stream may take to leave."""


def way_to(here: Here, address: str, robot: str) -> LocalWay | TeamWay:
    """A way to a driver at this address; `DriverError`: the team's keys are not here."""
    if address.startswith(SCHEME):
        return LocalWay(address.removeprefix(SCHEME))
    from failover.drivers.sockets import TeamWay  # ZeroMQ is loaded only by who needs other robots

    return TeamWay(address, here, robot)


def address_of(here: Here, place: Place) -> str:
    """By which address this process reaches a driver: a unix socket on its own robot, else tcp.

    Raises:
        DriverError: by none.
    """
    scheme = SCHEME if place.robot == here.robot else "tcp://"
    found = next((address for address in place.record.addresses if address.startswith(scheme)), "")
    if not found:
        why = here.alone or f"its driver on {place.robot} opened no port: the key of the team could not be read there"
        raise DriverError(f"cannot reach {place.record.path} on {place.robot}: {why}")
    return found


def _decoded(content: bytes) -> Envelope | None:
    try:
        return envelopes.decode(content)
    except EnvelopeError:
        return None
