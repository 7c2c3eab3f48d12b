"""What was seen on which machine: runs of the tests there, kept beside this file, and the table in docs/machines.md made of them.

pytest --junitxml=run.xml [--tracking digest] tests/checkpoint/test_tracees.py …     on that machine
python -m tests.machines.seen run.xml …                                              keeps the runs, and writes the table
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

KEPT: Final = Path(__file__).parent / "runs"
PAGE: Final = Path(__file__).parents[2] / "docs" / "machines.md"
BEGIN, END = "<!-- seen:begin (written by python -m tests.machines.seen) -->\n", "<!-- seen:end -->\n"

PASSED: Final = "passed"
FACTS: Final = ("processor", "kernel", "tracking", "page_size", "on")


@dataclass(frozen=True, slots=True)
class Seen:
    """One machine, and how each test ended there.

    Attributes:
        kernel: as uname(2) says.
        tracking: how written pages were found.
        page_size: bytes.
        on: the day.
        results: by test: "passed", "failed", or why it was skipped.
    """

    processor: str
    kernel: str
    tracking: str
    page_size: str
    on: str
    results: Mapping[str, str]

    @property
    def name(self) -> str:
        """For the head of a column."""
        large = "" if self.page_size == "4096" else f", pages of {int(self.page_size) >> 10} KiB"
        return f"{self.processor}, Linux {'.'.join(self.kernel.split('.')[:2])}, {self.tracking}{large}"

    @property
    def file(self) -> Path:
        """Where it is kept; a later run on such a machine takes its place."""
        return KEPT / f"{self.name.replace(', ', '-').replace(' ', '-').lower()}.json"


def seen_in(path: Path) -> Seen:
    """Of one run.

    Raises:
        ValueError: it says nothing of its machine.
    """
    root = ElementTree.parse(path).getroot()
    facts = {str(one.get("name")): str(one.get("value")) for one in root.iter("property")}
    if missing := [fact for fact in FACTS if fact not in facts]:
        raise ValueError(f"{path} is no run of these tests: it does not say {', '.join(missing)}")
    results = {f"{one.get('classname')}::{one.get('name')}": _result(one) for one in root.iter("testcase")}
    return Seen(**{fact: facts[fact] for fact in FACTS}, results=results)


def _result(case: ElementTree.Element) -> str:
    if case.find("failure") is not None or case.find("error") is not None:
        return "failed"
    skipped = case.find("skipped")
    return PASSED if skipped is None else str(skipped.get("message"))


def keep(runs: Iterable[Seen]) -> None:
    """Beside those of other machines; what an earlier run saw there and this one did not stays."""
    KEPT.mkdir(exist_ok=True)
    for run in runs:
        before = json.loads(run.file.read_text())["results"] if run.file.exists() else {}
        whole = asdict(run) | {"results": dict(sorted({**before, **run.results}.items()))}
        run.file.write_text(json.dumps(whole, indent=1) + "\n")


def kept() -> list[Seen]:
    """All of them, the machine that most was seen on first."""
    found = [Seen(**json.loads(path.read_text())) for path in sorted(KEPT.glob("*.json"))]
    return sorted(found, key=lambda one: (-len(one.results), one.name))


def table(machines: Sequence[Seen]) -> str:
    """A table for each test of several cases, one for all others; below them why something could not be seen."""
    tests = list(dict.fromkeys(test for one in machines for test in one.results))
    sections: dict[str, list[tuple[str, str]]] = {}
    for test in tests:
        title, _, case = test.partition("::")[2].removeprefix("test_").partition("[")
        sections.setdefault(title.replace("_", " "), []).append((case.removesuffix("]"), test))
    reasons: dict[str, int] = {}
    single = [(title, rows[0][1]) for title, rows in sections.items() if len(rows) == 1]
    parts = [_section(title, rows, machines, reasons) for title, rows in sections.items() if len(rows) > 1]
    parts.append(_section("one program each", single, machines, reasons))
    notes = "\n".join(f"{number}. {reason}" for reason, number in reasons.items())
    return "\n".join(parts) + f"\nWhy something could not be seen there:\n\n{notes}\n"


def _section(title: str, rows: list[tuple[str, str]], machines: Sequence[Seen], reasons: dict[str, int]) -> str:
    lines = [f"### {title[0].upper()}{title[1:]}", "", _row("", [one.name for one in machines]), "|---|" + "---|" * len(machines)]
    lines += [_row(name, [_cell(one, test, reasons) for one in machines]) for name, test in rows]
    return "\n".join(lines) + "\n"


def _row(name: str, cells: Sequence[str]) -> str:
    return f"| {name} | {' | '.join(cells)} |"


def _cell(machine: Seen, test: str, reasons: dict[str, int]) -> str:
    result = machine.results.get(test)
    if result is None:
        return "–"
    if result in (PASSED, "failed"):
        return {PASSED: "yes", "failed": "**no**"}[result]
    return f"({reasons.setdefault(result, len(reasons) + 1)})"


def written() -> str:
    """The page as it must be."""
    before, begin, rest = PAGE.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{begin}{table(kept())}{end}{after}"


if __name__ == "__main__":
    keep(map(seen_in, map(Path, sys.argv[1:])))
    PAGE.write_text(written())
