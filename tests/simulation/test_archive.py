"""What the status says where members vote and a robot has but a copy of the archive."""

from __future__ import annotations

from pathlib import Path

import pytest

from failover.core.events import Release
from failover.core.types import MS, State
from tests.simulation.chaos import life
from tests.simulation.invariants import seen_at, state_at
from tests.simulation.scenario import COMPONENT, Story

STORY = Path(__file__).parent / "scenarios" / "a_copy_of_the_archive_waits_for_the_standby_that_holds_more.txt"
WAITS = STORY.read_text().partition("3140  acts nobody")[0] + "2900  acts nobody\n"
"""Up to where robot2 and robot3 have copies, and robot1 is off."""

PART = "/team/part0"
ENDED_FOR_A_SERVER = 607
"""In this life all robots lose their disks and vote records after a declared program has ended; a server remembers that."""


@pytest.mark.parametrize("robot", ["robot2", "robot3"], ids=["a third robot", "the robot that ran it"])
def test_it_names_the_robot_for_which_it_waits_and_the_order_that_does_not_wait(robot: str) -> None:
    world = Story().play(WAITS)
    (note,) = [note for note in seen_at(world, robot, COMPONENT).notes if "may hold more" in note]
    assert note == (
        f"NOT PROTECTED: robot1 may hold more than the archive: {robot} waits 1 s at most; start what is off; "
        f"failover promote {COMPONENT} resumes it from its copy at {robot} at once"
    )


def test_the_order_that_does_not_wait_resumes_it_from_the_copy() -> None:
    Story().play(f"{WAITS}2900  promote robot2\n3100  acts robot2")


def test_it_names_the_server_that_says_that_it_has_ended_and_the_two_orders() -> None:
    world = life(ENDED_FOR_A_SERVER, archive=True)
    (note,) = [note for note in seen_at(world, "robot1", PART).notes if "has ended" in note]
    assert note.startswith("NOT PROTECTED: server1 says that it has ended, and no robot remembers that: failover promote ")
    assert note.endswith(f"failover release {PART} forgets it")
    world.command("robot1", Release(world.request(), PART))
    world.run(world.now_ns + 1_000 * MS)
    assert {state_at(world, robot, PART) for robot in ("robot1", "robot2")} == {State.RELEASED}
