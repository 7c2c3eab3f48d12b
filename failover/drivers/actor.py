"""What a driver does with messages, one at a time and in order; the sockets are `failover.drivers.server`'s.

    came → mailbox → (paced) → method → answer

A verb that begins with ``_`` is the driver's own: ``_describe`` tells its verbs, ``_graph`` who has called, ``_path`` where a
message spent its time, ``_ways`` where those did that began with the same hop, ``_subscribe`` and ``_unsubscribe`` begin and end
a stream.
"""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable, Hashable, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import UNSET, Struct

from failover.core.messaging import envelope as envelopes
from failover.core.messaging.envelope import Envelope, Fault, Hop, answer, refusal
from failover.core.messaging.mailbox import SENDERS_MAX, Mailbox
from failover.core.messaging.pacing import SECOND, Pace, merged
from failover.core.messaging.traffic import Traffic
from failover.core.naming import names
from failover.core.naming.names import Kind
from failover.drivers.declare import Declaration, Verb
from failover.drivers.in_hand import carrying_out
from failover.errors import EnvelopeError, NameFormatError

if TYPE_CHECKING:
    from failover.drivers.carried_out import CarriedOut
    from failover.drivers.keeping import Keeping

PATHS_MAX: Final = 4_096
"""Messages whose way is remembered, for ``failover path``."""

WAYS_MAX: Final = 64
"""Of these, those that one answer tells: what drivers sent while they carried out one message."""

SUBSCRIBERS_MAX: Final = 256
LEASE_NS: Final = 10 * SECOND
"""How long a stream is sent without a new ``_subscribe``."""

log = logging.getLogger("failover.drivers")

Whose = Hashable
"""The way back to who sent a message, as the sockets know it."""

Publish = Callable[[Whose, Envelope], bool]
"""Called with (whose, message): send it if that one takes it now; False: it is gone."""


Fence = Callable[[int], str]
"""Called with the epoch of the driver of which a sender has heard: why this copy may not act any more; "" if it may."""


def _acts(_: int) -> str:
    return ""


class Subscriber(Struct):
    """One who gets a stream. ``until_ns``: unless it asks again."""

    whose: Whose
    verb: Verb
    to: str
    until_ns: int


class Actor:
    """One driver: its mailbox, its pace, its streams. Every instant is an argument."""

    def __init__(
        self,
        instance: object,
        declaration: Declaration,
        who: str,
        keeping: Keeping | None = None,
        carried_out: CarriedOut | None = None,
    ) -> None:
        """
        Args:
            who: of this process in hops: ``robot1/NAME``.
            keeping: of a driver that keeps attributes.
            carried_out: of one that keeps none, and has a process of its own.
        """
        self._instance = instance
        self._declaration = declaration
        self._who = who
        self._keeping = keeping
        self._file = carried_out
        self._unnoted: list[Envelope] = []
        """Answers that `count` has still to note."""
        if keeping is not None:
            self._mailbox = keeping.mailbox
        else:
            self._mailbox = Mailbox() if carried_out is None else Mailbox(carried_out.streams, carried_out.asked)
        self._pace = Pace(declaration.rate_hz)
        self._paths: OrderedDict[str, tuple[Hop, ...]] = OrderedDict()
        self._meant: dict[str, bool] = {}
        self._earlier: dict[str, object] = {}
        """Version of callers → the object whose methods they call."""
        self._subscribers: dict[tuple[Whose, str], Subscriber] = {}
        self._samples_ns: dict[str, int] = {}
        self._own: Mapping[str, Callable[[Envelope, int], Any]] = {
            "_describe": self._describe,
            "_graph": self._graph,
            "_path": self._path,
            "_ways": self._ways,
            "_subscribe": self._subscribe,
            "_unsubscribe": self._unsubscribe,
        }
        self.fence: Fence = _acts
        self._traffic = Traffic()
        self._uncounted: list[tuple[Envelope, int, int, Envelope | None]] = []
        """What `count` has still to count: (message, instant, bytes, what was said to it; None: it came)."""
        self._routes: OrderedDict[str, tuple[int, Whose]] = OrderedDict()
        """Sender → its life, and the way back to it."""

    def turned_away(self, envelope: Envelope) -> Fault | None:
        """Why a message is not taken in, whoever sends it; None if it may be. The answer goes back the way the message came."""
        if why := self.fence(envelope.epoch):
            return Fault("moved", why)
        known = max(self._routes.get(envelope.sender, (0, None))[0], self._mailbox.boot_of(envelope.sender))
        if not envelope.sender or not (envelope.boot or envelope.seq) or envelope.boot >= known:
            return None
        return Fault(
            "outlived",
            f"{envelope.sender} was started again, or runs twice, or its clock was set back: a later life of it is heard here, "
            "and this one no more; give each process a sender of its own, and set the clock right",
        )

    def came(self, envelope: Envelope, whose: Whose, now_ns: int, size: int = 0) -> list[Envelope]:
        """Take in a message of so many bytes; answers that leave at once."""
        if not envelope.sender:
            envelope = msgspec.structs.replace(envelope, sender=f"by-hand-{hash(whose) & 0xFFFFFFFF:08x}")
        known = self._routes.get(envelope.sender, (0, None))[0]
        self._routes[envelope.sender] = (max(envelope.boot, known), whose)
        if len(self._routes) > SENDERS_MAX:
            self._routes.popitem(last=False)
        if not self.is_meant(envelope.to):
            here = f"this is {self._declaration.path}, and not {envelope.to}: look the name up anew"
            return [refusal(envelope, "wrong_driver", here)]
        if fault := self.refused(envelope, whose):
            return [refusal(envelope, fault.kind, fault.sentence)]
        try:
            envelope = envelopes.came(envelope, self._who, now_ns)
        except EnvelopeError as error:
            return [refusal(envelope, "circle", str(error))]
        if envelope.verb not in self._own:
            self._uncounted.append((envelope, now_ns, size, None))
        return self._mailbox.arrived(envelope, now_ns)

    def route(self, sender: str) -> Whose | None:
        """The way back to a sender; None: it is forgotten."""
        return self._routes.get(sender, (0, None))[1]

    def give_back(self, why: str) -> list[Envelope]:
        """Answers to all messages that wait: they are for a later copy of the driver."""
        return [refusal(one, "moved", why) for one in self._mailbox.give_back()]

    def refused(self, envelope: Envelope, whose: Whose) -> Fault | None:
        """Why a message is not taken that came this way; None if it is. Asked as it comes: later the way may be forgotten."""
        return None

    def is_meant(self, to: str) -> bool:
        """Whether a name is this driver's; an address is: the message has come there."""
        found = self._meant.get(to)
        if found is None:
            found = not to or self._is_name(to)
            if len(self._meant) < PATHS_MAX:
                self._meant[to] = found
        return found

    def _is_name(self, to: str) -> bool:
        try:
            name = names.parse(to)
        except NameFormatError:
            return False
        return name.kind is Kind.ADDRESS or name.text in (self._declaration.path, *self._declaration.aliases)

    # --- Handling ---------------------------------------------------------------------------------------------------------

    def wait_ns(self, now_ns: int) -> int | None:
        """How long until something is to be done although nothing comes; 0: at once; None: for ever."""
        waits = [max(sample_ns - now_ns, 0) for sample_ns in self._samples_ns.values()]
        if self._keeping is not None and (again_ns := self._keeping.wait_ns()) is not None:
            waits.append(again_ns)
        if (first := self.following(now_ns)) is not None and not self._mailbox.is_ahead:
            waits.append(self._pace.wait_ns(now_ns) if self._is_paced(first) else 0)
        return min(waits, default=None)

    def _is_paced(self, envelope: Envelope) -> bool:
        verb = self._declaration.verbs.get(envelope.verb)
        return verb is not None and verb.marked.role == "command"

    def following(self, now_ns: int) -> Envelope | None:
        """The next message of the mailbox, if it can be carried out now."""
        return self._mailbox.first()

    def handle(self, clock: Callable[[], int]) -> list[Envelope]:
        """Carry out the next message, if there is one and it is its turn; answers that leave now."""
        now_ns = clock()
        if self._mailbox.first() is not None and (why := self.fence(0)):
            return self.give_back(why)
        first = self.following(now_ns)
        is_turn = first is not None and not (self._is_paced(first) and self._pace.wait_ns(now_ns))
        if self._keeping is None:
            if is_turn:
                self._handle(now_ns, clock)
            answers = self._mailbox.committed()  # also of what expired while nothing could be handled
            self._unnoted += answers
            return answers
        if is_turn and not self._mailbox.is_ahead:
            with self._keeping.message():
                self._handle(now_ns, clock)
        handled = self._keeping.safe()
        return [] if handled is None else self._mailbox.committed(handled)

    def _handle(self, now_ns: int, clock: Callable[[], int]) -> None:
        message = self._mailbox.take(now_ns)
        if message is None:
            return
        run = [message]
        if self._is_paced(message):
            self._pace.begun(now_ns)
            if self._declaration.verbs[message.verb].marked.coalesce == "latest":
                while (following := self._mailbox.take_same(message.verb, now_ns)) is not None:
                    run.append(following)
        if self._file is not None and self._is_paced(message):
            self._file.began(run)
        said = self.carried_out(run)
        left_ns = clock()
        for replaced in run[:-1]:
            self._done(replaced, _as_merged(replaced, said), left_ns)
        self._done(run[-1], said, left_ns)

    def _done(self, message: Envelope, said: Envelope, left_ns: int) -> None:
        hops = envelopes.left_hops(message, left_ns)
        if message.verb not in self._own:
            self._uncounted.append((message, left_ns, 0, said))
        if message.id:
            self._paths[message.id] = hops
            if len(self._paths) > PATHS_MAX:
                self._paths.popitem(last=False)
        self._mailbox.done(message, msgspec.structs.replace(said, hops=hops))

    def count(self) -> None:
        """Count and note what came and was handled lately. Called once the answers have left: no sender waits for it.

        A driver that is killed before counts a command of which the answer has left as one in hand.
        """
        if self._unnoted:
            answers, self._unnoted = self._unnoted, []
            if self._file is not None:
                self._file.over(answers, self._mailbox.kept)
        uncounted, self._uncounted = self._uncounted, []
        for message, at_ns, size, said in uncounted:
            if said is None:
                self._traffic.came(message.sender, message.verb, size, at_ns)
            else:
                took_ns = at_ns - message.hops[-1].came_ns
                self._traffic.done(message.sender, message.verb, took_ns, at_ns, is_error=said.error is not UNSET)

    def carried_out(self, run: Sequence[Envelope]) -> Envelope:
        """The answer to messages that become one; the mailbox is not touched."""
        message = merged(run) if len(run) > 1 else run[0]
        if own := self._own.get(message.verb):
            return answer(message, own(message, message.hops[-1].came_ns))
        verb = self._declaration.verbs.get(message.verb)
        if verb is None:
            known = ", ".join(one.name for one in self._declaration.shown)
            return refusal(message, "unknown_verb", f"{self._declaration.path} has no verb {message.verb[:64]!r}; it has {known}")
        try:
            arguments = _arguments(verb, message.body)
        except (msgspec.ValidationError, TypeError) as error:
            return refusal(message, "bad_body", f"the body of {verb.name} is not as declared: {error}")
        return self.called(verb, arguments, message)

    def called(self, verb: Verb, arguments: Mapping[str, Any], message: Envelope) -> Envelope:
        """The answer of one method."""
        try:
            with carrying_out(message.hops):
                return answer(message, _plain(getattr(self._speaker(verb.earlier), verb.method)(**arguments)))
        except EnvelopeError as error:
            return refusal(
                message, "bad_result", f"{verb.name} was carried out, and no message can say what it returned: {error}"
            )
        except Exception as error:
            log.warning("%s of %s failed", verb.name, self._declaration.path, exc_info=error)
            return refusal(message, "failed", f"{verb.name} failed: {type(error).__name__}: {error}")

    def _speaker(self, version: str) -> object:
        """Who has the methods that callers of this version call; "": the driver."""
        if not version:
            return self._instance
        if version not in self._earlier:
            self._earlier[version] = self._declaration.earlier[version](self._instance)
        return self._earlier[version]

    # --- The driver's own verbs -------------------------------------------------------------------------------------------

    def _describe(self, _: Envelope, __: int) -> Any:
        return {"path": self._declaration.path, "aliases": list(self._declaration.aliases), "verbs": self._declaration.schemas()}

    def _graph(self, _: Envelope, now_ns: int) -> Any:
        self.count()
        return self._traffic.rows(now_ns)

    def _path(self, message: Envelope, _: int) -> Any:
        """The hops of a message that was carried out; None: this driver does not remember it."""
        wanted = message.body.get("id") if isinstance(message.body, dict) else None
        hops = self._paths.get(wanted) if isinstance(wanted, str) else None
        return None if hops is None else _told(hops)

    def _ways(self, message: Envelope, _: int) -> Any:
        """The hops of the newest messages that were carried out here and began with this hop: its name, and when it came."""
        began = message.body.get("began") if isinstance(message.body, dict) else None
        ways = (hops for hops in reversed(self._paths.values()) if [hops[0].who, hops[0].came] == began)
        return [_told(hops) for hops in islice(ways, WAYS_MAX)]

    def _subscribe(self, message: Envelope, now_ns: int) -> Any:
        """Send a stream to who asks, for `LEASE_NS`; what comes of it: the rate, or None without such a stream."""
        name = message.body.get("stream") if isinstance(message.body, dict) else None
        verb = self._declaration.verbs.get(name) if isinstance(name, str) else None
        whose = self.route(message.sender)
        if verb is None or verb.marked.role != "stream" or whose is None:
            return None
        key = (whose, verb.name)
        if key in self._subscribers or len(self._subscribers) < SUBSCRIBERS_MAX:
            self._subscribers[key] = Subscriber(whose, verb, message.sender, now_ns + LEASE_NS)
            self._samples_ns.setdefault(verb.name, now_ns)
        return verb.marked.rate_hz if key in self._subscribers else None

    def _unsubscribe(self, message: Envelope, _: int) -> Any:
        whose = self.route(message.sender)
        for key in [key for key in self._subscribers if key[0] == whose]:
            del self._subscribers[key]
        return None

    # --- Streams ----------------------------------------------------------------------------------------------------------

    def sample(self, publish: Publish, clock: Callable[[], int]) -> None:
        """Send the streams that are due to those that have subscribed."""
        if not self._samples_ns:
            return
        now_ns = clock()
        for name in [name for name, due_ns in self._samples_ns.items() if due_ns <= now_ns]:
            those = [one for one in self._subscribers.values() if one.verb.name == name and now_ns < one.until_ns]
            self._subscribers = {key: one for key, one in self._subscribers.items() if now_ns < one.until_ns}
            if not those:
                del self._samples_ns[name]
                continue
            period_ns = round(SECOND / those[0].verb.marked.rate_hz)
            self._samples_ns[name] = max(self._samples_ns[name] + period_ns, now_ns)
            if self.fence(0):
                continue
            said = self.called(those[0].verb, {}, Envelope(verb=name))
            for one in those:
                envelope = msgspec.structs.replace(said, to=one.to, verb=name, sender=self._declaration.path)
                if not publish(one.whose, envelope):
                    self._subscribers.pop((one.whose, name), None)


def _told(hops: tuple[Hop, ...]) -> list[Any]:
    return [[hop.who, hop.came, hop.left] for hop in hops]


def _as_merged(replaced: Envelope, said: Envelope) -> Envelope:
    """The answer to a message that became part of a later one: which one that is, or why that failed."""
    if said.error is UNSET:
        return answer(replaced, {"merged_into": said.re})
    return refusal(replaced, said.error.kind, said.error.sentence)


def _arguments(verb: Verb, body: Any) -> Mapping[str, Any]:
    """The body as a method's arguments; what is no table is the only argument of one that has just one.

    Raises:
        msgspec.ValidationError: it does not fit.
    """
    if body is UNSET or body is None:
        body = {}
    elif not isinstance(body, dict) and len(fields := verb.arguments.__struct_fields__) == 1:
        body = {fields[0]: body}
    return msgspec.structs.asdict(msgspec.convert(body, verb.arguments))


def _plain(value: Any) -> Any:
    """A result as JSON can say it.

    Raises:
        EnvelopeError: JSON cannot.
    """
    if value is None or value is True or value is False:
        return value
    try:
        found = msgspec.to_builtins(value, enc_hook=_of_arrays, str_keys=True)
    except (TypeError, ValueError, RecursionError) as error:
        raise EnvelopeError(str(error)) from error
    envelopes.check(found)
    return found


def _of_arrays(value: Any) -> Any:
    """Arrays and numbers of numpy."""
    if callable(listed := getattr(value, "tolist", None)):
        return listed()
    raise TypeError(f"{type(value).__name__} is no value of JSON")
