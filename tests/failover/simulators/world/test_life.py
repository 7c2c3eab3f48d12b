"""The simulated world: the same seed gives the same bytes, robots move as their wheels say, sensors measure what is there."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from failover.simulators.world.life import AWAY_TICKS, Life
from failover.simulators.world.motion import MOTOR_S, RIM_SPEED_MAX, Motion
from failover.simulators.world.parts import RADIUS_M, TICK_S, Lab, Robot, World, groups, usual
from failover.simulators.world.room import RANGE_MAX_M, Room

HALL = Lab("hall", (20.0, 20.0))


def played(life: Life, ticks: int) -> Life:
    """The world after so many ticks, as a process has it go on."""
    for _ in range(ticks):
        life.turn()
        list(life.values())
        for robot in range(len(life.robots)):
            life.control(robot)
    return life


def digests(world: World, ticks: int) -> list[str]:
    return [played(Life(world, lab), ticks).digest for lab in world.labs]


def alone(**words: object) -> Life:
    """One robot in the middle of a hall, which nothing drives."""
    robot = Robot("r", "hall", **{"at": (10.0, 10.0), "controller": "none", **words})  # type: ignore[arg-type]
    return Life(World((HALL,), (robot,)), HALL)


@settings(max_examples=15, deadline=None)
@given(robots=st.integers(1, 12), labs=st.integers(1, 3), seed=st.integers(0, 2**63 - 1), ticks=st.integers(1, 30))
def test_the_same_seed_gives_the_same_values_in_one_process_or_in_several(robots: int, labs: int, seed: int, ticks: int) -> None:
    world = usual(max(robots, labs), labs, seed)
    once = digests(world, ticks)
    assert digests(world, ticks) == once
    assert [digests(world.part((lab.name,)), ticks)[0] for lab in world.labs] == once


def test_another_seed_gives_other_values() -> None:
    assert len({digests(usual(2, 1, seed), 10)[0] for seed in range(5)}) == 5


def test_no_robot_goes_through_a_wall_a_column_or_another_robot() -> None:
    world = usual(16, 1, 3)
    life, room = Life(world, world.labs[0]), Room(world.labs[0])
    began = life.motion.place.copy()
    for _ in range(60):
        played(life, 10)
        assert room.clearance(life.motion.place, life.motion.radius).min() > -1e-9
    assert (np.linalg.norm(life.motion.place - began, axis=1) > RADIUS_M).all(), "all of them have moved"


@pytest.mark.parametrize(("kind", "engines"), [("omni", 3), ("omni", 4), ("differential", 2), ("differential", 4)])
def test_a_robot_goes_where_its_wheels_turn(kind: str, engines: int) -> None:
    wanted = (0.2, 0.1 if kind == "omni" else 0.0, 0.3)
    life = alone(kind=kind, engines=engines)
    life.motion.duty[0] = life.motion.duties(0, wanted)
    played(life, 40)  # two seconds: thirteen time constants of its motors
    assert life.motion.velocity[0] == pytest.approx(wanted, abs=1e-4)
    assert life.motion.heading[0] == pytest.approx(wanted[2] * (40 * TICK_S - MOTOR_S), abs=0.02)


def test_too_large_a_velocity_keeps_its_direction() -> None:
    motion = Motion([Robot("r", "hall", (10.0, 10.0))])
    duties = motion.duties(0, (5.0, 0.0, 0.0))
    assert np.abs(duties).max() == 1.0
    ahead, left, turn = np.linalg.pinv(motion.wheels[0]) @ (duties * RIM_SPEED_MAX)
    assert ahead > 0 and abs(left) < 1e-9 and abs(turn) < 1e-9


def test_a_motor_has_reached_two_thirds_after_its_time_constant() -> None:
    life = alone()
    life.motion.duty[0, 0] = 1.0
    life.motion.moved(MOTOR_S)
    assert life.motion.rim[0, 0] == pytest.approx(RIM_SPEED_MAX * (1 - math.exp(-1)))


def test_an_empty_battery_moves_nothing_and_one_that_is_used_becomes_empty_sooner() -> None:
    assert np.array_equal(played(_driven(battery=0.0), 40).motion.place, [(10.0, 10.0)])
    used, resting = played(_driven(), 40).motion.level[0], played(alone(), 40).motion.level[0]
    assert used < resting < 1.0
    assert played(_driven(battery=None), 40).motion.level[0] == 1.0


def _driven(**words: object) -> Life:
    life = alone(**words)
    life.motion.duty[0] = life.motion.duties(0, (0.3, 0.0, 0.0))
    return life


# --- Sensors --------------------------------------------------------------------------------------------------------------


def ranges(lab: Lab, *places: tuple[float, float], heading: float = 0.0) -> np.ndarray:
    """Exact ranges of the first of some robots: ahead, to the left, back, to the right."""
    angles = np.radians([[heading + 90 * n for n in range(4)]] * len(places))
    found = Room(lab).ranges(np.array(places), np.full(len(places), RADIUS_M), angles)
    return found[0]


def test_a_sensor_tells_the_distance_from_the_edge_of_the_robot_to_the_wall() -> None:
    assert ranges(Lab("a", (4.0, 3.0)), (1.0, 1.0)) == pytest.approx([3 - RADIUS_M, 2 - RADIUS_M, 1 - RADIUS_M, 1 - RADIUS_M])
    assert ranges(Lab("a", (4.0, 3.0)), (1.0, 1.0), heading=45)[0] == pytest.approx(2 * math.sqrt(2) - RADIUS_M)


def test_a_sensor_sees_what_stands_before_the_wall_and_nothing_behind_its_robot() -> None:
    inner, column = (2.0, 0.5, 2.0, 1.5), (1.0, 2.0, 0.25)
    assert ranges(Lab("a", (4.0, 3.0), (inner,)), (1.0, 1.0))[0] == pytest.approx(1 - RADIUS_M)
    assert ranges(Lab("a", (4.0, 3.0), (), (column,)), (1.0, 1.0))[1] == pytest.approx(0.75 - RADIUS_M)
    assert ranges(Lab("a", (4.0, 3.0)), (1.0, 1.0), (2.5, 1.0))[0] == pytest.approx(1.5 - 2 * RADIUS_M)
    assert ranges(Lab("a", (4.0, 3.0)), (2.5, 1.0), (1.0, 1.0))[0] == pytest.approx(1.5 - RADIUS_M)


def test_where_nothing_is_near_a_sensor_tells_its_range() -> None:
    assert (ranges(HALL, (10.0, 10.0)) == RANGE_MAX_M).all()
    assert (alone().ranges == RANGE_MAX_M).all(), "noise does not change that"


# --- Programs -------------------------------------------------------------------------------------------------------------


def test_a_controller_stands_aside_while_a_program_commands_an_engine() -> None:
    life = alone(controller="wander")
    played(life, 1)
    assert life.motion.duty[0].any()
    life.command(0, 2, -0.25)
    played(life, AWAY_TICKS - 1)
    assert life.motion.duty[0, 2] == -0.25 and life.moves[0] == [0, 0, 1, 0]
    played(life, 2)
    assert life.motion.duty[0, 2] != -0.25


def test_labs_stay_whole_and_small_ones_share_a_process() -> None:
    assert groups(usual(80, 4, 1), 20) == [("Lab1",), ("Lab2",), ("Lab3",), ("Lab4",)]
    assert groups(usual(40, 8, 1), 20) == [("Lab1", "Lab2", "Lab3", "Lab4"), ("Lab5", "Lab6", "Lab7", "Lab8")]
    assert groups(usual(50, 1, 1), 20) == [("Lab",)]
