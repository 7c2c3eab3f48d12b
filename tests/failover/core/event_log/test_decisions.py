"""A robot's record of a decision, and the merge of several robots' event logs into one."""

from __future__ import annotations

import itertools
from random import Random

import pytest

from checkpoint.model import Position
from failover.core import acts
from failover.core.event_log.decisions import Decision, Facts, Line, Sighting
from failover.core.event_log.merge import Timed, merged, precedes
from failover.core.events import Captured, Noticed, Received, Run, Started, Tick
from failover.core.node import Node
from failover.core.types import MS, ComponentSpec, Config, Held, Launch, Record, State, VoteRecord
from failover.core.wire.messages import Beat, Entry

SPEC = ComponentSpec("/lab/x", launch=Launch(("x",)))
PAIR = Config("robot1", ("robot2",), grace_ms=300)
ALONE = Config("robot1", grace_ms=300)


def told(node: Node, event: object, at_ms: int) -> list[Decision]:
    return list(node.step(event, at_ms * MS).told)  # type: ignore[arg-type]


def standing_by() -> Node:
    """robot1, standby of robot2's component, with a checkpoint from an earlier life; it hears robot2 over two links."""
    record = Record("/lab/x", 3, "robot2", State.STANDBY, trusted=True, spec=SPEC)
    node = Node(PAIR, 2, VoteRecord((record,)), 0, (Held("/lab/x", (Position(193, 5, b"d"),)),))
    held = Entry("/lab/x", tuple(State).index(State.PRIMARY), 3, "robot2", standby="robot1")
    for counter, link in enumerate(("wire", "air"), start=1):
        node.step(Received(Beat("robot2", 7, counter, total=1, entries=(held,)), link), counter * 10 * MS)
    return node


def test_a_takeover_tells_who_was_silent_how_long_on_which_link_against_which_limit() -> None:
    node = standing_by()
    for at_ms in range(20, 400, 5):
        if claims := [one for one in told(node, Tick(), at_ms) if "claims epoch" in one.sentence]:
            break
    (claim,) = claims
    (seen,) = claim.facts.seen
    assert (seen.robot, seen.state, seen.boot, seen.counter) == ("robot2", "dead", 7, 2)
    assert seen.silent_ns >= seen.limit_ns == PAIR.loyalty_ns
    assert dict(seen.links) == {"wire": seen.silent_ns + 10 * MS, "air": seen.silent_ns}
    assert seen.says == "primary, epoch 3, primary robot2"
    assert (claim.facts.epoch_before, claim.facts.epoch, claim.facts.state) == (3, 4, "claiming")
    assert claim.facts.checkpoint == 5


def test_a_silent_peer_is_told_once_and_once_more_when_it_is_heard_again() -> None:
    node = standing_by()
    said = [one.sentence for at_ms in range(20, 800, 5) for one in told(node, Tick(), at_ms)]
    farewell = "robot2 was silent for 170 ms on every link (air, wire): it counts as dead"
    assert [one for one in said if "counts as dead" in one] == [farewell]
    (again,) = told(node, Received(Beat("robot2", 7, 3), "air"), 800)
    assert again.sentence == "robot2 is heard again over air after 780 ms of silence" and again.component == ""


def test_a_link_that_brings_only_copies_is_not_silent_and_keeps_nobody_alive() -> None:
    node = standing_by()
    node.step(Received(Beat("robot2", 7, 3), "wire", (("air", 28 * MS),)), 30 * MS)
    (noticed,) = told(node, Noticed("", "look"), 40)
    assert dict(noticed.facts.seen[0].links) == {"wire": 10 * MS, "air": 12 * MS}
    node.step(Received(Beat("robot2", 7, 4), "wire", (("air", 10**18),)), 50 * MS)
    said = [one.sentence for at_ms in range(50, 400, 5) for one in told(node, Tick(), at_ms)]
    assert any("counts as dead" in one for one in said)


def test_an_own_stall_is_told_and_stands_beside_the_decisions_after_it() -> None:
    node = standing_by()
    stall = told(node, Tick(), 5_000)
    assert "robot1 itself stood still for" in stall[0].sentence
    assert not [one for one in stall if "dead" in one.sentence]
    (noticed,) = told(node, Noticed("/lab/x", "by the way"), 5_010)
    assert noticed.facts.late_ns > 4_000 * MS
    (later,) = [told(node, Noticed("/lab/x", f"at {at}"), at) for at in range(5_020, 5_160, 5)][-1]
    assert later.facts.late_ns > 4_000 * MS
    (later,) = [told(node, Noticed("", f"at {at}"), at)[-1:] for at in range(5_160, 5_800, 5)][-1]
    assert later.facts.late_ns < 4_000 * MS


def test_a_primary_tells_what_its_loss_would_cost() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    (_, claim) = told(node, Run(1, SPEC), 0)
    assert claim.facts.checkpoint == 0 and claim.facts.checkpoint_age_ns == -1 and claim.facts.lease_left_ns is None
    (capture,) = (one for one in node.step(Started("/lab/x", 1), 1 * MS).act if isinstance(one, acts.Capture))
    position = Position(capture.generation, capture.sequence, b"d")
    node.step(Captured("/lab/x", 1, position, None), 5 * MS)
    noticed = told(node, Noticed("/lab/x", "held still", output_pending=77), 205)[-1]
    assert (noticed.facts.checkpoint, noticed.facts.checkpoint_age_ns) == (position.sequence, 204 * MS)
    assert noticed.facts.output_pending == 77


def test_what_is_noticed_about_an_unknown_component_leaves_no_line() -> None:
    node = Node(ALONE, 1, VoteRecord(), 0)
    told(node, Tick(), 0)
    assert told(node, Noticed("/lab/strange", "something"), 1) == []
    assert [one.component for one in told(node, Noticed("", "the cable is out"), 1)] == [""]


# Several robots


def line(robot: str, number: int, *, counter: int = 0, life: int = 1, epoch: int = 1, **heard: tuple[int, int]) -> Line:
    """A line about /lab/x; ``heard``: newest beat of each peer by (life, counter)."""
    seen = tuple(Sighting(peer, "alive", *newest, 0, 0) for peer, newest in heard.items())
    return Line(robot, life, number, "k", 0, Decision(0, "/lab/x", f"{robot} {number}", Facts(counter, epoch=epoch, seen=seen)))


def order(*lines: tuple[Line, int]) -> list[str]:
    """The sentences in the order told; every line with its instant in ms by the common clock."""
    logs: dict[str, list[Timed]] = {}
    for one, at_ms in lines:
        logs.setdefault(one.robot, []).append(Timed(one, at_ms * MS))
    return [timed.line.decision.sentence for timed in merged(logs)]


def test_whoever_heard_of_a_decision_decided_later_whatever_the_clocks_say() -> None:
    claim = line("robot2", 1, counter=40)
    accepts = line("robot1", 1, robot2=(1, 40))
    assert precedes(claim, accepts) and not precedes(accepts, claim)
    assert order((accepts, 0), (claim, 5_000)) == ["robot2 1", "robot1 1"]
    assert order((accepts, 5_000), (claim, 0)) == ["robot2 1", "robot1 1"]


def test_a_beat_that_left_before_a_decision_says_nothing_about_it() -> None:
    claim = line("robot2", 1, counter=40)
    unaware = line("robot1", 1, robot2=(1, 39))
    assert not precedes(claim, unaware)
    assert order((unaware, 0), (claim, 5)) == ["robot1 1", "robot2 1"]


def test_a_beat_of_a_later_life_comes_after_all_of_an_earlier_one() -> None:
    assert precedes(line("robot2", 9, counter=1_000, life=1), line("robot1", 1, robot2=(2, 1)))


def test_where_clocks_cannot_tell_the_lower_epoch_comes_first() -> None:
    old, new = Timed(line("robot1", 1, epoch=1), 2 * MS, MS), Timed(line("robot2", 1, epoch=2), 1 * MS, MS)
    assert merged({"robot1": [old], "robot2": [new]}) == [old, new]
    sure = Timed(line("robot2", 1, epoch=2), 0, 0)
    assert merged({"robot1": [old], "robot2": [sure]}) == [sure, old]


def test_a_circle_which_only_a_lost_disk_can_make_ends_by_the_clocks() -> None:
    first = line("robot1", 1, counter=1, robot2=(1, 1))
    second = line("robot2", 1, counter=1, robot1=(1, 1))
    assert sorted(order((first, 2), (second, 1))) == ["robot1 1", "robot2 1"]


@pytest.mark.parametrize("seed", range(30))
def test_no_wrong_clock_turns_cause_and_consequence_round(seed: int) -> None:
    """Three robots talk at random; their clocks are wrong by up to five seconds and the whole takes one."""
    dice = Random(seed)
    wrong_ms = {robot: dice.randrange(-5_000, 5_000) for robot in ("robot1", "robot2", "robot3")}
    heard: dict[str, dict[str, tuple[int, int]]] = {robot: {} for robot in wrong_ms}
    beats = dict.fromkeys(wrong_ms, 0)
    numbers = {robot: itertools.count(1) for robot in wrong_ms}
    logs: dict[str, list[Timed]] = {robot: [] for robot in wrong_ms}
    for now_ms in range(1_000):
        robot = dice.choice(list(wrong_ms))
        if dice.random() < 0.1:
            one = line(robot, next(numbers[robot]), counter=beats[robot] + 1, **heard[robot])
            logs[robot].append(Timed(one, (now_ms + wrong_ms[robot]) * MS))
        else:
            beats[robot] += 1
            listener = dice.choice([other for other in wrong_ms if other != robot])
            heard[listener][robot] = (1, beats[robot])
    place = {(timed.line.robot, timed.line.number): at for at, timed in enumerate(merged(logs))}
    assert len(place) == sum(map(len, logs.values())), seed
    for effect in (timed.line for log in logs.values() for timed in log):
        heard_of = {one.robot: one.counter for one in effect.decision.facts.seen} | {effect.robot: beats[effect.robot] + 1}
        causes = [
            timed.line
            for robot, beat in heard_of.items()
            for timed in logs[robot]
            if timed.line.decision.facts.counter <= beat and (robot != effect.robot or timed.line.number < effect.number)
        ]
        assert all(place[cause.robot, cause.number] < place[effect.robot, effect.number] for cause in causes), seed
