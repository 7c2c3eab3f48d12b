"""Status tells of a program that stands still for longer than its operator allows it, on whichever robot it runs."""

from __future__ import annotations

from pathlib import Path

from tests.e2e import robots
from tests.e2e.test_takeover import start_counting

NEVER_KEPT = '[components."/demo/robot1/count"]\nfreeze_budget_ms = 0.001\nfreeze_overrun_s = 0.001\n'
ALWAYS_KEPT = '[components."/demo/robot1/count"]\nfreeze_budget_ms = 10000\n'

SAID = "longer than its freeze_budget_ms of 0.001"


def test_a_budget_that_is_not_kept_is_told_at_every_robot_that_runs_it(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, NEVER_KEPT) as (first, second):
        start_counting(first, 1_000_000)
        robots.until(lambda: SAID in robots.failover(first, "status").stdout, "the budget to be missed")
        assert robots.component(first, "count")["freeze_budget_missed"] > 0
        assert not robots.component(second, "count")["freeze_budget_missed"]
        robots.until_protected(first)
        first.cut_power()
        robots.until(lambda: SAID in robots.failover(second, "status").stdout, "the budget to be missed at robot2")


def test_a_budget_that_is_kept_is_no_matter(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, ALWAYS_KEPT) as (first, second):
        start_counting(first, 1_000_000)
        robots.until(lambda: robots.checkpoints(second, "count") >= 5, "checkpoints at robot2")
        assert not robots.component(first, "count")["freeze_budget_missed"]
        assert "freeze_budget_ms" not in robots.failover(first, "status").stdout
