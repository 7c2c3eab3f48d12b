"""The process that waits at a standby, one event at a time. Whole lives are in ``tests/simulation``."""

from __future__ import annotations

from itertools import count

import pytest
from msgspec.structs import replace

from checkpoint.model import Position
from failover.core import acts
from failover.core.election.consent import STATES
from failover.core.events import Event, Received, Stored, Tick, Warmed
from failover.core.node import Node
from failover.core.types import MS, ComponentSpec, Config, Held, Launch, OnLoss, Record, Rules, State, VoteRecord
from failover.core.wire.messages import WARM, Beat, Entry

NAME = "/lab/x"
SPEC = ComponentSpec(NAME, "robot2", Launch(("x",)))


class Standby:
    """robot1, which hears from robot2, and remembers what it was ordered."""

    def __init__(self) -> None:
        self.node = Node(Config("robot1", ("robot2",), grace_ms=300), 1, VoteRecord(), 0)
        self._beats, self._sequences, self.now_ns = count(1), count(1), 0

    def step(self, event: Event) -> list[acts.Act]:
        self.now_ns += 5 * MS
        return [act for act in self.node.step(event, self.now_ns).act if isinstance(act, acts.Warm | acts.Cool | acts.Restore)]

    def hears(self, state: State = State.PRIMARY, standby: str = "robot1", epoch: int = 1) -> list[acts.Act]:
        number = next(self._beats)
        entry = Entry(NAME, STATES.index(state), epoch, "robot2", standby=standby)
        return self.step(Received(Beat("robot2", 1, number, number, 1, 1, (), (entry,)), "wire"))

    def stores(self, spec: ComponentSpec = SPEC, keeps_state: bool = True) -> list[acts.Act]:
        position = Position(65, next(self._sequences), b"d")
        return self.step(Stored(NAME, 1, position, "robot2", spec, keeps_state))

    def says_warm(self) -> bool:
        for _ in range(10):
            self.now_ns += 20 * MS
            for beat in self.node.step(Tick(), self.now_ns).send:
                return any(entry.flags & WARM for entry in beat.entries)
        raise AssertionError("it says nothing")

    def notes(self) -> str:
        return " ".join(self.node.status(self.now_ns).components[0].notes)


@pytest.fixture
def standby() -> Standby:
    robot = Standby()
    robot.hears()
    return robot


def test_a_program_waits_as_soon_as_its_standby_holds_a_state_of_it(standby: Standby) -> None:
    assert standby.stores() == [acts.Warm(NAME, 1, SPEC)]
    assert standby.stores() == standby.hears() == []


def test_the_memory_of_a_program_that_keeps_no_state_waits_as_well(standby: Standby) -> None:
    assert standby.stores(keeps_state=False) == [acts.Warm(NAME, 1, SPEC)]


def test_a_program_that_comes_to_keep_its_state_is_started_in_place_of_its_memory(standby: Standby) -> None:
    standby.stores(keeps_state=False)
    assert standby.stores(keeps_state=True) == [acts.Warm(NAME, 1, SPEC)]
    assert standby.stores(keeps_state=True) == []


def test_a_program_does_not_wait_where_it_is_only_held_for_its_own_robot(standby: Standby) -> None:
    assert standby.stores(replace(SPEC, rules=Rules(on_loss=OnLoss.HOLD))) == []


def test_a_program_does_not_wait_at_a_robot_that_is_not_its_standby(standby: Standby) -> None:
    standby.hears(standby="")
    assert standby.stores() == []
    assert standby.hears() == [acts.Warm(NAME, 1, SPEC)]
    assert standby.hears(standby="robot3") == [acts.Cool(NAME, 1)]


def test_another_program_takes_the_place_of_the_one_that_waits(standby: Standby) -> None:
    standby.stores()
    other = replace(SPEC, launch=Launch(("y",)))
    assert standby.stores(other) == [acts.Warm(NAME, 1, other)]
    assert standby.stores(replace(other, rules=Rules(period_ms=7))) == [], "its rules are no part of the program"


@pytest.mark.parametrize("end", [State.FINISHED, State.FAILED, State.RELEASED])
def test_what_waits_ends_when_the_component_has_ended(standby: Standby, end: State) -> None:
    standby.stores()
    assert standby.hears(end) == [acts.Cool(NAME, 1)]


def test_a_takeover_uses_what_waits(standby: Standby) -> None:
    standby.stores()
    standby.step(Warmed(NAME, 1, True))
    ordered: list[acts.Act] = []
    while not ordered:
        ordered = standby.step(Tick())
    assert [type(act) for act in ordered] == [acts.Restore]
    assert not standby.node.status(standby.now_ns).components[0].warm


def test_a_standby_that_was_restarted_has_it_wait_without_another_snapshot() -> None:
    record = Record(NAME, 1, "robot2", State.STANDBY, trusted=True, spec=SPEC)
    held = Held(NAME, (Position(65, 1, b"d"),), keeps_state=True)
    node = Node(Config("robot1", ("robot2",), grace_ms=300), 2, VoteRecord((record,)), 0, (held,))
    assert acts.Warm(NAME, 1, SPEC) in node.step(Tick(), 1 * MS).act


def test_the_others_hear_whether_it_waits(standby: Standby) -> None:
    standby.stores()
    assert not standby.says_warm()
    standby.step(Warmed(NAME, 1, True))
    assert standby.says_warm() and standby.node.status(standby.now_ns).components[0].warm
    standby.step(Warmed(NAME, 1, False, "it ended with exit code 3"))
    assert not standby.says_warm()


def test_why_it_does_not_wait_is_told_and_is_not_healthy(standby: Standby) -> None:
    standby.stores()
    assert "wait" not in standby.notes()
    standby.step(Warmed(NAME, 1, False, "no such program here: /nowhere/mapper"))
    assert "no such program here: /nowhere/mapper" in standby.notes()
    assert not standby.node.status(standby.now_ns).healthy
    standby.step(Warmed(NAME, 1, True))
    assert standby.notes() == "" and standby.node.status(standby.now_ns).healthy


def test_word_of_a_program_that_waits_no_longer_changes_nothing(standby: Standby) -> None:
    standby.stores()
    standby.hears(epoch=2)
    standby.step(Stored(NAME, 2, Position(129, 1, b"d"), "robot2", replace(SPEC, launch=Launch(("y",))), True))
    standby.step(Warmed(NAME, 1, True))
    assert not standby.node.status(standby.now_ns).components[0].warm
