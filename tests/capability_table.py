"""Writes the table of what comes back into docs/capabilities.md: ``./run table``, after a row was changed."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from checkpoint.capability import Area, Capability
from checkpoint.engines import capability_table

PAGE = Path(__file__).parent.parent / "docs" / "capabilities.md"
BEGIN, END = "<!-- capabilities:begin (written by ./run table) -->\n", "<!-- capabilities:end -->\n"


HEAD = "| thing | verdict | how it comes back, or what to do instead |\n|---|---|---|\n"


def line_of(row: Capability) -> str:
    """One thing with its verdict and its sentence."""
    return f"| {row.kind} | {row.verdict.value} | {row.sentence} |"


def whole() -> str:
    """Every row, a table for each area."""
    parts = []
    for area in Area:
        lines = "\n".join(line_of(row) for row in capability_table.rows() if row.area == area)
        parts.append(f"## {area.value[0].upper()}{area.value[1:]}\n\n{HEAD}{lines}\n")
    return "\n".join(parts)


def row_of(sentence: str) -> Capability | None:
    """The row that a refusal or note belongs to, by the words that it says; None where no row has them."""
    return next((row for row in capability_table.rows() for part in row.said if _pattern(part).search(sentence)), None)


@cache
def _pattern(part: str) -> re.Pattern[str]:
    return re.compile(".*".join(map(re.escape, part.split("{}"))))


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
    """The document as it must be."""
    return {PAGE: put_into(PAGE.read_text(), whole())}


if __name__ == "__main__":
    for path, text in written().items():
        path.write_text(text)
