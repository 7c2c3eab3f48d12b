"""A component returns by itself to its preferred robot, as soon as that robot lacks nothing of what it needs."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from failover.core.events import Handover, Inquired, Prefer, TeamChanged
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
    assert seen_at(world, "robot2", PART).standby in ("robot1", "robot3"), "whichever voted first"
    assert later(world, LONG_MS) == ["robot2"]
    assert seen_at(world, "robot2", PART).standby == "robot1", "its home"


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


def three(prefer: str = "") -> World:
    """Of a pair's rule: it was started at robot1, which was lost, and runs at robot2, protected by robot3. Robot1 is off."""
    specs = (ComponentSpec(PART, home="robot1", launch=Launch(("part",)), rules=Rules(prefer=prefer)),)
    world = World(1, pair(specs, ("robot1", "robot2", "robot3")))
    for name in world.robots:
        world.power_on(name)
    assert later(world, 1_000) == ["robot1"]
    world.power_off("robot1")
    assert later(world, 1_500) == ["robot2"] and seen_at(world, "robot2", PART).standby == "robot3"
    return world


def cut_off(world: World, *others: str) -> None:
    """Robot1, from these."""
    world.network.cuts |= {way for other in others for way in (("robot1", other), (other, "robot1"))}


def test_a_robot_that_takes_no_snapshot_gives_its_place_back_to_the_standby_before_it() -> None:
    world = three()
    world.robots["robot1"].broken_store = True
    world.power_on("robot1")
    assert later(world, LONG_MS) == ["robot2"]
    seen = seen_at(world, "robot2", PART)
    assert (seen.standby, str(seen.protection)) == ("robot3", "protected")
    told = [one.sentence for one in world.robots["robot2"].told]
    assert sum("robot1 is its standby" in sentence for sentence in told) == 1, "it is not tried again and again"


def test_a_robot_that_was_cut_off_stands_by_only_when_it_has_been_back_for_some_time() -> None:
    world = three()
    world.power_on("robot1")
    later(world, 1_000)
    cut_off(world, "robot2", "robot3")
    later(world, 2_100)
    world.network.cuts.clear()
    later(world, 1_000)
    assert seen_at(world, "robot2", PART).standby == "robot3"
    later(world, 3_000)
    assert seen_at(world, "robot2", PART).standby == "robot1"


def test_a_late_answer_of_a_robot_that_was_taken_out_of_the_team_changes_nothing() -> None:
    world = three()
    core = world.robots["robot2"].node
    assert core is not None
    world.power_on("robot1")
    later(world, 3_000)
    epoch = seen_at(world, "robot2", PART).epoch
    config = world.robots["robot2"].config
    now_ns = world.local(world.robots["robot2"])
    core.step(TeamChanged(replace(config, peers=("robot3",))), now_ns)
    core.step(Inquired(PART, epoch, "robot1"), now_ns)


def test_of_three_robots_the_copy_that_never_stopped_stays_though_another_one_has_heard_the_other_copy_first() -> None:
    world = three()
    world.power_on("robot1")
    later(world, 4_000)
    assert seen_at(world, "robot2", PART).standby == "robot1"
    cut_off(world, "robot2", "robot3")
    assert later(world, 2_100) == ["robot1", "robot2"]
    world.network.cuts.clear()
    cut_off(world, "robot2")
    later(world, 200)
    world.network.cuts.clear()
    assert later(world, 2_000) == ["robot2"]
    assert "never stopped acting" in " ".join(one.sentence for one in world.robots["robot2"].told)


def test_a_robot_that_ran_it_before_tells_the_age_of_the_checkpoint_it_takes_over_from_and_not_of_its_own_last_one() -> None:
    world = at_robot1(lacks=())
    assert later(world, 1_000) == ["robot2"]
    world.command("robot2", Prefer(world.request(), PART, "robot1"))
    assert later(world, LONG_MS) == ["robot1"]
    world.power_off("robot1")
    assert later(world, LONG_MS) == ["robot2"]
    claim = next(one for one in reversed(world.robots["robot2"].told) if " claims epoch " in one.sentence)
    assert 0 <= claim.facts.checkpoint_age_ns < 1_000 * MS
