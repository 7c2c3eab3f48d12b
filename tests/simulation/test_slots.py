"""The slots of RA-TDMA on a simulated radio: every scenario in ``scenarios/slots`` comes true, and mistakes are noticed."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.simulation.slots_story import SlotsStory

FOLDER = Path(__file__).parent / "scenarios" / "slots"
SCENARIOS = sorted(FOLDER.glob("*.txt"))


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_the_story_comes_true(path: Path, seed: int) -> None:
    SlotsStory().play(path.read_text(), seed)
