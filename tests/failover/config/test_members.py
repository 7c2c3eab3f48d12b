"""The next team: seats that are not given again at once, members that left, keys that belong to one member."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from failover.config import members, team
from failover.config.team import FORMER_LIMIT, Robot, Team
from failover.errors import TeamFileError


def robot(number: int, key: str = "") -> Robot:
    return Robot((f"10.0.0.{number}:7420",), f"10.0.0.{number}:7421", public_key=key)


PRESENT = Team("lab", {"a": robot(1), "b": robot(2), "c": robot(3)})


def test_the_seat_of_one_that_left_is_not_the_next_ones(tmp_path: Path) -> None:
    team.write(tmp_path, members.left(PRESENT, "c", "a"))
    after = members.joined(team.read(tmp_path), "d", robot(4))
    assert {name: one.seat for name, one in after.robots.items()} == {"a": 0, "b": 1, "d": 3}
    assert after.next_seat == 4 and after.change == 2


def test_who_left_is_remembered_in_the_file_until_it_is_back_or_another_has_its_place(tmp_path: Path) -> None:
    gone = members.left(PRESENT, "c", "a")
    team.write(tmp_path, gone)
    assert team.read(tmp_path) == gone and gone.former["c"].bulk == "10.0.0.3:7421"
    assert not members.joined(gone, "c", robot(9)).former
    assert not members.joined(gone, "d", robot(3)).former, "it has the same address"
    assert members.joined(gone, "d", robot(4)).former == gone.former


def test_so_many_are_remembered() -> None:
    present = replace(PRESENT, former={f"f{number}": robot(100 + number) for number in range(FORMER_LIMIT)})
    after = members.left(present, "c", "a")
    assert len(after.former) == FORMER_LIMIT and "c" in after.former and "f0" not in after.former


def test_two_members_with_one_key_are_refused(tmp_path: Path) -> None:
    twice = Team("lab", {"a": robot(1, "k" * 40), "b": robot(2, "k" * 40)})
    team.write(tmp_path, twice)
    with pytest.raises(TeamFileError, match="b and a have the same public key"):
        team.read(tmp_path)
    with pytest.raises(TeamFileError, match="same public key"):
        members.joined(replace(twice, robots={"a": twice.robots["a"]}), "b", twice.robots["b"])


# --- Keys -------------------------------------------------------------------------------------------------------------

KEYED = Team("lab", {"a": robot(1, "k" * 40), "b": robot(2, "l" * 40)})


def test_a_second_key_comes_and_the_first_goes_and_the_file_has_both_meanwhile(tmp_path: Path) -> None:
    both = members.with_next_key(KEYED, "a", "m" * 40)
    team.write(tmp_path, both)
    assert team.read(tmp_path) == both and both.robots["a"].keys == ("k" * 40, "m" * 40) and both.change == 1
    one = members.with_one_key(both, "a", "m" * 40)
    assert one.robots["a"].keys == ("m" * 40,) and one.change == 2
    assert {name: one.seat for name, one in one.robots.items()} == {"a": 0, "b": 1}
    assert members.is_rotation(KEYED.robots["a"], both.robots["a"]), "though it has got its first seat"
    assert members.is_rotation(both.robots["a"], one.robots["a"])


def test_no_key_takes_the_place_of_another_one_at_once_and_no_address_changes_with_it() -> None:
    before = KEYED.robots["a"]
    after = replace(before, next_key="m" * 40)
    assert not members.is_rotation(before, replace(before, public_key="m" * 40))
    assert not members.is_rotation(before, replace(after, bulk="10.0.0.9:7421"))
    assert not members.is_rotation(replace(before, seat=1), replace(after, seat=2))
    assert not members.is_rotation(before, before)


def test_a_second_key_that_is_another_members_or_no_second_one_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TeamFileError, match="same public key"):
        members.with_next_key(KEYED, "a", "l" * 40)
    with pytest.raises(TeamFileError, match="next_key of a is for a second key"):
        members.with_next_key(KEYED, "a", "k" * 40)
    with pytest.raises(TeamFileError, match="has 3 characters"):
        members.with_next_key(KEYED, "a", "mmm")
    team.write(tmp_path, replace(KEYED, robots={"a": replace(robot(1), next_key="m" * 40)}))
    with pytest.raises(TeamFileError, match="next_key of a is for a second key"):
        team.read(tmp_path)


def test_a_former_member_with_a_key_that_is_to_be_another_ones_is_forgotten() -> None:
    gone = replace(KEYED, former={"z": robot(9, "m" * 40)})
    assert not members.with_next_key(gone, "a", "m" * 40).former
