"""How late activations began and how long they took: counts in steps of a tenth of a millisecond, for percentiles. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

STEP_NS: Final = 100_000
STEPS: Final = 2_000
"""What is above 200 ms counts as that; the longest is remembered itself."""


class Spans:
    """Spans of time, counted."""

    def __init__(self, counts: Sequence[int] = (), longest_ns: int = 0) -> None:
        self.counts = [*counts] or [0] * STEPS
        self.longest_ns = longest_ns

    def note(self, span_ns: int) -> None:
        """One more."""
        self.counts[min(max(span_ns, 0) // STEP_NS, STEPS - 1)] += 1
        self.longest_ns = max(self.longest_ns, span_ns)

    def add(self, other: Spans) -> None:
        """All those of another one."""
        self.counts = [one + two for one, two in zip(self.counts, other.counts, strict=True)]
        self.longest_ns = max(self.longest_ns, other.longest_ns)

    def below_ms(self, part: float) -> float:
        """So large a part of them was not longer, rounded up to a step; 0.0 where there are none."""
        wanted, passed = part * sum(self.counts), 0
        for step, count in enumerate(self.counts if wanted else ()):
            passed += count
            if passed >= wanted:
                return min((step + 1) * STEP_NS, self.longest_ns) / 1e6
        return 0.0

    def told(self) -> dict[str, Any]:
        """Half, 99 of 100, and the longest, in ms."""
        return {
            "p50": round(self.below_ms(0.5), 3),
            "p99": round(self.below_ms(0.99), 3),
            "max": round(self.longest_ns / 1e6, 3),
        }
