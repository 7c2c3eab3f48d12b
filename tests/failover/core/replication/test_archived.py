"""A robot that hears nobody but etcd: which checkpoints of the archive it takes, and when it goes on from one."""

from __future__ import annotations

import msgspec
import pytest

from checkpoint.model import Position
from failover.core import acts
from failover.core.acts import Ready
from failover.core.election.consent import STATES
from failover.core.events import Archived, Damaged, Event, Fetched, Handover, Looked, Received, Restored, Started, Tick
from failover.core.node import Node
from failover.core.types import (
    COORDINATOR,
    MS,
    PEERS_MAX,
    ComponentSpec,
    Config,
    Held,
    Launch,
    OnLoss,
    Protection,
    Record,
    Rule,
    Rules,
    State,
    VoteRecord,
)
from failover.core.wire.messages import FREE, FRESH, OPEN, RULES, SAFE, Beat, Echo, Entry

NAME = "/lab/robot1/mapper"
SPEC = ComponentSpec(NAME, "robot1", Launch(("mapper",)))
CONFIG = Config(
    "robot2", (COORDINATOR, "robot1"), lease_ms=200, rule=Rule.ETCD, witnesses=(COORDINATOR,), patience_ms=60_000, copies_ms=1_000
)

DECLARED = msgspec.structs.replace(CONFIG, components=(SPEC,))


STANDBY = VoteRecord((Record(NAME, 1, "robot1", State.STANDBY, entrusted=("robot2",), spec=SPEC),))


def position(epoch: int, sequence: int) -> Position:
    return Position(epoch * (PEERS_MAX + 1), sequence, b"d")


class Lonely:
    """robot2, and etcd's word about the component: robot1 runs it in this epoch, or is silent (``flags``)."""

    def __init__(
        self,
        config: Config = CONFIG,
        record: VoteRecord = VoteRecord(),  # noqa: B008
        seat: str = "robot1",
        held: tuple[Position, ...] = (),
    ) -> None:
        self.now_ns = 0
        self.seat, self.record = seat, record
        self.epoch, self.flags, self.state = 1, 0, State.STANDBY
        self.counter, self.standby, self.counter_of_robot1 = 0, "", 0
        self.node = Node(config, 1, record, 0, (Held(NAME, held),) if held else ())
        self.acts: list[acts.Act] = []
        self.said: list[str] = []
        self.live(5_000)

    def step(self, event: Event) -> Ready:
        ready = self.node.step(event, self.now_ns)
        self.acts += ready.act
        self.record = ready.persist or self.record
        self.said += [one.sentence for one in ready.told]
        return ready

    def live(self, ms: int) -> None:
        for _ in range(ms // 20):
            self.now_ns += 20 * MS
            self.step(Tick())
            self.counter += 1
            seat = Entry(NAME, STATES.index(self.state), self.epoch, self.seat, standby=self.standby, flags=self.flags)
            seats = (seat,) if self.seat else ()
            echo = Echo("robot2", 1, self.node.word().counter)
            rule = RULES.index(Rule.ETCD)
            beat = Beat(COORDINATOR, 1, self.counter, 1, total=len(seats), echoes=(echo,), entries=seats, rule=rule)
            self.step(Received(beat, "etcd"))

    def fetched(self, epoch: int, sequence: int) -> None:
        self.step(Fetched(NAME, epoch, position(epoch, sequence), SPEC, self.now_ns))

    def hear_robot1(self, sequence: int, state: State = State.STANDBY, epoch: int = 1, flags: int = 0) -> None:
        """It tells that it holds this checkpoint of epoch 1, and not that it hears robot2."""
        self.counter_of_robot1 += 1
        at = position(1, sequence)
        entry = Entry(NAME, STATES.index(state), epoch, "robot1", at.generation, at.sequence, at.digest, flags=flags | FREE)
        counter, rule = self.counter_of_robot1, RULES.index(Rule.ETCD)
        self.step(Received(Beat("robot1", 1, counter, 1, total=1, entries=(entry,), rule=rule), "wire"))

    def live_beside_robot1(self, ms: int, entry: Entry) -> None:
        """It says this of the component, and that it hears robot2."""
        for _ in range(ms // 20):
            self.live(20)
            echo = Echo("robot2", 1, self.node.word().counter)
            rule = RULES.index(Rule.ETCD)
            beat = Beat("robot1", 2, self.counter, 1, total=1, echoes=(echo,), entries=(entry,), rule=rule)
            self.step(Received(beat, "cable"))

    @property
    def held(self) -> list[Position]:
        return [position for one in self.node.status(self.now_ns).components for position in one.positions]

    def claims(self) -> bool:
        """Whether it claims it, or has done so in vain."""
        entry = self.node.word().entry(NAME)
        return entry is not None and entry.primary == "robot2"

    def looks(self) -> bool:
        return any(isinstance(act, acts.Look) for act in self.acts)


def test_a_checkpoint_of_the_archive_makes_a_standby_of_a_robot_that_knew_nothing_of_the_component() -> None:
    robot = Lonely()
    robot.fetched(1, 5)
    robot.live(100)
    (shown,) = robot.node.status(robot.now_ns).components
    assert (shown.state, shown.primary, shown.epoch) == (State.STANDBY, "robot1", 1)
    assert any("came from the archive" in note for note in shown.notes)


def test_a_later_checkpoint_is_never_replaced_by_an_earlier_one() -> None:
    robot = Lonely()
    robot.epoch = 2
    robot.fetched(2, 3)
    robot.live(100)
    robot.fetched(1, 900)
    assert robot.held == [position(2, 3)]
    assert acts.Discard(NAME, 2, position(1, 900)) in robot.acts
    robot.fetched(2, 4)
    assert robot.held == [position(2, 4), position(2, 3)]


def test_it_looks_into_the_archive_once_more_and_then_claims_without_waiting_for_the_old_primary() -> None:
    robot = Lonely()
    robot.fetched(1, 5)
    robot.live(100)
    robot.step(Looked(robot.now_ns))
    robot.flags = FREE
    robot.live(500)
    assert robot.looks() and not robot.claims(), "what it had looked at before may be old"
    robot.step(Looked(robot.now_ns, (NAME,)))
    robot.live(100)
    assert not robot.claims(), "a newer copy is on its way"
    robot.fetched(1, 6)
    robot.live(100)
    assert robot.claims()
    entry = robot.node.word().entry(NAME)
    assert entry is not None and entry.flags & FRESH


def test_where_the_archive_does_not_answer_it_waits_for_the_patience_and_no_longer() -> None:
    robot = Lonely()
    robot.fetched(1, 5)
    robot.live(100)
    robot.flags = FREE
    robot.live(50_000)
    assert not robot.claims()
    robot.flags = FREE | OPEN
    robot.live(12_000)
    assert robot.claims()


def standby() -> Lonely:
    """robot2 holds what robot1 had acknowledged."""
    robot = Lonely(record=STANDBY, held=(position(1, 5),))
    robot.standby = "robot2"
    robot.live(100)
    return robot


def test_a_standby_that_heard_its_primary_waits_for_no_patience_once_it_has_looked() -> None:
    """etcd names it as the standby: it has all that was acknowledged, and the archive may still have more."""
    robot = standby()
    robot.flags = FREE
    robot.live(5_000)
    assert not robot.claims(), "it did not hear its primary lately: the archive may have something newer"
    robot.step(Looked(robot.now_ns))
    robot.live(100)
    assert robot.claims()


def robot2_with_an_empty_disk() -> Lonely:
    """It was the standby, so it had all that was acknowledged; robot1, the primary, is silent. The archive has a copy."""
    robot = Lonely(record=STANDBY)
    robot.standby, robot.flags = "robot2", FREE
    robot.live(100)
    robot.step(Looked(robot.now_ns, (NAME,)))
    robot.fetched(1, 5)
    return robot


def test_a_standby_that_lost_its_disk_waits_for_the_primary_that_may_have_more_than_the_archive() -> None:
    robot = robot2_with_an_empty_disk()
    robot.live(50_000)
    assert not robot.claims(), "what was acknowledged after that copy is at robot1 still"
    robot.flags = FREE | OPEN
    robot.live(12_000)
    assert robot.claims()


@pytest.mark.parametrize("comes_first", ["the copy", "the word"])
def test_a_standby_that_lost_its_disk_and_its_record_waits_for_the_primary_too(comes_first: str) -> None:
    robot = Lonely(seat="" if comes_first == "the copy" else "robot1")
    robot.standby = "robot2"
    robot.live(100)
    robot.fetched(1, 5)
    robot.seat = "robot1"
    robot.live(100)
    robot.flags = FREE
    robot.live(100)
    robot.step(Looked(robot.now_ns))
    robot.live(20_000)
    assert robot.record.records[0].entrusted == ("robot2",) and not robot.claims()


def test_a_standby_whose_checkpoint_was_damaged_has_it_again_from_the_archive_and_waits_no_longer() -> None:
    robot = robot2_with_an_empty_disk()
    robot.hear_robot1(6, State.PRIMARY, 1, SAFE)
    robot.live(6_000)
    robot.step(Looked(robot.now_ns, (NAME,)))
    assert not robot.claims()
    robot.fetched(1, 6)
    robot.live(100)
    assert robot.claims()


@pytest.mark.parametrize("sequence", [5, 6])
def test_a_robot_goes_on_from_no_copy_of_the_archive_while_it_hears_a_robot_that_claims_it_and_holds_more(sequence: int) -> None:
    """robot1 does not hear robot2: robot2's vote does not help it, and robot2 may claim above it."""
    robot = Lonely()
    robot.fetched(1, 5)
    robot.hear_robot1(sequence, State.CLAIMING, 2)
    robot.flags = FREE
    for _ in range(100):
        robot.hear_robot1(sequence, State.CLAIMING, 2)
        robot.live(20)
        robot.step(Looked(robot.now_ns))
    assert robot.claims() == (sequence == 5)


@pytest.mark.parametrize("sequence", [4, 5])
def test_a_robot_votes_for_no_copy_of_the_archive_while_it_holds_more_itself(sequence: int) -> None:
    """robot2 ran it, is back, and has claimed it. robot1 claims it above that, from the newest copy that the archive has."""
    robot = Lonely(record=VoteRecord((Record(NAME, 1, "robot2", State.STANDBY, spec=SPEC),)), seat="")
    robot.fetched(1, 5)
    assert robot.claims() and robot.record.records[0].epoch == 2
    robot.hear_robot1(sequence, State.CLAIMING, 3, FRESH)
    assert robot.claims() == (sequence == 4)


def test_what_ran_elsewhere_does_not_begin_anew_before_the_archive_has_answered() -> None:
    declared = Lonely(DECLARED)
    declared.flags = FREE | OPEN
    declared.live(100_000)
    assert not declared.claims()
    declared.step(Looked(declared.now_ns))
    declared.live(100)
    assert declared.claims()


@pytest.mark.parametrize("end", [State.FINISHED, State.FAILED, State.RELEASED])
def test_copies_of_a_life_that_has_ended_count_no_more_once_it_begins_anew(end: State) -> None:
    robot = Lonely()
    robot.fetched(1, 5)
    robot.live(100)
    robot.state = end
    robot.live(100)
    robot.state, robot.epoch = State.STANDBY, 2
    robot.live(100)
    assert robot.held == [], "what it held is of the former life too"
    robot.fetched(1, 6)
    assert robot.held == []
    robot.node = Node(CONFIG, 2, robot.record, 0)
    robot.live(100)
    robot.fetched(1, 6)
    assert robot.held == [], "an agent that restarts knows it still"
    robot.fetched(2, 1)
    assert robot.held == [position(2, 1)]


def test_a_copy_alone_makes_no_program_run_before_an_operator_orders_it() -> None:
    """It may have ended, or have been released and run on, at a robot that is not heard: etcd has no seat of it."""
    robot = Lonely(seat="")
    robot.fetched(9, 5)
    for _ in range(5):
        robot.live(20_000)
        robot.step(Looked(robot.now_ns))
    assert robot.held and not robot.claims()
    (shown,) = robot.node.status(robot.now_ns).components
    assert any("failover handover /lab/robot1/mapper resumes it at robot2" in note for note in shown.notes)
    robot.step(Handover(7, NAME))
    robot.live(100)
    entry = robot.node.word().entry(NAME)
    assert entry is not None and (entry.epoch, entry.primary) == (10, "robot2")


def test_what_is_declared_where_nobody_knows_it_looks_into_the_archive_before_it_begins_anew() -> None:
    robot = Lonely(DECLARED, seat="")
    robot.live(20_000)
    assert robot.looks() and not robot.claims()
    robot.step(Looked(robot.now_ns, (NAME,)))
    robot.fetched(9, 5)
    robot.live(100)
    entry = robot.node.word().entry(NAME)
    assert entry is not None and (entry.epoch, entry.primary) == (10, "robot2")
    silent = Lonely(DECLARED, seat="")
    silent.live(70_000)
    assert silent.claims(), "an archive that does not answer stops nothing new for longer than the patience"


@pytest.mark.parametrize("begun", [False, True])
def test_a_program_of_this_robot_that_never_had_a_checkpoint_starts_again_while_the_archive_is_silent(begun: bool) -> None:
    record = VoteRecord((Record(NAME, 1, "robot2", State.STANDBY, spec=SPEC, begun=begun),))
    robot = Lonely(DECLARED, record, seat="robot2")
    robot.flags = FREE | OPEN
    robot.live(10_000)
    entry = robot.node.word().entry(NAME)
    assert entry is not None and (entry.epoch > 1) != begun


@pytest.mark.parametrize("behind", [False, True])
def test_a_standby_that_heard_its_primary_waits_for_a_newer_copy_that_it_knows_of(behind: bool) -> None:
    robot = standby()
    for counter in range(1, 50):
        held = Entry(NAME, STATES.index(State.PRIMARY), 1, "robot1", 1 * (PEERS_MAX + 1), 5, b"d", standby="robot2")
        robot.step(Received(Beat("robot1", 1, counter, 1, total=1, entries=(held,), rule=RULES.index(Rule.ETCD)), "lan"))
        robot.live(20)
    robot.flags = FREE
    for _ in range(10):
        robot.live(500)
        if behind:
            robot.step(Looked(robot.now_ns, (NAME,)))
    assert robot.claims() != behind


def test_a_copy_that_is_older_than_this_boot_of_the_computer_says_how_old_it_is() -> None:
    robot = Lonely()
    robot.step(Fetched(NAME, 1, position(1, 5), SPEC, robot.now_ns, age_ns=3 * 86_400_000 * MS))
    robot.live(100)
    (shown,) = robot.node.status(robot.now_ns).components
    assert any("came from the archive and is 2592" in note for note in shown.notes), shown.notes


def test_after_a_takeover_from_the_archive_no_sentence_tells_how_much_was_lost() -> None:
    """The time of the file here is when the copy came: it does not say how old the state is."""
    robot = Lonely()
    robot.fetched(1, 5)
    robot.live(100)
    robot.flags = FREE
    robot.live(100)
    robot.step(Looked(robot.now_ns))
    robot.live(100)
    robot.seat, robot.epoch, robot.flags = "robot2", 2, 0
    robot.live(100)
    assert any(isinstance(act, acts.Restore) for act in robot.acts)
    robot.step(Restored(NAME, 2, position(1, 5), age_ns=100 * MS, lost_ns=100 * MS))
    assert any("resumes from checkpoint 5" in said for said in robot.said)
    assert not any("of its work" in said for said in robot.said)


def test_a_component_that_waits_for_its_robot_is_not_said_to_be_resumed_elsewhere_from_the_archive() -> None:
    spec = msgspec.structs.replace(SPEC, rules=Rules(on_loss=OnLoss.HOLD))
    robot = Lonely(msgspec.structs.replace(CONFIG, components=(spec,)), seat="")
    robot.step(Looked(robot.now_ns))
    robot.live(100)
    robot.seat, robot.epoch = "robot2", 1
    robot.live(100)
    robot.step(Started(NAME, 1))
    robot.step(Archived(NAME, 1, position(1, 1), robot.now_ns))
    robot.live(100)
    (shown,) = robot.node.status(robot.now_ns).components
    assert "in the archive waits until robot2 is back" in shown.promise


def test_a_primary_whose_copy_the_archive_has_lost_is_not_said_to_be_protected_by_it() -> None:
    robot = Lonely(DECLARED, seat="")
    robot.step(Looked(robot.now_ns))
    robot.live(100)
    robot.seat, robot.epoch = "robot2", 1
    robot.live(100)
    robot.step(Started(NAME, 1))
    robot.step(Archived(NAME, 1, position(1, 1), robot.now_ns))
    (shown,) = robot.node.status(robot.now_ns).components
    assert shown.protection is Protection.PROTECTED
    robot.step(Archived(NAME, 1, None, robot.now_ns))
    (shown,) = robot.node.status(robot.now_ns).components
    assert shown.protection is Protection.NONE
    assert any("NOT PROTECTED" in note for note in shown.notes)


def test_a_damaged_checkpoint_is_held_no_more_and_the_one_before_it_waits_for_the_archive() -> None:
    robot = Lonely()
    robot.fetched(1, 5)
    robot.fetched(1, 6)
    robot.live(100)
    robot.flags = FREE
    robot.live(100)
    robot.step(Damaged(NAME, 1, position(1, 6)))
    assert robot.held == [position(1, 5)]
    robot.step(Looked(robot.now_ns, (NAME,)))
    robot.live(500)
    assert not robot.claims(), "the archive has a newer one, on its way"
    robot.fetched(1, 6)
    robot.live(100)
    assert robot.held == [position(1, 6), position(1, 5)] and robot.claims()


def test_the_only_checkpoint_that_is_damaged_begins_nothing_anew_before_the_archive_has_answered() -> None:
    robot = Lonely()
    robot.fetched(1, 5)
    robot.live(100)
    robot.step(Looked(robot.now_ns))
    robot.step(Damaged(NAME, 1, position(1, 5)))
    robot.flags = FREE
    robot.live(20_000)
    assert not robot.held and not robot.claims() and robot.looks()
    robot.fetched(1, 5)
    robot.live(100)
    assert robot.claims()


@pytest.mark.parametrize("is_damaged", [True, False])
def test_the_old_primary_whose_newest_checkpoint_is_damaged_waits_for_the_archive_too(is_damaged: bool) -> None:
    record = Record(NAME, 1, "robot2", State.PRIMARY, spec=SPEC, begun=True)
    own = [Position(PEERS_MAX + 1 + CONFIG.place, sequence, b"d") for sequence in (5, 6)]
    robot = Lonely(record=VoteRecord((record,)), seat="robot2", held=tuple(own))
    if is_damaged:
        robot.step(Damaged(NAME, 1, own[1]))
    robot.flags = FREE
    robot.live(2_000)
    entry = robot.node.word().entry(NAME)
    assert entry is not None
    assert (entry.epoch == 1) == is_damaged, "it claims: its own newest one needs no archive; an older one does"
    robot.step(Fetched(NAME, 1, own[1], SPEC, robot.now_ns))
    robot.step(Looked(robot.now_ns))
    robot.live(200)
    entry = robot.node.word().entry(NAME)
    assert entry is not None and entry.epoch > 1


def test_a_checkpoint_that_could_not_be_restored_because_it_is_damaged_gives_the_one_before_it_new_tries() -> None:
    robot = Lonely()
    robot.fetched(1, 5)
    robot.fetched(1, 6)
    robot.live(100)
    component = robot.node._components[NAME]
    component.unable, component.tries, component.retry_ns = "damaged", 3, robot.now_ns + 1_000_000 * MS
    robot.step(Damaged(NAME, 1, position(1, 6)))
    robot.flags = FREE
    robot.live(100)
    robot.step(Looked(robot.now_ns))
    robot.live(200)
    assert not component.unable and robot.claims()


def test_damage_of_what_is_not_held_changes_nothing() -> None:
    robot = Lonely()
    robot.fetched(1, 5)
    robot.step(Damaged(NAME, 1, position(1, 4)))
    assert robot.held == [position(1, 5)]


def test_a_look_that_skipped_the_component_is_none() -> None:
    robot = Lonely()
    robot.fetched(1, 5)
    robot.flags = FREE
    robot.live(100)
    robot.step(Looked(robot.now_ns, (), (NAME,)))
    robot.live(500)
    assert not robot.claims(), "its primary was heard then, and nothing was compared"
    robot.step(Looked(robot.now_ns))
    robot.live(100)
    assert robot.claims()


def test_where_the_old_primary_lives_and_has_lost_its_disk_the_archive_is_looked_into_before_a_claim() -> None:
    """The two of them are a majority; etcd is bound to the old primary still."""
    robot = Lonely()
    robot.fetched(1, 5)
    robot.live(1_000)
    robot.acts.clear()

    nothing = Entry(NAME, STATES.index(State.STANDBY), 1, "robot1", flags=FREE | OPEN)
    robot.live_beside_robot1(1_000, nothing)
    assert robot.looks() and not robot.claims()
    robot.fetched(1, 9)
    robot.step(Looked(robot.now_ns, ()))
    robot.live_beside_robot1(1_000, nothing)
    assert robot.claims() and robot.held[0] == position(1, 9)


def test_once_the_old_primary_that_let_go_is_silent_the_archive_is_looked_into_once_more() -> None:
    """It held more, so robot2 left the component to it; what it put into the archive came after that look."""
    robot = Lonely()
    robot.fetched(1, 5)
    robot.live(1_000)
    at = position(1, 9)
    more = Entry(NAME, STATES.index(State.STANDBY), 1, "robot1", at.generation, at.sequence, at.digest, flags=FREE)
    robot.live_beside_robot1(1_000, more)
    robot.step(Looked(robot.now_ns, ()))
    robot.live_beside_robot1(1_000, more)
    assert not robot.claims()
    robot.acts.clear()
    robot.flags = FREE
    robot.live(2_000)
    assert robot.looks() and not robot.claims()
    robot.fetched(1, 9)
    robot.step(Looked(robot.now_ns, ()))
    robot.live(100)
    assert robot.claims() and robot.held[0] == at


def test_an_operators_handover_does_not_go_before_the_look_into_the_archive() -> None:
    robot = standby()
    robot.flags = FREE
    robot.live(500)
    robot.acts.clear()
    robot.step(Handover(7, NAME))
    (answer,) = [act for act in robot.acts if isinstance(act, acts.Answer)]
    assert not answer.ok and not robot.claims()
    assert answer.sentence == (
        f"robot2 asks the archive for a newer checkpoint of {NAME}, for 60 s at most; ask again then, or promote robot2"
    )
    robot.step(Looked(robot.now_ns))
    robot.step(Handover(8, NAME))
    robot.live(100)
    assert robot.claims()
