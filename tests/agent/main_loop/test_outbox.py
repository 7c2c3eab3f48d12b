"""Persist → send → act while the disk is slow: nothing that depends on the disk leaves, and heartbeats continue."""

from __future__ import annotations

from msgspec.structs import replace

from agent.main_loop.outbox import NOTHING, Due, Outbox
from checkpoint.model import Position
from failover.core.acts import Acknowledge, Act, Ready, SetLease
from failover.core.types import Awaited, Record, VoteRecord
from failover.core.wire.messages import Beat, Echo, Entry, Promise

BEAT_NS = 20_000_000
ECHOES = (Echo("robot2", 1, 5), Echo("robot3", 1, 9))
OLD = VoteRecord((Record("/a", epoch=3, primary="robot2"), Record("/b", epoch=1, primary="robot3")))
NEW = VoteRecord((Record("/a", epoch=4, primary="robot1"), Record("/b", epoch=1, primary="robot3")))


def beat(counter: int, settled: int = 0) -> Beat:
    return Beat("robot1", 1, counter, settled, echoes=ECHOES, entries=(Entry("/a", 1, 3),), total=1)


def act(sequence: int) -> Act:
    return Acknowledge("/a", 1, Position(1, sequence, b""), True)


def outbox() -> Outbox:
    box = Outbox(OLD, BEAT_NS)
    assert box.take(Ready(send=(beat(1, 1),)), 0).beats == (beat(1, 1),)
    return box


def test_without_a_vote_record_everything_leaves_at_once() -> None:
    assert outbox().take(Ready(send=(beat(2),), act=(act(1),)), BEAT_NS) == Due(None, (beat(2),), (act(1),))


def test_what_makes_nothing_due_is_told_as_nothing_and_only_then() -> None:
    box = outbox()
    assert box.take(Ready(), 1) is NOTHING
    box.take(Ready(NEW, act=(act(1),)), 2)
    assert box.take(Ready(), 3) is not NOTHING, "a vote record is on its way"
    assert box.kept(1, NEW, 4).acts == (act(1),)
    assert box.take(Ready(), 5) is NOTHING
    assert box.take(Ready(act=(act(2),)), 6).acts == (act(2),)


def test_a_step_that_makes_nothing_due_keeps_the_beat_that_waits_for_the_disk() -> None:
    box = outbox()
    assert box.take(Ready(NEW, send=(beat(2),)), 1).beats == ()
    assert box.take(Ready(), 2).beats == ()
    assert box.kept(1, NEW, 3).beats == (beat(2),)


def test_acts_wait_for_the_vote_record_they_depend_on_and_keep_their_order() -> None:
    box = outbox()
    first = box.take(Ready(NEW, act=(act(1),)), 1)
    assert first == Due((1, NEW), (), ())
    assert box.take(Ready(act=(act(2),)), 2).acts == ()
    assert box.take(Ready(NEW, act=(act(3),)), 3).persist == (2, NEW)
    assert box.kept(1, NEW, 4).acts == (act(1), act(2))
    assert box.kept(2, NEW, 5).acts == (act(3),)


def test_leases_do_not_pile_up_behind_a_disk_that_is_full() -> None:
    box = outbox()
    box.take(Ready(NEW, act=(act(1),)), 1)
    for instant in range(2, 1000):
        box.take(Ready(act=(SetLease("/a", 4, instant), SetLease("/b", 1, instant))), instant)
    assert box.kept(1, NEW, 1000).acts == (act(1), SetLease("/a", 4, 999), SetLease("/b", 1, 999))


def test_a_newer_lease_asks_for_the_word_that_the_one_it_replaces_asked_for() -> None:
    box = outbox()
    box.take(Ready(NEW), 1)
    box.take(Ready(act=(SetLease("/a", 4, 20, is_asked=True), SetLease("/b", 1, 20))), 2)
    box.take(Ready(act=(SetLease("/a", 4, 30), SetLease("/b", 1, 30))), 3)
    assert box.kept(1, NEW, 4).acts == (SetLease("/a", 4, 30, is_asked=True), SetLease("/b", 1, 30))


def test_a_later_epochs_lease_answers_for_no_earlier_one() -> None:
    box = outbox()
    box.take(Ready(NEW), 1)
    box.take(Ready(act=(SetLease("/a", 4, 20, is_asked=True), SetLease("/a", 5, 30))), 2)
    assert box.kept(1, NEW, 3).acts == (SetLease("/a", 5, 30),)


def test_it_names_the_components_whose_newest_lease_waits_for_the_disk() -> None:
    box = outbox()
    assert box.unleased == ()
    box.take(Ready(NEW, act=(act(1),)), 1)
    box.take(Ready(act=(SetLease("/a", 4, 20), SetLease("/b", 1, 20))), 2)
    assert box.unleased == ("/a", "/b")
    box.kept(1, NEW, 3)
    assert box.unleased == ()


def test_a_later_vote_record_covers_the_earlier_ones() -> None:
    box = outbox()
    box.take(Ready(NEW, act=(act(1),)), 1)
    box.take(Ready(NEW, act=(act(2),)), 2)
    assert box.kept(2, NEW, 3).acts == (act(1), act(2))


def test_a_due_beat_goes_out_stripped_while_the_disk_is_slow() -> None:
    box = outbox()
    box.take(Ready(NEW), 1)
    (sent,) = box.take(Ready(send=(beat(2, 2),)), BEAT_NS).beats
    assert sent.counter == 2
    assert sent.entries == ()
    assert sent.settled == 1, "peers go on knowing what the last durable beat told them"


def test_a_robot_whose_primacy_is_given_up_gets_no_echo_that_would_extend_its_lease() -> None:
    box = outbox()
    box.take(Ready(NEW), 1)
    (sent,) = box.take(Ready(send=(beat(2, 2),)), BEAT_NS).beats
    assert sent.echoes == (Echo("robot3", 1, 9),)


def test_a_promise_that_is_not_on_the_disk_yet_is_not_told() -> None:
    box, promise = outbox(), Promise("robot2", 3, 5, 20_000)
    box.take(Ready(VoteRecord(OLD.records, (Awaited("robot2", 3, 20_000),))), 1)
    promising = replace(beat(2, 2), promises=(promise,))
    (sent,) = box.take(Ready(send=(promising,)), BEAT_NS).beats
    assert sent.promises == ()
    assert box.take(Ready(send=(replace(beat(3, 2), promises=(promise,)),)), BEAT_NS + 1).beats == ()
    (told,) = box.kept(1, NEW, BEAT_NS + 2).beats
    assert told.promises == (promise,)


def test_an_early_beat_waits_for_the_disk_and_then_goes_whole() -> None:
    box = outbox()
    box.take(Ready(NEW), 1)
    assert box.take(Ready(send=(beat(2, 2),)), 2).beats == ()
    assert box.kept(1, NEW, 3).beats == (beat(2, 2),)


def test_a_beat_that_went_stripped_is_not_sent_again() -> None:
    box = outbox()
    box.take(Ready(NEW), 1)
    box.take(Ready(send=(beat(2, 2),)), BEAT_NS)
    assert box.kept(1, NEW, BEAT_NS + 1).beats == ()
