"""Misses that a task has not told yet."""

from __future__ import annotations

import pytest

from failover.core.schedule.activation import State
from failover.core.schedule.hanging import has_untold_miss, past_deadline_ns
from failover.core.schedule.layout import Live
from failover.core.schedule.terms import Terms

TERMS = Terms(period_ns=100, deadline_ns=80)
AFTER = Terms(period_ns=100, deadline_ns=80, after=(3,))


@pytest.mark.parametrize(
    ("live", "terms", "past", "is_untold"),
    [
        (Live(state=State.RUNNING, due_ns=1000, started_ns=1010, limit_ns=1080), TERMS, 120, True),
        (Live(state=State.RUNNING, due_ns=1000, started_ns=1010, limit_ns=1200), TERMS, 0, False),
        (Live(state=State.RUNNING, due_ns=1000, started_ns=1010, limit_ns=0), Terms(period_ns=100), 0, False),
        (Live(state=State.WAITING, due_ns=1000), TERMS, 120, True),
        (Live(state=State.WAITING, due_ns=1150), TERMS, 0, False),
        (Live(state=State.HELD, due_ns=1000), AFTER, 120, False),
        (Live(state=State.RUNNING, due_ns=1000, started_ns=1090, limit_ns=1080), AFTER, 120, False),
        (Live(state=State.RUNNING, due_ns=1000, started_ns=1070, limit_ns=1080), AFTER, 120, True),
        (Live(state=State.IDLE, due_ns=1000), TERMS, 0, False),
        (Live(state=State.DONE, due_ns=1000), TERMS, 0, False),
    ],
)
def test_a_task_is_past_its_deadline(live: Live, terms: Terms, past: int, is_untold: bool) -> None:
    assert past_deadline_ns(live, terms, 1200) == past
    assert has_untold_miss(live, terms, 1200) == is_untold
