"""What a mailbox promises holds over cuts, kills of both ends, and a takeover; in virtual time."""

from __future__ import annotations

import heapq
import itertools
import random
from collections import Counter
from collections.abc import Callable

import msgspec
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from msgspec import UNSET

from failover.core.messaging import mailbox
from failover.core.messaging.envelope import Envelope, answer
from failover.core.messaging.mailbox import (
    ANSWER_NS,
    FLIGHT_MAX,
    HELD_ALL_MAX,
    HELD_MAX,
    MAILBOX_MAX,
    MS,
    SENDERS_MAX,
    WINDOW,
    Mailbox,
    Outbox,
    unpacked,
)
from failover.errors import EnvelopeError, MailboxFullError


class Sender:
    """A program that counts, keeps its outbox with its count, and is killed now and then."""

    def __init__(self, name: str, count: int, reliable_of: int) -> None:
        self.name = name
        self.count = count
        self.reliable_of = reliable_of
        self.posted = 0
        self.outbox = Outbox(name, 1)
        self.outbox.connected(0)
        self.kept = (0, self.outbox.kept())
        self.told: dict[int, str] = {}

    def post(self, now_ns: int) -> None:
        """As many as there is room for, up to eight; then commit."""
        for _ in range(8):
            if self.posted < self.count and len(self.outbox) < WINDOW:
                self.posted += 1
                reliable = self.posted % self.reliable_of == 0
                deadline_ms = 30.0 if self.posted % 97 == 0 else None
                self.outbox.post(Envelope("actor", "add", self.posted, reliable=reliable, deadline_ms=deadline_ms), now_ns)
        self.commit()

    def commit(self) -> None:
        self.kept = (self.posted, self.outbox.kept())
        self.outbox.committed()

    def die(self, now_ns: int) -> None:
        """Everything since the last commit is lost."""
        self.posted, kept = self.kept
        self.outbox = Outbox(self.name, 99, kept)
        self.outbox.connected(now_ns)

    @property
    def is_done(self) -> bool:
        return self.posted == self.count and not len(self.outbox)


class Actor:
    """A program whose state is the list of what it handled; it keeps the list with its mailbox."""

    def __init__(self) -> None:
        self.handled: list[tuple[str, int]] = []
        self.mailbox = Mailbox()
        self.kept = (0, self.mailbox.packed())

    def work(self, now_ns: int, most: int) -> None:
        for _ in range(most):
            if (envelope := self.mailbox.take(now_ns)) is None:
                return
            self.handled.append((envelope.sender, envelope.body))
            self.mailbox.done(envelope, answer(envelope, envelope.body))

    def commit(self) -> list[Envelope]:
        self.kept = (len(self.handled), self.mailbox.packed())
        return self.mailbox.committed()

    def die(self) -> None:
        """As a kill, or as a takeover by a robot that has the last commit."""
        count, kept = self.kept
        del self.handled[count:]
        self.mailbox = Mailbox(unpacked(kept))


class World:
    """A network that delays, reorders, doubles, loses and is cut, between senders and one actor."""

    def __init__(
        self, seed: int, senders: int, count: int, *, loss: float = 0.05, double: float = 0.05, reliable_of: int = 1
    ) -> None:
        self.random = random.Random(seed)
        self.senders = {f"s{number}": Sender(f"s{number}", count, reliable_of) for number in range(senders)}
        self.actor = Actor()
        self.now_ns = 0
        self.loss, self.double = loss, double
        self.cut: set[str] = set()
        self.deaths: Counter[str] = Counter()
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._numbers = itertools.count()

    def at(self, after_ns: int, act: Callable[[], None]) -> None:
        heapq.heappush(self._events, (self.now_ns + after_ns, next(self._numbers), act))

    def carry(self, name: str, act: Callable[[], None]) -> None:
        """One way of a message between a sender and the actor."""
        if name in self.cut or self.random.random() < self.loss:
            return
        for _ in range(2 if self.random.random() < self.double else 1):
            self.at(self.random.randrange(1, 4 * MS), lambda: None if name in self.cut else act())

    def say(self, name: str) -> None:
        sender = self.senders[name]
        for late in sender.outbox.expired(self.now_ns):
            sender.told[late.seq] = "expired"
        for envelope in sender.outbox.due(self.now_ns):
            self.carry(name, lambda one=envelope: self.hear(one))  # type: ignore[misc]

    def hear(self, envelope: Envelope) -> None:
        for one in self.actor.mailbox.arrived(envelope, self.now_ns):
            self.reply(one)

    def reply(self, one: Envelope) -> None:
        self.carry(one.to, lambda: self.get(one))

    def get(self, one: Envelope) -> None:
        sender = self.senders[one.to]
        if sender.outbox.answered(one, self.now_ns):
            sender.told[one.seq] = "ok" if one.error is UNSET else one.error.kind
            assert one.error is not UNSET or one.ok == one.seq, "the answer of another message"

    def step(self) -> None:
        """A millisecond."""
        until_ns = self.now_ns + MS
        while self._events and self._events[0][0] <= until_ns:
            self.now_ns, _, act = heapq.heappop(self._events)
            act()
        self.now_ns = until_ns
        for name, sender in self.senders.items():
            if sender.posted < sender.count:
                sender.post(self.now_ns)
            if len(sender.outbox):
                self.say(name)
        self.actor.work(self.now_ns, 200)
        if self.random.random() < 0.5:
            for one in self.actor.commit():
                self.reply(one)

    def trouble(self) -> None:
        """Now and then one of: a cut that heals later, a death of a sender, a death of the actor."""
        drawn = self.random.random()
        name = self.random.choice(list(self.senders))
        if drawn < 0.01 and name not in self.cut:
            self.cut.add(name)
            self.senders[name].outbox.disconnected()
            self.at(self.random.randrange(1, 400) * MS, lambda: self.heal(name))
        elif drawn < 0.02:
            self.deaths["sender"] += 1
            self.senders[name].die(self.now_ns)
            if name in self.cut:
                self.senders[name].outbox.disconnected()
        elif drawn < 0.03:
            self.deaths["actor"] += 1
            self.actor.die()

    def heal(self, name: str) -> None:
        self.cut.discard(name)
        self.senders[name].outbox.connected(self.now_ns)

    def run(self, steps_max: int) -> None:
        for _ in range(steps_max):
            self.step()
            self.trouble()
            if all(sender.is_done for sender in self.senders.values()):
                break
        for one in list(self.cut):
            self.heal(one)
        for _ in range(240_000):  # thirty tries at the longest pause
            if all(sender.is_done for sender in self.senders.values()) and not self._events and not len(self.actor.mailbox):
                return
            self.step()
        raise AssertionError({name: (one.posted, len(one.outbox)) for name, one in self.senders.items()})

    def check(self) -> None:
        for name, sender in self.senders.items():
            handled = [number for one, number in self.actor.handled if one == name]
            assert handled == sorted(handled), f"out of order: {name}"
            assert len(set(handled)) == len(handled), f"handled twice: {name}"
            there = set(handled)
            for number in range(1, sender.count + 1):
                if number % sender.reliable_of == 0:
                    told = sender.told.get(number)
                    assert told in ("ok", "expired"), f"{name} was told nothing of {number}: {told}"
                    assert (told == "ok") == (number in there), f"{name} was told {told} of {number}"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_ten_thousand_messages_of_ten_senders_over_cuts_kills_of_both_ends_and_takeovers() -> None:
    world = World(1, 10, 1_000, loss=0.0002, double=0.01)
    world.run(1_000_000)
    world.check()
    assert world.deaths["sender"] > 5 and world.deaths["actor"] > 5
    assert sum(len(sender.told) for sender in world.senders.values()) == 10_000


@pytest.mark.timeout(600)
@settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.integers(0, 1 << 32), st.integers(1, 3), st.sampled_from([0.0, 0.1, 0.4]), st.sampled_from([1, 2, 5]))
@example(63272909, 1, 0.1, 2)  # a sender forgot in its death that it had an answer, and asked for it again
def test_order_and_once_hold_in_any_run(seed: int, senders: int, loss: float, reliable_of: int) -> None:
    world = World(seed, senders, 60, loss=loss, double=loss, reliable_of=reliable_of)
    world.run(200)
    world.check()


def test_queued_over_an_outage_they_arrive_in_order_or_their_sender_is_told_that_they_expired() -> None:
    outbox, box = Outbox("s", 1), Mailbox()
    outbox.disconnected()
    for number in range(1, 5):
        deadline_ms = 50.0 if number == 2 else None
        outbox.post(Envelope("actor", "add", number, reliable=number % 2 == 0, deadline_ms=deadline_ms), 0)
    outbox.committed()
    assert outbox.due(60_000 * MS) == []
    (late,) = outbox.expired(60_000 * MS)
    assert (late.seq, late.error.kind) == (2, "expired")  # type: ignore[union-attr]
    outbox.connected(60_000 * MS)
    sent = outbox.due(60_000 * MS)
    assert [(one.seq, one.after) for one in sent] == [(1, 0), (3, 0), (4, 0)]
    for one in sent:
        assert box.arrived(one, 0) == []
    assert [box.take(0).body for _ in sent] == [1, 3, 4]  # type: ignore[union-attr]


def test_what_did_not_leave_because_the_link_is_cut_waits_as_before_and_expires_with_a_sentence() -> None:
    outbox = Outbox("s", 1)
    for number in range(1, 4):
        outbox.post(Envelope("actor", "add", number, reliable=True, deadline_ms=50.0 if number == 2 else None), 0)
    outbox.committed()
    assert [one.seq for one in outbox.due(0)] == [1, 2, 3]
    outbox.returned(2)
    assert (outbox.left, len(outbox), outbox.is_connected, outbox.due(MS)) == (1, 3, False, [])
    (late,) = outbox.expired(50 * MS)
    assert late.seq == 2 and late.error is not UNSET and "it was not handled" in late.error.sentence
    outbox.connected(60_000 * MS)
    assert [(one.seq, one.after) for one in outbox.due(60_000 * MS)] == [(1, 0), (3, 1)]
    assert outbox.answered(answer(Envelope(boot=1, seq=1), None), 60_000 * MS)
    outbox.connected(60_001 * MS)
    assert [(one.seq, one.after) for one in outbox.due(60_001 * MS)] == [(3, 0)]


def test_one_that_expired_before_it_left_is_answered_when_its_sender_forgot_that_in_a_death() -> None:
    box, outbox = Mailbox(), Outbox("s", 1)
    outbox.disconnected()
    for number in (1, 2):
        outbox.post(Envelope("actor", "add", number, reliable=True, deadline_ms=50.0 if number == 1 else None), 0)
    kept = outbox.kept()
    outbox.committed()
    assert [late.seq for late in outbox.expired(60 * MS)] == [1]
    outbox.connected(60 * MS)
    for envelope in outbox.due(60 * MS):
        assert box.arrived(envelope, 60 * MS) == []
    handled = box.take(60 * MS)
    assert handled is not None and handled.seq == 2
    box.done(handled, answer(handled, None))
    box.committed()
    after = Outbox("s", 99, kept)
    told = [one for envelope in after.due(70 * MS) for one in box.arrived(envelope, 70 * MS)]
    assert [(one.seq, one.error.kind if one.error is not UNSET else "ok") for one in told] == [(1, "expired"), (2, "ok")]
    assert all(after.answered(one, 70 * MS) for one in told) and not len(after)


def test_one_that_left_and_is_never_answered_is_given_up_and_the_next_does_not_wait_for_it() -> None:
    outbox = Outbox("s", 1)
    outbox.post(Envelope("actor", "add", 1, reliable=True, deadline_ms=50.0), 0)
    outbox.committed()
    assert len(outbox.due(0)) == 1 and outbox.expired(60 * MS) == [], "its receiver knows whether it was handled"
    outbox.disconnected()
    assert outbox.next_ns() == 50 * MS + ANSWER_NS and outbox.given_up(50 * MS + ANSWER_NS - 1) == []
    assert [one.seq for one in outbox.given_up(50 * MS + ANSWER_NS)] == [1] and not len(outbox)
    outbox.post(Envelope("actor", "add", 2, reliable=True), 0)
    outbox.committed()
    outbox.connected(10_000 * MS)
    assert [(one.seq, one.after) for one in outbox.due(10_000 * MS)] == [(2, 0)]


def test_a_receiver_that_says_nothing_is_looked_up_more_and_more_seldom_and_after_a_word_as_in_the_beginning() -> None:
    outbox = Outbox("s", 1)
    assert not outbox.must_look(5_000 * MS), "nothing is on its way"
    posted = outbox.post(Envelope("arm", "move", 1, reliable=True), 6_000 * MS)
    outbox.committed()
    assert not outbox.must_look(6_000 * MS)
    outbox.due(6_000 * MS)

    def looks(begin_ms: int, end_ms: int) -> list[int]:
        return [at for at in range(begin_ms, end_ms, 100) if outbox.must_look(at * MS)]

    assert looks(6_000, 13_000) == [6_500, 7_500, 9_500, 11_500]
    outbox.heard(13_000 * MS)
    assert looks(13_000, 15_000) == [13_500, 14_500]
    assert outbox.answered(answer(posted, None), 20_000 * MS) and not outbox.must_look(30_000 * MS)


def test_a_sender_has_no_more_on_its_way_than_the_receiver_holds() -> None:
    outbox, box = Outbox("s", 1), Mailbox()
    for number in range(WINDOW):
        outbox.post(Envelope("actor", "add", number, reliable=True), 0)
    outbox.committed()
    sent = outbox.due(0)
    assert len(sent) == FLIGHT_MAX and outbox.due(1) == []
    for one in sent[1:]:
        box.arrived(one, 0)
    box.arrived(sent[0], 0)  # it had been lost: the others were held
    for one in sent:
        taken = box.take(0)
        assert taken is not None and taken.seq == one.seq
        box.done(taken, answer(taken, None))
    for told in box.committed():
        assert outbox.answered(told, 2)
    assert [one.seq for one in outbox.due(2)] == list(range(FLIGHT_MAX + 1, 2 * FLIGHT_MAX + 1))


def test_nothing_leaves_before_it_is_kept() -> None:
    outbox, box = Outbox("s", 1), Mailbox()
    outbox.post(Envelope("actor", reliable=True), 0)
    assert outbox.due(0) == []
    outbox.committed()
    (sent,) = outbox.due(0)
    box.arrived(sent, 0)
    taken = box.take(0)
    assert taken is not None
    box.done(taken, answer(taken, 1))
    assert box.arrived(sent, 0) == []
    (told,) = box.committed()
    assert box.arrived(sent, 0) == [told]
    assert outbox.answered(told, 0)
    assert not outbox.answered(told, 0)


def test_only_so_many_answers_leave_as_were_handled_at_the_commit_that_is_safe() -> None:
    mailbox = Mailbox()
    marks = []
    for number in range(1, 4):
        mailbox.arrived(Envelope("a", "add", number, sender="s", boot=1, seq=number, after=number - 1, reliable=True), 0)
        envelope = mailbox.take(0)
        assert envelope is not None
        mailbox.done(envelope, answer(envelope, number))
        marks.append(mailbox.handled)
    assert [one.ok for one in mailbox.committed(marks[0])] == [1] and mailbox.committed(marks[0]) == []
    again = Envelope("a", "add", 2, sender="s", boot=1, seq=2, after=1, reliable=True)
    assert mailbox.arrived(again, 0) == [], "its answer is not safe yet"
    assert [one.ok for one in mailbox.committed(marks[2])] == [2, 3]
    assert [one.ok for one in mailbox.arrived(again, 0)] == [2]


def test_answers_that_the_sender_has_had_are_forgotten() -> None:
    mailbox = Mailbox()
    for number, had in ((1, 0), (2, 0), (3, 2)):
        mailbox.arrived(Envelope("a", "add", number, sender="s", boot=1, seq=number, had=had, reliable=True), 0)
        envelope = mailbox.take(0)
        assert envelope is not None
        mailbox.done(envelope, answer(envelope, number))
        mailbox.committed()
        assert list(unpacked(mailbox.packed())["s"].answers) == {1: [1], 2: [1, 2], 3: [3]}[number]


def test_a_message_that_came_too_early_waits_for_the_one_before() -> None:
    outbox, box = Outbox("s", 1), Mailbox()
    for number in range(3):
        outbox.post(Envelope("actor", body=number, reliable=number == 0), 0)
    outbox.committed()
    first, second, third = outbox.due(0)
    assert box.arrived(third, 0) == box.arrived(second, 0) == []
    assert box.take(0) is None
    box.arrived(first, 0)
    assert [box.take(0).body for _ in range(3)] == [0, 1, 2]  # type: ignore[union-attr]


def test_a_full_mailbox_says_busy_and_a_full_outbox_takes_no_more() -> None:
    box = Mailbox()
    for _ in range(MAILBOX_MAX):
        assert box.arrived(Envelope("actor"), 0) == []
    (busy,) = box.arrived(Envelope("actor", id="x"), 0)
    assert (busy.re, busy.error.kind) == ("x", "busy")  # type: ignore[union-attr]
    outbox = Outbox("s", 1)
    for _ in range(WINDOW):
        outbox.post(Envelope("actor", reliable=True), 0)
    with pytest.raises(MailboxFullError, match="1024 messages to actor wait"):
        outbox.post(Envelope("actor"), 0)


def test_a_sender_that_begins_a_new_life_is_heard_and_its_old_messages_are_not() -> None:
    box = Mailbox()
    box.arrived(Envelope("actor", sender="s", boot=2, seq=1, body="new"), 0)
    assert box.arrived(Envelope("actor", sender="s", boot=1, seq=9, body="old"), 0) == []
    assert len(box) == 1


def test_a_deadline_that_passes_in_the_mailbox_is_told_and_not_handled() -> None:
    box = Mailbox()
    box.arrived(Envelope("actor", sender="s", boot=1, seq=1, id="x", deadline_ms=5, reliable=True), 0)
    assert box.take(5 * MS) is None
    (told,) = box.committed()
    assert (told.re, told.error.kind) == ("x", "expired")  # type: ignore[union-attr]


MUTANTS = {
    "answers leave before they are kept": (
        "_again",
        lambda self, envelope: [one for one in self._answers if one.seq == envelope.seq],
    ),
    "the one before is not waited for": ("_hold", lambda self, taken, arrived: self._accept(taken, arrived)),
    "a number is taken again": ("_again", lambda self, envelope: self._queued(mailbox.Arrived(envelope, None))),
}


def test_a_message_brought_forward_overtakes_other_senders_and_never_its_own() -> None:
    box = Mailbox()

    def came(sender: str, seq: int, verb: str, deadline_ms: float | None = None) -> None:
        after = max(seq - 1, 0)
        message = Envelope("a", verb, sender=sender, boot=1, seq=seq, after=after, reliable=True, deadline_ms=deadline_ms)
        assert not box.arrived(message, 0)

    came("one", 1, "set", 5.0)
    came("one", 2, "_look")
    came("two", 1, "set")
    came("two", 2, "_look")
    came("three", 1, "_look")
    box.bring_forward(lambda message: message.verb == "_look", 0)
    assert [box.take(0).sender, box.take(0).verb] == ["three", "set"]  # type: ignore[union-attr]
    box = Mailbox()
    came("one", 1, "set", 5.0)
    came("two", 1, "set")
    came("one", 2, "_look")
    box.bring_forward(lambda message: message.verb == "_look", 10 * MS)
    assert [one.error.kind for one in box.committed()] == ["expired"]  # type: ignore[union-attr]
    found = [box.take(10 * MS), box.take(10 * MS)]
    assert [(one.sender, one.verb) for one in found] == [("one", "_look"), ("two", "set")]  # type: ignore[union-attr]


@pytest.mark.slow
@pytest.mark.parametrize("name", MUTANTS)
def test_a_mistake_in_the_mailbox_is_seen(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    attribute, wrong = MUTANTS[name]
    monkeypatch.setattr(mailbox.Mailbox, attribute, wrong)
    with pytest.raises(AssertionError):
        look()


def look() -> None:
    """Twenty short runs with much trouble."""
    for seed in range(20):
        world = World(seed, 3, 100, loss=0.3, double=0.3)
        world.run(300)
        world.check()


def test_messages_held_for_ones_that_never_come_neither_make_it_busy_nor_let_it_remember_without_end() -> None:
    box = Mailbox()
    for sender in range(3 * SENDERS_MAX):
        for seq in range(2, 2 + HELD_MAX if sender < 100 else 3):
            assert box.arrived(Envelope("actor", "x", sender=f"s{sender}", boot=1, seq=seq, after=1, reliable=True), 0) == []
    assert len(box) <= HELD_ALL_MAX and len(box._taken) <= HELD_ALL_MAX
    assert box.arrived(Envelope("actor", "x", sender="honest", boot=1, seq=1), 0) == []
    taken = box.take(0)
    assert taken is not None and taken.sender == "honest"


def test_senders_that_are_refused_because_it_is_full_are_not_remembered() -> None:
    box = Mailbox()
    for number in range(MAILBOX_MAX):
        assert box.arrived(Envelope("actor", "x", sender="s", boot=1, seq=number + 1), 0) == []
    for number in range(100):
        (busy,) = box.arrived(Envelope("actor", "x", sender=f"t{number}", boot=1, seq=1), 0)
        assert busy.error is not UNSET and busy.error.kind == "busy"
    assert set(box._taken) == {"s"}


def test_a_held_message_keeps_the_deadline_that_it_came_with() -> None:
    box = Mailbox()
    box.arrived(Envelope("actor", "late", sender="s", boot=1, seq=2, after=1, deadline_ms=10.0), 0)
    box.arrived(Envelope("actor", "first", sender="s", boot=1, seq=1, reliable=True), 20 * MS)
    taken = box.take(20 * MS)
    assert taken is not None and taken.verb == "first"
    box.done(taken, answer(taken, None))
    assert box.take(20 * MS) is None
    assert [one.error.kind for one in box.committed() if one.error is not UNSET] == ["expired"]


DEEP = msgspec.msgpack.encode([("me", mailbox.Stream(1, 1, 1, {1: Envelope(ok=0)}))])


@pytest.mark.parametrize("content", [b"\x91\x92\xa1\xff\x81", DEEP[:-1] + b"\x91" * 12_000 + b"\x01", b"\xc1"])
def test_a_kept_mailbox_that_is_damaged_is_refused(content: bytes) -> None:
    with pytest.raises(EnvelopeError, match="the kept mailbox is damaged"):
        unpacked(content)
