"""What a program calls drivers by: the name is looked up, and messages are sent until they are answered.

    with failover.proxy("engine") as engine:
        engine.call("set", duty=0.4)                   # waits for the answer
        done = engine.post("set", duty=0.5)            # does not; a concurrent.futures.Future
        for amperes in engine.stream("current"):
            ...

A message is sent again until it is answered or its time is over; the driver carries it out once. Calls and posts of one proxy are
carried out in order. A proxy may be used by several threads; one call goes on at a time.
"""

from __future__ import annotations

import concurrent.futures
import itertools
import os
import sys
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar, get_args

import msgspec
from msgspec import UNSET, Struct

from failover.config import accounts
from failover.core.messaging import envelope as envelopes
from failover.core.messaging.envelope import SPEAKS, TEXT_MAX, VERSION_SIZE_MAX, Encoding, Envelope, Hop, is_version
from failover.core.messaging.mailbox import WINDOW
from failover.core.naming.tree import Place
from failover.drivers.here import Here, here, is_served
from failover.drivers.in_hand import hops_so_far
from failover.drivers.local import SCHEME
from failover.drivers.lookup import lookup
from failover.drivers.route import Route
from failover.drivers.sending import EXPIRED, SECOND_NS, Posting, Sending, refused
from failover.drivers.streaming import Streaming
from failover.errors import CallRefusedError, DriverError, EnvelopeError, NoAnswerError

TIMEOUT_S: Final = 5.0
"""How long a call waits unless told otherwise; and the end of a ``with`` block for what was posted in it."""

NUMBERS_SIZE: Final = 4 << 10
"""Bytes of a message for its sender, id and numbers, which it gets when it is taken."""

_NUMBERS: Final = itertools.count(1)

T = TypeVar("T")


class _Role(Struct, frozen=True):
    """Of one verb, as ``_describe`` tells it."""

    role: str = ""


class _Described(Struct, frozen=True):
    """What is read of an answer to ``_describe``."""

    verbs: dict[str, _Role] = {}


def proxy(
    name: str, *, queue: int = WINDOW, sender: str = "", encoding: Encoding = "json", durable: bool = False, version: str = ""
) -> Proxy:
    """The driver of that name: a path, an alias, or an address.

    Args:
        queue: messages that may wait for an answer, from 1 to 1,024; one more is refused.
        sender: a name of this program that stays the same when it is started again: what its process before has sent and was not
            carried out is then never carried out after what this one sends. One process at a time uses it. "": a new name.
        encoding: of messages and their answers: json, msgpack or avro; a driver that cannot read it gets JSON.
        durable: what has no answer when the program ends is kept in a file, and sent when a program with this ``sender`` and
            ``durable`` runs again on this robot, before what that one posts. The file is in ``$FAILOVER_STATE``, else in the
            working directory. Each call and post then waits for the disk.
        version: of the driver's verbs that this program speaks. "": the newest, whichever that is.

    Raises:
        NameFormatError, NameUnknownError, NameAmbiguousError: it names nothing, or several things.
        DriverError: it is on another robot, and no key of the team can be read here; or an argument cannot work.
    """
    place = here()
    return Proxy(place, lookup(place, name), queue=queue, sender=sender, encoding=encoding, durable=durable, version=version)


class Proxy:
    """One driver, as another process calls it; a context manager."""

    def __init__(
        self,
        here: Here,
        place: Place,
        *,
        queue: int = WINDOW,
        sender: str = "",
        encoding: Encoding = "json",
        durable: bool = False,
        version: str = "",
    ) -> None:
        """
        Raises:
            DriverError: it is on another robot that cannot be reached, an argument cannot work, or no file can be kept.
        """
        self.here = here
        self.path = place.record.path
        self.last: Envelope | None = None
        """The newest answer to a call, with its hops."""
        if not 1 <= queue <= WINDOW:
            raise DriverError(f"queue={queue} is no number of messages that can wait: write one from 1 to {WINDOW}")
        _check_encoding(encoding)
        if version and not is_version(version):
            raise DriverError(
                f'version={version!r} is none: write text, such as version="1"; {VERSION_SIZE_MAX} characters at most'
            )
        if not sender.isprintable() or "/" in sender or len(sender) + len(here.robot) >= TEXT_MAX // 2:
            raise DriverError(f"sender={sender[:64]!r} cannot name a program: write visible characters without /, 200 at most")
        if durable and not sender:
            raise DriverError("durable=True needs a name by which this program's messages are found again: give it a sender, too")
        program = Path(sys.argv[0] if sys.argv and sys.argv[0] else "python").stem
        self.sender = f"{here.robot}/{sender or f'{program}-{os.getpid()}-{next(_NUMBERS)}'}"
        self._by = accounts.name_of(os.geteuid())
        """For a driver at another robot, now or after it has moved; one at this robot believes the kernel."""
        self._sending = Sending(here, place, self.sender, queue, encoding, is_durable=durable)
        self._posting: Posting | None = Posting(self._sending) if self._sending.left_over else None
        self.left_over: tuple[concurrent.futures.Future[Any], ...] = self._posting.left_over if self._posting is not None else ()
        """Of what an earlier process of a durable sender has posted and that had no answer, in order."""
        self._spoken = f"{SPEAKS}{version}" if version else ""
        self._lock = threading.RLock()
        self._is_closed = False

    @property
    def place(self) -> Place:
        """Where the driver is, as far as it is known."""
        return self._sending.route.place

    def close(self) -> None:
        """Let the connection go. What was posted and has no answer is sent no more; its futures say so."""
        self._is_closed = True  # a call that waits looks at it
        with self._lock:
            posting = self._posting
        if posting is not None:
            posting.close()
        self._sending.close()

    def __enter__(self) -> Proxy:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                self.flush(TIMEOUT_S)
        except NoAnswerError:
            if not self._sending.is_durable:
                raise
        finally:
            self.close()

    def now_ns(self) -> int:
        """The clock of this process's hops."""
        return self._sending.now_ns()

    def call(self, verb: str, body: Any = None, /, *, timeout: float = TIMEOUT_S, **fields: Any) -> Any:
        """Have a verb carried out, and return what it returns.

        Args:
            body: the arguments as a table, or the only one; or each by its name as ``fields``.
            timeout: seconds; after them the driver does not begin it any more.

        Raises:
            CallRefusedError: it was not carried out, or failed; says why.
            NoAnswerError: no answer came in time. Whether it was carried out is not known.
            EnvelopeError: no message can say this body.
            MailboxFullError: too many earlier messages have had no answer.
            DriverError: the proxy is closed.
        """
        with self._lock:
            self._refuse_closed("call")
            if self._posting is None:
                answer = self._answered(self._envelope(verb, self._body(body, fields), timeout), round(timeout * SECOND_NS))
                self.last = answer
                if answer.error is not UNSET:
                    raise refused(answer)
                return None if answer.ok is UNSET else answer.ok
        try:
            return self.post(verb, body, deadline_s=timeout, **fields).result(timeout)
        except NoAnswerError:  # a TimeoutError too, which knows more
            raise
        except concurrent.futures.TimeoutError as error:
            raise NoAnswerError(self._no_answer(verb, timeout, "")) from error
        except CallRefusedError as error:
            if error.kind != EXPIRED:
                raise
            raise NoAnswerError(self._no_answer(verb, timeout, "")) from error

    def post(
        self, verb: str, body: Any = None, /, *, deadline_s: float | None = None, **fields: Any
    ) -> concurrent.futures.Future[Any]:
        """Have a verb carried out, without waiting: a thread of this proxy sends it, over cuts and restarts of the driver.

        Args:
            body, fields: as of `call`.
            deadline_s: seconds from now; after them the driver does not begin it any more. None: it never expires.

        Returns:
            The result, once it comes; or `CallRefusedError`, of the kind "expired" after the deadline; or `NoAnswerError`, if
            the message left, and no answer came until 5 s after its deadline or until the proxy was closed. It cannot be
            cancelled. What is called when it is done runs in the thread that sends, and must not wait.

        Raises:
            MailboxFullError: so many messages wait already as the queue takes; this one was not taken.
            EnvelopeError: no message can say this body.
            DriverError: the proxy is closed, or a durable one cannot keep the message.
        """
        envelope = self._envelope(verb, self._body(body, fields), deadline_s)
        with self._lock:
            self._refuse_closed("post to")
            if self._posting is None:
                self._posting = Posting(self._sending)
        return self._posting.post(envelope, self.now_ns())

    def _refuse_closed(self, what: str) -> None:
        if self._is_closed:
            raise DriverError(f"cannot {what} {self.path}: the proxy is closed; make a new one")

    def flush(self, timeout: float | None = None) -> None:
        """Return when all that was posted has its result, an error included.

        Args:
            timeout: seconds.

        Raises:
            NoAnswerError: not in time; says how many have none.
        """
        if self._posting is None:
            return
        _, waiting = concurrent.futures.wait(self._posting.waiting(), timeout)
        if waiting:
            raise NoAnswerError(f"{len(waiting)} messages that were posted to {self.path} had no answer within {timeout:g} s")

    def _envelope(self, verb: str, body: Any, deadline_s: float | None) -> Envelope:
        deadline_ms = None if deadline_s is None else deadline_s * 1_000
        if self._spoken and not verb.startswith("_"):
            verb += self._spoken
        hops = hops_so_far() or (Hop(self.sender, self.now_ns()),)
        found = Envelope(to=self.path, verb=verb, body=body, by=self._by, reliable=True, deadline_ms=deadline_ms, hops=hops)
        envelopes.check_size(found, NUMBERS_SIZE, self._sending.encoding)
        return found

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
        posted = self._sending.post(envelope, now_ns)
        busy = ""
        while now_ns < until_ns:
            for answer in self._sending.turn(until_ns):
                if answer.re != posted.id:
                    continue
                if answer.error is UNSET or answer.error.kind not in ("busy", EXPIRED):
                    return answer
                if answer.error.kind == "busy":
                    busy = answer.error.sentence
                elif self.now_ns() < until_ns:
                    return answer
            if self._is_closed:
                raise NoAnswerError(f"{self.path} has not answered: the proxy was closed; it may have been carried out")
            now_ns = self.now_ns()
        raise NoAnswerError(self._no_answer(envelope.verb, timeout_ns / SECOND_NS, busy))

    def _no_answer(self, verb: str, timeout_s: float, busy: str) -> str:
        said = f"{self.path} did not answer {verb!r} within {timeout_s:g} s"
        if busy:
            return f"{said}: it is busy: {busy}"
        address = self._sending.route.address
        if address.startswith(SCHEME) and not is_served(address.removeprefix(SCHEME)):
            return f"{said}: its process has ended; start it again"
        return f"{said}; it may still carry it out"

    def stream(self, name: str) -> Iterator[Any]:
        """The values of a stream, one after the other, while they are asked for; those that cannot be taken in time are lost.

        They come on after a restart of the driver, and from another robot once it runs there.

        Raises:
            CallRefusedError: the driver has no such stream, or it failed at it.
            DriverError: it does not say which streams it has.
        """
        verbs, spoken = self.told("_describe", _Described).verbs, f"{name}{self._spoken}"
        if verbs.get(spoken, verbs.get(name, _Role())).role != "stream":
            raise CallRefusedError(f"{self.path} has no stream {spoken!r}", "unknown_verb")
        number = f"{self.sender}-{next(_NUMBERS)}"
        asked = Envelope(to=self.path, verb="_subscribe", body={"stream": spoken}, sender=number, by=self._by, id=number)
        with Streaming(Route(self.here, self.place), asked, spoken, self._sending.encoding) as streaming:
            yield from streaming.values()


def _check_encoding(encoding: str) -> None:
    if encoding not in get_args(Encoding):
        raise DriverError(f"encoding={encoding!r} is none: write one of {', '.join(get_args(Encoding))}")
    if encoding == "avro":
        try:
            envelopes.encode(Envelope(), "avro")
        except EnvelopeError as error:
            raise DriverError(f"cannot send Avro: {error}") from error
