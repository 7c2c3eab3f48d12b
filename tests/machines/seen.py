"""Results per machine: runs of the tests there, kept beside this file, and the tables of docs/machines.md.

pytest --junitxml=run.xml [--tracking digest] tests/checkpoint/test_tracees.py …     on that machine
python -m tests.machines.seen run.xml …                                              keeps the runs, and writes the tables
"""

from __future__ import annotations

import json
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

KEPT: Final = Path(__file__).parent / "runs"
PAGE: Final = Path(__file__).parents[2] / "docs" / "machines.md"
BEGIN, END = "<!-- seen:begin (written by python -m tests.machines.seen) -->\n", "<!-- seen:end -->\n"

PASSED: Final = "passed"
FAILED: Final = "failed"
NOT_RUN: Final = "not run there"
NAMED_MAX: Final = 2
"""Tests that a case is named with; of more, their count."""
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
        return FAILED
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
    """The machines; tests that passed whole on all of them; of the others, how many cases passed where; why the rest did not."""
    letters = {one.name: chr(ord("A") + place) for place, one in enumerate(machines)}
    cases = _cases_by_title(machines)
    kinds = [_row(letters[one.name], [one.name, one.on]) for one in machines]
    counts = {title: [_count(one, tests.values()) for one in machines] for title, tests in cases.items()}
    whole = [title for title, cells in counts.items() if set(cells) == {str(len(cases[title]))}]
    others = [_row(title, cells) for title, cells in counts.items() if title not in whole]
    parts = (
        [_row("", ["machine", "last run"]), "|---|---|---|", *kinds],
        ["Whole on every machine (cases in brackets):"],
        [f"* {title}{f' ({len(cases[title])})' if len(cases[title]) > 1 else ''}" for title in whole],
        ["The others, cases that passed:"],
        [_row("test", list(letters.values())), "|---|" + "---|" * len(machines), *others],
        ["Why the rest could not be tried:"],
        [_row("reason", ["cases", "machines"]), "|---|---|---|", *_missing(machines, letters, cases)],
    )
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _cases_by_title(machines: Sequence[Seen]) -> Mapping[str, Mapping[str, str]]:
    """By each test its cases ("" of a test without any), and their names in the runs; those of most cases first."""
    found: dict[str, dict[str, str]] = {}
    for test in dict.fromkeys(test for one in machines for test in one.results):
        title, _, case = test.partition("::")[2].removeprefix("test_").partition("[")
        title = f"{title[0].upper()}{title[1:]}".replace("_", " ")
        found.setdefault(title, {})[case.removesuffix("]")] = test
    return dict(sorted(found.items(), key=lambda one: -len(one[1])))


def _count(machine: Seen, tests: Collection[str]) -> str:
    results = [machine.results.get(test) for test in tests]
    passed, failed = results.count(PASSED), results.count(FAILED)
    told = f"{passed} of {len(tests)}" if passed < len(tests) else str(passed)
    return f"{told}, **{failed} failed**" if failed else told


def _missing(machines: Sequence[Seen], letters: Mapping[str, str], cases: Mapping[str, Mapping[str, str]]) -> Iterator[str]:
    """A row for each reason and set of machines."""
    found: dict[tuple[str, str], dict[str, list[str]]] = {}
    for title, tests in cases.items():
        for case, test in tests.items():
            where: dict[str, str] = {}
            for one in machines:
                if (result := one.results.get(test, NOT_RUN)) != PASSED:
                    where[result] = where.get(result, "") + letters[one.name]
            for reason, which in where.items():
                found.setdefault((reason.partition(": /")[0], which), {}).setdefault(case, []).append(title)
    for (reason, which), titles in sorted(found.items()):
        together: dict[tuple[str, ...], list[str]] = {}
        for case, of in titles.items():
            together.setdefault(tuple(of), []).append(case)
        yield _row(reason, ["; ".join(_told(names, of) for of, names in together.items()), " ".join(which)])


def _told(cases: Sequence[str], titles: Sequence[str]) -> str:
    of = " / ".join(titles) if len(titles) <= NAMED_MAX else f"{len(titles)} tests"
    return f"{', '.join(cases)} ({of})" if any(cases) else of


def _row(name: str, cells: Sequence[str]) -> str:
    return f"| {name} | {' | '.join(cells)} |"


def written() -> str:
    """The page as it must be."""
    before, begin, rest = PAGE.read_text().partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{begin}{table(kept())}{end}{after}"


if __name__ == "__main__":
    keep(map(seen_in, map(Path, sys.argv[1:])))
    PAGE.write_text(written())
