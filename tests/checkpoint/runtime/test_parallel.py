"""Work that is done in several threads gives the same results as in one."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator

import pytest

from checkpoint.runtime import parallel


def pieces(count: int, trouble: str = "") -> Iterator[int]:
    """So many numbers, and then trouble, if there is any."""
    yield from range(count)
    if trouble:
        raise ValueError(trouble)


def square(number: int) -> int:
    """A piece of work; 70 is too much for it."""
    if number == 70:
        raise ValueError("70")
    return number * number


def scheduled() -> tuple[int, int]:
    """Policy and priority of the calling thread."""
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_answers_come_in_order(threads: int) -> None:
    assert list(parallel.in_order(square, pieces(60), threads)) == [n * n for n in range(60)]


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize(("count", "words"), [(60, "no more"), (100, "70")])
def test_trouble_is_raised_in_its_place_and_no_thread_is_left(threads: int, count: int, words: str) -> None:
    before, answers = threading.active_count(), parallel.in_order(square, pieces(count, "no more"), threads)
    expected = [n * n for n in range(min(count, 70))]
    assert [next(answers) for _ in expected] == expected
    with pytest.raises(ValueError, match=words):
        next(answers)
    assert threading.active_count() == before


def test_who_begins_is_not_far_ahead_of_who_takes() -> None:
    begun: list[int] = []
    answers = parallel.in_order(begun.append, pieces(1000), 2)
    next(answers)
    answers.close()
    assert len(begun) <= 2 * parallel.AHEAD


def test_where_no_thread_may_be_born_the_work_is_done_all_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    assert list(parallel.in_order(square, pieces(60), 2)) == [n * n for n in range(60)]


@pytest.mark.root
def test_those_that_work_for_who_comes_first_come_first_too() -> None:
    before = os.sched_getscheduler(0)
    os.sched_setscheduler(0, os.SCHED_RR | os.SCHED_RESET_ON_FORK, os.sched_param(3))
    try:
        found = set(parallel.in_order(lambda _: scheduled(), range(20), 2))
    finally:
        os.sched_setscheduler(0, before & ~os.SCHED_RESET_ON_FORK, os.sched_param(0))
    assert found == {(os.SCHED_RR | os.SCHED_RESET_ON_FORK, 3)}
