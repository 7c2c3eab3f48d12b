"""An object that is reached by two paths is one object again, cycles too; one that cannot be is refused by both names."""

from __future__ import annotations

import collections
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from failover.errors import FitError, KeepError
from failover.state import Schema
from tests.failover.state.models import Box, Cell, CheckedTrack, FrozenSlotted, Node, Pose, Settings, Track
from tests.failover.state.sameness import moved, resumed


@dataclass
class Pair:
    left: Any
    right: Any


@dataclass
class Plan:
    steps: list[Pose] = field(default_factory=list)
    current: Pose | None = None
    again: list[Pose] | None = None


@dataclass
class Reordered:
    current: Pose | None = None
    steps: list[Pose] = field(default_factory=list)


@dataclass
class Shortened:
    current: Pose | None = None


def test_the_current_step_of_a_plan_is_still_one_of_its_steps() -> None:
    plan = Plan([Pose(1), Pose(2)])
    plan.current, plan.again = plan.steps[1], plan.steps
    found = resumed(Plan, plan)
    assert found.current is found.steps[1]
    assert found.again is found.steps


@pytest.mark.parametrize(
    "shared",
    [[1], {1}, {"a": 1}, bytearray(b"x"), bytearray(9000), np.zeros(3), np.zeros(3000), collections.deque([1])],
    ids=lambda shared: type(shared).__name__,
)
def test_every_mutable_value_stays_one(shared: Any) -> None:
    found = resumed(Pair, Pair(shared, (1, [shared])))
    assert found.left is found.right[1][0]


@pytest.mark.parametrize(
    ("annotation", "shared"),
    [(Pose, Pose()), (Track, Track(1)), (Settings, {"rate": 1.0}), (CheckedTrack, CheckedTrack(1)), (list[int], [1])],
    ids=lambda part: type(part).__name__,
)
def test_every_mutable_record_stays_one(annotation: Any, shared: Any) -> None:
    found = resumed(list[annotation | None], [shared, None, shared])
    assert found[0] is found[2]


def test_a_list_that_holds_itself_does_so_again() -> None:
    value: list[Any] = [1]
    value.append((value, {"me": value}))
    found = resumed(list, value)
    assert found[1][0] is found and found[1][1]["me"] is found


def test_a_ring_of_records_is_a_ring_again() -> None:
    first = Node("a", Node("b", Node("c")))
    assert first.next is not None and first.next.next is not None
    first.next.next.next = first
    first.children.append(first.next)
    found = resumed(Node, first)
    assert found.next.next.next is found
    assert found.children[0] is found.next


def test_what_an_immutable_record_shares_stays_one() -> None:
    tags = Box[Any]([1])
    found = resumed(tuple[Box[Any], tuple[Box[Any], Cell]], (tags, (tags, Cell(1, 2))))
    assert found[0] is found[1][0]


def test_immutable_values_may_be_two() -> None:
    cell = FrozenSlotted(Cell(1, 2))
    found = resumed(list[FrozenSlotted], [cell, cell])
    assert found == [cell, cell]


def test_sharing_survives_another_order_of_fields() -> None:
    plan = Plan([Pose(1)])
    plan.current = plan.steps[0]
    found, _ = moved(Plan, plan, Reordered)
    assert found.current is found.steps[0]


def test_what_was_shared_with_a_dropped_field_is_refused_by_both_names() -> None:
    plan = Plan([Pose(1)])
    plan.current = plan.steps[0]
    with pytest.raises(FitError, match=r"kept\.current: stored as the same object as kept\.steps\[0\], which is not part"):
        moved(Plan, plan, Shortened)


def test_one_object_declared_in_two_ways_is_refused_by_both_names() -> None:
    shared = [1]
    schema = Schema.of(tuple[list[int], Any], name="kept")
    with pytest.raises(
        KeepError, match=r"kept\[1\]: it is the same object as kept\[0\], declared list\[Any\] here and list\[int\] there"
    ):
        schema.encode((shared, shared))


@pytest.mark.parametrize(
    ("left", "right"),
    [
        (lambda grid: grid, lambda grid: grid[2:5]),
        (lambda grid: grid[:50], lambda grid: grid[49:]),
        (lambda grid: grid.T, lambda grid: grid),
        (lambda grid: grid.reshape(-1), lambda grid: grid.view("i8")),
    ],
)
def test_views_of_one_memory_are_refused_by_both_names(left: Any, right: Any) -> None:
    grid = np.zeros((100, 100))
    with pytest.raises(KeepError, match=r"kept\.right: it shares memory with kept\.left .*property, or assign a copy"):
        resumed(Pair, Pair(left(grid), right(grid)))


def test_views_that_do_not_overlap_are_two_arrays() -> None:
    grid = np.arange(10000.0).reshape(100, 100)
    found = resumed(Pair, Pair(grid[:50], grid[50:]))
    assert np.array_equal(np.concatenate([found.left, found.right]), grid)
    found = resumed(Pair, Pair(grid[::2], grid[1::2]))
    assert found.right[0, 0] == 100.0


def test_an_array_over_a_bytearray_is_refused_beside_it() -> None:
    memory = bytearray(8000)
    for pair in (Pair(memory, np.frombuffer(memory)), Pair(np.frombuffer(memory), memory)):
        with pytest.raises(KeepError, match=r"kept\.right: it shares memory with kept\.left"):
            resumed(Pair, pair)


def test_a_union_that_tries_several_types_leaves_no_trace_of_those_that_failed() -> None:
    inner = [np.zeros(1000)]
    value = [inner, ["x"], inner]
    found = resumed(list[list[np.ndarray | int] | list[np.ndarray | str]], value)
    assert found[0] is found[2] and found[1] == ["x"]
