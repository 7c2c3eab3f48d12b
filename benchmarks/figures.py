"""Figures: one case measured many times, and how a table of them is written."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Figure:
    """One case of one benchmark; ``values`` in ``unit``, in the order they were measured."""

    benchmark: str
    case: str
    unit: str
    values: tuple[float, ...]

    @property
    def median(self) -> float:
        """The middle one."""
        return statistics.median(self.values)


def table(figures: Sequence[Figure]) -> str:
    """A Markdown table."""
    lines = ["| benchmark | case | unit | min | median | p95 | max | n |", "|---|---|---|---|---|---|---|---|"]
    for figure in figures:
        ordered = sorted(figure.values)
        p95 = ordered[min(len(ordered) - 1, round(0.95 * (len(ordered) - 1)))]
        numbers = " | ".join(f"{value:.2f}" for value in (ordered[0], figure.median, p95, ordered[-1]))
        lines.append(f"| {figure.benchmark} | {figure.case} | {figure.unit} | {numbers} | {len(ordered)} |")
    return "\n".join(lines)
