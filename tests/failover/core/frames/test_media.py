"""Media: who takes turns, how frames are cast, and whether all fit a round."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.frames.media import (
    LOAD_MAX,
    RETRY_ROUNDS,
    UNHEARD_ROUNDS,
    Cast,
    Casting,
    Medium,
    air_us,
    dropped,
    overload,
    room,
)

RADIO = Medium("wlan0", is_wireless=True, rate_mbps=1)


@pytest.mark.parametrize(
    ("is_wireless", "slots", "expected"), [(True, None, True), (False, None, False), (True, False, False), (False, True, True)]
)
def test_robots_take_turns_on_a_radio_unless_told_otherwise(is_wireless: bool, slots: bool | None, expected: bool) -> None:
    assert Medium("m", is_wireless, slots).is_slotted is expected


def test_a_frame_of_379_bytes_occupies_a_slow_radio_for_four_ms() -> None:
    assert air_us(379, 1) == 360 + 192 + 443 * 8 == 4_096


def test_twelve_robots_do_not_fit_fifty_ms_and_the_cure_is_told() -> None:
    told = overload(RADIO, 12, 480, 50)
    assert "wlan0: 12 robots × 4.9 ms need 59 ms" in told
    assert "t_tup_ms ≥ 75" in told
    assert overload(RADIO, 12, 480, 75) == ""
    assert overload(RADIO, 8, 480, 50) == ""


def test_what_is_not_known_is_not_refused() -> None:
    assert overload(Medium("wlan0", is_wireless=True), 64, 1_200, 50) == ""
    assert overload(Medium("eth0", is_wireless=False, rate_mbps=10), 64, 1_200, 5) == ""


def test_unicast_costs_as_many_frames_as_there_are_receivers() -> None:
    unicast = Medium("wlan0", is_wireless=True, cast=Cast.UNICAST, rate_mbps=11)
    assert "need" in overload(unicast, 10, 379, 50)
    assert overload(Medium("wlan0", is_wireless=True, rate_mbps=11), 10, 379, 50) == ""


@given(
    st.integers(1, 64),
    st.integers(0, 1_200),
    st.integers(10, 1_000),
    st.sampled_from([1, 2, 5.5, 11]),
    st.sampled_from(list(Cast)),
)
def test_the_round_that_is_proposed_is_enough_and_frames_that_have_room_fit(
    robots: int, size: int, t_tup_ms: int, rate_mbps: float, cast: Cast
) -> None:
    medium = Medium("wlan0", is_wireless=True, cast=cast, rate_mbps=rate_mbps)
    told = overload(medium, robots, size, t_tup_ms)
    if told:
        (least_ms,) = re.findall(r"t_tup_ms ≥ (\d+)", told)
        assert overload(medium, robots, size, int(least_ms)) == ""
    fits = room(medium, robots, t_tup_ms, 1_200)
    assert fits == 0 or overload(medium, robots, fits, t_tup_ms) == ""
    assert told == "" or size > fits or fits == 0
    assert LOAD_MAX < 1


def test_items_of_the_longest_period_are_left_out_first() -> None:
    items = ((1, 100), (5, 50), (2, 100), (5, 50))
    assert dropped(items, 300) == ()
    assert dropped(items, 260) == (3,)
    assert dropped(items, 210) == (1, 3)
    assert dropped(items, 150) == (1, 2, 3)
    assert dropped(items, 0) == (0, 1, 2, 3)


def test_another_way_is_tried_when_nobody_hears_us_though_we_hear_others() -> None:
    casting = Casting(Cast.AUTO)
    assert [casting.round_over(3, 0) for _ in range(UNHEARD_ROUNDS)] == [False] * (UNHEARD_ROUNDS - 1) + [True]
    assert casting.now is Cast.BROADCAST
    assert "none has heard a multicast" in casting.why
    assert casting.failed("EACCES") and casting.now is Cast.UNICAST
    assert not casting.failed("EACCES") and casting.now is Cast.UNICAST


@pytest.mark.parametrize(("heard", "hear_us"), [(0, 0), (3, 1), (1, 1)])
def test_a_robot_alone_or_heard_by_one_keeps_its_way(heard: int, hear_us: int) -> None:
    casting = Casting(Cast.AUTO)
    assert not any(casting.round_over(heard, hear_us) for _ in range(10 * UNHEARD_ROUNDS))
    assert casting.now is Cast.MULTICAST


@pytest.mark.parametrize("cast", [Cast.MULTICAST, Cast.BROADCAST, Cast.UNICAST])
def test_a_way_that_was_chosen_is_kept(cast: Cast) -> None:
    casting = Casting(cast)
    assert not casting.failed("EACCES")
    assert not any(casting.round_over(3, 0) for _ in range(10 * UNHEARD_ROUNDS))
    assert casting.now is cast


def test_a_way_that_did_not_work_is_tried_again_after_a_while() -> None:
    casting = Casting(Cast.AUTO)
    for _ in range(2 * UNHEARD_ROUNDS):
        casting.round_over(3, 0)
    assert casting.now is Cast.UNICAST
    assert [casting.round_over(3, 0) for _ in range(RETRY_ROUNDS)].index(True) == RETRY_ROUNDS - 1
    assert (casting.now, casting.why) == (Cast.MULTICAST, "")
