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
