"""Live memory of this process, whose written pages are known: no written page is left out, however it was written."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from checkpoint.linux.memory import own_memory
from checkpoint.linux.memory.own_memory import LiveMemory
from checkpoint.segment.layout import PAGE

COUNT = 64


@pytest.fixture
def memory() -> Iterator[LiveMemory]:
    made = LiveMemory()
    yield made
    made.close()


def followed(memory: LiveMemory) -> np.ndarray:
    array = memory.array((COUNT * PAGE,), np.dtype("u1"))
    if memory.note:
        pytest.skip(memory.note)
    return array


def taken(memory: LiveMemory, array: np.ndarray, owner: str = "grid") -> list[int] | None:
    memory.look()
    held = memory.at(array.ctypes.data)
    assert held is not None
    written = held.take(owner)
    return None if written is None else written.tolist()


def test_just_the_written_pages_are_told_once(memory: LiveMemory) -> None:
    array = followed(memory)
    assert taken(memory, array) == []
    array[3 * PAGE] = array[9 * PAGE + 7] = 1
    assert taken(memory, array) == [3, 9]
    assert taken(memory, array) == []
    array[3 * PAGE] = 2
    assert taken(memory, array) == [3]


def test_every_write_is_told_whatever_wrote_it(memory: LiveMemory, tmp_path: Path) -> None:
    """Against a comparison with a copy: by numpy, by the kernel (readinto), many and few, two arrays, looks without a taking."""
    array, other = followed(memory), followed(memory)
    dice = random.Random(5)
    (tmp_path / "bytes").write_bytes(bytes(range(256)) * 64)
    copies = [array.copy(), other.copy()]
    for _ in range(200):
        for written in (array, other):
            for _ in range(dice.randrange(4)):
                start = dice.randrange(COUNT * PAGE - 5 * PAGE)
                match dice.randrange(4):
                    case 0:
                        written[start] = dice.randrange(256)
                    case 1:
                        written[start : start + 4 * PAGE] = dice.randrange(256)
                    case 2:
                        with open(tmp_path / "bytes", "rb", buffering=0) as file:
                            file.readinto(written[start : start + 3 * PAGE].data)
                    case 3:
                        written[:] = np.roll(written, 1)
        if dice.random() < 0.3:
            memory.look()
            continue
        for written, copy in zip((array, other), copies, strict=True):
            told = taken(memory, written)
            assert told is not None
            differing = np.flatnonzero((written != copy).reshape(-1, PAGE).any(axis=1)).tolist()
            assert set(differing) <= set(told)
            copy[:] = written


def test_after_another_owner_or_a_cut_everything_is_compared(memory: LiveMemory) -> None:
    array = followed(memory)
    assert taken(memory, array, "grid") == []
    assert taken(memory, array, "map") is None
    assert taken(memory, array, "map") == []
    memory.distrust()
    assert taken(memory, array, "map") is None
    assert taken(memory, array, "map") == []


def test_where_the_kernel_tells_nothing_that_is_said_and_everything_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(own_memory, "number_of", {}.get)
    memory = LiveMemory()
    array = memory.array((COUNT * PAGE,), np.dtype("u1"))
    assert "compared" in memory.note
    assert taken(memory, array) is None
    assert taken(memory, array) is None
    memory.close()


def test_an_array_is_zeros_of_the_shape_that_was_asked_for(memory: LiveMemory) -> None:
    array = memory.array((3, 5, 7), np.dtype("<f4"))
    assert array.shape == (3, 5, 7) and array.dtype == np.dtype("<f4") and not array.any()
    assert array.flags.writeable and array.flags.c_contiguous
