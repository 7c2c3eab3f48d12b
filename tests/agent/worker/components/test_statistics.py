"""Figures of a component in status beyond counts: commits that no longer come, a processor that has too little."""

from __future__ import annotations

from agent.worker.components.component import Captured
from agent.worker.components.statistics import Commits, Figures
from checkpoint.model import Position

MS = 10**6
SECOND = 10**9


def committing(every_ns: int, count: int) -> Commits:
    commits = Commits()
    for number in range(1, count + 1):
        commits.note(10 * number, 10 * number * every_ns)  # a capture sees every tenth
    return commits


def test_a_program_is_measured_by_what_it_used_to_do() -> None:
    often, seldom = committing(10 * MS, 20), committing(60 * SECOND, 20)
    assert (often.usual_ns, seldom.usual_ns) == (10 * MS, 60 * SECOND)
    assert not often.is_overdue(often.newest_ns + 1_900 * MS), "two seconds at least"
    assert often.is_overdue(often.newest_ns + 2_100 * MS)
    assert not seldom.is_overdue(seldom.newest_ns + 590 * SECOND)
    assert "last commit 14 s ago, before that there was one every 0.010 s" in often.remark(often.newest_ns + 14 * SECOND)


def test_a_program_that_committed_once_is_given_more_time() -> None:
    once = committing(10 * MS, 1)
    assert not Commits().is_overdue(100 * SECOND), "nothing was committed: that is told otherwise"
    assert not once.is_overdue(once.newest_ns + 9 * SECOND)
    assert once.is_overdue(once.newest_ns + 11 * SECOND)
    assert "its only one" in once.remark(once.newest_ns + 11 * SECOND)


def test_a_capture_that_finds_nothing_new_changes_nothing() -> None:
    commits = committing(10 * MS, 20)
    before = commits.newest_ns
    commits.note(200, before)
    assert (commits.usual_ns, commits.newest_ns) == (10 * MS, before)


def test_the_hit_rate_of_the_cache_counts_deltas_alone() -> None:
    figures, base, delta = Figures(), Position(1, 1, bytes(16)), Position(1, 2, bytes(16))
    figures.captured(Captured(base, None, -1, 900, 500, 8192, ()))
    assert figures.xor_hit_rate is None
    figures.captured(Captured(delta, base, -1, 300, 500, 8192, (), known_bytes=4096))
    figures.captured(Captured(delta, base, -1, 100, 500, 8192, (), known_bytes=8192))
    assert figures.xor_hit_rate == 0.75


def test_what_misses_its_budget_is_told_with_how_much_was_copied() -> None:
    figures, base = Figures(), Position(1, 1, bytes(16))
    figures.captured(Captured(base, None, -1, 900, 4_999, 8192, ()), budget_ms=5)
    assert not figures.budget.remark(5)
    figures.captured(Captured(base, None, -1, 900, 14_200, 8192, (), frozen_bytes=3_200_000), budget_ms=5)
    figures.captured(Captured(base, None, -1, 900, 300, 8192, ()), budget_ms=5)
    assert figures.budget.remark(5) == (
        "it stood still for longer than its freeze_budget_ms of 5 in 1 of 3 snapshots, "
        "last for 14.2 ms, in which 3.2 MB were copied"
    )
    assert figures.budget.missed == 1
