"""Whether a task has missed a deadline that it has not told yet: its activation does not end, or its process is stopped. Pure.

A task counts its own misses, when an activation ends. So all who look at the table see earlier that one hangs, and no process has
to stand beside the tasks for it.
"""

from __future__ import annotations

from failover.core.schedule.activation import State
from failover.core.schedule.layout import Live
from failover.core.schedule.terms import Terms


def past_deadline_ns(live: Live, terms: Terms, now_ns: int) -> int:
    """How long a task that a process runs is past the deadline of its activation; 0: it is not.

    Args:
        now_ns: CLOCK_MONOTONIC of the initial time namespace.
    """
    if live.state is State.RUNNING:
        limit_ns = live.limit_ns
    elif live.state in (State.WAITING, State.HELD) and terms.deadline_ns:
        limit_ns = live.due_ns + terms.deadline_ns
    else:
        return 0
    return max(now_ns - limit_ns, 0) if limit_ns else 0


def has_untold_miss(live: Live, terms: Terms, now_ns: int) -> bool:
    """Whether the task itself has still to count a miss.

    One that waits for its predecessors counts it at its deadline, before it begins.
    """
    if live.state is State.HELD or not past_deadline_ns(live, terms, now_ns):
        return False
    return live.state is not State.RUNNING or not terms.after or live.started_ns <= live.limit_ns
