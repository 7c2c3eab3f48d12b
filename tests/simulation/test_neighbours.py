"""A protects B while B protects A: no spare computer stands idle, and whichever robot is lost, both components live on."""

from __future__ import annotations

import pytest

from failover.core.types import MS, ComponentSpec, Launch, Rules, WhenAlone
from tests.simulation.invariants import Invariants
from tests.simulation.teams import elective, pair
from tests.simulation.world import World

A, B = "/team/a", "/team/b"
AT_HOME = {A: ["robot1"], B: ["robot2"]}
ABSENCE_NS = 1_000 * MS
RETURN_NS = 4_000 * MS


def neighbours(servers: int = 0, alone: WhenAlone = WhenAlone.RUN) -> World:
    """``/team/a`` runs at robot1, ``/team/b`` at robot2, each protected by the other robot."""
    specs = tuple(
        ComponentSpec(name, launch=Launch(("part",)), rules=Rules(prefer=home, when_alone=alone))
        for name, (home,) in AT_HOME.items()
    )
    never_twice = {A, B} if servers or alone is WhenAlone.FREEZE else set()
    configs = elective(2, specs, servers, patience_ms=1_000) if servers else pair(specs)
    world = World(1, configs, (Invariants(safe=never_twice, votes=servers > 0),))
    for name in world.robots:
        world.power_on(name)
    after(world, RETURN_NS)
    assert acting(world) == AT_HOME
    return world


def after(world: World, pause_ns: int) -> None:
    world.run(world.now_ns + pause_ns)


def until_the_server_has_all(world: World) -> None:
    """Until no robot has a newer checkpoint of either."""
    while any(newest(world, "server1", name) < newest(world, robot, name) for robot in ("robot1", "robot2") for name in (A, B)):
        after(world, MS)


def newest(world: World, robot: str, component: str) -> int:
    """The count in its newest checkpoint."""
    return world.values[world.robots[robot].store[component][-1]]


def acting(world: World) -> dict[str, list[str]]:
    return {name: world.acting(name) for name in (A, B)}


@pytest.mark.parametrize("servers", [0, 1])
def test_each_of_two_that_protect_each_other_loses_its_power_in_turn_and_both_components_live_on(servers: int) -> None:
    world = neighbours(servers)
    for lost, other in (("robot1", "robot2"), ("robot2", "robot1")):
        world.power_off(lost)
        after(world, ABSENCE_NS)
        assert acting(world) == {A: [other], B: [other]}
        world.power_on(lost)
        after(world, RETURN_NS)
        assert acting(world) == AT_HOME


def test_where_safety_was_chosen_what_the_lost_robot_ran_lives_on_and_what_it_protected_stands_still_until_it_is_back() -> None:
    world = neighbours(alone=WhenAlone.FREEZE)
    for lost, lives_on in (("robot1", {A: ["robot2"], B: []}), ("robot2", {A: [], B: ["robot1"]})):
        world.power_off(lost)
        after(world, ABSENCE_NS)
        assert acting(world) == lives_on
        world.power_on(lost)
        after(world, RETURN_NS)
        assert acting(world) == AT_HOME


def test_each_of_two_that_protect_each_other_is_cut_off_in_turn_and_nothing_acts_twice() -> None:
    world = neighbours(servers=1)
    for lost, other in (("robot1", "robot2"), ("robot2", "robot1")):
        world.network.cuts = {way for one in world.robots if one != lost for way in ((lost, one), (one, lost))}
        after(world, ABSENCE_NS)
        assert acting(world) == {A: [other], B: [other]}
        world.network.cuts.clear()
        after(world, RETURN_NS)
        assert acting(world) == AT_HOME


def test_two_that_choose_safety_and_are_cut_from_each_other_stand_still_and_exchange_their_components() -> None:
    world = neighbours(alone=WhenAlone.FREEZE)
    world.network.cuts = {("robot1", "robot2"), ("robot2", "robot1")}
    after(world, ABSENCE_NS)
    assert acting(world) == {A: ["robot2"], B: ["robot1"]}
    world.network.cuts.clear()
    after(world, RETURN_NS)
    assert acting(world) == AT_HOME


def test_both_are_dead_one_is_back_with_a_new_disk_and_the_server_returns_both_components() -> None:
    world = neighbours(servers=1)
    until_the_server_has_all(world)  # what the robot that stays away has besides would be lost
    kept = {name: world.values[world.robots["server1"].store[name][-1]] for name in (A, B)}
    world.power_off("robot2")
    world.power_off("robot1")
    world.new_disk("robot2", vote_record=True)
    after(world, 500 * MS)
    world.power_on("robot2")
    after(world, RETURN_NS)
    assert acting(world) == {A: ["robot2"], B: ["robot2"]}
    assert all(world.robots["robot2"].programs[name].value >= kept[name] for name in (A, B))


def test_a_robot_that_lost_its_store_waits_for_the_standby_before_it_goes_on_from_what_the_server_has() -> None:
    world = neighbours(servers=1)
    until_the_server_has_all(world)
    world.network.cuts = {way for one in ("robot1", "robot2") for way in (("server1", one), (one, "server1"))}
    after(world, ABSENCE_NS)
    kept = newest(world, "robot2", A)
    assert newest(world, "server1", A) < kept
    world.power_off("robot2")
    world.power_off("robot1")
    world.new_disk("robot1", vote_record=False)
    world.network.cuts.clear()
    world.power_on("robot1")
    after(world, 700 * MS)
    assert acting(world) == {A: [], B: []}
    world.power_on("robot2")
    after(world, RETURN_NS)
    assert acting(world) == AT_HOME
    assert world.robots["robot1"].programs[A].value >= kept
