"""The roster: equal team files give equal ranks and digests, different ones different digests; words of ranks and of views."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.frames.roster import RANKS_MAX, pack_seen, place_in, ranks_in, roster, unpack_seen, word

RANKS = st.sets(st.integers(0, RANKS_MAX - 1))


def test_ranks_follow_the_order_w_however_the_members_are_listed() -> None:
    team = roster(["robot10", "base", "robot2"])
    assert team == roster(["robot2", "robot10", "base", "base"])
    assert team.names == ("base", "robot2", "robot10")
    assert team.ranks == {"base": 0, "robot2": 1, "robot10": 2}
    assert (len(team), team.everybody) == (3, 0b111)


def test_the_digest_tells_another_team_and_another_board() -> None:
    digests = [
        roster(["a", "b"]).digest,
        roster(["a", "c"]).digest,
        roster(["ab"]).digest,
        roster(["a"], b"b").digest,
        roster(["a", "b"], b"board").digest,
        roster([]).digest,
    ]
    assert len({digest & 0xFFFFFFFF for digest in digests}) == len(digests)
    assert roster(["a", "b"]).digest == roster(["b", "a"]).digest
    assert roster(["a", "b"]).short_digest == digests[0] & 0xFFFFFFFF


def test_the_digest_is_the_same_in_every_version() -> None:
    """Robots of two versions must agree on it: a change of this number needs a new version of the frame."""
    assert roster(["robot1", "robot2"]).digest == 4583651408453642332


def test_more_members_than_bits_are_refused() -> None:
    assert len(roster(f"robot{number}" for number in range(RANKS_MAX))) == RANKS_MAX
    with pytest.raises(ValueError, match="limit of 64"):
        roster(f"robot{number}" for number in range(RANKS_MAX + 1))


@given(RANKS)
def test_a_word_is_its_ranks(ranks: set[int]) -> None:
    assert ranks_in(word(ranks)) == tuple(sorted(ranks))
    assert word(ranks) < 1 << 64
    assert [place_in(word(ranks), rank) for rank in sorted(ranks)] == list(range(len(ranks)))


@given(st.lists(st.integers(0, 3), max_size=RANKS_MAX))
def test_views_come_back_from_their_words(seen: list[int]) -> None:
    words = pack_seen(seen)
    assert all(one < 1 << 64 for one in words)
    assert unpack_seen(words, len(seen)) == tuple(seen)


@given(st.lists(st.integers(-1, 1 << 65), max_size=4), st.integers(0, RANKS_MAX))
def test_words_of_another_roster_are_none(words: list[int], count: int) -> None:
    seen = unpack_seen(words, count)
    assert seen is None or (len(seen) == count and pack_seen(seen) == tuple(words))


def test_views_longer_than_the_roster_are_none() -> None:
    assert unpack_seen(pack_seen([1] * 5), 4) is None
    assert unpack_seen(pack_seen([1] * 33), 32) is None
    assert unpack_seen((), 1) is None
