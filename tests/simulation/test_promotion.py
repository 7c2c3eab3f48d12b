"""`failover promote`: which components an operator's order brings to life, and which risks the operator is told before."""

from __future__ import annotations

import pytest

from failover.core.events import Promote
from failover.core.types import MS, ComponentSpec, Launch, OnLoss, Rules, State, WhenAlone
from tests.simulation.invariants import seen_at, state_at
from tests.simulation.planned import with_grace
from tests.simulation.teams import elective, pair
from tests.simulation.world import World

PART = "/team/part"
HOLD = Rules(on_loss=OnLoss.HOLD)
FREEZE = Rules(when_alone=WhenAlone.FREEZE)


def two_robots(rules: Rules) -> World:
    """It runs at robot1, protected by robot2."""
    world = World(1, pair((ComponentSpec(PART, launch=Launch(("part",)), rules=rules),)))
    for name in world.robots:
        world.power_on(name)
    world.run(2_000 * MS)
    assert world.acting(PART) == ["robot1"] and seen_at(world, "robot1", PART).standby == "robot2"
    return world


def later(world: World, ms: int = 1_000) -> list[str]:
    world.run(world.now_ns + ms * MS)
    return world.acting(PART)


def told(world: World, robot: str, *, is_trial: bool = False) -> str:
    """The status that an operator gets at that robot."""
    world.command(robot, Promote(world.request(), PART, is_trial))
    world.run(world.now_ns + 500 * MS)
    return world.log[-1]


@pytest.mark.parametrize("rules", [HOLD, Rules(on_loss=OnLoss.HOLD, when_alone=WhenAlone.FREEZE)])
def test_what_on_loss_holds_back_runs_at_the_standby_when_it_is_promoted(rules: Rules) -> None:
    world = two_robots(rules)
    world.power_off("robot1")
    assert later(world) == []
    epoch = seen_at(world, "robot2", PART).epoch
    told(world, "robot2")
    assert later(world) == ["robot2"] and seen_at(world, "robot2", PART).epoch > epoch + 1
    world.power_on("robot1")
    assert later(world, 3_000) == ["robot2"], "who is back does not take newer state back"


def test_what_freeze_holds_still_goes_on_where_it_stands_when_it_is_promoted() -> None:
    world = two_robots(FREEZE)
    world.power_off("robot2")
    assert later(world) == [] and state_at(world, "robot1", PART) is State.FROZEN
    value, epoch = world.robots["robot1"].programs[PART].value, seen_at(world, "robot1", PART).epoch
    told(world, "robot1")
    assert later(world) == ["robot1"] and seen_at(world, "robot1", PART).epoch > epoch + 1
    assert world.robots["robot1"].programs[PART].value > value
    world.power_on("robot2")
    assert later(world, 3_000) == ["robot1"] and seen_at(world, "robot1", PART).standby == "robot2"


def test_a_claim_that_waits_for_consent_goes_on_when_it_is_promoted() -> None:
    world = two_robots(FREEZE)
    world.power_off("robot1")
    world.power_off("robot2")
    world.power_on("robot1")
    assert later(world, 5_000) == []
    told(world, "robot1")
    assert later(world) == ["robot1"]


def test_two_that_ran_it_at_once_agree_on_the_promoted_one_when_they_meet() -> None:
    world = two_robots(HOLD)
    world.network.cuts |= {("robot1", "robot2"), ("robot2", "robot1")}
    assert later(world) == ["robot1"]
    told(world, "robot2")
    assert later(world) == ["robot1", "robot2"]
    epochs = {seen_at(world, robot, PART).epoch for robot in world.robots}
    assert len(epochs) == 2, "a fencing token belongs to one of them"
    world.network.cuts.clear()
    assert later(world) == ["robot2"]


def test_an_operator_is_told_of_a_copy_that_may_act_and_nothing_is_done() -> None:
    world = two_robots(HOLD)
    world.power_off("robot1")
    later(world, 2_000)
    sentence = told(world, "robot2", is_trial=True)
    assert "would resume at robot2 from checkpoint" in sentence and "the work since then is lost" in sentence
    assert "robot1 has not been heard for 2 s; if it lives it may run it too" in sentence
    assert later(world) == []


def test_a_primary_that_stands_still_by_its_lease_is_no_risk() -> None:
    world = two_robots(Rules(on_loss=OnLoss.HOLD, when_alone=WhenAlone.FREEZE))
    world.power_off("robot1")
    later(world)
    assert "robot1 has not been heard" not in told(world, "robot2", is_trial=True)


def test_nobody_is_promoted_beside_a_primary_that_is_heard() -> None:
    world = two_robots(HOLD)
    assert "robot1 lives and has it" in told(world, "robot2")
    assert "here it is primary" in told(world, "robot1")


def test_without_a_majority_nobody_can_be_promoted() -> None:
    world = World(1, elective(2, (ComponentSpec(PART, launch=Launch(("part",))),), servers=1))
    for name in world.robots:
        world.power_on(name)
    later(world, 2_000)
    world.power_off("server1")
    world.power_off("robot1")
    assert later(world) == []
    assert "of 3 that vote robot2 hears 1 and needs 2" in told(world, "robot2")
    assert later(world) == []
    world.power_on("server1")
    assert later(world, 3_000) == ["robot2"]


def three_with_a_server(rules: Rules) -> World:
    """It ran at robot1; its standby is lost with it, so that only the server has a checkpoint."""
    world = World(1, elective(3, (ComponentSpec(PART, launch=Launch(("part",)), rules=rules),), servers=1, witnesses=1))
    for name in world.robots:
        world.power_on(name)
    later(world, 2_000)
    (primary,) = world.acting(PART)
    standby = seen_at(world, primary, PART).standby
    world.power_off(primary)
    world.power_off(standby)
    assert later(world) == []
    return world


def test_a_robot_without_a_checkpoint_gets_it_from_the_server_when_it_is_promoted() -> None:
    world = three_with_a_server(HOLD)
    (last,) = [name for name, robot in world.robots.items() if robot.node and name.startswith("robot")]
    kept = world.robots["server1"].store[PART][-1]
    assert not world.robots[last].store.get(PART)
    assert f"from checkpoint {kept.sequence}, which server1 keeps and sends first" in told(world, last, is_trial=True)
    assert later(world, 3_000) == [], "no operator asked for it yet"
    assert f"{PART} runs at {last}" in told(world, last)
    assert later(world) == [last] and world.robots[last].programs[PART].value >= world.values[kept]


def test_who_waits_for_a_checkpoint_is_told_when_it_cannot_be_stored() -> None:
    world = three_with_a_server(HOLD)
    (last,) = [name for name, robot in world.robots.items() if robot.node and name.startswith("robot")]
    world.robots[last].broken_store = True
    assert "it could not be stored: no space left" in told(world, last)
    world.robots[last].broken_store = False
    told(world, last)
    assert later(world) == [last]


def test_who_waits_for_a_checkpoint_is_told_when_its_keeper_is_lost() -> None:
    world = three_with_a_server(HOLD)
    (last,) = [name for name, robot in world.robots.items() if robot.node and name.startswith("robot")]
    world.command(last, Promote(world.request(), PART))
    world.power_off("server1")
    later(world)
    assert "server1 is not heard any more; try again" in world.log[-1]
    assert "holds a checkpoint of it" in told(world, last)


def test_an_operator_is_told_whose_restart_a_promotion_waits_for() -> None:
    specs = (ComponentSpec(PART, launch=Launch(("part",))),)
    world = World(1, with_grace(pair(specs, ("robot1", "robot2", "robot3")), 9_000))
    for name in world.robots:
        world.power_on(name)
    assert later(world, 2_000) == ["robot1"]
    world.restart("robot3", 8_000 * MS)
    later(world, 300)
    world.power_off("robot1")
    later(world)
    assert "the agent of robot3 restarts, and robot2 has promised to wait for it: ask again in" in told(world, "robot2")
