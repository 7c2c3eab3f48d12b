"""Single rules of votes, one event at a time. Whole lives, scenarios and promises are in ``tests/simulation``."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from checkpoint.model import Position
from failover.core import acts
from failover.core.component import Component
from failover.core.election.consent import STATES
from failover.core.election.pair import placing, vacant
from failover.core.events import Captured, Handover, Leave, Received, Run, Started, Stored, Tick
from failover.core.node import Node
from failover.core.types import (
    COORDINATOR,
    MS,
    ComponentSpec,
    Config,
    Held,
    Launch,
    Record,
    Rule,
    Rules,
    State,
    VoteRecord,
    WhenAlone,
)
from failover.core.wire.messages import FREE, RETURNED, SAFE, Beat, Echo, Entry
from failover.errors import RulesError

NAME = "/lab/x"
SPEC = ComponentSpec(NAME, launch=Launch(("x",)))
WITNESS = Config("witness1", ("robot1", "robot2"), rule=Rule.MAJORITY, witnesses=("witness1",), grace_ms=300)
ROBOT = Config("robot1", ("robot2", "witness1"), rule=Rule.MAJORITY, witnesses=("witness1",), grace_ms=300)
NEWEST = Position(64, 5, b"d")


def entry(state: State, epoch: int, primary: str, position: Position | None = None, standby: str = "", flags: int = 0) -> Entry:
    at = position or Position(0, 0, b"")
    return Entry(NAME, STATES.index(state), epoch, primary, at.generation, at.sequence, at.digest, standby, flags=flags)


class Talk:
    """A node, and what its peers say to it. Time goes on in small steps, so that the node is never late."""

    def __init__(self, config: Config, vote_record: VoteRecord | None = None, held: tuple[Held, ...] = ()) -> None:
        self.node = Node(config, 1, vote_record or VoteRecord(), 0, held)
        self.now_ns = 0
        self.readies: list[acts.Ready] = []
        self._counters: dict[str, int] = {}

    def tick(self, ms: int) -> None:
        until_ns = self.now_ns + ms * MS
        while (at_ns := self.node.next_deadline_ns()) < until_ns:
            self.readies.append(self.node.step(Tick(), at_ns))
        self.now_ns = until_ns

    def hear(self, sender: str, *entries: Entry, untold: int = 0) -> acts.Ready:
        """A beat with these entries; ``untold``: how many more have changed and are told in a later one."""
        counter = self._counters[sender] = self._counters.get(sender, 0) + 1
        said = [beat for ready in self.readies for beat in ready.send]
        echoes = (Echo(said[-1].sender, 1, said[-1].counter),) if said else ()
        beat = Beat(sender, 1, counter, counter, 0, len(entries) + untold, echoes, entries)
        ready = self.node.step(Received(beat, "wire"), self.now_ns)
        self.readies.append(ready)
        return ready

    def vote(self) -> tuple[int, str]:
        """Epoch and primary on the newest vote record."""
        vote_records = [ready.persist for ready in self.readies if ready.persist is not None]
        return next(((record.epoch, record.primary) for record in vote_records[-1].records), (0, "")) if vote_records else (0, "")

    def said(self) -> list[Entry]:
        """What the node told of the component, oldest first."""
        return [one for ready in self.readies for beat in ready.send for one in beat.entries]

    def orders(self, kind: type[acts.Act]) -> list[acts.Act]:
        return [act for ready in self.readies for act in ready.act if isinstance(act, kind)]


def followed() -> Talk:
    """A witness that follows robot1, whose standby is robot2."""
    talk = Talk(WITNESS)
    talk.tick(400)
    for _ in range(3):
        talk.hear("robot2", entry(State.STANDBY, 1, "robot1", NEWEST, "robot2"))
        talk.hear("robot1", entry(State.PRIMARY, 1, "robot1", NEWEST, "robot2"))
        talk.tick(20)
    assert talk.vote() == (1, "robot1")
    return talk


def test_a_member_that_hears_its_primary_votes_for_nobody_else() -> None:
    talk = followed()
    talk.hear("robot1", entry(State.PRIMARY, 1, "robot1", NEWEST, "robot2"))
    talk.hear("robot2", entry(State.CLAIMING, 2, "robot2", NEWEST))
    assert talk.vote() == (1, "robot1")


def test_a_member_whose_primary_is_silent_votes_once_an_epoch() -> None:
    talk = followed()
    talk.tick(WITNESS.loyalty_ns // MS + 5)
    ready = talk.hear("robot2", entry(State.CLAIMING, 2, "robot2", NEWEST))
    assert ready.persist is not None and talk.vote() == (2, "robot2")
    talk.hear("robot1", entry(State.CLAIMING, 2, "robot1", NEWEST))
    assert talk.vote() == (2, "robot2")


def test_a_vote_survives_a_restart() -> None:
    record = Record(NAME, 2, "robot2", State.STANDBY)
    talk = Talk(WITNESS, VoteRecord((record,)))
    talk.tick(400)
    talk.hear("robot1", entry(State.CLAIMING, 2, "robot1", NEWEST))
    assert talk.vote() == (0, "")  # nothing new to persist


def test_a_member_says_when_it_is_free() -> None:
    talk = followed()
    bound = talk.said()[-1]
    talk.tick(WITNESS.loyalty_ns // MS + 40)
    assert not bound.flags & FREE and talk.said()[-1].flags & FREE


def test_a_robot_without_what_was_acknowledged_gets_no_vote() -> None:
    talk = followed()
    talk.hear("robot1", entry(State.PRIMARY, 1, "robot1", NEWEST, "robot1"))
    talk.tick(WITNESS.loyalty_ns // MS + 5)
    talk.hear("robot2", entry(State.CLAIMING, 2, "robot2", Position(64, 4, b"d")))
    assert talk.vote() == (1, "robot1")


def test_a_witness_claims_nothing_and_takes_no_snapshots() -> None:
    talk = followed()
    talk.tick(WITNESS.patience_ms + 1_000)
    assert not talk.orders(acts.Admit) and not talk.orders(acts.Start) and talk.vote() == (1, "robot1")


def claiming(config: Config = ROBOT) -> Talk:
    """robot1 hears everybody, was told to run the component, and claims it."""
    talk = Talk(config)
    talk.tick(400)
    for peer in config.peers:
        talk.hear(peer)
    talk.readies.append(talk.node.step(Run(1, SPEC), talk.now_ns))
    talk.tick(5)
    return talk


def running(config: Config = ROBOT) -> Talk:
    """robot1 is primary by its own vote and the witness's, and holds a first snapshot that robot2 has stored."""
    talk = claiming(config)
    for voter in config.peers[1:]:
        talk.hear(voter, entry(State.STANDBY, 1, "robot1"))
    assert talk.orders(acts.Start)
    talk.readies.append(talk.node.step(Started(NAME, 1), talk.now_ns))
    talk.hear("robot2", entry(State.STANDBY, 1, "robot1"))
    talk.tick(5)
    (capture,) = talk.orders(acts.Capture)
    assert isinstance(capture, acts.Capture)
    position = Position(capture.generation, capture.sequence, b"d")
    talk.readies.append(talk.node.step(Captured(NAME, 1, position, None), talk.now_ns))
    return talk


def test_a_claim_is_carried_out_once_a_majority_votes_for_it() -> None:
    talk = claiming()
    assert talk.vote() == (1, "robot1") and not talk.orders(acts.Start)
    talk.hear("robot2", entry(State.STANDBY, 1, "robot1"))
    assert talk.orders(acts.Start)


def test_a_claim_of_the_epoch_in_which_it_has_ended_elsewhere_records_that_end() -> None:
    """Two claimed it at once. The other one won and ended; etcd tells of that before it loses its keys."""
    config = Config("robot1", ("robot2", COORDINATOR), rule=Rule.ETCD, witnesses=(COORDINATOR,), components=(SPEC,))
    talk = Talk(config)
    talk.hear(COORDINATOR)
    while talk.vote() != (1, "robot1"):
        talk.tick(30)
        talk.hear(COORDINATOR)
    talk.hear(COORDINATOR, entry(State.FINISHED, 1, "robot2"))
    for _ in range(100):
        talk.tick(30)
        talk.hear(COORDINATOR)
    (shown,) = talk.node.status(talk.now_ns).components
    assert (shown.state, shown.epoch, shown.primary) == (State.FINISHED, 1, "robot2")
    assert not talk.orders(acts.Start)


def test_a_checkpoint_counts_once_a_majority_has_noted_who_holds_it() -> None:
    talk = running()
    (ship,) = talk.orders(acts.Ship)
    assert isinstance(ship, acts.Ship) and ship.to == "robot2"
    talk.hear("robot2", entry(State.STANDBY, 1, "robot1", ship.position))
    assert not talk.orders(acts.Acknowledge)
    talk.hear("robot2", entry(State.STANDBY, 1, "robot1", ship.position, "robot2"))
    assert talk.orders(acts.Acknowledge)


def standby_of(talk: Talk) -> str:
    (component,) = talk.node.status(talk.now_ns).components
    return component.standby


def notes_of(talk: Talk) -> tuple[str, ...]:
    (component,) = talk.node.status(talk.now_ns).components
    return component.notes


def test_a_standby_stays_while_its_word_is_due_in_a_later_beat_and_is_left_when_it_objects() -> None:
    talk = running(replace(ROBOT, peers=("robot2", "robot3", "witness1")))
    assert standby_of(talk) == "robot3", "the first robot that consented"
    talk.hear("robot2", entry(State.STANDBY, 1, "robot1"))
    talk.hear("robot3", untold=1)
    talk.tick(5)
    assert standby_of(talk) == "robot3"
    talk.hear("robot3", entry(State.STOPPING, 1, "robot1"))
    talk.tick(5)
    assert standby_of(talk) == "robot2"


def test_why_nobody_stands_by_is_told_while_a_peer_ends_a_copy_of_its_own() -> None:
    talk = running()
    assert not notes_of(talk)
    talk.hear("robot2", entry(State.STOPPING, 1, "robot1"))
    talk.tick(5)
    assert notes_of(talk) == ("robot2 cannot stand by yet: that robot still ends its own copy",)
    talk.hear("robot2", entry(State.STANDBY, 1, "robot1"))
    talk.tick(5)
    assert not notes_of(talk)


def test_a_primary_with_a_valid_lease_answers_a_later_epoch_by_one_above_it() -> None:
    talk = running()
    talk.hear("witness1", entry(State.STANDBY, 1, "robot1"))
    (ship,) = talk.orders(acts.Ship)
    assert isinstance(ship, acts.Ship)
    talk.hear("robot2", entry(State.CLAIMING, 2, "robot2", ship.position))
    assert talk.vote() == (3, "robot1") and not talk.orders(acts.Stop)


def test_a_primary_that_nobody_hears_stands_still() -> None:
    talk = running()
    talk.tick(ROBOT.lease_ms)
    assert talk.orders(acts.Freeze)


def test_a_copy_that_is_held_still_without_a_lease_would_give_way_and_says_so() -> None:
    talk = running()
    talk.hear("witness1", entry(State.STANDBY, 1, "robot1"))
    talk.tick(20)
    assert not talk.said()[-1].flags & FREE
    talk.tick(ROBOT.lease_ms)
    assert talk.orders(acts.Freeze) and talk.said()[-1].flags & FREE


def test_a_copy_that_is_held_still_goes_above_an_epoch_in_which_a_vote_that_it_needs_is_spent() -> None:
    talk = running()
    talk.tick(4 * ROBOT.lease_ms)  # robot2 is lost, and had claimed it
    for epoch in (2, 3):
        for _ in range(ROBOT.retry_ms // 20 + 1):
            talk.hear("witness1", entry(State.STANDBY, epoch, "robot2"))
            talk.tick(20)
        assert talk.vote() == (epoch + 1, "robot1")


def test_a_robot_claims_when_the_others_would_vote_for_it_by_what_they_have_noted() -> None:
    """It gave its copy up to robot2's claim of epoch 3; robot2 is back with a new disk; nobody else has heard of that claim."""
    record = Record(NAME, 3, "robot2", State.STANDBY, spec=SPEC)
    talk = Talk(ROBOT, VoteRecord((record,)), (Held(NAME, (NEWEST,)),))
    talk.tick(400)
    for _ in range(3):
        talk.hear("robot2", entry(State.STANDBY, 2, "robot1", None, "robot2", FREE))
        talk.hear("witness1", entry(State.STANDBY, 2, "robot1", None, "robot2", FREE))
        talk.tick(20)
    assert talk.vote() == (4, "robot1")


def leases(talk: Talk) -> list[int]:
    return [act.until_ns for act in talk.orders(acts.SetLease) if isinstance(act, acts.SetLease)]


def test_a_primary_that_hands_over_renews_its_lease_until_it_has_given_way() -> None:
    talk = running()
    (first,) = talk.orders(acts.Ship)
    assert isinstance(first, acts.Ship)
    talk.hear("robot2", entry(State.STANDBY, 1, "robot1", first.position, "robot2"))
    talk.readies.append(talk.node.step(Handover(2, NAME, "robot2"), talk.now_ns))
    for _ in range(10):
        talk.tick(20)
        talk.hear("robot2", entry(State.STANDBY, 1, "robot1", first.position, "robot2"))
    assert leases(talk)[-1] > talk.now_ns + ROBOT.lease_ns // 2
    final = [act for act in talk.orders(acts.Capture) if isinstance(act, acts.Capture)][-1]
    position = Position(final.generation, final.sequence, b"d")
    talk.readies.append(talk.node.step(Captured(NAME, 1, position, first.position), talk.now_ns))
    talk.hear("robot2", entry(State.STANDBY, 1, "robot1", position, "robot2"))
    talk.tick(20)
    assert final.hold and talk.said()[-1].yields_to == "robot2"
    given = leases(talk)
    for _ in range(10):
        talk.tick(20)
        talk.hear("robot2", entry(State.STANDBY, 1, "robot1", position, "robot2"))
    assert leases(talk) == given


def test_two_copies_that_stand_still_unelected_are_told_apart_by_what_was_acknowledged() -> None:
    talk = running()
    (ship,) = talk.orders(acts.Ship)
    assert isinstance(ship, acts.Ship)
    talk.tick(ROBOT.lease_ms)
    older = entry(State.FROZEN, 2, "robot2", Position(1, 1, b"d"))
    talk.hear("robot2", older)
    assert talk.vote() == (1, "robot1") and not talk.orders(acts.Stop), "it holds less, and nobody has elected it"
    for _ in range(ROBOT.loyalty_ns // (20 * MS) + 1):
        talk.tick(20)
        talk.hear("robot2", older)
    assert talk.vote() == (3, "robot1"), "voters may follow a later epoch"
    talk.hear("robot2", entry(State.FROZEN, 4, "robot2", ship.position))
    assert talk.vote() == (4, "robot2") and talk.orders(acts.Stop), "nothing is lost if that one goes on"


def test_a_leap_of_the_clock_makes_no_peer_deaf() -> None:
    talk = running()
    talk.hear("robot2", entry(State.STANDBY, 1, "robot1"))
    leap_ns = 10 * ROBOT.loyalty_ns
    talk.node.step(Tick(), talk.now_ns + leap_ns)
    talk.now_ns += leap_ns
    said = talk.hear("robot2", entry(State.STANDBY, 1, "robot1"))
    talk.tick(30)
    echoes = [echo for ready in (said, *talk.readies) for beat in ready.send for echo in beat.echoes]
    assert all(echo.counter > 0 for echo in echoes)


def test_a_claim_without_consent_gives_no_right_to_act_alone_after_a_restart() -> None:
    spec = ComponentSpec(NAME, launch=Launch(("x",)), rules=Rules(when_alone=WhenAlone.FREEZE))
    pair = Config("robot1", ("robot2",), grace_ms=300)
    held = (Held(NAME, (NEWEST,)),)
    for claimed in (True, False):
        record = Record(NAME, 2, "robot1", State.PRIMARY, spec=spec, claimed=claimed)
        talk = Talk(pair, VoteRecord((record,)), held)
        talk.tick(1_000)
        assert bool(talk.orders(acts.Restore)) is not claimed


def test_of_robots_with_the_same_checkpoint_the_preferred_one_then_the_least_loaded_then_the_lesser_name() -> None:
    component = Component(NAME, spec=ComponentSpec(NAME, rules=Rules(prefer="robot9")))
    node = Node(Config("robot1", ("robot2", "robot9", "robot10")), 1, VoteRecord(), 0)
    turn = node._turn(0)
    turn.load, turn.team.peers["robot9"].load = 3, 7

    def order() -> list[str]:
        return sorted(("robot1", *turn.team.peers), key=lambda robot: placing(component, turn, robot))

    assert order() == ["robot9", "robot2", "robot10", "robot1"]
    turn.team.peers["robot9"].drained = True
    assert order() == ["robot2", "robot10", "robot1", "robot9"], "a drained one is the last"


@pytest.mark.parametrize(
    "settings",
    [
        {"rule": Rule.MAJORITY, "witnesses": ("stranger",)},
        {"rule": Rule.MAJORITY, "witnesses": ("robot2",), "servers": ("robot2",)},
        {"witnesses": ("robot2",)},
    ],
)
def test_roles_that_contradict_each_other_are_refused(settings: dict[str, object]) -> None:
    with pytest.raises(RulesError):
        Config("robot1", ("robot2",), **settings)  # type: ignore[arg-type]


def test_a_voters_standby_shows_output_only_as_far_as_its_primary_says_that_it_is_acknowledged() -> None:
    """A robot that holds less may be elected as long as a majority has not noted who holds this."""
    config = Config("robot1", ("robot2", "robot3"), rule=Rule.MAJORITY, grace_ms=300)
    talk, first, second = Talk(config), Position(65, 1, b"d"), Position(65, 2, b"e")
    talk.tick(1_000)
    talk.hear("robot2", entry(State.PRIMARY, 1, "robot2", first))
    assert shown(talk.node.step(Stored(NAME, 1, first, "robot2", SPEC), talk.now_ns)) == []
    told = Stored(NAME, 1, second, "robot2", SPEC, acknowledged=first)
    assert shown(talk.node.step(told, talk.now_ns)) == [first]
    assert shown(talk.hear("robot2", entry(State.PRIMARY, 1, "robot2", second))) == []
    assert shown(talk.hear("robot2", entry(State.PRIMARY, 1, "robot2", second, flags=SAFE))) == [second]
    assert shown(talk.hear("robot2", entry(State.PRIMARY, 1, "robot2", second, flags=SAFE))) == []


def shown(ready: acts.Ready) -> list[Position]:
    """How far readers may see from now on."""
    return [act.position for act in ready.act if isinstance(act, acts.Show)]


def test_an_agent_goes_only_after_its_peer_has_heard_a_beat_that_left_with_the_promise() -> None:
    talk = Talk(replace(WITNESS, restart_grace_ms=1_000))
    talk.tick(400)
    for _ in range(3):
        talk.hear("robot1", entry(State.PRIMARY, 1, "robot1", NEWEST))
        talk.tick(20)
    talk.readies.append(talk.node.step(Leave(), talk.now_ns))
    (first,) = talk.readies[-1].send
    assert [promise.robot for promise in first.promises] == ["robot1"]
    talk.node.left_without_promises(first.counter)
    talk.hear("robot1", entry(State.PRIMARY, 1, "robot1", NEWEST))
    assert not talk.node.may_go(talk.now_ns), "the disk was slow, and that beat has not said it"
    talk.tick(40)
    talk.hear("robot1", entry(State.PRIMARY, 1, "robot1", NEWEST))
    assert talk.node.may_go(talk.now_ns)
    told = [one.sentence for ready in talk.readies for one in ready.told]
    assert "what runs at robot1 acts on the word of witness1: witness1 promises to wait 1.1 s for robot1" in told


@pytest.mark.parametrize(("grace_ms", "free"), [(0, False), (RETURNED, True)])
def test_a_new_life_that_says_it_runs_nothing_frees_no_voter_before_it_gives_the_promise_back(grace_ms: int, free: bool) -> None:
    config = replace(ROBOT, restart_grace_ms=9_000)
    talk = Talk(config)
    talk.tick(400)
    primary = entry(State.PRIMARY, 1, "robot2", NEWEST)
    for counter in range(1, 4):
        beat = Beat("robot2", 1, counter, counter, 0, 1, (), (primary,), grace_ms=9_000 if counter == 3 else 0)
        talk.node.step(Received(beat, "wire"), talk.now_ns)
        talk.tick(20)
    for counter in range(1, 10):
        idle = entry(State.STANDBY, 1, "robot2", NEWEST)
        beat = Beat("robot2", 2, counter, counter, 0, 1, (), (idle,), grace_ms=grace_ms)
        talk.readies.append(talk.node.step(Received(beat, "wire"), talk.now_ns))
        talk.hear("witness1", idle)
        talk.tick(20)
    component, turn = talk.node._components[NAME], talk.node._turn(talk.now_ns)
    assert (component.free, vacant(component, turn)) == (free, free)
    for _ in range(600):
        talk.hear("witness1")
        talk.node.step(Received(replace(beat, counter=(counter := counter + 1), grace_ms=0), "wire"), talk.now_ns)
        talk.tick(20)
    component, turn = talk.node._components[NAME], talk.node._turn(talk.now_ns)
    assert component.free and vacant(component, turn), "to its end, and no longer"
