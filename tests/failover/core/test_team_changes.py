"""Grants of changes of the team, majorities of them, seats, keys that are replaced."""

from __future__ import annotations

from itertools import combinations, product

import pytest

from failover.core.team_changes import GRANT_NS, SEATS, Grants, is_step_of_keys, missing, rotation, seats, step


def test_a_grant_is_given_to_one_robot_at_a_time() -> None:
    grants = Grants()
    assert grants.ask(3, 3, "r1", 0) == ""
    assert "r1 changes the team now" in grants.ask(3, 3, "r2", GRANT_NS - 1)
    assert grants.ask(3, 3, "r1", 1) == "", "again to the same one"


def test_a_grant_ends_by_itself_and_by_the_change() -> None:
    grants = Grants()
    assert grants.ask(0, 0, "r1", 0) == ""
    assert grants.ask(0, 0, "r2", GRANT_NS) == ""
    grants.done("r2")
    assert grants.ask(1, 1, "r3", GRANT_NS + 1) == ""


def test_who_gives_up_frees_its_own_grant_alone() -> None:
    grants = Grants()
    assert grants.ask(3, 3, "r1", 0, 7) == ""
    grants.done("r2")
    assert grants.covers("r1", 7) and not grants.covers("r1", 8) and not grants.covers("r2", 7)
    assert grants.ask(3, 3, "r2", GRANT_NS, 8) == "" and not grants.covers("r1", 7)
    grants.done("r2")
    assert not grants.covers("r2", 8)


@pytest.mark.parametrize(("have", "wanted"), [(4, 3), (3, 4)])
def test_who_has_not_the_same_changes_gets_none(have: int, wanted: int) -> None:
    assert f"has change {have}" in Grants().ask(have, wanted, "r1", 0)


def test_who_asks_again_with_older_news_loses_nothing_of_another_ones_grant() -> None:
    grants = Grants()
    assert grants.ask(3, 3, "r1", 0) == ""
    assert grants.ask(3, 2, "r2", 1)
    assert grants.ask(3, 3, "r2", 2), "still r1's"


@pytest.mark.parametrize("size", range(2, 8))
def test_majorities_before_and_after_a_change_share_a_member(size: int) -> None:
    before = [f"r{number}" for number in range(size)]
    after = [*before, "new"]
    for small in combinations(before, len(before) // 2 + 1):
        for large in combinations(after, len(after) // 2 + 1):
            assert set(small) & set(large)


def test_every_member_must_grant_a_change_but_one_that_leaves_and_is_lost() -> None:
    assert missing(("a", "b", "c"), {"a", "b"}) == ["c"]
    assert missing(("a", "b", "c"), {"a", "b"}, "c") == ["c"], "it is heard"
    assert missing(("a", "b", "c"), {"a", "b"}, "c", lives=False) == []
    assert missing(("a", "b", "c"), {"a"}, "c", lives=False) == ["b"]
    assert missing(("a", "b"), {"a"}, "b", lives=False) == []


def test_a_step_is_one_member() -> None:
    assert step({"a": 1}, {"a": 1, "b": 2}) == "b"
    assert step({"a": 1, "b": 2}, {"a": 1}) == "b"
    assert step({"a": 1}, {"a": 2}) == "a"
    assert step({"a": 1}, {"b": 1}) == "" and step({"a": 1}, {"a": 1}) == ""


def test_seats_stay_while_members_come_and_go() -> None:
    assert seats({"a": -1, "b": -1}, ["a", "b"]) == {"a": 0, "b": 1}
    assert seats({"b": 1, "a": -1}, ["b", "a"]) == {"b": 1, "a": 0}
    assert seats({"b": 0, "c": 2, "a": -1}, ["a", "b", "c"]) == {"a": 1, "b": 0, "c": 2}


def test_a_seat_that_became_free_is_given_again_when_all_others_are_used_up() -> None:
    assert seats({"a": 0, "c": -1}, ["a", "c"], 2) == {"a": 0, "c": 2}, "1 was the seat of one that left"
    assert seats({"a": 0, "c": -1}, ["a", "c"], SEATS - 1) == {"a": 0, "c": SEATS - 1}
    assert seats({"a": 0, "b": SEATS - 1, "c": -1}, ["a", "b", "c"], SEATS - 1) == {"a": 0, "b": SEATS - 1, "c": 1}


# --- Keys -------------------------------------------------------------------------------------------------------------

PAIRS = tuple(product(("", "A", "B", "C"), repeat=2))


def test_one_change_of_keys_leaves_one_that_both_know() -> None:
    steps = [(before, after) for before, after in product(PAIRS, PAIRS) if is_step_of_keys(before, after)]
    for before, after in steps:
        assert {*before} & {*after} - {""}, (before, after)
        assert len({*before} ^ {*after} - {""}) <= 2 and before != after
    assert (("A", ""), ("A", "B")) in steps
    assert {after for before, after in steps if before == ("A", "B")} == {("A", ""), ("B", "")}
    assert not any("" in before and after[1] == "" for before, after in steps), "no key in the place of another one at once"


@pytest.mark.parametrize(
    ("keys", "in_use", "prepared", "stage"),
    [
        (("A", ""), "A", "", "begin"),
        (("A", ""), "A", "B", "begin"),  # put aside, and told to no member
        (("A", "B"), "A", "B", "switch"),
        (("A", "B"), "B", "", "finish"),
        (("A", "B"), "A", "", "undo"),
        (("A", "B"), "A", "C", "undo"),
        (("A", ""), "B", "", "unfit"),
        (("A", ""), "", "", "unfit"),
        (("", ""), "A", "", "unfit"),
    ],
)
def test_a_rotation_that_broke_off_goes_on(keys: tuple[str, str], in_use: str, prepared: str, stage: str) -> None:
    assert rotation(keys, in_use, prepared) == stage
