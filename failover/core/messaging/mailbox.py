"""An actor's mailbox, and the outbox of who writes to it; pure: every instant is an argument, both are values that can be kept.

Promised, of one sender to one receiver:

* *order*: messages are handled in the order in which they were posted.
* *at most once*: none is handled twice.
* a *reliable* one is sent until it is answered, over any outage and any death of either side: with the lines above it is handled
  *effectively once*, as long as both sides keep their state. It is answered only when what it did is kept.
* one past its deadline is not handled, and its sender is told.

Not promised: any order between different senders; that an unreliable message arrives. A receiver that keeps no state may, after
its death, handle again what it had handled and not yet answered, unless it notes that (`failover.drivers.carried_out`).

How: the sender numbers its messages (`seq`) within its life (`boot`), and says in each which unanswered reliable one comes right
before (`after`). The receiver takes a message whose number is above all it has taken, once it has taken the one before. It keeps
its last `WINDOW` answers to reliable messages, and gives them again. The sender has never more than that unanswered.

What must be kept together with the effects of the messages: `Mailbox.kept` and `Outbox.kept`. Nothing leaves before `committed`:
a program that goes back to its last commit takes back nothing that others have heard.

    Outbox:  post → (committed) → due → … → answered
    Mailbox: arrived → take → done → (committed) → the answer leaves
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Mapping
from typing import Final

import msgspec
from msgspec import Struct

from checkpoint.errors import UNDECODABLE
from failover.core.messaging.envelope import Envelope, refusal
from failover.errors import EnvelopeError, MailboxFullError

MAILBOX_MAX: Final = 1_024
"""Messages that wait: a driver of 20 Hz is a minute behind."""

WINDOW: Final = 1_024
"""Reliable messages of one sender without an answer, and answers that the receiver keeps for it."""

HELD_MAX: Final = 64
"""Messages of one sender that came before one that must be handled first; the sender sends the others again."""

FLIGHT_MAX: Final = HELD_MAX
"""Reliable messages that a sender has on their way at once: the receiver holds so many if the first of them is lost."""

HELD_ALL_MAX: Final = 1_024
"""The same of all senders together; then the sender whose messages are held for longest loses them, and sends them again."""

SENDERS_MAX: Final = 1_024
"""Senders that a mailbox remembers; the one silent for longest is forgotten."""

MS: Final = 1_000_000
RESEND_FIRST_NS: Final = 500 * MS
RESEND_MOST_NS: Final = 8_000 * MS
"""Until an unanswered message is sent again; doubled each time, and from the beginning after an answer or a cut."""

LOOK_FIRST_NS: Final = 500 * MS
LOOK_MOST_NS: Final = 2_000 * MS
"""Until a receiver that says nothing is looked up: its robot may be lost without a word. Doubled each time."""

MOVED: Final = ("moved", "wrong_driver")
"""Kinds of errors of one who is not, or is no more, the receiver: it took nothing; look the name up anew."""

AGAIN: Final = ("busy", *MOVED)
"""Kinds of errors after which a reliable message is sent again."""

NO_ANSWER: Final = "no_answer"
"""Kind of the error of a message of which is not known whether it was carried out."""

ANSWER_NS: Final = 5_000 * MS
"""How long after the deadline of a message that left its answer is waited for: its receiver says then that it expired."""


# --- Sending ----------------------------------------------------------------------------------------------------------


class Waiting(Struct, frozen=True, gc=False):
    """A posted message. ``until_ns``: its deadline; None: it has none."""

    envelope: Envelope
    until_ns: int | None = None


class Outgoing(Struct):
    """What an outbox keeps."""

    boot: int
    seq: int = 0
    waiting: list[Waiting] = []


class Outbox:
    """What one sender has to tell one receiver."""

    def __init__(self, sender: str, boot: int, kept: Outgoing | None = None, limit: int = WINDOW) -> None:
        """
        Args:
            boot: of a sender that keeps nothing: greater than in all its lives before. With ``kept`` its own goes on.
            limit: messages that may wait for an answer; from 1 to `WINDOW`.
        """
        self._limit = limit
        self._sender = sender
        self._boot = kept.boot if kept is not None else boot
        self._seq = kept.seq if kept is not None else 0
        self._sent = deque(kept.waiting if kept is not None else ())
        """May have arrived: all that was kept, too, as it may have left after the commit."""
        self._unsent: deque[Waiting] = deque()
        self._handed: list[Waiting] = []
        """Those that the newest `due` gave for the first time."""
        self._free = self._seq
        self._had = 0
        self._is_connected = True
        self._again_ns: int | None = 0 if self._sent else None
        self._pause_ns = RESEND_FIRST_NS
        self._quiet_ns = 0
        """Since when nothing was heard while messages wait for their answers, or since the receiver was looked up."""
        self._look_pause_ns = LOOK_FIRST_NS

    def __len__(self) -> int:
        return len(self._sent) + len(self._unsent)

    def kept(self) -> Outgoing:
        """What must be kept with the state of the program that posts."""
        return Outgoing(self._boot, self._seq, [*self._sent, *self._unsent])

    def post(self, envelope: Envelope, now_ns: int) -> Envelope:
        """Take a message; it leaves after the next `committed`.

        Returns:
            It with its number; with an ``id`` if it had none.

        Raises:
            MailboxFullError: so many wait already as may.
        """
        if len(self) >= self._limit:
            raise MailboxFullError(f"{len(self)} messages to {envelope.to} wait, and that is the limit; try again later")
        self._seq += 1
        name = envelope.id or f"{self._sender}-{self._boot:x}-{self._seq}"
        envelope = msgspec.structs.replace(envelope, sender=self._sender, boot=self._boot, seq=self._seq, id=name)
        until_ns = None if envelope.deadline_ms is None else now_ns + int(envelope.deadline_ms * MS)
        self._unsent.append(Waiting(envelope, until_ns))
        return envelope

    def withdrawn(self) -> None:
        """The message that was posted last cannot be kept: it is as if it had not been posted. None was `committed` since."""
        self._unsent.pop()
        self._seq -= 1

    def committed(self) -> None:
        """All that was posted so far is kept, and may leave; so is which answers have come."""
        self._free = self._seq
        waiting = (one.envelope.seq for one in (*self._sent, *self._unsent) if one.envelope.reliable)
        self._had = next(waiting, self._seq + 1) - 1

    def connected(self, now_ns: int) -> None:
        """The link stands again: what may not have arrived is sent again, in order, at once."""
        self._is_connected, self._again_ns, self._pause_ns = True, now_ns, RESEND_FIRST_NS

    def disconnected(self) -> None:
        """The link is cut: messages wait."""
        self._is_connected = False

    @property
    def is_connected(self) -> bool:
        """Whether messages leave."""
        return self._is_connected

    @property
    def left(self) -> int:
        """Messages that may have left, and have no answer yet."""
        return len(self._sent)

    def next_ns(self) -> int | None:
        """When `due`, `expired` or `given_up` has something without anything else happening; None: never."""
        times = [one.until_ns for one in self._unsent if one.until_ns is not None]
        times += [one.until_ns + ANSWER_NS for one in self._sent if one.until_ns is not None]
        if self._is_connected and self._sent and self._again_ns is not None:
            times.append(self._again_ns)
        return min(times, default=None)

    def heard(self, now_ns: int) -> None:
        """The receiver has said something, or nothing is to be heard of it."""
        self._quiet_ns, self._look_pause_ns = now_ns, LOOK_FIRST_NS

    def must_look(self, now_ns: int) -> bool:
        """Whether the receiver is to be looked up now: it has been silent for so long that it may be elsewhere."""
        if not self._sent:
            self.heard(now_ns)
        if now_ns < self._quiet_ns + self._look_pause_ns:
            return False
        self._quiet_ns, self._look_pause_ns = now_ns, min(2 * self._look_pause_ns, LOOK_MOST_NS)
        return True

    def due(self, now_ns: int) -> list[Envelope]:
        """What is to be sent now, in order; `returned` takes back what does not leave."""
        self._handed = []
        if not self._is_connected:
            return []
        found: list[Envelope] = []
        if self._again_ns is not None and now_ns >= self._again_ns:
            after = 0
            for one in self._sent:
                found.append(_as_sent(one, after, self._had, now_ns))
                after = one.envelope.seq if one.envelope.reliable else after
            self._sent = deque(one for one in self._sent if one.envelope.reliable)
            self._again_ns = now_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, RESEND_MOST_NS)
        while self._unsent and self._unsent[0].envelope.seq <= self._free and len(self._sent) < FLIGHT_MAX:
            one = self._unsent.popleft()
            self._handed.append(one)
            found.append(_as_sent(one, self._sent[-1].envelope.seq if self._sent else 0, self._had, now_ns))
            if one.envelope.reliable:
                self._sent.append(one)
        if self._again_ns is None and self._sent:
            self._again_ns = now_ns + self._pause_ns
        return found

    def returned(self, count: int) -> None:
        """So many of the last that `due` has given did not leave, for the link is cut: they wait as before."""
        self.disconnected()
        for one in self._handed[::-1][:count]:
            if one.envelope.reliable:
                self._sent.pop()
            self._unsent.appendleft(one)
        self._handed = []

    def answered(self, answer: Envelope, now_ns: int) -> bool:
        """Whether this is the first final answer to one of our reliable messages; after one in `AGAIN` it is sent again."""
        if answer.boot != self._boot or (answer.error is not msgspec.UNSET and answer.error.kind in AGAIN):
            return False
        for place, one in enumerate(self._sent):
            if one.envelope.seq == answer.seq:
                del self._sent[place]
                self._pause_ns = RESEND_FIRST_NS
                if not self._sent:
                    self._again_ns = None
                elif place == 0:  # nothing before it was lost; nor was an answer
                    self._again_ns = now_ns + RESEND_FIRST_NS
                return True
        return False

    def expired(self, now_ns: int) -> list[Envelope]:
        """Answers to messages whose deadline passed before they left. One that left is answered by its receiver, who knows."""
        late = [one for one in self._unsent if one.until_ns is not None and one.until_ns <= now_ns]
        if late:
            self._unsent = deque(one for one in self._unsent if one not in late)
        return [
            refusal(one.envelope, "expired", "its deadline passed while it waited to be sent; it was not handled") for one in late
        ]

    def given_up(self, now_ns: int) -> list[Envelope]:
        """Messages that left, and of which no answer came until long after their deadline; they are forgotten."""
        late = [one for one in self._sent if one.until_ns is not None and one.until_ns + ANSWER_NS <= now_ns]
        if late:
            self._sent = deque(one for one in self._sent if one not in late)
        return [one.envelope for one in late]

    def abandoned(self) -> tuple[list[Envelope], list[Envelope]]:
        """All that have no answer, which are forgotten: those that may have left, and those that have not."""
        found = [one.envelope for one in self._sent], [one.envelope for one in self._unsent]
        self._sent.clear()
        self._unsent.clear()
        return found


def _as_sent(one: Waiting, after: int, had: int, now_ns: int) -> Envelope:
    """With what is left of its time: the receiver counts it by its own clock."""
    left_ms = None if one.until_ns is None else max(one.until_ns - now_ns, 0) / MS
    return msgspec.structs.replace(one.envelope, after=after, had=had, deadline_ms=left_ms)


# --- Receiving --------------------------------------------------------------------------------------------------------


class Stream(Struct):
    """What a mailbox keeps of one sender.

    Attributes:
        last: the highest number handled. reliable: the highest of a reliable one.
        answers: to the last reliable ones, by number.
    """

    boot: int
    last: int = 0
    reliable: int = 0
    answers: dict[int, Envelope] = {}


_pack: Final = msgspec.msgpack.Encoder().encode
_streams: Final = msgspec.msgpack.Decoder(list[tuple[str, Stream]])


def unpacked(content: bytes) -> dict[str, Stream]:
    """What `Mailbox.packed` has written; b"": nothing.

    Raises:
        EnvelopeError: it is damaged.
    """
    try:
        return dict(_streams.decode(content)) if content else {}
    except UNDECODABLE as error:
        raise EnvelopeError(f"the kept mailbox is damaged: {error}") from error


class Arrived(Struct, gc=False):
    """A message that waits. ``until_ns``: its deadline by the receiver's clock."""

    envelope: Envelope
    until_ns: int | None


class Taken(Struct):
    """Up to where messages of one sender's life were taken into the mailbox; lost with the process. ``held``: came too early."""

    boot: int
    last: int = 0
    reliable: int = 0
    held: list[Arrived] = []


Key = tuple[str, int, int]
"""Which message: sender, its life, number."""


def key_of(answer: Envelope) -> Key:
    """Of the message that it answers."""
    return answer.to, answer.boot, answer.seq


class Mailbox:
    """The messages of one actor, which handles one at a time."""

    def __init__(self, kept: Mapping[str, Stream] | None = None, asked: Collection[Key] = ()) -> None:
        """``asked``: messages below the numbers of ``kept`` that change nothing, and are handled again when they come again."""
        self._streams = OrderedDict(
            (sender, Stream(one.boot, one.last, one.reliable, dict(one.answers))) for sender, one in (kept or {}).items()
        )
        self._taken = {sender: Taken(one.boot, one.last, one.reliable) for sender, one in self._streams.items()}
        self._queue: deque[Arrived] = deque()
        self._held = 0
        self._holding: OrderedDict[str, None] = OrderedDict()
        """Senders of which messages are held, the one that is held for longest first."""
        self._answers: deque[Envelope] = deque()
        self._packed: dict[str, bytes] = {}
        self.handled = 0
        """Messages told `done` so far."""
        self._free = {sender: one.reliable for sender, one in self._streams.items()}
        self._asked = set(asked)

    def __len__(self) -> int:
        return len(self._queue) + self._held

    def kept(self) -> dict[str, Stream]:
        """What must be kept with the effects of the messages that are done."""
        return {sender: Stream(one.boot, one.last, one.reliable, dict(one.answers)) for sender, one in self._streams.items()}

    @property
    def is_ahead(self) -> bool:
        """Whether so many answers wait for a commit that no more should be handled before."""
        return len(self._answers) >= MAILBOX_MAX

    def packed(self) -> bytes:
        """`kept` as bytes; only senders of which something was done since the last time are encoded anew."""
        for sender, stream in self._streams.items():
            if sender not in self._packed:
                self._packed[sender] = _pack((sender, stream))
        return b"\xdd" + len(self._streams).to_bytes(4, "big") + b"".join(self._packed[sender] for sender in self._streams)

    def boot_of(self, sender: str) -> int:
        """The sender's newest life of which something was taken; 0: it is not known."""
        taken = self._taken.get(sender)
        return taken.boot if taken is not None else 0

    # --- A message arrives ------------------------------------------------------------------------------------------------

    def arrived(self, envelope: Envelope, now_ns: int) -> list[Envelope]:
        """Take in a message; answers that are to be sent at once: one given before, or that there is no room."""
        until_ns = None if envelope.deadline_ms is None else now_ns + int(envelope.deadline_ms * MS)
        arrived = Arrived(envelope, until_ns)
        if not envelope.seq or not envelope.sender:  # by hand: nothing is promised
            return self._queued(arrived)
        taken = self._taken.get(envelope.sender)
        if taken is None or envelope.boot > taken.boot:
            taken = Taken(envelope.boot)  # it is remembered once there is something to remember
        if envelope.boot < taken.boot:
            return []
        if envelope.seq <= taken.last:
            key = envelope.sender, envelope.boot, envelope.seq
            if key not in self._asked:
                return self._again(envelope)
            if not (refused := self._queued(arrived)):
                self._asked.discard(key)
            return refused
        if envelope.after > taken.reliable:
            self._hold(taken, arrived)
            return []
        answers = self._accept(taken, arrived)
        while following := next((one for one in taken.held if one.envelope.after <= taken.reliable), None):
            taken.held.remove(following)
            self._unheld(envelope.sender, 1, left=len(taken.held))
            if following.envelope.seq > taken.last:
                answers += self._accept(taken, following)
        return answers

    def _queued(self, arrived: Arrived) -> list[Envelope]:
        if len(self._queue) >= MAILBOX_MAX:
            return [refusal(arrived.envelope, "busy", f"{MAILBOX_MAX} messages wait; retry later")]
        self._queue.append(arrived)
        return []

    def _accept(self, taken: Taken, arrived: Arrived) -> list[Envelope]:
        envelope = arrived.envelope
        refused = self._queued(arrived)
        if not refused:
            self._remember(envelope.sender, taken)
            taken.last = envelope.seq
            if envelope.reliable:
                taken.reliable = envelope.seq
        return refused

    def _remember(self, sender: str, taken: Taken) -> None:
        before = self._taken.get(sender)
        if before is not taken:
            if before is not None:
                self._unheld(sender, len(before.held), left=0)
            self._taken[sender] = taken

    def _again(self, envelope: Envelope) -> list[Envelope]:
        """One that was taken before, or passed over: its answer, once what it did is kept.

        A sender passes over what expires before it leaves. If it is killed before it keeps that, it sends the message after all.
        """
        stream = self._streams.get(envelope.sender)
        if stream is None or stream.boot != envelope.boot or envelope.seq > self._free.get(envelope.sender, 0):
            return []
        answer = stream.answers.get(envelope.seq)
        if answer is None and envelope.reliable and envelope.deadline_ms is not None and envelope.seq > envelope.had:
            answer = refusal(envelope, "expired", "its sender has passed it over; it was not handled")
        return [] if answer is None else [answer]

    def _hold(self, taken: Taken, arrived: Arrived) -> None:
        sender = arrived.envelope.sender
        if len(taken.held) >= HELD_MAX or any(one.envelope.seq == arrived.envelope.seq for one in taken.held):
            return
        self._remember(sender, taken)
        taken.held.append(arrived)
        taken.held.sort(key=_seq)
        self._held += 1
        self._holding.setdefault(sender)
        if self._held > HELD_ALL_MAX:
            self._drop_held(next(iter(self._holding)))

    def _unheld(self, sender: str, count: int, *, left: int) -> None:
        self._held -= count
        if not left:
            self._holding.pop(sender, None)

    def _drop_held(self, sender: str) -> None:
        taken = self._taken[sender]
        self._held -= len(taken.held)
        taken.held.clear()
        del self._holding[sender]
        if sender not in self._streams and all(one.envelope.sender != sender for one in self._queue):
            del self._taken[sender]  # nothing of it was taken

    def give_back(self) -> list[Envelope]:
        """Messages that wait and were not handled: it is as if they had never come."""
        given = [one.envelope for one in self._queue]
        given += [one.envelope for taken in self._taken.values() for one in taken.held]
        self._queue.clear()
        self._holding.clear()
        self._held = 0
        self._taken = {sender: Taken(one.boot, one.last, one.reliable) for sender, one in self._streams.items()}
        return given

    # --- A message is handled ---------------------------------------------------------------------------------------------

    def take(self, now_ns: int) -> Envelope | None:
        """The next message to handle, then to be told `done`; None: there is none. Those past their deadline are answered."""
        while self._queue:
            one = self._queue.popleft()
            if one.until_ns is None or now_ns < one.until_ns:
                return one.envelope
            self._expire(one.envelope)
        return None

    def first(self) -> Envelope | None:
        """What `take` would look at next; it stays."""
        return self._queue[0].envelope if self._queue else None

    def bring_forward(self, is_chosen: Callable[[Envelope], bool], now_ns: int) -> None:
        """Have the first message that is chosen be the next one, unless one of the same sender waits before it.

        Those before it that are past their deadline are answered, in the order of their sender.
        """
        waiting: set[str] = set()
        passed: deque[Arrived] = deque()
        chosen: Arrived | None = None
        while chosen is None and self._queue:
            one = self._queue.popleft()
            sender = one.envelope.sender
            if sender not in waiting and one.until_ns is not None and now_ns >= one.until_ns:
                self._expire(one.envelope)
            elif sender not in waiting and is_chosen(one.envelope):
                chosen = one
            else:
                waiting.add(sender)
                passed.append(one)
        self._queue.extendleft(reversed(passed))
        if chosen is not None:
            self._queue.appendleft(chosen)

    def take_same(self, verb: str, now_ns: int) -> Envelope | None:
        """The next message to handle, if it has this verb; None: it has another one, or there is none."""
        while self._queue and self._queue[0].envelope.verb == verb:
            one = self._queue.popleft()
            if one.until_ns is None or now_ns < one.until_ns:
                return one.envelope
            self._expire(one.envelope)
        return None

    def _expire(self, envelope: Envelope) -> None:
        self.done(envelope, refusal(envelope, "expired", "its deadline passed while it waited; it was not handled"))

    def done(self, envelope: Envelope, answer: Envelope) -> None:
        """A message was handled, with this answer; it leaves after the next `committed`."""
        self._answers.append(answer)
        self.handled += 1
        if not envelope.seq or not envelope.sender:
            return
        stream = self._streams.get(envelope.sender)
        if stream is None or envelope.boot > stream.boot:
            stream = self._streams[envelope.sender] = Stream(envelope.boot, answers={})
            self._free.pop(envelope.sender, None)
        self._streams.move_to_end(envelope.sender)
        self._packed.pop(envelope.sender, None)
        if envelope.boot == stream.boot:
            stream.last = max(stream.last, envelope.seq)
            if envelope.reliable:
                stream.reliable = max(stream.reliable, envelope.seq)
                while stream.answers and (oldest := next(iter(stream.answers))) <= envelope.had:
                    del stream.answers[oldest]
                stream.answers[envelope.seq] = answer
                if len(stream.answers) > WINDOW:
                    del stream.answers[next(iter(stream.answers))]
        if len(self._streams) > SENDERS_MAX:
            sender, _ = self._streams.popitem(last=False)
            self._free.pop(sender, None)
            self._packed.pop(sender, None)
            if (taken := self._taken.pop(sender, None)) is not None:
                self._unheld(sender, len(taken.held), left=0)

    def committed(self, handled: int | None = None) -> list[Envelope]:
        """All that is done is kept, or so many as were `handled` once: the answers that may leave now."""
        count = len(self._answers) - (0 if handled is None else self.handled - handled)
        answers = [self._answers.popleft() for _ in range(max(count, 0))]
        for answer in answers:
            stream = self._streams.get(answer.to)
            if stream is not None and stream.boot == answer.boot and answer.seq in stream.answers:
                self._free[answer.to] = max(answer.seq, self._free.get(answer.to, 0))
        return answers


def _seq(arrived: Arrived) -> int:
    return arrived.envelope.seq
