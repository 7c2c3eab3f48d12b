"""Names and the order W."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from failover.core.wire.names import check_component, check_robot, weight
from failover.errors import NameFormatError


@pytest.mark.parametrize(
    ("lesser", "greater"),
    [
        ("robot1", "robot2"),
        ("robot2", "robot10"),
        ("Робот2", "Робот10"),
        ("robot", "robot1"),
        ("robot٢", "robot١٠"),
        ("ロボット2", "ロボット10"),
        ("a1b2", "a1b10"),
    ],
)
def test_the_order_is_the_one_a_person_expects(lesser: str, greater: str) -> None:
    assert weight(lesser) < weight(greater)


def test_full_width_digits_count_like_others() -> None:
    assert weight("robot２") < weight("robot10")


@given(st.lists(st.text(max_size=8), min_size=3, max_size=3))
def test_the_order_is_total_and_only_equal_texts_are_equal(names: list[str]) -> None:
    for one, other in itertools.permutations(names, 2):
        assert (weight(one) == weight(other)) == (one == other)
    backwards = names[::-1]
    assert sorted(names, key=weight) == sorted(backwards, key=weight)


@pytest.mark.parametrize("name", ["/lab/robot1/mapper", "/a", "/лаб/робот/карта"])
def test_a_path_names_a_component(name: str) -> None:
    assert check_component(name) == name


@pytest.mark.parametrize("name", ["", "/", "a", "a/b", "/a/", "/a//b", "/a/../b", "/a b", "/a\n", "/" + "x" * 200, "/\ud800"])
def test_anything_else_does_not(name: str) -> None:
    with pytest.raises(NameFormatError):
        check_component(name)


@pytest.mark.parametrize("name", ["", "a/b", "a b", "x" * 64, "é" * 32])
def test_a_robot_has_a_short_plain_name(name: str) -> None:
    with pytest.raises(NameFormatError):
        check_robot(name)
