"""Which arrays of a first value move into live memory, and which stay where their program may know them."""

from __future__ import annotations

import weakref
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from failover.kept_state.api import Task, open_task
from failover.state import Schema

LARGE = 1 << 20


@dataclass
class Layer:
    heights: NDArray[np.float32] = field(default_factory=lambda: np.ones((512, 512), np.float32))


@dataclass
class Map:
    grid: NDArray[np.uint8] = field(default_factory=lambda: np.ones(LARGE, np.uint8))
    layers: list[Layer] = field(default_factory=lambda: [Layer(), Layer()])


def task_of(value: Any, folder: Path) -> Task:
    return open_task("map", lambda name: Schema.of(type(value), value, name=name), lambda *_: value, folder)


def is_live(task: Task, array: NDArray[Any]) -> bool:
    return task.state.live.at(array.ctypes.data) is not None


def test_large_arrays_of_a_default_move_into_live_memory_with_what_they_hold(tmp_path: Path) -> None:
    value = Map()
    task = task_of(value, tmp_path)
    assert task.value is value
    assert is_live(task, value.grid) and all(is_live(task, layer.heights) for layer in value.layers)
    assert value.grid.all() and value.layers[1].heights.shape == (512, 512) and value.layers[1].heights.all()
    task.commit()
    value.grid[5] = 9
    task.commit()
    task.close()
    again = task_of(Map(), tmp_path)
    assert again.value.grid[4:7].tolist() == [1, 9, 1]
    again.close()


@pytest.mark.parametrize("holding", [lambda array: array, lambda array: array[3:], memoryview, weakref.ref])
def test_an_array_that_the_program_could_know_stays_where_it_is(tmp_path: Path, holding: Any) -> None:
    value = Map()
    held = holding(value.grid)
    before = value.grid.ctypes.data
    task = task_of(value, tmp_path)
    assert value.grid.ctypes.data == before and held is not None
    task.close()


def test_an_array_that_is_reached_by_two_ways_stays_one(tmp_path: Path) -> None:
    shared = np.ones(LARGE, np.uint8)
    value = {"first": shared, "second": shared}
    del shared
    task = task_of(value, tmp_path)
    assert value["first"] is value["second"] and not is_live(task, value["first"])
    task.close()
