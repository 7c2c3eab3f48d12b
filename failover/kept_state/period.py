"""Computes when the next step begins: a period counted from one beginning, so that a late step delays no later one. Pure."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from failover.core.schedule.course import Course


@dataclass(slots=True)
class Activations:
    """The steps of a component, counted.

    Attributes:
        period_ns: 0 for steps that follow one another at once.
        begin_ns: CLOCK_MONOTONIC at the first step.
        steps: that were begun.
        overruns: beginnings that were missed because a step was still under way.
    """

    period_ns: int
    begin_ns: int
    steps: int = 0
    overruns: int = 0
    _due: int = field(default=0, repr=False)

    def next_ns(self, now_ns: int) -> int:
        """When the next step begins; beginnings that lie in the past are counted and skipped."""
        self.steps += 1
        if not self.period_ns:
            return now_ns
        course = Course(0, self.begin_ns, self.period_ns)
        before, self._due = self._due, course.following(self._due, now_ns)
        self.overruns += self._due - before - 1
        return course.due_ns(self._due)


class Finished(enum.Enum):
    """What a step returns when it was the last one."""

    FINISHED = "finished"


FINISHED: Final = Finished.FINISHED


Step = Callable[[], object]
