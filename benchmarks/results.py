"""The written result: a page for people and the same for machines."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Final

from benchmarks.figures import OURS, Findings, table
from benchmarks.machine import STOLEN_SHARE

PAGE: Final = "RESULTS.md"
RECORD: Final = "results.json"


def page(command: str, facts: Mapping[str, str], warning: str, findings: Sequence[Findings]) -> str:
    """Everything on one page."""
    heading = [
        "# Benchmarks: the newest figures",
        f"`{command}`, all of it in one run. Compare rows of one table, not two machines; the last column is a row's median "
        f"divided by that of {OURS} in the same case. [OTHERS.md](OTHERS.md) holds figures of others that were recorded "
        "elsewhere.",
        *([f"**{warning}.**"] if warning else []),
        "\n".join(f"* {key}: {value}" for key, value in facts.items()),
    ]
    return "\n\n".join([*heading, *(section(found) for found in findings)]) + "\n"


def section(found: Findings) -> str:
    """One benchmark: its story, its table, and the makers that are missing, with reasons."""
    parts = [f"## {found.title}", found.story]
    parts += [table(found.figures)] if found.figures else []
    if found.stolen >= STOLEN_SHARE:
        parts += [f"**The host gave {found.stolen:.0%} of this machine's time to others meanwhile.**"]
    parts += [f"Not measured: {one.who}: {one.reason}." for one in found.absent]
    return "\n\n".join(parts)


def record(command: str, facts: Mapping[str, str], findings: Sequence[Findings]) -> str:
    """The same as JSON, with every single value."""
    whole = {"command": command, "machine": dict(facts), "findings": [asdict(found) for found in findings]}
    return json.dumps(whole, ensure_ascii=False, separators=(",", ":")) + "\n"


def write(directory: Path, command: str, facts: Mapping[str, str], warning: str, findings: Sequence[Findings]) -> None:
    """Write both files."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / PAGE).write_text(page(command, facts, warning, findings))
    (directory / RECORD).write_text(record(command, facts, findings))
