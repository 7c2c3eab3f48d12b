"""When a silent peer counts as dead. Whole lives are in ``tests/simulation``."""

from __future__ import annotations

import pytest

from failover.core.election.consent import STATES
from failover.core.events import Received, Tick
from failover.core.membership import LATE_BEATS, UNSTEADY_BEATS, Membership
from failover.core.node import Node
from failover.core.types import MS, Config, State, VoteRecord
from failover.core.wire.messages import RULES, Beat, Echo, Entry

PAIR = Config("robot1", ("robot2",), beat_ms=10, lease_ms=100)
LOYALTY_MS = PAIR.loyalty_ns // MS


def beat(counter: int) -> Beat:
    return Beat("robot2", 1, counter)


def heard(*at_ms: int) -> Membership:
    """A team in which robot2's beats came at these instants."""
    team = Membership(PAIR, 1, 0)
    for counter, at in enumerate(at_ms, start=1):
        team.hear(beat(counter), "eth0", at * MS)
    return team


def patience_ms(team: Membership) -> int:
    return (team.loyal_until_ns("robot2") - team.peers["robot2"].heard_ns) // MS


def test_beats_that_come_in_time_ask_for_the_least_margin_only() -> None:
    assert patience_ms(heard(10, 20, 32, 40, 50)) == LOYALTY_MS


def test_beats_that_come_late_widen_the_margin_and_never_beyond_another_lease() -> None:
    assert patience_ms(heard(10, 20, 70)) == 100 + 2 * 40
    assert patience_ms(heard(10, 20, 130)) == PAIR.loyalty_ns_max // MS == 200


def test_a_lateness_that_is_not_seen_again_is_forgotten() -> None:
    late, steady = (10, 20, 70), range(80, 80 + 10 * 3 * UNSTEADY_BEATS, 10)
    assert patience_ms(heard(*late, *steady)) == LOYALTY_MS


def test_the_longest_lateness_is_forgotten_as_soon_as_one_that_widens_the_margin_as_much() -> None:
    last = heard(10, 20, 80), heard(10, 20, 20 + 2 * LOYALTY_MS - 1)
    assert [patience_ms(team) for team in last] == [200, 200]
    for team in last:
        at_ms = team.peers["robot2"].heard_ns // MS
        for number in range(1, UNSTEADY_BEATS):
            team.hear(beat(3 + number), "eth0", (at_ms + 10 * number) * MS)
    assert patience_ms(last[0]) == patience_ms(last[1]) < 150


def test_a_robot_that_was_away_is_not_late() -> None:
    assert patience_ms(heard(10, 20, 10_000)) == LOYALTY_MS


def test_our_own_lateness_is_not_the_peers() -> None:
    team = heard(10, 20)
    team.forgive(50 * MS, 80 * MS)
    team.hear(beat(3), "eth0", 80 * MS)
    assert patience_ms(team) == LOYALTY_MS


@pytest.mark.parametrize("rule", [0, 1, 2])
def test_a_beat_that_is_not_the_newest_keeps_no_dead_robot_alive(rule: int) -> None:
    """As frames do that were recorded on a medium of which this robot heard nothing: their counters are new there."""
    team = Membership(PAIR, 1, 0)
    for number, counter in enumerate((*range(1, 101), *range(1, 101)), start=1):
        team.hear(Beat("robot2", 1, counter, rule=rule), "eth0", 10 * min(number, 100 + counter) * MS)
    assert team.loyal_until_ns("robot2") == 1_000 * MS + PAIR.loyalty_ns
    assert not team.alive("robot2", 1_000 * MS + PAIR.loyalty_ns)
    team.hear(Beat("robot2", 2, 1, rule=rule), "eth0", 2_010 * MS)
    assert team.alive("robot2", 2_010 * MS), "another life of it is news"


def test_a_copy_of_a_recent_beat_proves_its_link_and_an_old_one_nothing() -> None:
    team = heard(*range(10, 1_010, 10))
    entry = Entry("/lab/x", STATES.index(State.PRIMARY), 1, "robot2")
    old, recent = (Beat("robot2", 1, counter, 1, 1, 1, (), (entry,)) for counter in (100 - LATE_BEATS, 101 - LATE_BEATS))
    assert team.hear(old, "wlan0", 1_010 * MS) == ()
    assert set(team.peers["robot2"].links) == {"eth0"}
    assert team.hear(recent, "wlan0", 1_010 * MS) == (entry,)
    assert team.peers["robot2"].links == {"eth0": 1_000 * MS, "wlan0": 1_010 * MS}


def test_a_peer_by_another_rule_is_told_of_no_beat_of_its_own() -> None:
    team = Membership(PAIR, 1, 0)
    other = next(number for number, rule in enumerate(RULES) if number and rule != PAIR.rule)
    team.hear(Beat("robot2", 1, 7, rule=other), "eth0", 10 * MS)
    assert team.at_odds(10 * MS) == ("robot2",)
    assert team.echoes(10 * MS) == (Echo("robot2", 1, 0),)


def test_an_older_beat_does_not_take_back_that_a_robot_cannot_be_authenticated() -> None:
    team = heard(10, 20)
    team.unreadable("robot2", "", 1_000 * MS)
    team.hear(beat(2), "wlan0", 1_010 * MS)
    assert team.unread("robot2", 1_020 * MS)
    team.hear(beat(3), "wlan0", 1_030 * MS)
    assert not team.unread("robot2", 1_040 * MS)


def test_a_step_is_due_the_instant_a_peer_counts_as_dead() -> None:
    node = Node(PAIR, 1, VoteRecord(), 0)
    node.step(Received(beat(1), "eth0"), 3 * MS)
    dead_ns = 3 * MS + PAIR.loyalty_ns
    asked: list[int] = []
    while node.next_deadline_ns() <= dead_ns + 50 * MS:
        asked.append(node.next_deadline_ns())
        node.step(Tick(), asked[-1])
    assert dead_ns in asked


def rests_at(node: Node, *at_ms: int) -> list[bool]:
    return [node.rests(at * MS) for at in at_ms]


def beating(node: Node, first: int, last: int) -> int:
    """Its peer's beats of these numbers, each 10 ms; returns the instant of the last one, in ms."""
    for number in range(first, last + 1):
        node.step(Received(beat(number), "eth0"), number * 10 * MS)
        node.step(Tick(), number * 10 * MS)
    return last * 10


def test_a_robot_rests_while_nothing_is_protected_and_its_peer_is_heard() -> None:
    node = Node(PAIR, 1, VoteRecord(), 0)
    assert rests_at(node, 0) == [False]
    at = beating(node, 1, 5)
    missing = at + 2 * LOYALTY_MS // 3
    assert rests_at(node, at, missing - 1, missing + 1) == [True, True, False]
    node.step(Tick(), (at + LOYALTY_MS) * MS)
    assert rests_at(node, at + LOYALTY_MS) == [True], "it is dead: to hear it again is not urgent"


def test_a_robot_that_hears_of_a_component_rests_no_more_until_it_has_ended() -> None:
    node = Node(PAIR, 1, VoteRecord(), 0)
    runs = Entry("/lab/x", STATES.index(State.PRIMARY), 1, "robot2")
    node.step(Received(Beat("robot2", 1, 1, 1, 1, 1, (), (runs,)), "eth0"), 10 * MS)
    assert rests_at(node, 11) == [False]
    ended = Entry("/lab/x", STATES.index(State.RELEASED), 1, "robot2")
    node.step(Received(Beat("robot2", 1, 2, 2, 0, 1, (), (ended,)), "eth0"), 20 * MS)
    node.step(Tick(), 21 * MS)
    assert rests_at(node, 22) == [True]


def test_a_beat_that_waited_while_its_hearer_rested_was_not_late() -> None:
    def patience_ms_after(*came_ms: int) -> int:
        node = Node(PAIR, 1, VoteRecord(), 0)
        beating(node, 1, 5)
        for at in range(60, 110, 10):
            node.step(Tick(), at * MS)
        for number, came in enumerate(came_ms, start=6):
            node.step(Received(beat(number), "eth0", came_ns=came * MS), 101 * MS)
        return patience_ms(node._team)

    assert patience_ms_after(60, 70, 80, 90) == LOYALTY_MS
    assert patience_ms_after(95) == 100 + 2 * 35
