"""What a member may say, one claim at a time. Whole lies are in ``tests/simulation/scenarios``."""

from __future__ import annotations

import pytest

from failover.core.events import Promote, Received, Run, Tick
from failover.core.node import Node
from failover.core.peer_claims import EPOCHS_AWAY_MAX
from failover.core.types import COMPONENTS_MAX, EPOCH_MAX, EPOCH_SAID_MAX, MS, SPAN, Config, Record, State, VoteRecord
from failover.core.wire import codec
from failover.core.wire.messages import Beat, Echo, Entry
from tests.failover.core.election.test_majority import NAME, NEWEST, ROBOT, SPEC, Talk, entry

PAIR = Config("robot2", ("robot1",), grace_ms=300)


def told(talk: Talk, robot: str) -> str:
    views = talk.node.status(talk.now_ns).peers
    return "\n".join(next(view.refused for view in views if view.robot == robot))


def epoch(talk: Talk) -> int:
    return next((one.epoch for one in talk.node.status(talk.now_ns).components if one.name == NAME), 0)


@pytest.mark.parametrize("passed", [1, 5_000, 500 * SPAN, EPOCHS_AWAY_MAX - 1])
def test_as_many_epochs_as_can_have_passed_are_believed(passed: int) -> None:
    talk = Talk(PAIR, VoteRecord((Record(NAME, 7, "robot1", State.STANDBY, spec=SPEC),)))
    talk.hear("robot1", entry(State.PRIMARY, 7 + passed, "robot1", NEWEST))
    assert epoch(talk) == 7 + passed and not told(talk, "robot1")


@pytest.mark.parametrize("said", [7 + EPOCHS_AWAY_MAX + 100, 1 << 30, EPOCH_SAID_MAX, EPOCH_MAX - 1])
@pytest.mark.parametrize("state", [State.PRIMARY, State.CLAIMING, State.STANDBY, State.FINISHED])
def test_more_are_refused_counted_and_told(state: State, said: int) -> None:
    talk = Talk(PAIR, VoteRecord((Record(NAME, 7, "robot1", State.STANDBY, spec=SPEC),)))
    for _ in range(3):
        ready = talk.hear("robot1", entry(state, said, "robot1", NEWEST))
    assert epoch(talk) == 7
    assert f"not believed, 3 times, last 0 s ago: robot1 says epoch {said} of {NAME}, {said - 7} above" in told(talk, "robot1")
    assert not talk.node.status(talk.now_ns).healthy and not ready.told, "the event log has the first, the tenth, the hundredth"


def test_a_robot_that_says_it_runs_something_in_an_impossible_epoch_is_not_replaced_while_it_lives() -> None:
    talk = Talk(PAIR, VoteRecord((Record(NAME, 7, "robot1", State.STANDBY, spec=SPEC, entrusted=("robot2",), trusted=True),)))
    for _ in range(60):
        talk.hear("robot1", entry(State.PRIMARY, 1 << 35, "robot1"))
        talk.tick(20)
    assert epoch(talk) == 7


def test_no_number_of_lies_brings_an_epoch_to_where_beats_end() -> None:
    talk = Talk(PAIR)
    said = 1
    for _ in range(300):
        said = min(max(said, epoch(talk)) + EPOCHS_AWAY_MAX, EPOCH_MAX - 1)
        talk.hear("robot1", entry(State.PRIMARY, said, "robot1"))
        talk.hear("robot1", entry(State.PRIMARY, epoch(talk) + 1, "robot1"))
        talk.tick(20)
    assert epoch(talk) < 2 * EPOCHS_AWAY_MAX


def test_a_record_without_a_later_epoch_spoils_no_beat_and_says_what_to_do() -> None:
    for poisoned in (EPOCH_MAX - 1, EPOCH_MAX, EPOCH_MAX + 5):
        talk = Talk(PAIR, VoteRecord((Record(NAME, poisoned, "robot2", State.STANDBY, spec=SPEC), Record("/lab/y", 3, "robot1"))))
        talk.tick(2_000)
        beats = [beat for ready in talk.readies for beat in ready.send]
        assert beats and all(codec.is_sound(beat) for beat in beats)
        ready = talk.node.step(Run(1, SPEC), talk.now_ns)
        assert f"failover-agent mend {NAME} --epoch N" in str(ready.act)
        ready = talk.node.step(Promote(2, NAME), talk.now_ns)
        assert f"failover-agent mend {NAME} --epoch N" in str(ready.act)
        assert not talk.node.status(talk.now_ns).healthy


def test_a_witness_names_no_component_that_nobody_else_knows() -> None:
    talk = Talk(ROBOT)
    talk.tick(400)
    for number in range(COMPONENTS_MAX):
        talk.hear("witness1", Entry(f"/lab/{number}", 9, 1, "robot2"))
    talk.hear("robot2", entry(State.PRIMARY, 1, "robot2", NEWEST))
    assert [view.name for view in talk.node.status(talk.now_ns).components] == [NAME]
    assert epoch(talk) == 1


def test_a_life_of_ours_that_only_one_member_remembers_is_a_lie_while_others_hear_this_one() -> None:
    talk = Talk(ROBOT)
    talk.tick(100)
    lie = Beat("witness1", 1, 1, 1, echoes=(Echo("robot1", 1 << 20, 1),))
    assert talk.node.outlived_by(lie) == 1 << 20, "nobody else is heard: it may be so"
    talk.hear("robot2")
    assert talk.node.outlived_by(lie) == 0


def test_a_life_of_ours_that_more_members_remember_is_believed() -> None:
    config = Config("robot1", ("robot2", "robot3", "witness1"), rule=ROBOT.rule, witnesses=("witness1",))
    node = Node(config, 1, VoteRecord(), 0)
    node.step(Tick(), 100 * MS)
    for counter, sender in enumerate(("robot2", "robot3"), 1):
        beat = Beat(sender, 1, counter, counter, echoes=(Echo("robot1", 9, 1),))
        assert node.outlived_by(beat) == 9
        node.step(Received(beat, "wire"), 100 * MS)
