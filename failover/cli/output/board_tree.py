"""The board as rows of text: robot → item → value, age, bound, rate, state. Pure: values in, text out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from failover.cli.output.team_tree import Mood, Row, milliseconds, size

COLUMNS: Final = ("", "value", "age", "of its bound", "rate", "state")
TOP_COLUMNS: Final = ("item", "puts", "size", "age p50", "age p99", "bound", "frames", "lost", "refused")

VALUE_WIDTH: Final = 60
BAR_WIDTH: Final = 10


def ms(span_ns: int | None) -> float | None:
    """Nanoseconds in milliseconds, to a microsecond."""
    return None if span_ns is None else round(span_ns / 1_000_000, 3)


def span(span_ns: int | None) -> str:
    """0.31 ms, 98 ms, 4.2 s; "–" when it is not known."""
    if span_ns is None:
        return "–"
    return f"{span_ns / 1_000_000:.2f} ms" if span_ns < 10_000_000 else milliseconds(span_ns / 1_000_000)


def bar(age_ns: int | None, bound_ns: int) -> str:
    """How much of its bound an age has used: ``[####......] 120 ms``; "" without a bound."""
    if not bound_ns:
        return ""
    used = BAR_WIDTH if age_ns is None else min(BAR_WIDTH, -(-age_ns * BAR_WIDTH // bound_ns))
    return f"[{'#' * used}{'.' * (BAR_WIDTH - used)}] {span(bound_ns)}"


def rate(per_s: float | None) -> str:
    """20/s, 0.5/s; "" where it is not known."""
    if per_s is None:
        return ""
    return f"{per_s:.0f}/s" if per_s >= 10 or per_s == 0 else f"{per_s:.1f}/s"


def shortened(text: str) -> str:
    """A value on one line."""
    return text if len(text) <= VALUE_WIDTH else text[: VALUE_WIDTH - 1] + "…"


def rows(answer: Mapping[str, Any], text_of: Any) -> list[Row]:
    """The tree of an answer of ``failover board --json``; ``text_of``: a value as JSON."""
    found = []
    for name, robot in answer["robots"].items():
        is_here = name == answer["robot"]
        state = "this robot" if is_here else "simulated" if robot.get("simulated") else robot["state"]
        age = "" if is_here or robot["age_ms"] is None else span(_ns(robot["age_ms"]))
        found.append(Row((name, "", age, "", "", state), "good" if robot["state"] == "run" else "warning"))
        items = [item for item in answer["items"] if item["robot"] == name]
        for index, item in enumerate(items):
            branch = "└─ " if index == len(items) - 1 else "├─ "
            found.append(_row(branch, item, text_of))
        if not items:
            found.append(Row(("└─ no items", "", "", "", "", ""), "quiet"))
    return found


def _row(branch: str, item: Mapping[str, Any], text_of: Any) -> Row:
    state, mood = _state(item)
    private = " (private)" if item["area"] == "private" else ""
    age_ns, most_ns, bound_ns = (_ns(item[key]) for key in ("age_ms", "age_max_ms", "bound_ms"))
    value = "" if item["put"] == 0 or item["complaint"] else shortened(text_of(item["value"]))
    age, bound = ("", "") if age_ns is None else (span(age_ns), bar(most_ns, bound_ns or 0))
    return Row((f"{branch}{item['item']}{private}", value, age, bound, rate(item["rate_per_s"]), state), mood)


def _ns(milliseconds_: float | None) -> int | None:
    return None if milliseconds_ is None else round(milliseconds_ * 1_000_000)


def _state(item: Mapping[str, Any]) -> tuple[str, Mood]:
    if item["complaint"]:
        return item["complaint"], "bad"
    if not item["put"]:
        return "never put", "quiet"
    return ("stale", "warning") if item["stale"] else ("fresh", "good")


def top_rows(items: Sequence[Mapping[str, Any]]) -> list[Row]:
    """The table of an answer of ``failover board top --json``, the most bytes a second first."""
    ordered = sorted(items, key=lambda item: -(item["rate_per_s"] or 0) * item["size"])
    return [
        Row(
            (
                f"{item['robot']}/{item['item']}",
                rate(item["rate_per_s"]),
                size(item["size"]),
                span(_ns(item["age_p50_ms"])),
                span(_ns(item["age_p99_ms"])),
                span(_ns(item["bound_ms"])) if item["bound_ms"] else "",
                str(item["frames"] or ""),
                str(item["lost"] or ""),
                str(item["refused"] or ""),
            ),
            _state(item)[1],
        )
        for item in ordered
    ]
