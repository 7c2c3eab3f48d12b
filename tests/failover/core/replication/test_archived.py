"""A robot that hears nobody but etcd: which checkpoints of the archive it takes, and when it goes on from one."""

from __future__ import annotations

from checkpoint.model import Position
from failover.core import acts
from failover.core.acts import Ready
from failover.core.election.consent import STATES
from failover.core.events import Event, Fetched, Looked, Received, Tick
from failover.core.node import Node
from failover.core.types import COORDINATOR, MS, PEERS_MAX, ComponentSpec, Config, Launch, Rule, State, VoteRecord
from failover.core.wire.messages import FREE, FRESH, OPEN, RULES, Beat, Echo, Entry

NAME = "/lab/robot1/mapper"
SPEC = ComponentSpec(NAME, "robot1", Launch(("mapper",)))
CONFIG = Config(
    "robot2", (COORDINATOR, "robot1"), lease_ms=200, rule=Rule.ETCD, witnesses=(COORDINATOR,), patience_ms=60_000, copies_ms=1_000
)


def position(epoch: int, sequence: int) -> Position:
    return Position(epoch * (PEERS_MAX + 1), sequence, b"d")


class Lonely:
    """robot2, and etcd's word about the component: robot1 runs it in this epoch, or is silent (``flags``)."""

    def __init__(self, config: Config = CONFIG) -> None:
        self.now_ns = 0
        self.epoch, self.flags, self.state = 1, 0, State.STANDBY
        self.counter, self.standby = 0, ""
        self.node = Node(config, 1, VoteRecord(), 0)
        self.acts: list[acts.Act] = []
        self.live(5_000)

    def step(self, event: Event) -> Ready:
        ready = self.node.step(event, self.now_ns)
        self.acts += ready.act
        return ready

    def live(self, ms: int) -> None:
        for _ in range(ms // 20):
            self.now_ns += 20 * MS
            self.step(Tick())
            self.counter += 1
            seat = Entry(NAME, STATES.index(self.state), self.epoch, "robot1", standby=self.standby, flags=self.flags)
            echo = Echo("robot2", 1, self.node.word().counter)
            rule = RULES.index(Rule.ETCD)
            self.step(
                Received(Beat(COORDINATOR, 1, self.counter, 1, total=1, echoes=(echo,), entries=(seat,), rule=rule), "etcd")
            )

    def fetched(self, epoch: int, sequence: int) -> None:
        self.step(Fetched(NAME, epoch, position(epoch, sequence), SPEC, self.now_ns))

    @property
    def held(self) -> tuple[Position, ...]:
        return next((one.positions for one in self.node.status(self.now_ns).components), ())

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
    assert robot.held == (position(2, 3),)
    assert acts.Discard(NAME, 2, position(1, 900)) in robot.acts
    robot.fetched(2, 4)
    assert robot.held == (position(2, 4), position(2, 3))


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


def test_a_standby_that_heard_its_primary_waits_for_no_patience_once_it_has_looked() -> None:
    """etcd names it as the standby: it has all that was acknowledged, and the archive may still have more."""
    robot = Lonely()
    robot.standby = "robot2"
    robot.fetched(1, 5)
    robot.live(100)
    robot.flags = FREE
    robot.live(5_000)
    assert not robot.claims(), "it did not hear its primary lately: the archive may have something newer"
    robot.step(Looked(robot.now_ns))
    robot.live(100)
    assert robot.claims()


def test_what_ran_elsewhere_does_not_begin_anew_before_the_archive_has_answered() -> None:
    declared = Lonely(Config(**{name: getattr(CONFIG, name) for name in CONFIG.__struct_fields__} | {"components": (SPEC,)}))
    declared.flags = FREE | OPEN
    declared.live(100_000)
    assert not declared.claims()
    declared.step(Looked(declared.now_ns))
    declared.live(100)
    assert declared.claims()


def test_copies_of_a_life_that_has_ended_count_no_more_once_it_begins_anew() -> None:
    robot = Lonely()
    robot.fetched(1, 5)
    robot.live(100)
    robot.state = State.RELEASED
    robot.live(100)
    robot.state, robot.epoch = State.STANDBY, 2
    robot.live(100)
    robot.fetched(1, 6)
    assert robot.held == ()
    robot.fetched(2, 1)
    assert robot.held == (position(2, 1),)
