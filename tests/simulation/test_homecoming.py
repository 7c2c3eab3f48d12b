"""A component returns by itself to its preferred robot, as soon as that robot lacks nothing of what it needs."""

from __future__ import annotations

import pytest

from failover.core.events import Handover, Prefer
from failover.core.types import MS, ComponentSpec, Launch, Rules
from tests.simulation.deeds import LACK
from tests.simulation.invariants import seen_at
from tests.simulation.teams import elective, pair
from tests.simulation.world import World

PART = "/team/part"
LONG_MS = 15_000


def at_robot1(lacks: tuple[str, ...]) -> World:
    """It runs at robot1, protected by robot2, which is preferred from now on and lacks this."""
    world = World(1, pair((ComponentSpec(PART, launch=Launch(("part",))),)))
    world.robots["robot2"].lacks = lacks
    for name in world.robots:
        world.power_on(name)
    world.run(2_000 * MS)
    assert world.acting(PART) == ["robot1"] and seen_at(world, "robot1", PART).standby == "robot2"
    world.command("robot1", Prefer(world.request(), PART, "robot2"))
    return world


def later(world: World, ms: int) -> list[str]:
    world.run(world.now_ns + ms * MS)
    return world.acting(PART)


def notes(world: World) -> str:
    return " ".join(seen_at(world, "robot1", PART).notes)


def test_it_goes_to_a_robot_that_lacks_nothing() -> None:
    world = at_robot1(lacks=())
    assert later(world, 1_000) == ["robot2"]


def test_it_waits_while_the_robot_lacks_something_and_status_says_what() -> None:
    world = at_robot1(LACK)
    assert later(world, LONG_MS) == ["robot1"]
    assert f"its return waits: robot2 could not resume it: {LACK[0]}" in notes(world)
    told = [one.sentence for one in world.robots["robot1"].told]
    assert sum("it does not return to robot2" in sentence for sentence in told) == 1
    assert not any("handover" in sentence or "hand it over" in sentence for sentence in told), "it was never held still for that"
    world.robots["robot2"].lacks = ()
    assert later(world, LONG_MS) == ["robot2"]
    assert "waits" not in notes(world)


def test_what_its_operator_says_meanwhile_counts() -> None:
    world = at_robot1(LACK)
    assert later(world, 1_000) == ["robot1"] and "its return waits: robot2" in notes(world)
    world.command("robot1", Prefer(world.request(), PART, ""))
    world.robots["robot2"].lacks = ()
    assert later(world, LONG_MS) == ["robot1"] and "waits" not in notes(world)


def test_what_one_robot_lacked_is_not_said_of_the_one_that_is_preferred_then() -> None:
    world = at_robot1(LACK)
    assert later(world, 1_000) == ["robot1"] and "its return waits: robot2" in notes(world)
    world.command("robot1", Prefer(world.request(), PART, "robot2"))
    assert "waits" not in notes(world), "it is asked anew"


def brought(home: str, rules: Rules, to: str) -> World:
    """Three robots that vote; a program of that home runs where it was sent. Until then that robot is its standby."""
    world = World(1, elective(3, (ComponentSpec(PART, home=home, launch=Launch(("part",)), rules=rules),)))
    for name in world.robots:
        world.power_on(name)
    world.run(2_000 * MS)
    (first,) = world.acting(PART)
    if first != to:
        assert seen_at(world, first, PART).standby == to
        world.command(first, Handover(world.request(), PART, to))
    assert later(world, 2_000) == [to]
    return world


def test_the_robot_where_it_was_started_stands_by_after_a_handover_so_that_it_can_go_back() -> None:
    world = brought("robot3", Rules(), to="robot3")
    world.command("robot3", Handover(world.request(), PART, seen_at(world, "robot3", PART).standby))
    (away,) = later(world, LONG_MS)
    assert away != "robot3"
    assert seen_at(world, away, PART).standby == "robot3", "though another robot's name is less"


def test_where_it_runs_on_the_robot_that_its_operator_chose_as_standby_another_one_stands_by() -> None:
    world = brought("robot1", Rules(standby="robot2"), to="robot2")
    assert seen_at(world, "robot2", PART).standby == "robot1"


@pytest.mark.parametrize("rule", ["pair", "majority"])
@pytest.mark.parametrize("prefer", ["robot1", ""])
def test_of_three_robots_the_lost_one_stands_by_once_it_is_back_and_is_returned_to_where_it_is_preferred(
    rule: str, prefer: str
) -> None:
    specs = (ComponentSpec(PART, home="robot1", launch=Launch(("part",)), rules=Rules(prefer=prefer)),)
    world = World(1, elective(3, specs) if rule == "majority" else pair(specs, ("robot1", "robot2", "robot3")))
    world.robots["robot1"].lacks = LACK
    for name in world.robots:
        world.power_on(name)
    assert later(world, 2_000) == ["robot1"]
    world.power_off("robot1")
    assert later(world, 3_000) == ["robot2"] and seen_at(world, "robot2", PART).standby == "robot3"
    world.power_on("robot1")
    assert later(world, LONG_MS) == ["robot2"]
    assert seen_at(world, "robot2", PART).standby == "robot3", "it could not resume it, so the protection stays as it is"
    world.robots["robot1"].lacks = ()
    (at,) = later(world, 2 * LONG_MS)
    assert at == (prefer or "robot2")
    assert prefer or seen_at(world, "robot2", PART).standby == "robot1"
