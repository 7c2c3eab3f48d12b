"""Simultaneous starts: of robots that would all run a component the one with the lesser name does, in any alphabet."""

from __future__ import annotations

from itertools import permutations
from random import Random

import pytest
from msgspec.structs import replace

from failover.core.types import MS, ComponentSpec, Config, Launch, Rule, State
from failover.core.wire.names import weight
from tests.simulation.invariants import Invariants, seen_at, state_at
from tests.simulation.teams import elective, pair, ruled
from tests.simulation.world import World

SPEC = ComponentSpec("/team/part", launch=Launch(("part",)))
STARTS = 1_000
BLOCK = 250
DECIDED_NS = 1_500 * MS

STEMS = ("robot", "Robot", "Робот", "робот", "Rоbоt", "робот-r", "机器人", "ロボット", "ρομπότ", "r2-unit-", "ROBOT")
"""Also of two alphabets in one name: the fifth has two Cyrillic letters."""
DIGITS = ("0123456789", "٠١٢٣٤٥٦٧٨٩", "０１２３４５６７８９")


def name_of(random: Random) -> str:
    """A robot's name: any stem, a number of one to three places, in any digits."""
    number = str(random.randrange(1, random.choice((10, 100, 1_000))))
    return random.choice(STEMS) + number.translate(str.maketrans(DIGITS[0], random.choice(DIGITS)))


def names_of(random: Random) -> tuple[str, ...]:
    """Two or three names, often of one stem."""
    names: set[str] = set()
    while len(names) < 2 + (random.random() < 0.3):
        names.add(name_of(random))
    return tuple(sorted(names, key=lambda _: random.random()))


def started(seed: int, configs: list[Config]) -> World:
    """A world whose robots all begin at one instant, with beats that take up to 5 ms."""
    world = World(seed, configs, (Invariants(safe={SPEC.name}, votes=configs[0].by_majority),))
    world.network.spread_ns = 5 * MS
    for config in configs:
        world.power_on(config.robot)
    while not world.acting(SPEC.name) and world.now_ns < DECIDED_NS:
        world.run(world.now_ns + 20 * MS)
    world.run(world.now_ns + 100 * MS)
    return world


@pytest.mark.parametrize("first", range(0, STARTS, BLOCK))
def test_of_simultaneous_claims_the_lesser_name_wins(first: int) -> None:
    for seed in range(first, first + BLOCK):
        random = Random(seed)
        names = names_of(random)
        configs = pair((SPEC,), names)
        if len(names) > 2:
            configs = [replace(config, rule=Rule.MAJORITY) for config in configs]
        found = started(seed, configs).acting(SPEC.name)
        assert found == [min(names, key=weight)], f"seed {seed}: of {names} {found} runs it"


@pytest.mark.parametrize("rule", list(Rule))
def test_robot2_runs_it_and_not_robot10(rule: Rule) -> None:
    names = ("robot10", "robot2") if rule is Rule.PAIR else ("robot10", "robot2", "robot33")
    configs = ruled(rule, pair((SPEC,), names))
    assert started(1, configs).acting(SPEC.name) == ["robot2"]


@pytest.mark.parametrize("order", [*permutations(("robot1", "robot2", "robot3"))], ids="-".join)
@pytest.mark.parametrize("rule", list(Rule))
def test_in_any_order_of_arrival_the_first_that_may_act_stays_and_the_late_comers_protect_it(
    rule: Rule, order: tuple[str, ...]
) -> None:
    world = World(1, ruled(rule, pair((SPEC,), tuple(sorted(order)))))
    first = order[0] if rule is Rule.PAIR else min(order[:2])
    for name in order:
        world.power_on(name)
        world.run(world.now_ns + 2_000 * MS)
        enough = rule is Rule.PAIR or name != order[0]
        assert world.acting(SPEC.name) == ([first] if enough else [])
    standby = seen_at(world, first, SPEC.name).standby
    assert {one: state_at(world, one, SPEC.name) for one in order if one != first} == dict.fromkeys(
        sorted({*order} - {first}), State.STANDBY
    )
    assert standby in {*order} - {first}


@pytest.mark.parametrize("names", [("robot1",), ("robot1", "robot2")], ids="-".join)
def test_what_no_robot_ever_ran_begins_at_once_where_every_robot_is_heard(names: tuple[str, ...]) -> None:
    assert started(1, pair((SPEC,), names, 60_000)).acting(SPEC.name) == ["robot1"]


def test_what_no_robot_is_known_to_have_run_waits_for_a_robot_that_was_not_heard_since_the_boot() -> None:
    world = World(1, pair((SPEC,), boot_patience_ms=6_000), (Invariants(safe={SPEC.name}),))
    world.power_on("robot1")
    world.run(5_500 * MS)
    assert world.acting(SPEC.name) == []
    world.run(7_000 * MS)
    assert world.acting(SPEC.name) == ["robot1"]


def test_a_robot_with_a_new_disk_begins_nothing_afresh_of_which_another_member_knows_checkpoints() -> None:
    world = World(1, elective(2, (SPEC,), witnesses=1), (Invariants(safe={SPEC.name}, votes=True),))
    for name in ("robot1", "robot2", "witness1"):
        world.power_on(name)
    world.run(2_000 * MS)
    assert world.acting(SPEC.name) == ["robot1"]
    world.power_off("robot1")
    world.run(4_000 * MS)
    assert world.acting(SPEC.name) == ["robot2"]
    world.power_off("robot2")
    world.new_disk("robot2", vote_record=True)
    world.power_on("robot2")
    world.run(10_000 * MS)
    assert world.acting(SPEC.name) == []
    world.power_on("robot1")
    world.run(13_000 * MS)
    assert world.acting(SPEC.name) == ["robot1"]


@pytest.mark.parametrize("rule", list(Rule))
def test_the_late_comer_is_the_standby_whatever_its_name(rule: Rule) -> None:
    names = ("robot1", "robot2") if rule is Rule.PAIR else ("robot1", "robot2", "robot3")
    world = World(1, ruled(rule, pair((SPEC,), names)))
    for name in names[1:]:
        world.power_on(name)
    world.run(3_000 * MS)
    assert world.acting(SPEC.name) == ["robot2"]
    world.power_on("robot1")
    world.run(5_000 * MS)
    assert world.acting(SPEC.name) == ["robot2"]
