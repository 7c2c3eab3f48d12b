"""Every scenario in ``scenarios/`` comes true."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.simulation.mutants import SPOILERS, Mutant, mistaken
from tests.simulation.scenario import Story

FOLDER = Path(__file__).parent / "scenarios"
SCENARIOS = sorted(FOLDER.glob("*.txt"))


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_the_story_comes_true(path: Path) -> None:
    Story().play(path.read_text())


@pytest.mark.sampled(2)
@pytest.mark.slow
@pytest.mark.parametrize(("mutant", "name"), SPOILERS, ids=lambda one: one if isinstance(one, str) else one.__name__)
def test_a_mistake_in_the_rules_spoils_the_story(mutant: Mutant, name: str) -> None:
    with mistaken(mutant), pytest.raises(AssertionError):
        Story().play((FOLDER / f"{name}.txt").read_text())
