"""The team's names, and the way of a message, as rows of text. Pure: values in, text out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from failover.cli.output.team_tree import Mood, Row

COLUMNS: Final = ("", "kind", "robot", "aliases", "verbs", "addresses", "state")
PATH_COLUMNS: Final = ("where", "took", "at least", "at most")

STEP: Final = "  "


def rows(names: Sequence[Mapping[str, Any]]) -> list[Row]:
    """The tree of an answer of ``failover names --json``: a line for each step of a path, what stands there in columns."""
    found: list[Row] = []
    before: tuple[str, ...] = ()
    for one in names:
        steps = tuple(one["path"].split("/"))
        shared = _shared(before, steps[:-1])
        for depth in range(shared, len(steps) - 1):
            found.append(Row((STEP * depth + steps[depth], *[""] * 6), "quiet"))
        found.append(_row(STEP * (len(steps) - 1) + steps[-1], one))
        before = steps
    return found


def _shared(before: tuple[str, ...], steps: tuple[str, ...]) -> int:
    """How many steps the last line's path and this one have in common."""
    for depth, step in enumerate(steps):
        if depth >= len(before) or before[depth] != step:
            return depth
    return len(steps)


def _row(name: str, one: Mapping[str, Any]) -> Row:
    state, mood = _state(one)
    cells = (", ".join(one["aliases"]), " ".join(one["verbs"]), " ".join(one["addresses"]))
    return Row((name, one["kind"], one["robot"], *cells, state), mood)


def _state(one: Mapping[str, Any]) -> tuple[str, Mood]:
    if one["refused"]:
        return one["refused"], "bad"
    if one["rivals"]:
        return f"conflict with {', '.join(one['rivals'])}", "warning"
    return one["reach"], "good" if one["reach"] == "live" else "warning"


def path_rows(parts: Sequence[Mapping[str, Any]]) -> list[Row]:
    """Where a message spent its time: waiting and travelling in turn."""
    return [
        Row(
            (
                f"{part['who']} → {part['to']}" if part["to"] else part["who"],
                _ms(part["took_ms"]),
                _ms(part["at_least_ms"]),
                _ms(part["at_most_ms"]) if part["at_most_ms"] is not None else "not bounded",
            ),
            "good",
        )
        for part in parts
    ]


def _ms(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f} ms"
