"""When a silent peer counts as dead. Whole lives are in ``tests/simulation``."""

from __future__ import annotations

from failover.core.events import Received, Tick
from failover.core.membership import UNSTEADY_BEATS, Membership
from failover.core.messages import Beat
from failover.core.node import Node
from failover.core.types import MS, Ballot, Config

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


def test_a_step_is_due_the_instant_a_peer_counts_as_dead() -> None:
    node = Node(PAIR, 1, Ballot(), 0)
    node.step(Received(beat(1), "eth0"), 3 * MS)
    dead_ns = 3 * MS + PAIR.loyalty_ns
    asked: list[int] = []
    while node.next_deadline_ns() <= dead_ns + 50 * MS:
        asked.append(node.next_deadline_ns())
        node.step(Tick(), asked[-1])
    assert dead_ns in asked
