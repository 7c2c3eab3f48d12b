"""Figures: one case measured many times, and how a table of them is written, side by side with the alternatives."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

OURS: Final = "failover"
"""The row that the others of its case are divided by."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One case of one benchmark; ``values`` in ``unit``, in the order they were measured.

    Attributes:
        who: the maker that was measured: `OURS`, or an alternative in the same case.
    """

    benchmark: str
    case: str
    unit: str
    values: tuple[float, ...]
    who: str = OURS

    @property
    def median(self) -> float:
        """The middle one."""
        return statistics.median(self.values)


@dataclass(frozen=True, slots=True)
class Absent:
    """An alternative that was not measured, and why not."""

    who: str
    reason: str


@dataclass(frozen=True, slots=True)
class Findings:
    """The results of one benchmark.

    Attributes:
        title: heading of its table.
        story: one paragraph about the measurement.
        stolen: of the cores' time meanwhile, the share that the host of a virtual machine gave to others.
    """

    title: str
    story: str
    figures: tuple[Figure, ...]
    absent: tuple[Absent, ...] = ()
    stolen: float = 0.0


def percentile(values: Sequence[float], share: float) -> float:
    """The value below which ``share`` (0 to 1) of all lie, by the nearest rank."""
    ordered = sorted(values)
    return ordered[round(share * (len(ordered) - 1))]


def ratio(figure: Figure, figures: Sequence[Figure]) -> float | None:
    """The median beside ours in the same case; None for ours, without one, or where ours is nought."""
    if figure.who == OURS:
        return None
    case = (figure.benchmark, figure.case, figure.unit)
    ours = [one for one in figures if one.who == OURS and (one.benchmark, one.case, one.unit) == case]
    return figure.median / ours[0].median if ours and ours[0].median else None


def table(figures: Sequence[Figure]) -> str:
    """A Markdown table; the columns of alternatives and ratios only where there are any."""
    compared = any(figure.who != OURS for figure in figures)
    lines = [_line(figure, ratio(figure, figures), compared) for figure in figures]
    head = ["measured", "case", *(["by"] if compared else []), "unit", "min", "median", "p95", "p99", "max", "n"]
    head += [f"÷ {OURS}"] if compared else []
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *lines))


def _line(figure: Figure, beside: float | None, compared: bool) -> list[str]:
    values = figure.values
    late = percentile(values, 0.95), percentile(values, 0.99)
    numbers = [number(value) for value in (min(values), figure.median, *late, max(values))]
    closing = ["" if beside is None else f"{number(beside)} ×"] if compared else []
    return [figure.benchmark, figure.case, *([figure.who] if compared else []), figure.unit, *numbers, str(len(values)), *closing]


def number(value: float) -> str:
    """Three digits that matter, no exponent."""
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
