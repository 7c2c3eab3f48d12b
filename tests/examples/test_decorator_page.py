"""Every program on the page of the decorator, run as often as the page shows its output."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "decorator.md"


@dataclass(frozen=True)
class Program:
    """A block of Python, and what each of its runs prints; nothing is shown for one that prints nothing."""

    text: str
    printed: tuple[str, ...]


def programs_by_heading(page: str) -> dict[str, list[Program]]:
    """Those below one heading are run in one folder, one after the other."""
    found: dict[str, list[Program]] = {}
    for part in re.split(r"^## ", page, flags=re.MULTILINE)[1:]:
        blocks = re.findall(r"```(python|text)\n(.*?)```", part, re.DOTALL)
        starts = [at for at, (kind, _) in enumerate(blocks) if kind == "python"]
        ends = [*starts[1:], len(blocks)]
        programs = [
            Program(blocks[start][1], tuple(text for _, text in blocks[start + 1 : end]) or ("",))
            for start, end in zip(starts, ends, strict=False)
        ]
        if programs:
            found[part.splitlines()[0]] = programs
    return found


HEADINGS = programs_by_heading(PAGE.read_text())
ENDLESS = "In five lines"


def run(path: Path) -> subprocess.CompletedProcess[str]:
    environment = {key: value for key, value in os.environ.items() if not key.startswith("FAILOVER_")}
    return subprocess.run([sys.executable, path], cwd=path.parent, env=environment, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("heading", [heading for heading in HEADINGS if heading != ENDLESS])
def test_every_program_on_the_page_prints_what_the_page_shows(heading: str, tmp_path: Path) -> None:
    path = tmp_path / "program.py"
    for program in HEADINGS[heading]:
        path.write_text(program.text)
        for printed in program.printed:
            ran = run(path)
            assert (ran.stdout, ran.stderr, ran.returncode) == (printed, "", 0)


def test_the_counter_is_the_one_of_the_readme() -> None:
    """That one is killed and resumed in tests/failover/kept_state/test_api.py."""
    (counter,) = HEADINGS[ENDLESS]
    assert f"```python\n{counter.text}```" in (PAGE.parent.parent / "README.md").read_text()


def test_no_program_is_overlooked() -> None:
    assert sum(len(programs) for programs in HEADINGS.values()) == PAGE.read_text().count("```python")
