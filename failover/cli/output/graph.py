"""Who talks to whom, as rows of text and as a graph for Graphviz. Pure: values in, text out."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

from failover.cli.output.team_tree import Row

COLUMNS: Final = ("from", "to", "verb", "messages", "bytes", "errors", "p99")


def rows(edges: Sequence[Mapping[str, Any]]) -> list[Row]:
    """A line for each edge, the busiest first."""
    return [
        Row(
            (
                *(str(one[key]) for key in ("from", "to", "verb", "count", "bytes", "errors")),
                "–" if one["p99_us"] is None else f"{one['p99_us'] / 1_000:g} ms",
            ),
            "warning" if one["errors"] else "good",
        )
        for one in edges
    ]


def dot(edges: Sequence[Mapping[str, Any]]) -> str:
    """A directed graph; an edge is as thick as its share of the messages."""
    most = max((one["count"] for one in edges), default=1) or 1  # of one that came over an hour ago only its end may count
    lines = ["digraph team {", "  rankdir=LR;"]
    for one in edges:
        label = f"{one['verb']}: {one['count']}" + (f", {one['errors']} errors" if one["errors"] else "")
        ends = f"{_quoted(one['from'])} -> {_quoted(one['to'])}"
        lines.append(f"  {ends} [label={_quoted(label)}, penwidth={1 + 4 * one['count'] / most:.1f}];")
    return "\n".join([*lines, "}"])


def _quoted(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
