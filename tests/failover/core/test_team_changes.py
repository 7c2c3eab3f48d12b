"""Grants of changes of the team, majorities of them, seats, keys that are replaced."""

from __future__ import annotations

from itertools import combinations, product
from typing import Any

import pytest

from failover.core.team_changes import (
    GRANT_NS,
    SEATS,
    Elections,
    Grants,
    is_step_of_keys,
    missing,
    rotation,
    seats,
    step,
    unaware,
)


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


def know(*ended: str, **epochs: int) -> Elections:
    return Elections(epochs, frozenset(ended))


def test_a_change_waits_until_no_majority_after_it_can_lack_an_election() -> None:
    three, four, five = ("a", "b", "c"), ("a", "b", "c", "new"), ("a", "b", "c", "d", "e")
    two_of_three = {"a": know(x=3), "b": know(x=3), "c": know(x=2)}
    assert unaware(three, four, two_of_three) == {}, "any three of four have one that knows"
    assert unaware(four, ("a", "c", "new"), {**two_of_three, "new": know()}) == {"x": (3, ["c", "new"])}
    without_a = {"b": know(x=3), "c": know(x=2), "new": know(x=2)}
    assert unaware(four, ("b", "c", "new"), without_a) == {"x": (3, ["c", "new"])}, "a is lost"
    assert unaware(three, ("a", "b"), two_of_three) == {}
    assert unaware(five, five[:4], {name: know(x=3 if name < "d" else 2) for name in five}) == {}


def test_no_change_waits_for_an_epoch_that_was_claimed_in_vain_but_for_the_one_below_it() -> None:
    four, after = ("a", "b", "c", "d"), ("b", "c", "d")
    assert unaware(four, after, {"a": know(x=2), "b": know(x=2), "c": know(x=2), "d": know(x=3)}) == {}, "a majority lacks 3"
    assert unaware(four, after, {"a": know(x=3), "b": know(x=2), "c": know(x=1), "d": know(x=1)}) == {"x": (2, ["c", "d"])}


def test_what_has_ended_is_waited_for_nowhere_and_counts_as_known() -> None:
    four, after = ("a", "b", "c", "d"), ("b", "c", "d")
    assert unaware(four, after, {"a": know("x", x=3), "b": know(x=2), "c": know("x", x=2), "d": know("x", x=2)}) == {}
    assert unaware(four, after, {"a": know("x", x=3), "b": know(x=2), "c": know(x=2), "d": know("x", x=3)}) == {}, "not for 3"
    assert unaware(four, after, {"a": know(x=2), "b": know(x=2), "c": know("x", x=2), "d": know("x", x=2)}) == {}, "known"
    told = {"a": know(x=3, y=1), "b": know(x=3, y=1), "c": know(x=2, y=1), "d": know(x=2)}
    assert unaware(four, after, told) == {"x": (3, ["c", "d"])}, "each component by itself"


def test_etcd_counts_as_one_that_lacks_an_election_unless_there_is_a_single_member() -> None:
    told = {"a": know(x=3), "b": know(x=3)}
    assert unaware(("a", "b"), ("a", "b", "new"), told, with_etcd=True) == {}
    assert unaware(("a", "b"), ("a", "new"), told, with_etcd=True) == {"x": (3, ["new"])}, (
        "etcd and the new one would be a majority"
    )
    assert unaware(("a",), ("a", "new"), {"a": know(x=3)}, with_etcd=True) == {}, "one that etcd elected, or nothing did"


def test_a_member_whose_release_tells_no_elections_holds_no_change_up() -> None:
    assert unaware(("a", "b", "c"), ("a", "b", "c", "d"), {"a": know(x=3), "b": None, "c": None}) == {}
    four, told = ("a", "b", "c", "d"), {"a": know(x=3), "c": know(x=3), "d": know(x=2)}
    assert unaware(four, ("a", "b", "d"), {**told, "b": know(x=2)}) == {"x": (3, ["b", "d"])}
    assert unaware(four, ("a", "b", "d"), {**told, "b": None}) == {}


def elections_in_all_histories(start: int, depth: int, wait: bool) -> str:
    """Play every history of claims and changes of a small team; the first in which one epoch is elected twice, or "".

    A claim asks as many members as are a majority, or none: then it is in vain. A member that is lost tells nothing any more.
    """
    first: tuple[Any, ...] = (tuple((name, 0) for name in range(start)), frozenset(), start)
    histories: dict[Any, str] = {first: ""}
    waiting = [first]
    while waiting:
        state = waiting.pop(0)
        team, elected, following = state
        story = histories[state]
        if story.count(";") >= depth:
            continue
        told = {str(name): know(x=epoch) for name, epoch in team}
        steps: list[tuple[str, dict[str, Elections], Any]] = []
        for name, epoch in team:
            claimed = epoch + 1
            able = [other for other, known in team if other != name and known < claimed]
            majority = len(team) // 2
            for asked in [(), *combinations(able, majority)] if claimed < 3 and majority else []:
                after = tuple((one, claimed if one == name or one in asked else known) for one, known in team)
                if asked and claimed in elected:
                    return f"{story} {name} is elected in {claimed} by {asked}"
                reached = after, elected | {claimed} if asked else elected, following
                steps.append((f"{name} claims {claimed}, {asked} vote", told, reached))
        if following < start + 2:
            steps.append((f"{following} joins", told, ((*team, (following, 0)), elected, following + 1)))
        for name, _ in team if len(team) > 3 else ():
            rest = tuple(one for one in team if one[0] != name), elected, following
            without_it = {other: one for other, one in told.items() if other != str(name)}
            steps += [(f"{name} leaves", told, rest), (f"{name} is lost", without_it, rest)]
        for step_of_it, granting, reached in steps:
            members = [str(name) for name, _ in team]
            voters = [str(name) for name, _ in reached[0]]
            if wait and members != voters and unaware(members, voters, granting):
                continue
            if reached not in histories:
                histories[reached] = f"{story} {step_of_it};"
                waiting.append(reached)
    return ""


@pytest.mark.parametrize("start", [3, 4])
def test_no_history_of_claims_and_changes_elects_two_robots_in_one_epoch(start: int) -> None:
    assert elections_in_all_histories(start, 6, wait=True) == ""
    assert elections_in_all_histories(start, 6, wait=False), "the check can fail"


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
