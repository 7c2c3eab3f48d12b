"""Whose turn it is in a frame, and how often an urgent item may go besides."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from failover.core.board.due import NS_PER_S, URGENT_PER_S, Bucket, Sent, Turns


def turns(*items: tuple[int, int, int]) -> Turns:
    made = Turns()
    made.hold([Sent(*item) for item in items])
    return made


def test_an_item_is_due_in_the_rounds_of_its_phase() -> None:
    made = turns((0, 1, 0), (1, 3, 0), (2, 3, 2))
    assert [made.due(round_) for round_ in range(6)] == [[0, 1], [0], [0, 2], [0, 1], [0], [0, 2]]


def test_what_found_no_room_goes_first_in_the_next_frame_and_is_counted() -> None:
    made = turns((0, 1, 0), (1, 2, 0), (2, 2, 0))
    assert made.due(0) == [0, 1, 2]
    made.left([1, 2])
    assert made.due(1) == [1, 2, 0]
    made.left([0])
    assert made.due(2) == [0, 1, 2]
    made.left([])
    assert made.due(3) == [0]
    assert made.waited == {0: 1, 1: 1, 2: 1}


def test_an_item_that_is_removed_while_it_waits_is_forgotten() -> None:
    made = turns((0, 2, 0), (1, 2, 0))
    made.left([0, 1])
    made.hold([Sent(1, 2, 0)])
    assert made.due(1) == [1]


@given(st.integers(1, 12), st.integers(1, 30), st.lists(st.integers(1, 7), min_size=1, max_size=20))
def test_no_item_waits_for_ever_though_more_is_due_than_fits(room: int, rounds: int, periods: list[int]) -> None:
    made = turns(*[(number, period, 0) for number, period in enumerate(periods)])
    went = set()
    for round_ in range(max(periods) * (len(periods) + 1)):
        due = made.due(round_)
        assert len(due) == len(set(due))
        went |= set(due[:room])
        made.left(due[room:])
    assert went == set(range(len(periods)))


@given(st.lists(st.integers(0, 2 * NS_PER_S), min_size=1, max_size=200))
def test_an_urgent_item_goes_ten_times_a_second_and_ten_times_at_one_time(gaps_ns: list[int]) -> None:
    bucket, now_ns, went = Bucket(), 1, []
    for gap_ns in gaps_ns:
        now_ns += gap_ns
        if bucket.take(now_ns):
            went.append(now_ns)
    for number, at_ns in enumerate(went):
        later = [one for one in went[number:] if one - at_ns < NS_PER_S]
        assert len(later) <= 2 * URGENT_PER_S
    assert went[0] == gaps_ns[0] + 1


def test_a_frame_that_leaves_more_seldom_than_rounds_pass_carries_every_turn_since_the_one_before() -> None:
    both = turns((0, 1, 0), (1, 3, 1), (2, 10, 5))
    assert both.due(3, since=0) == [0, 1]
    assert both.due(5, since=3) == [0, 1, 2]
    assert both.due(6, since=5) == [0]
    assert both.due(5, since=5) == []
    assert [both.due(round_, since=round_ - 1) for round_ in range(1, 31)] == [both.due(round_) for round_ in range(1, 31)]
