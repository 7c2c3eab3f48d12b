"""Who hears a cast is told by frames, not assumed: what was not told lately is not heard."""

from __future__ import annotations

import pytest

from failover.core.frames.casts import LEFT_MAX, LINKS_MAX, Casts
from failover.core.frames.frame import Body, casts_size_max, size_of

MS = 1_000_000
MEMBERS = 3
WAYS = {0: ((0, 0), (1, 1)), 1: ((0, 0), (1, 1)), 2: ((0, 0), (1, 1))}


def casts(me: int) -> Casts:
    return Casts(me, MEMBERS, WAYS)


def test_a_member_that_says_that_it_heard_the_newest_cast_hears_it() -> None:
    first, second = casts(0), casts(1)
    first.left(0, 100, 1_000 * MS)
    assert not first.hears(1, 0, 1)
    second.heard(0, 0, boot=1, counter=100)
    first.told(1, second.says())
    assert first.hears(1, 0, 1_000 * MS)
    assert not first.hears(1, 0, 1_000 * MS + 1), "later ones it may have missed"
    assert not first.hears(1, 1, 1), "of the other link it said nothing"
    assert not first.hears(2, 0, 1), "of the other member nothing is known"


def test_after_another_way_to_cast_was_chosen_members_must_say_anew_that_they_hear_it() -> None:
    first, second = casts(0), casts(1)
    for place in (0, 1):
        first.left(place, 100, 1_000 * MS)
        second.heard(place, 0, boot=1, counter=100)
    first.told(1, second.says())
    first.forget(0)
    first.told(1, second.says())
    assert (first.hears(1, 0, 1), first.hears(1, 1, 1)) == (False, True), "what left before is none of this way"
    first.left(0, 101, 1_020 * MS)
    second.heard(0, 0, boot=1, counter=101)
    first.told(1, second.says())
    assert first.hears(1, 0, 1_020 * MS)


def test_what_a_member_heard_long_ago_proves_nothing() -> None:
    first, second = casts(0), casts(1)
    second.heard(0, 0, boot=1, counter=1)
    for counter in range(1, LEFT_MAX + 2):
        first.left(0, counter, counter * MS)
    first.told(1, second.says())
    assert not first.hears(1, 0, 1)


def test_the_newest_cast_counts_whatever_comes_late() -> None:
    second = casts(1)
    second.heard(0, 0, boot=1, counter=65_535)
    second.heard(0, 0, boot=1, counter=65_538)
    second.heard_again(0, 0, 65_537)
    assert second.says()[0][:2] == (2).to_bytes(2, "little"), "its low half"


@pytest.mark.parametrize("silent", [32_768, 40_000, 65_536])
def test_a_cast_after_a_long_silence_is_a_later_one(silent: int) -> None:
    second = casts(1)
    second.heard(0, 0, boot=1, counter=100)
    second.heard(0, 0, boot=1, counter=100 + silent + 1)
    assert second.says()[0][:2] == ((101 + silent) % 65_536).to_bytes(2, "little")


@pytest.mark.parametrize("heard", [100, 0])
def test_a_member_that_hears_no_casts_any_more_is_never_taken_for_one_that_does(heard: int) -> None:
    """It repeats the last one that it heard, if any; one part of 65,536 has that low half, too."""
    first, second = casts(0), casts(1)
    first.left(0, 100, 1_000 * MS)
    if heard:
        second.heard(0, 0, boot=1, counter=heard)
    else:
        second.heard(0, 2, boot=1, counter=7)
    first.told(1, second.says())
    for counter in range(65_400, 65_700):
        now_ns = (1_000 + counter) * MS
        first.left(0, counter, now_ns)
        first.told(1, second.says())
        assert not first.hears(1, 0, now_ns)


def test_another_life_of_a_member_begins_with_nothing_heard() -> None:
    second = casts(1)
    second.heard(0, 0, boot=1, counter=500)
    second.heard(1, 0, boot=2, counter=3)
    second.heard(0, 0, boot=1, counter=501)
    assert [said[:2] for said in second.says()] == [b"\0\0", b"\3\0"]


@pytest.mark.parametrize("said", [(), (b"",), (b"\1" * 5,), (b"\1" * 1_000,), (b"\0" * 6,) * 9])
def test_what_makes_no_sense_proves_nothing(said: tuple[bytes, ...]) -> None:
    first = casts(0)
    first.left(0, 1, MS)
    first.told(1, said)
    assert not first.hears(1, 0, 1)


def test_a_frame_has_room_for_all_that_is_said() -> None:
    for members in (3, 17):
        second = Casts(1, members, {})
        for place in range(LINKS_MAX + 1):
            for rank in range(members):
                second.heard(place, rank, boot=1, counter=60_000)
        assert len(second.says()) == LINKS_MAX
        assert size_of(Body(casts=second.says())) - size_of(Body()) <= casts_size_max(members)
