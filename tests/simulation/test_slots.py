"""The slots of RA-TDMA on a simulated radio: every scenario in ``scenarios/slots`` comes true, and mistakes are noticed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from benchmarks.figures import percentile
from failover.core.types import MS
from tests.simulation import agreements
from tests.simulation.mutants import Mutant, mistaken
from tests.simulation.slots_mutants import SLOTS_SPOILERS
from tests.simulation.slots_story import SlotsStory
from tests.simulation.slotted import Robot, Team

FOLDER = Path(__file__).parent / "scenarios" / "slots"
SCENARIOS = sorted(FOLDER.glob("*.txt"))

AGREED_MS = 250
RUNS = 200
HOUR_NS = 3_600_000 * MS


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_the_story_comes_true(path: Path) -> None:
    for seed in (1, 2):
        SlotsStory().play(path.read_text(), seed)


@pytest.mark.parametrize(("mutant", "name"), SLOTS_SPOILERS, ids=lambda one: one if isinstance(one, str) else one.__name__)
def test_a_mistake_in_the_slots_spoils_the_story(mutant: Mutant, name: str) -> None:
    with mistaken(mutant), pytest.raises(AssertionError):
        SlotsStory().play((FOLDER / f"{name}.txt").read_text())


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("happens", [agreements.start, agreements.crash, agreements.join], ids=lambda one: one.__name__)
def test_eight_agree_within_a_quarter_of_a_second(happens: Callable[[int], int]) -> None:
    took_ms = [happens(seed) / MS for seed in range(RUNS)]
    assert percentile(took_ms, 0.99) <= AGREED_MS, f"seed {took_ms.index(max(took_ms))} took {max(took_ms):.0f} ms"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_no_set_changes_in_an_hour_in_which_one_frame_in_a_hundred_is_lost() -> None:
    team = Team(1, 4)
    team.loss = 0.01
    team.on(0, 1, 2, 3)
    team.run(1_000 * MS)
    assert team.agreed()
    changes: list[str] = []

    def look(robot: Robot) -> None:
        if robot.slots is not None and robot.slots.set != team.roster.everybody:
            changes.append(f"at {team.now_ns / MS:.0f} ms robot{robot.rank + 1} used {robot.slots.set:b}")

    team.watch = look
    while not changes and team.now_ns < HOUR_NS:
        team.run(team.now_ns + 60_000 * MS)
    assert changes == []
    assert min(len(robot.sends) for robot in team.robots) > HOUR_NS // (60 * MS)
