"""Computes when the next step begins: a period counted from one beginning, so that a late step delays no later one. Pure."""

from __future__ import annotations

import enum
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final


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
        self._due += 1
        late = (now_ns - self.begin_ns) // self.period_ns - self._due + 1
        if late > 0 and now_ns > self.begin_ns + self._due * self.period_ns:
            self.overruns += late
            self._due += late
        return self.begin_ns + self._due * self.period_ns


class Finished(enum.Enum):
    """What a step returns when it was the last one."""

    FINISHED = "finished"


FINISHED: Final = Finished.FINISHED


Step = Callable[[], object]
