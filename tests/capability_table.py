"""Writes the table of what comes back into README.md and docs/capabilities.md: ``./run table``, after a row was changed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from checkpoint import capabilities
from checkpoint.capability import Capability, Verdict

ROOT = Path(__file__).parent.parent
BEGIN, END = "<!-- capabilities:begin (written by ./run table) -->\n", "<!-- capabilities:end -->\n"


def line_of(row: Capability) -> str:
    """A row with its sentence."""
    return f"| {row.kind} | {row.verdict.value} | {row.sentence} |"


def whole() -> str:
    """Every row, a table for each area."""
    parts = []
    for area, rows in capabilities.by_area().items():
        lines = "\n".join(line_of(row) for row in rows)
        parts.append(f"## {area.value[0].upper()}{area.value[1:]}\n\n| | | |\n|---|---|---|\n{lines}\n")
    return "\n".join(parts)


def short() -> str:
    """The kinds by area and verdict, without sentences."""
    verdicts = " | ".join(verdict.value for verdict in Verdict)
    lines = [f"| | {verdicts} |", f"|---|{'---|' * len(Verdict)}"]
    for area, rows in capabilities.by_area().items():
        cells = ["; ".join(row.kind for row in rows if row.verdict == verdict) for verdict in Verdict]
        lines.append(f"| {area.value} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def put_into(text: str, table: str) -> str:
    """A document with the table between its two marks.

    Raises:
        ValueError: it has none.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"no place for the table: {BEGIN.strip()} … {END.strip()} is missing")
    return f"{before}{BEGIN}{table}{END}{after}"


def written() -> Mapping[Path, str]:
    """Each document as it must be."""
    tables = {ROOT / "README.md": short(), ROOT / "docs" / "capabilities.md": whole()}
    return {path: put_into(path.read_text(), table) for path, table in tables.items()}


if __name__ == "__main__":
    for path, text in written().items():
        path.write_text(text)
