"""Every story in ``scenarios/`` comes true."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.simulation.scenario import Story

SCENARIOS = sorted((Path(__file__).parent / "scenarios").glob("*.txt"))


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_the_story_comes_true(path: Path) -> None:
    Story().play(path.read_text())
