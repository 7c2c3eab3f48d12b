"""When a silent peer counts as dead. Whole lives are in ``tests/simulation``."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from failover.core.election.consent import STATES
from failover.core.events import Received, Tick
from failover.core.membership import LATE_BEATS, UNSTEADY_BEATS, Membership
from failover.core.node import Node
from failover.core.types import MS, Awaited, Config, Rule, State, VoteRecord
from failover.core.wire.messages import OTHER_SITES, RETURNED, RULES, Beat, Echo, Entry, Promise

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


@pytest.mark.parametrize("other", [RULES.index(Rule.MAJORITY), RULES.index(Rule.ETCD), OTHER_SITES])
def test_a_peer_by_another_rule_or_with_other_sites_is_told_of_no_beat_of_its_own(other: int) -> None:
    team = Membership(PAIR, 1, 0)
    says = (Entry("/lab/x", STATES.index(State.PRIMARY), 1, "robot2"),)
    assert team.hear(Beat("robot2", 1, 7, 1, 0, 1, (Echo("robot1", 1, 5),), says, rule=other), "eth0", 10 * MS) == ()
    assert team.at_odds(10 * MS) == ("robot2",) and team.alive("robot2", 10 * MS) and not team.hears_us("robot2", 10 * MS)
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


# Promises to wait for an agent that restarts

PATIENT = Config("robot1", ("robot2",), beat_ms=10, lease_ms=100, restart_grace_ms=20_000)
WAIT_MS = PATIENT.awaited_ns(20_000) // MS


def asks(counter: int, grace_ms: int = 20_000, boot: int = 1) -> Beat:
    return Beat("robot2", boot, counter, grace_ms=grace_ms)


def test_a_robot_that_asks_is_waited_for_from_its_newest_request_and_is_neither_alive_nor_dead_meanwhile() -> None:
    team = Membership(PATIENT, 1, 0)
    team.hear(asks(1), "eth0", 10 * MS)
    team.hear(asks(2), "eth0", 20 * MS)
    assert WAIT_MS == 20_000 * LOYALTY_MS // 100, "longer than the grace as the loyalty is longer than the lease"
    silent, over = (21 + LOYALTY_MS) * MS, (20 + WAIT_MS) * MS
    assert not team.alive("robot2", silent) and not team.dead("robot2", over - 1) and not team.gone("robot2", over - 1)
    assert team.dead("robot2", over)
    assert [view.state for view in team.views(silent)] == ["restarting"]
    assert team.next_death_ns(silent) == over
    assert team.awaited(over - 1) == (Awaited("robot2", 1, 20_000),)
    assert team.awaited(over) == ()
    assert team.promises((Awaited("robot2", 1, 20_000),)) == (Promise("robot2", 1, 2, 20_000),)


def test_no_robot_waits_longer_than_its_operator_allows_nor_for_one_with_another_rule() -> None:
    short = Membership(replace(PATIENT, restart_grace_ms=1_000), 1, 0)
    short.hear(asks(1), "eth0", 10 * MS)
    assert short.awaited(11 * MS) == (Awaited("robot2", 1, 1_000),)
    for config, beat_ in ((PAIR, asks(1)), (PATIENT, replace(asks(1), rule=RULES.index("majority")))):
        team = Membership(config, 1, 0)
        team.hear(beat_, "eth0", 10 * MS)
        assert team.awaited(11 * MS) == ()


def test_a_promise_outlives_a_restart_of_the_one_that_gave_it_a_shorter_request_and_the_membership() -> None:
    team = Membership(PATIENT, 2, 0, (Awaited("robot2", 1, 20_000),))
    assert not team.dead("robot2", (WAIT_MS - 1) * MS)
    assert team.promises(team.awaited(MS)) == (), "the beat that asked is not known to this life"
    team.hear(asks(9, 500), "eth0", 10 * MS)
    assert team.awaited(11 * MS) == (Awaited("robot2", 1, 20_000),)
    team.change(replace(PATIENT, peers=()), 20 * MS)
    assert not team.dead("robot2", (10 + WAIT_MS) * MS - 1)


def test_a_later_life_of_the_robot_gives_the_promise_back_and_the_same_life_does_not() -> None:
    team = Membership(PATIENT, 1, 0)
    team.hear(asks(1), "eth0", 10 * MS)
    team.hear(asks(2, RETURNED), "eth0", 20 * MS)
    assert team.awaited(21 * MS)
    team.hear(asks(1, 0, boot=2), "eth0", 30 * MS)
    assert team.awaited(31 * MS), "its guards still have the long lease, perhaps"
    team.hear(asks(2, RETURNED, boot=2), "eth0", 40 * MS)
    assert team.awaited(41 * MS) == ()
    assert team.dead("robot2", (41 + LOYALTY_MS) * MS)


def test_a_promise_lets_act_from_when_the_beat_left_that_asked_and_one_to_an_earlier_life_does_not() -> None:
    team = Membership(PATIENT, 3, 0)
    team.asked(7, 100 * MS)
    team.hear(Beat("robot2", 1, 1, promises=(Promise("robot1", 2, 7, 20_000), Promise("robot3", 3, 7, 20_000))), "eth0", 150 * MS)
    assert team.lease_ns("robot2") == 0
    team.hear(Beat("robot2", 1, 2, promises=(Promise("robot1", 3, 7, 20_000),)), "eth0", 160 * MS)
    assert team.lease_ns("robot2") == 20_100 * MS


def test_a_stall_of_our_own_is_not_counted_as_silence_of_a_robot_that_is_waited_for() -> None:
    team = Membership(PATIENT, 1, 0)
    team.hear(asks(1), "eth0", 10 * MS)
    team.forgive(WAIT_MS * MS, (10 + WAIT_MS) * MS)
    assert not team.dead("robot2", (9 + 2 * WAIT_MS) * MS)
    assert team.dead("robot2", (10 + 2 * WAIT_MS) * MS)


def test_a_promise_outlives_that_its_robot_leaves_the_team_and_our_restart_and_that_it_joins_again() -> None:
    team, alone, kept = Membership(PATIENT, 1, 0), replace(PATIENT, peers=()), (Awaited("robot2", 1, 20_000),)
    team.hear(asks(1), "eth0", 10 * MS)
    team.change(alone, 20 * MS)
    assert team.awaited(21 * MS) == kept, "the record would forget it"
    team.change(PATIENT, 30 * MS)
    over_ns = (10 + WAIT_MS) * MS
    assert team.awaited(31 * MS) == kept and team.promises(kept) == ()
    assert not team.dead("robot2", over_ns - 1) and team.dead("robot2", over_ns)
    assert team.awaited(over_ns) == ()
    later = Membership(alone, 2, 0, kept)
    assert later.awaited(MS) == kept and not later.dead("robot2", WAIT_MS * MS - 1)
    assert later.dead("robot2", WAIT_MS * MS) and later.awaited(WAIT_MS * MS) == ()


def test_a_member_that_joins_again_at_once_is_not_replaced_while_it_may_act_on_what_it_heard_before() -> None:
    team = Membership(PAIR, 1, 0)
    team.hear(beat(1), "eth0", 10 * MS)
    team.change(replace(PAIR, peers=()), 20 * MS)
    team.change(PAIR, 30 * MS)
    assert team.awaited(31 * MS) == (), "it was promised nothing"
    assert not team.dead("robot2", (9 + LOYALTY_MS) * MS) and team.dead("robot2", (10 + LOYALTY_MS) * MS)


def test_an_operators_order_does_not_pass_over_one_that_is_waited_for_because_it_cannot_be_authenticated() -> None:
    team = Membership(replace(PATIENT, grace_ms=100), 2, 0, (Awaited("robot2", 1, 20_000),))
    at_ns = (WAIT_MS - 1) * MS
    team.unreadable("robot2", "a wrong key", at_ns)
    assert not team.keeps_waiting("robot2", at_ns) and team.keeps_waiting("robot2", WAIT_MS * MS)


def test_a_promise_that_no_one_asked_for_says_so_until_it_is_asked_for_and_a_promise_is_no_echo() -> None:
    team = Membership(PATIENT, 1, 0)
    team.asked(7, MS)
    team.hear(Beat("robot2", 1, 1, promises=(Promise("robot1", 1, 7, 20_000),)), "eth0", 10 * MS)
    assert team.lease_ns("robot2") > 10 * MS and not team.views(10 * MS)[0].hears_us
    team.promise_unasked("robot2", 10 * MS)
    kept = team.awaited(11 * MS)
    assert kept == (Awaited("robot2", 1, 20_000, is_asked=False),) and not team.views(11 * MS)[0].is_asked
    assert not Membership(PATIENT, 2, 0, kept).views(MS)[0].is_asked
    team.hear(asks(2), "eth0", 20 * MS)
    assert team.awaited(21 * MS) == (Awaited("robot2", 1, 20_000),)
    team.promise_unasked("robot2", 30 * MS)
    assert team.views(31 * MS)[0].is_asked, "it asked for what still runs"
