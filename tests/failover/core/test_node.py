"""Single rules of the node, one event at a time. Whole lives are in ``tests/simulation``."""

from __future__ import annotations

from typing import TypeVar

import pytest
from msgspec.structs import replace

from checkpoint.model import Position
from failover.core import acts, vote_record
from failover.core.component import TABLE, Cause
from failover.core.election.consent import STATES
from failover.core.events import (
    Captured,
    CaptureFailed,
    Command,
    Committed,
    Exited,
    Failback,
    Handover,
    NothingToCapture,
    Prefer,
    Promote,
    Received,
    Release,
    Restored,
    Run,
    Started,
    Stop,
    Stored,
    Tick,
    Unchanged,
    UnderWay,
)
from failover.core.membership import Peer
from failover.core.node import Node
from failover.core.types import MS, ComponentSpec, Config, Held, Launch, OnUnsupported, Record, Rules, State, VoteRecord
from failover.core.wire.messages import Beat, Echo, Entry
from failover.errors import RulesError

SPEC = ComponentSpec("/lab/x", launch=Launch(("x",)))
A = TypeVar("A", bound=acts.Act)
ALONE = Config("robot1", grace_ms=300)
PAIR = Config("robot1", ("robot2",), grace_ms=300)
PAIR_OF_2 = Config("robot2", ("robot1",), grace_ms=300)


def running(node: Node, spec: ComponentSpec = SPEC) -> acts.Ready:
    """Start a component at a robot that is alone."""
    node.step(Run(1, spec), 0)
    return node.step(Started(spec.name, 1), 1 * MS)


def only(ready: acts.Ready, kind: type[A]) -> list[A]:
    return [act for act in ready.act if isinstance(act, kind)]


def test_the_vote_record_holds_the_claim_that_the_same_step_tells_of() -> None:
    ready = Node(ALONE, 1, VoteRecord(), 0).step(Run(1, SPEC), 0)
    assert ready.persist is not None and ready.persist.records[0].epoch == ready.send[0].entries[0].epoch == 1


def test_a_vote_record_survives_its_bytes() -> None:
    written = VoteRecord((Record("/lab/x", 3, "robot1", State.PRIMARY, ("robot2",), spec=SPEC),))
    assert vote_record.decode(vote_record.encode(written)) == written
    assert vote_record.decode(b"") == VoteRecord()
    with pytest.raises(RulesError, match="cannot read the vote record"):
        vote_record.decode(b"{")


def test_an_event_of_an_older_epoch_changes_nothing() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    running(node)
    late = Captured("/lab/x", 0, Position(64, 1, b"d"), None)
    assert not only(node.step(late, 2 * MS), acts.Acknowledge)


def test_one_capture_is_in_flight_at_a_time() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    assert len(only(running(node), acts.Capture)) == 1
    assert not any(only(node.step(Tick(), at * MS), acts.Capture) for at in range(2, 5_000, 20))


@pytest.mark.parametrize(("period_ms", "lag_ms"), [(100, 500), (60_000, 1_000)])
def test_a_capture_waits_for_its_window_for_five_periods_and_never_for_longer_than_a_second(period_ms: int, lag_ms: int) -> None:
    """Orders on its component wait behind it."""
    node = Node(replace(ALONE, alone_period_ms=period_ms), 1, VoteRecord(), 0)
    (capture,) = only(running(node), acts.Capture)
    assert isinstance(capture, acts.Capture) and capture.lag_ns == lag_ms * MS


def test_alone_a_capture_counts_from_this_robots_own_store() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    (capture,) = only(running(node), acts.Capture)
    assert isinstance(capture, acts.Capture) and capture.base
    position = Position(capture.generation, capture.sequence, b"d")
    (acknowledged,) = only(node.step(Captured("/lab/x", 1, position, None), 5 * MS), acts.Acknowledge)
    assert isinstance(acknowledged, acts.Acknowledge) and acknowledged.is_safe, "it is the whole team"
    (later,) = only(node.step(Tick(), 2_000 * MS), acts.Capture)
    assert isinstance(later, acts.Capture) and not later.base


def test_the_status_tells_how_long_the_newest_delta_took_to_be_a_checkpoint() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    (capture,) = only(running(node), acts.Capture)
    assert isinstance(capture, acts.Capture)
    base = Position(capture.generation, capture.sequence, b"d")
    node.step(Captured("/lab/x", 1, base, None), 5 * MS)
    assert node.status(6 * MS).components[0].took_ns == 0, "a base says nothing about deltas"
    (later,) = only(node.step(Tick(), 2_000 * MS), acts.Capture)
    assert isinstance(later, acts.Capture)
    node.step(Captured("/lab/x", 1, Position(later.generation, later.sequence, b"e"), base), 2_030 * MS)
    assert node.status(2_500 * MS).components[0].took_ns == 30 * MS


def test_what_this_robot_alone_holds_is_not_called_safe_while_there_could_be_a_standby() -> None:
    node = Node(PAIR, 1, VoteRecord(), 0)
    node.step(Run(1, SPEC), 0)
    starts = [at for at in range(0, 5_000, 20) if only(node.step(Tick(), at * MS), acts.Start)]
    assert starts, "nobody else was heard: it starts alone"
    (capture,) = only(node.step(Started("/lab/x", 1), 5_000 * MS), acts.Capture)
    assert isinstance(capture, acts.Capture)
    taken = Captured("/lab/x", 1, Position(capture.generation, capture.sequence, b"d"), None)
    (acknowledged,) = only(node.step(taken, 5_005 * MS), acts.Acknowledge)
    assert isinstance(acknowledged, acts.Acknowledge) and not acknowledged.is_safe


def test_a_program_that_commits_nothing_makes_no_snapshots_and_its_lag_grows() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    (capture,) = only(running(node), acts.Capture)
    assert isinstance(capture, acts.Capture)
    held = Position(capture.generation, capture.sequence, b"d")
    node.step(Captured("/lab/x", 1, held, None, age_ns=1 * MS), 5 * MS)
    first = node.status(100 * MS).components[0].lag_ns
    (later,) = only(node.step(Tick(), 2_000 * MS), acts.Capture)
    assert isinstance(later, acts.Capture)
    assert not node.step(Unchanged("/lab/x", 1, later.sequence, held), 2_001 * MS).act
    seen = node.status(2_100 * MS).components[0]
    assert (seen.lag_ns - first, seen.positions) == (2_000 * MS, (held,))
    (again,) = only(node.step(Tick(), 4_000 * MS), acts.Capture)
    assert isinstance(again, acts.Capture)
    assert (again.sequence, again.base) == (later.sequence, False), "no number is left out"
    node.step(Unchanged("/lab/x", 1, later.sequence - 1, held), 4_001 * MS)
    assert not only(node.step(Tick(), 4_002 * MS), acts.Capture), "a late answer to an older order is none to this one"


def test_a_program_that_rests_makes_no_snapshots_and_its_checkpoint_does_not_grow_older() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    (capture,) = only(running(node), acts.Capture)
    assert isinstance(capture, acts.Capture)
    held = Position(capture.generation, capture.sequence, b"d")
    node.step(Captured("/lab/x", 1, held, None, age_ns=1 * MS), 5 * MS)
    (later,) = only(node.step(Tick(), 2_000 * MS), acts.Capture)
    assert isinstance(later, acts.Capture)
    assert not node.step(Unchanged("/lab/x", 1, later.sequence, held, is_current=True), 2_001 * MS).act
    seen = node.status(2_100 * MS).components[0]
    assert (seen.lag_ns, seen.positions) == (100 * MS, (held,)), "as old as the look, which was ordered at 2,000"


def test_an_unchanged_state_that_is_not_the_newest_checkpoint_is_sent_whole() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    (capture,) = only(running(node), acts.Capture)
    assert isinstance(capture, acts.Capture)
    (again,) = only(node.step(Unchanged("/lab/x", 1, capture.sequence, Position(1, 1, b"old")), 5 * MS), acts.Capture)
    assert isinstance(again, acts.Capture) and again.base


def test_what_cannot_be_captured_degrades_and_names_the_reason() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    running(node)
    node.step(CaptureFailed("/lab/x", 1, "fd 7 is a socket", unsupported=True), 5 * MS)
    (seen,) = node.status(6 * MS).components
    assert seen.protection == "degraded" and "fd 7 is a socket" in seen.notes[0]
    assert only(node.step(Tick(), 2_000 * MS), acts.Capture)


def test_a_program_that_has_committed_nothing_yet_is_captured_as_soon_as_it_has() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    running(node)
    ready = node.step(NothingToCapture("/lab/x", 1, "it has committed nothing yet"), 5 * MS)
    assert not ready.act
    seen = node.status(6 * MS).components[0]
    assert (seen.protection, node.status(6 * MS).healthy) == ("none", True), "nothing is wrong"
    assert seen.notes == ("nothing to protect yet: it has committed nothing yet; there is no checkpoint yet",)
    assert not any("not captured" in decision.sentence for decision in ready.told)
    (capture,) = only(node.step(Committed("/lab/x", 1), 7 * MS), acts.Capture)
    assert isinstance(capture, acts.Capture)
    node.step(Captured("/lab/x", 1, Position(capture.generation, capture.sequence, b"d"), None), 8 * MS)
    assert node.status(9 * MS).components[0].notes == ()


def test_a_snapshot_that_was_lost_degrades_nothing_while_there_is_nothing_to_take() -> None:
    node = Node(replace(ALONE, ship_ms=500), 1, VoteRecord(), 0)
    running(node)
    node.step(Tick(), 600 * MS)
    assert node.status(5_000 * MS).components[0].protection == "degraded"
    assert only(node.step(Tick(), 5_000 * MS), acts.Capture)
    node.step(NothingToCapture("/lab/x", 1, "nothing yet"), 5_001 * MS)
    seen = node.status(9_000 * MS).components[0]
    assert (seen.protection, [note.partition(":")[0] for note in seen.notes]) == ("none", ["nothing to protect yet"])


def test_a_snapshot_that_takes_long_is_not_begun_anew_while_it_is_under_way() -> None:
    node = Node(replace(ALONE, ship_ms=500), 1, VoteRecord(), 0)
    captures = [act for act in running(node).act if isinstance(act, acts.Capture)]
    for now_ms in range(400, 4_000, 400):
        ready = node.step(UnderWay("/lab/x", 1), now_ms * MS)
        captures += [act for act in ready.act if isinstance(act, acts.Capture)]
    assert len(captures) == 1, "it is taken once"
    node.step(UnderWay("/lab/x", 7), 4_050 * MS)  # of another epoch
    node.step(Tick(), 4_200 * MS)
    assert only(node.step(Tick(), 6_000 * MS), acts.Capture), "nothing was heard of it"


def test_a_first_commit_in_the_middle_of_a_capture_is_not_passed_over() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    running(node)
    assert not only(node.step(Committed("/lab/x", 1), 3 * MS), acts.Capture), "one is in flight"
    assert only(node.step(NothingToCapture("/lab/x", 1, "nothing yet"), 5 * MS), acts.Capture)


def test_stop_protecting_means_no_more_captures() -> None:
    spec = ComponentSpec("/lab/x", launch=Launch(("x",)), rules=Rules(on_unsupported=OnUnsupported.STOP_PROTECTING))
    node = Node(ALONE, 1, VoteRecord(), 0)
    running(node, spec)
    node.step(CaptureFailed("/lab/x", 1, "fd 7 is a socket", unsupported=True), 5 * MS)
    assert not only(node.step(Tick(), 5_000 * MS), acts.Capture)
    assert node.status(5_000 * MS).components[0].protection == "stopped"


def test_a_beat_is_due_all_the_time() -> None:
    node = Node(PAIR, 1, VoteRecord(), 0)
    beats, now = 0, 0
    while now < 1_000 * MS:
        beats += len(node.step(Tick(), now).send)
        now = node.next_deadline_ns()
    assert beats == 1_000 // PAIR.beat_ms


@pytest.mark.parametrize(
    ("sender", "paces", "follows"), [("robot1", True, True), ("robot3", True, False), ("robot1", False, False)]
)
def test_a_beat_is_due_at_once_when_that_of_the_least_name_has_come(sender: str, paces: bool, follows: bool) -> None:
    config = Config("robot2", ("robot1", "robot3"))
    node, now_ns, followed = Node(config, 1, VoteRecord(), 0), 0, 0
    for number in range(1, 201):
        now_ns += config.beat_ns
        while node.next_deadline_ns() <= now_ns:
            node.step(Tick(), node.next_deadline_ns())
        assert not node.step(Received(Beat(sender, 1, number), "wire", paces=paces), now_ns).send, "other beats wait to be read"
        if node.next_deadline_ns() <= now_ns:
            followed += len(node.step(Tick(), now_ns).send)
    assert followed > 50 if follows else not followed


@pytest.mark.parametrize("late_us", [0, 300, 2_000, 4_900])
def test_a_beat_that_comes_at_the_instant_of_its_senders_death_counts_before_anything_is_decided(late_us: int) -> None:
    position = Position(64, 5, b"12345678")
    record = Record("/lab/x", 1, "robot1", State.STANDBY, ("robot2",), trusted=True, spec=SPEC, begun=True)
    node = Node(replace(PAIR_OF_2, lease_ms=200), 1, VoteRecord((record,)), 0, (Held("/lab/x", (position,)),))
    entry = Entry("/lab/x", STATES.index(State.PRIMARY), 1, "robot1", 64, 5, position.digest, "robot2")

    def beat(counter: int) -> Beat:
        return Beat("robot1", 1, counter, 1, 0, 1, (Echo("robot2", 1, max(counter - 1, 1)),), (entry,))

    now_ns, last = 0, 120
    for counter in range(1, last + 1):
        now_ns += PAIR_OF_2.beat_ns
        node.step(Received(beat(counter), "wire"), now_ns)
        while node.next_deadline_ns() <= now_ns:
            node.step(Tick(), node.next_deadline_ns())
    dead_ns = node._team.peers["robot1"].loyal_until_ns
    while node.next_deadline_ns() < dead_ns:
        node.step(Tick(), node.next_deadline_ns())
    now_ns = dead_ns + late_us * 1_000
    node.step(Received(beat(last + 1), "wire"), now_ns)
    node.step(Tick(), max(now_ns, node.next_deadline_ns()))
    assert node.status(now_ns).components[0].state is State.STANDBY


def test_a_late_own_loop_accuses_nobody() -> None:
    node = Node(PAIR, 1, VoteRecord(), 0)
    node.step(Received(Beat("robot2", 1, 1), "wire"), 1 * MS)
    node.step(Tick(), 5_000 * MS)
    assert node.status(5_000 * MS).peers[0].state != "dead"


def test_unknown_states_and_strangers_change_nothing() -> None:
    node = Node(PAIR, 1, VoteRecord(), 0)
    mad = Beat("robot2", 1, 1, total=1, entries=(Entry("/lab/x", 99, 4, "robot2"),))
    node.step(Received(mad, "wire"), 1 * MS)
    node.step(Received(Beat("nobody", 1, 1, total=1, entries=(Entry("/lab/y", 3, 4, "nobody"),)), "wire"), 2 * MS)
    assert [one.name for one in node.status(3 * MS).components] == []


def test_a_restarted_robot_does_not_start_anew_what_it_gave_away() -> None:
    record = Record("/lab/x", 3, "robot1", State.PRIMARY, ("robot2",), spec=SPEC)
    node = Node(PAIR, 2, VoteRecord((record,)), 0, (Held("/lab/x", (Position(192, 5, b"d"),)),))
    ready = node.step(Tick(), 100 * MS)
    assert not only(ready, acts.Restore) and not only(ready, acts.Start)


def test_who_takes_a_component_over_takes_no_more_snapshots_of_it() -> None:
    """A robot that stood still in the middle of sending one goes on with that when it wakes up."""
    node, position = Node(PAIR, 1, VoteRecord(), 0), Position(65, 1, b"d")
    entry = Entry(SPEC.name, STATES.index(State.PRIMARY), 1, "robot2", standby="robot1")
    heard = node.step(Received(Beat("robot2", 1, 1, 1, 0, 1, (Echo("robot1", 1, 1),), (entry,)), "wire"), 10 * MS)
    assert [(act.sender, act.epoch) for act in only(heard, acts.Admit)] == [("robot2", 1)]
    node.step(Stored(SPEC.name, 1, position, "robot2", SPEC), 20 * MS)
    ordered = [act for at in range(30, 2_000, 10) for act in node.step(Tick(), at * MS).act]
    kinds = [type(act) for act in ordered if isinstance(act, acts.Admit | acts.Restore)]
    assert kinds == [acts.Admit, acts.Restore]
    assert acts.Admit(SPEC.name, 2, "") in ordered


def test_a_snapshot_that_comes_after_the_claim_is_neither_accepted_nor_shown() -> None:
    """It was being stored when the standby claimed; the claim goes on from the one before."""
    node, first, late = Node(PAIR, 1, VoteRecord(), 0), Position(65, 1, b"d"), Position(65, 2, b"e")
    entry = Entry(SPEC.name, STATES.index(State.PRIMARY), 1, "robot2", standby="robot1")
    node.step(Received(Beat("robot2", 1, 1, 1, 0, 1, (Echo("robot1", 1, 1),), (entry,)), "wire"), 10 * MS)
    taken = node.step(Stored(SPEC.name, 1, first, "robot2", SPEC), 20 * MS).act
    assert acts.Accept(SPEC.name, 1, first) in taken
    assert acts.Show(SPEC.name, 1, first) in taken
    ordered = [act for at in range(30, 2_000, 10) for act in node.step(Tick(), at * MS).act]
    assert [act.position for act in ordered if isinstance(act, acts.Restore)] == [first]
    assert node.step(Stored(SPEC.name, 1, late, "robot2", SPEC), 2_000 * MS).act == (acts.Discard(SPEC.name, 2, late),)


def test_after_a_restart_a_standby_shows_what_it_holds_of_the_present_primacy_and_no_earlier_copy_of_its_own() -> None:
    ours, theirs = Position(64, 9, b"d"), Position(64 * 2 + 1, 3, b"e")
    record = Record(SPEC.name, 2, "robot2", State.STANDBY, spec=SPEC)
    for held, shown in (((ours,), []), ((ours, theirs), [theirs])):
        node = Node(PAIR, 2, VoteRecord((record,)), 0, (Held(SPEC.name, held),))
        assert [act.position for act in only(node.step(Tick(), 1 * MS), acts.Show)] == shown


def test_an_entry_from_before_the_last_change_is_not_acted_on() -> None:
    peer = Peer("robot2", 0)
    own = ("robot1", 1)
    peer.take(Beat("robot2", 1, 1, 1, 0, 2, (), (Entry("/lab/x", 9, 1, "robot1"),)), own, "wire", 0)
    assert peer.entry("/lab/x") is not None
    peer.take(Beat("robot2", 1, 2, 2, 0, 2, (), (Entry("/lab/y", 9, 1, "robot1"),)), own, "wire", 0)
    assert peer.entry("/lab/x") is None and not peer.complete


def test_an_echo_of_an_earlier_life_gives_no_lease() -> None:
    peer = Peer("robot2", 0)
    peer.take(Beat("robot2", 1, 1, echoes=(Echo("robot1", 1, 90),)), ("robot1", 2), "wire", 0)
    assert peer.echoed == 0


@pytest.mark.parametrize("settings", [{"beat_ms": 0}, {"lease_ms": 79}, {"margin_percent": 0}, {"peers": ("robot1",)}])
def test_a_configuration_that_contradicts_itself_is_refused(settings: dict[str, object]) -> None:
    with pytest.raises(RulesError):
        Config("robot1", **settings)  # type: ignore[arg-type]


def test_every_state_can_be_reached_and_every_cause_is_used() -> None:
    assert set(TABLE.values()) == set(State) - {State.ABSENT}
    assert {cause for _, cause in TABLE} == set(Cause)


ORDERS: tuple[Command, ...] = (
    Run(2, replace(SPEC, owner=1001)),
    Release(2, SPEC.name),
    Stop(2, SPEC.name),
    Handover(2, SPEC.name),
    Promote(2, SPEC.name),
    Failback(2, SPEC.name),
    Prefer(2, SPEC.name, "robot1"),
)


@pytest.mark.parametrize("order", ORDERS, ids=lambda order: type(order).__name__)
def test_an_order_about_a_name_that_another_user_has_taken_meanwhile_does_nothing(order: Command) -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    running(node, replace(SPEC, owner=1000))
    (answer,) = node.step(replace(order, by=1001), 2 * MS).act
    assert isinstance(answer, acts.Answer) and not answer.ok and "belongs to uid 1000" in answer.sentence
    assert node.status(2 * MS).components[0].state is State.PRIMARY
    for by in (1000, None):
        answers = only(node.step(replace(order, by=by), 3 * MS), acts.Answer)
        assert not any("belongs to uid" in one.sentence for one in answers)


@pytest.mark.parametrize("order", ORDERS[1:], ids=lambda order: type(order).__name__)
def test_an_order_that_was_decided_on_another_epoch_does_nothing_and_says_so(order: Command) -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    running(node, SPEC)
    epoch = node.status(2 * MS).components[0].epoch
    (answer,) = node.step(replace(order, decided=epoch + 1), 2 * MS).act
    assert isinstance(answer, acts.Answer) and not answer.ok
    assert f"epoch {epoch + 1} then, {epoch} now, at robot1" in answer.sentence and "nothing was done" in answer.sentence
    assert node.status(2 * MS).components[0].state is State.PRIMARY
    for decided in (epoch, 0):
        answers = only(node.step(replace(order, decided=decided), 3 * MS), acts.Answer)
        assert not any("was decided" in one.sentence for one in answers)


def test_a_failback_to_another_robot_than_the_user_saw_does_nothing() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    running(node, SPEC)
    (answer,) = node.step(Failback(2, SPEC.name, to="robot9"), 2 * MS).act
    assert isinstance(answer, acts.Answer) and not answer.ok
    assert "would move to robot1 now, and not to robot9" in answer.sentence and "nothing was done" in answer.sentence
    (answer,) = node.step(Failback(3, SPEC.name, to="robot1"), 3 * MS).act
    assert isinstance(answer, acts.Answer) and answer.ok


def test_a_released_name_is_free_for_another_user_and_what_is_kept_under_it_is_not() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    running(node, replace(SPEC, owner=1000))
    node.step(Release(2, SPEC.name, by=1000), 2 * MS)
    (answer,) = only(node.step(Release(3, SPEC.name, by=1001), 3 * MS), acts.Answer)
    assert not answer.ok and "belongs to uid 1000" in answer.sentence
    assert only(node.step(Run(4, replace(SPEC, owner=1001), by=1001), 4 * MS), acts.Start)


def test_a_command_about_an_unknown_component_is_answered() -> None:
    (answer,) = Node(ALONE, 1, VoteRecord(), 0).step(Release(4, "/lab/z"), 0).act
    assert isinstance(answer, acts.Answer) and not answer.ok and "failover status" in answer.sentence


@pytest.mark.parametrize(
    ("echo", "remembered"),
    [
        (Echo("robot1", 3, 7), 0),
        (Echo("robot1", 4, 0), 0),
        (Echo("robot1", 4, 1_000), 4),
        (Echo("robot1", 4, -1_000), 4),
        (Echo("robot1", 9, 7), 9),
        (Echo("robot3", 9, 7), 0),
        (Echo("robot1", 1 << 60, 7), 0),
    ],
)
def test_a_robot_finds_out_that_others_remember_a_life_that_its_vote_record_does_not(echo: Echo, remembered: int) -> None:
    node = Node(PAIR, 4, VoteRecord(), 0)
    node.step(Tick(), 0)
    assert node.outlived_by(Beat("robot2", 1, 1, 0, 0, 0, (echo,), ())) == remembered


@pytest.mark.parametrize(("launch", "verb"), [(SPEC.launch, "run"), (Launch(pid=41), "protect")], ids=["run", "protect"])
def test_a_start_is_refused_in_the_words_of_the_order(launch: Launch, verb: str) -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    node.step(Run(1, SPEC), 0)
    (refusal,) = only(node.step(Run(2, replace(SPEC, launch=launch)), MS), acts.Answer)
    assert not refusal.ok and refusal.sentence.startswith(f"cannot {verb} {SPEC.name}: ")


@pytest.mark.parametrize(("lost_ns", "lost_s"), [(500 * MS, 0.5), (-1, 8.1)], ids=["known", "not known"])
def test_a_component_that_resumes_says_what_was_lost_and_not_how_long_it_did_not_run(lost_ns: int, lost_s: float) -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    (capture,) = only(running(node), acts.Capture)
    assert isinstance(capture, acts.Capture)
    position = Position(capture.generation, capture.sequence, b"d")
    node.step(Captured("/lab/x", 1, position, None), 5 * MS)
    (restore,) = only(node.step(Exited("/lab/x", 1, 9), 6 * MS), acts.Restore)
    assert isinstance(restore, acts.Restore)
    ready = node.step(Restored("/lab/x", restore.epoch, position, 8_100 * MS, lost_ns), 9_000 * MS)
    (told,) = (one.sentence for one in ready.told if "resumes from checkpoint" in one.sentence)
    assert told.endswith(f"; it lost {lost_s} s of its work")
    notes = node.status(9_001 * MS).components[0].notes
    assert ("it resumed at robot1 from its last checkpoint and lost 8.1 s of its work" in notes) == (lost_ns < 0)


def test_what_a_heartbeat_said_that_never_left_is_said_in_the_next_one() -> None:
    """More components than fit one heartbeat, and every second heartbeat is replaced before its slot."""
    specs = [replace(SPEC, name=f"/lab/robot1/component-with-a-long-name-{number:02}") for number in range(40)]
    node, told = Node(ALONE, 1, VoteRecord(), 0), set[str]()
    for spec in specs:
        running(node, spec)
    for turn in range(1, 20):
        (beat,) = node.step(Tick(), turn * 100 * MS).send
        node.waits(None if turn % 2 else beat)
        told.update(entry.name for entry in beat.entries if turn % 2)
    assert told == {spec.name for spec in specs}
