"""The time between two activations, in which a snapshot costs a control loop nothing. Pure.

A capture that is ready to freeze its component asks `Wait.choose`, again after each end of an activation:

    window holds the freeze                              → CAPTURE
    else, and the wait is shorter than ``lag_ns``        → WAIT
    else, right after an activation has ended            → SQUEEZE   counted, told: it delays the next activation
    else, the next one is due already and has not begun  → SQUEEZE   its task is late, or held: no window is near
    else, and the wait is longer than 2 × ``lag_ns``     → SQUEEZE   no activation ends any more, or none begins
    else                                                 → WAIT

Invariants: `CAPTURE` is never answered while an activation is under way, nor where the freeze would reach into the next one;
before ``lag_ns`` nothing but `CAPTURE` ends the wait; after 2 × ``lag_ns`` it always ends.
"""

from __future__ import annotations

import enum
import math
from collections import deque
from collections.abc import Iterable
from typing import Final

from msgspec import Struct

MARGIN_NS: Final = 200_000
"""From the end of a freeze to the next activation: a thawed thread is not at once on its processor."""

LAG_PERIODS: Final = 5
"""A capture waits for a window that holds it for so many periods of its component's snapshots: no checkpoint grows much older."""
LAG_NS_MAX: Final = 1_000_000_000
"""But no longer than this: orders on the component wait behind its capture. A wait ends after twice this time, before the keeper
that sleeps in it is taken for one that hangs (`agent.worker.components.stall_watchdog`)."""

FREEZES_KEPT: Final = 64
FREEZES_TELLING: Final = 8
FREEZE_RESERVE: Final = 1.2
FREEZE_NS_MIN: Final = 300_000
"""A freeze is expected to take as long as the last 64, and a fifth more; at least so long. From eight on the longest of them does
not count: it came of a busy machine, and would spoil the next captures."""
FREEZE_NS_AT_FIRST: Final = 1_000_000
"""Before any was measured."""

FRESH_NS: Final = 1_000_000
"""So long after an end a capture begins that will delay the next activation whenever it begins."""

MS: Final = 1_000_000


class TaskSeen(Struct, frozen=True):
    """A task of a component. Instants: CLOCK_MONOTONIC of the initial time namespace.

    Attributes:
        is_running: an activation is under way.
        ended_ns: when its last one ended.
        due_ns: when its next one is due; None: that is not known.
    """

    is_running: bool
    ended_ns: int
    due_ns: int | None


class Window(Struct, frozen=True):
    """When a component's tasks may be frozen.

    Attributes:
        begin_ns: the last of them has ended.
        end_ns: the first of them is due, less the margin; None: none of them is due again.
    """

    begin_ns: int
    end_ns: int | None

    def holds(self, now_ns: int, freeze_ns: int) -> bool:
        """Whether a freeze that begins now ends in it."""
        return now_ns >= self.begin_ns and (self.end_ns is None or now_ns + freeze_ns <= self.end_ns)


def window(tasks: Iterable[TaskSeen], margin_ns: int = MARGIN_NS) -> Window | None:
    """The window of one component: all its tasks have ended, and none is due.

    Returns:
        None while an activation is under way.
    """
    seen = list(tasks)
    if any(task.is_running for task in seen):
        return None
    dues = [task.due_ns for task in seen if task.due_ns is not None]
    begin_ns = max((task.ended_ns for task in seen), default=0)
    return Window(begin_ns, min(dues) - margin_ns if dues else None)


class Freezes:
    """How long the last freezes of one component took."""

    def __init__(self) -> None:
        self._kept: deque[int] = deque(maxlen=FREEZES_KEPT)

    def note(self, freeze_ns: int) -> None:
        """One more."""
        self._kept.append(freeze_ns)

    @property
    def expected_ns(self) -> int:
        """How long the next one may take."""
        if not self._kept:
            return FREEZE_NS_AT_FIRST
        outliers = 1 if len(self._kept) >= FREEZES_TELLING else 0
        return max(int(sorted(self._kept)[-1 - outliers] * FREEZE_RESERVE), FREEZE_NS_MIN)


class Choice(enum.Enum):
    """What a capture that is ready to freeze does now."""

    CAPTURE = "capture"
    SQUEEZE = "squeeze"
    WAIT = "wait"


class Wait:
    """The wait of one capture for its window.

    Attributes:
        asked_ns: when it began.
        lag_ns: how long it waits for a window that holds it.
        freeze_ns: how long the freeze is expected to take.
        slack_ns: the longest window that was seen, whether it was still whole or not; None: none was, or one without an end.
    """

    def __init__(self, asked_ns: int, lag_ns: int, freeze_ns: int) -> None:
        self.asked_ns = asked_ns
        self.lag_ns = lag_ns
        self.freeze_ns = freeze_ns
        self.slack_ns: int | None = None

    def choose(self, tasks: Iterable[TaskSeen], now_ns: int) -> Choice:
        """See the head of this file."""
        found, waited_ns = window(tasks), now_ns - self.asked_ns
        if found is not None:
            self._note(found)
            if found.holds(now_ns, self.freeze_ns):
                return Choice.CAPTURE
        if waited_ns < self.lag_ns:
            return Choice.WAIT
        if waited_ns >= 2 * self.lag_ns:
            return Choice.SQUEEZE
        if found is not None and (_is_fresh(found, now_ns) or _is_overdue(found, now_ns)):
            return Choice.SQUEEZE
        return Choice.WAIT

    def _note(self, found: Window) -> None:
        if found.end_ns is not None:
            self.slack_ns = max(self.slack_ns or 0, found.end_ns - found.begin_ns)


def _is_fresh(found: Window, now_ns: int) -> bool:
    """Whether an activation has just ended, and the next one is not due yet."""
    return 0 <= now_ns - found.begin_ns <= FRESH_NS and not _is_overdue(found, now_ns)


def _is_overdue(found: Window, now_ns: int) -> bool:
    """Whether none is under way although one is due: its task is late, or held."""
    return found.end_ns is not None and now_ns >= found.end_ns + MARGIN_NS


def remark(task: str, period_ns: int, slack_ns: int, freeze_ns: int, every_ns: int) -> str:
    """A sentence on a task whose slack does not hold its component's freezes.

    Args:
        period_ns: of the task; 0: it has none.
        slack_ns: 0: no window was seen, and no period is known to help.
        freeze_ns: as it is expected.
        every_ns: from one capture to the next.
    """
    short_ns = max(freeze_ns - slack_ns, 0)
    delayed = f"captures delay {task} by {_milliseconds(short_ns)} ms every {every_ns / MS:.0f} ms"
    state = f"slack {_milliseconds(slack_ns)} ms, freeze {_milliseconds(freeze_ns)} ms: {delayed}"
    return f"{state}; a period of {math.ceil((period_ns + short_ns) / MS)} ms would do" if period_ns and slack_ns else state


def _milliseconds(duration_ns: int) -> str:
    return f"{duration_ns / MS:.1f}"
