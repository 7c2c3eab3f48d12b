"""The team grows and shrinks while its robots run, fall silent and start anew: nothing acts twice, nothing moves without need."""

from __future__ import annotations

from random import Random

import pytest
from msgspec.structs import replace

from failover.core.events import TeamChanged
from failover.core.team_changes import Elections, elections, unaware
from failover.core.types import MS, ComponentSpec, Config, Launch, Rule, WhenAlone
from tests.simulation.invariants import Broken, Invariants, seen_at
from tests.simulation.robots import vote_record_of
from tests.simulation.teams import elective, pair
from tests.simulation.world import World

PART = "/team/part"
SPEC = ComponentSpec(PART, launch=Launch(("part",)))
SEEDS = 24
BLOCK = 8


def in_team(config: Config, names: tuple[str, ...], rule: Rule) -> Config:
    """The configuration in a team of these; each has the same seat in all teams."""
    peers = tuple(name for name in names if name != config.robot)
    return replace(config, peers=peers, rule=rule, seat=int(config.robot.removeprefix("robot")) - 1)


def take(world: World, name: str, names: tuple[str, ...], rule: Rule = Rule.MAJORITY) -> None:
    """A robot reads that these belong to the team: at once if it runs, else when it starts."""
    robot = world.robots[name]
    robot.config = in_team(robot.config, names, rule)
    world.feed(robot, TeamChanged(robot.config))


def test_a_robot_alone_gets_a_second_and_a_third_and_its_program_never_stands_still() -> None:
    names = ("robot1", "robot2", "robot3")
    configs = [in_team(config, names[: count + 1], Rule.PAIR) for count, config in enumerate(pair((SPEC,), names))]
    world = World(1, configs, (Invariants(votes=False),))
    world.power_on("robot1")
    world.run(1_000 * MS)
    began = world.robots["robot1"].programs[PART]
    take(world, "robot1", names[:2], Rule.PAIR)
    world.after(500 * MS, lambda: world.power_on("robot2"))
    world.run(world.now_ns + 2_000 * MS)
    assert seen_at(world, "robot1", PART).standby == "robot2"
    world.robots["robot3"].config = in_team(configs[2], names, Rule.MAJORITY)
    take(world, "robot2", names)
    world.after(20 * MS, lambda: take(world, "robot1", names))
    stood = 0
    for _ in range(500):
        world.run(world.now_ns + 1 * MS)
        stood += world.acting(PART) != ["robot1"]
    assert stood == 0
    world.power_on("robot3")
    world.run(world.now_ns + 2_000 * MS)
    assert world.robots["robot1"].programs[PART] is began and world.acting(PART) == ["robot1"]
    assert seen_at(world, "robot1", PART).epoch == 1, "it has not moved"
    world.power_off("robot1")
    world.run(world.now_ns + 2_000 * MS)
    assert len(world.acting(PART)) == 1


def test_a_member_that_has_just_joined_and_was_never_heard_delays_no_takeover() -> None:
    names = ("robot1", "robot2", "robot3")
    world = World(2, [in_team(config, names[:2], Rule.PAIR) for config in pair((SPEC,), names)], (Invariants(),))
    for name in names[:2]:
        world.power_on(name)
    world.run(2_000 * MS)
    for name in names[:2]:
        take(world, name, names, Rule.PAIR)
    world.run(world.now_ns + 5 * MS)
    world.power_off("robot1")
    world.run(world.now_ns + 350 * MS)
    assert world.acting(PART) == ["robot2"], "within less than the grace that robots have which start together"


def test_a_member_that_was_taken_out_is_no_standby_any_more_and_its_place_is_given_to_another() -> None:
    names = ("robot1", "robot2", "robot3")
    world = World(3, elective(3, (SPEC,)), (Invariants(safe={PART}, votes=True),))
    for name in names:
        world.power_on(name)
    world.run(2_000 * MS)
    standby = seen_at(world, "robot1", PART).standby
    rest = tuple(name for name in names if name != standby)
    world.power_off(standby)
    for name in rest:
        take(world, name, rest)
    world.run(world.now_ns + 3_000 * MS)
    assert world.acting(PART) == ["robot1"]
    assert seen_at(world, "robot1", PART).standby == next(name for name in rest if name != "robot1")


def test_under_pair_a_robot_that_was_taken_out_while_it_acted_is_waited_for_until_its_lease_is_over() -> None:
    """From three to two the rule may go over to pair, where no majority would have to be found first."""
    names = ("robot1", "robot2", "robot3")
    world = World(5, elective(3, (SPEC,)), (Invariants(safe={PART}),))
    for name in names:
        world.power_on(name)
    world.run(2_000 * MS)
    assert world.acting(PART) == ["robot1"]
    world.network.cuts |= {pair for name in names[1:] for pair in (("robot1", name), (name, "robot1"))}
    for name in names[1:]:
        take(world, name, names[1:], Rule.PAIR)
    for _ in range(600):
        world.run(world.now_ns + 1 * MS)
        assert len(world.acting(PART)) <= 1
    world.run(world.now_ns + 2_000 * MS)
    (acting,) = world.acting(PART)
    assert acting in names[1:]


def test_with_freeze_a_program_goes_on_once_its_lost_standby_is_taken_out() -> None:
    frozen = replace(SPEC, rules=replace(SPEC.rules, when_alone=WhenAlone.FREEZE))
    names = ("robot1", "robot2")
    world = World(6, [in_team(config, names, Rule.PAIR) for config in pair((frozen,), names)], (Invariants(safe={PART}),))
    for name in names:
        world.power_on(name)
    world.run(2_000 * MS)
    assert world.acting(PART) == ["robot1"]
    world.power_off("robot2")
    world.run(world.now_ns + 2_000 * MS)
    assert world.acting(PART) == []
    take(world, "robot1", names[:1], Rule.PAIR)
    world.run(world.now_ns + 2_000 * MS)
    assert world.acting(PART) == ["robot1"]


def test_a_member_one_change_behind_lets_nothing_act_twice_whatever_part_it_is_cut_off_with() -> None:
    for seed in range(8):
        world = World(
            seed, [in_team(config, FIVE[:4], Rule.MAJORITY) for config in elective(5, (SPEC,))], (Invariants({PART}, True),)
        )
        for name in FIVE[:4]:
            world.power_on(name)
        world.run(1_500 * MS)
        (acting,) = world.acting(PART)
        behind = FIVE[seed % 4]
        for name in (*FIVE[:4], FIVE[4]):
            if name != behind:
                take(world, name, FIVE)
        world.power_on(FIVE[4])
        side = {behind, *[name for name in FIVE if name != behind][: seed % 3]}
        world.network.cuts |= {pair for one in side for other in set(FIVE) - side for pair in ((one, other), (other, one))}
        world.run(world.now_ns + 3_000 * MS)
        assert len(world.acting(PART)) <= 1, f"seed {seed}: {acting} before, {side} are apart"


def test_a_robot_keeps_its_place_while_others_come_and_go() -> None:
    """Its snapshots would else count as older than those before, or as another robot's."""
    (config,) = [one for one in pair((), ("robot1", "robot2")) if one.robot == "robot2"]
    assert config.place == 1, "without seats by the order of names"
    assert in_team(config, ("robot2", "robot3"), Rule.PAIR).place == 1


@pytest.mark.parametrize("order", ["robot2 robot3", "robot3 robot2"])
def test_a_robot_that_is_taken_out_while_it_acts_is_replaced_once_its_lease_is_over(order: str) -> None:
    names = ("robot1", "robot2", "robot3")
    world = World(4, elective(3, (SPEC,)), (Invariants(safe={PART}, votes=True),))
    for name in names:
        world.power_on(name)
    world.run(2_000 * MS)
    assert world.acting(PART) == ["robot1"]
    for name in order.split():
        take(world, name, names[1:])
    world.run(world.now_ns + 3_000 * MS)
    (acting,) = world.acting(PART)
    assert acting in names[1:]


def stormy(seed: int, growth: str, patience_ms: int) -> World:
    """A team of three grows (+) and shrinks (-) amid faults, each member taking each change at an instant of its own.

    As the agents do it: a robot that is taken out runs nothing, and has ended before the others take the change. Its disk is lost
    to the team. Faults fall between the grants and the last member that takes the change, and last until the next one may begin.
    """
    random = Random(seed)
    configs = elective(3 + growth.count("+"), (SPEC,))
    everyone = [config.robot for config in configs]
    team = tuple(everyone[:3])
    world = World(seed, [in_team(config, team, Rule.MAJORITY) for config in configs], (Invariants({PART}, votes=True),), 0.05)
    world.network.loss = random.choice((0, 0.02, 0.1))
    for name in team:
        world.power_on(name)
    world.run(1_000 * MS)
    former: set[str] = set()
    for change in growth:
        if change == "+":
            joining = everyone[len(former) + len(team)]
            after = (*team, joining)
        else:
            idle = [name for name in team if PART not in world.robots[name].programs]
            leaving = random.choice(idle)
            former.add(leaving)
            world.power_off(leaving)
            world.new_disk(leaving, vote_record=False)
            after = tuple(name for name in team if name != leaving)
        given_up_ns = world.now_ns + 10_000 * MS
        while not _may_be_granted(world, team, after):
            assert world.now_ns < given_up_ns, f"seed {seed}: {team} cannot become {after}"
            world.run(world.now_ns + 10 * MS)
        for name in random.sample(staying := [name for name in team if name in after], len(staying)):
            if random.random() < 0.5:
                _fault(world, random, team, former)
            world.run(world.now_ns + random.randrange(patience_ms) * MS)
            take(world, name, after)
        if change == "+":
            take(world, joining, after)
            world.power_on(joining)
        team = after
        world.run(world.now_ns + random.randrange(patience_ms) * MS)
    world.network.heal()
    for name in team:
        world.power_on(name)
    world.run(world.now_ns + 4_000 * MS)
    return world


def _may_be_granted(world: World, team: tuple[str, ...], after: tuple[str, ...]) -> bool:
    """Whether all members are there, but one that leaves, and know enough of what was elected."""
    told = {name: known_at(world, name) for name in team if world.robots[name].node is not None}
    return set(team) & set(after) <= set(told) and not unaware(team, after, told)


def known_at(world: World, robot: str) -> Elections:
    """What a robot tells with its grant."""
    return elections(vote_record_of(world.robots[robot]))


def _fault(world: World, random: Random, names: tuple[str, ...], former: set[str]) -> None:
    """Something happens, and is over soon: a robot loses its power, its agent stalls, or the network is in two parts."""
    name = random.choice([one for one in names if one not in former])
    for_ns = random.randrange(50, 900) * MS
    match random.randrange(3):
        case 0:
            if world.robots[name].node is not None:
                world.power_off(name)
                world.after(for_ns, lambda: world.power_on(name) if name not in former else None)
        case 1:
            world.stall(name, for_ns)
        case _:
            side = set(random.sample(names, len(names) // 2))
            cuts = {(one, other) for one in names for other in names if (one in side) != (other in side)}
            world.network.cuts |= cuts
            world.after(for_ns, lambda: world.network.cuts.difference_update(cuts))


FIVE = ("robot1", "robot2", "robot3", "robot4", "robot5")
GROWTHS = ("++--", "-+-+", "+-+-")


@pytest.mark.parametrize("first", range(0, SEEDS, BLOCK))
def test_one_member_at_a_time_nothing_acts_twice_in_any_fault(first: int) -> None:
    for seed in range(first, first + BLOCK):
        world = stormy(seed, GROWTHS[seed % len(GROWTHS)], 400)
        assert len(world.acting(PART)) == 1, f"seed {seed}: at {world.acting(PART)}"


def test_a_change_before_a_majority_of_the_next_team_knows_an_election_would_let_two_be_elected() -> None:
    """So all grants are not enough: robot2 has every change, and grants the next one before it has heard of robot3."""
    world = World(1, [in_team(config, FIVE[:3], Rule.MAJORITY) for config in elective(4, (SPEC,))], (Invariants({PART}, True),))
    for name in FIVE[:3]:
        world.power_on(name)
    world.run(1_500 * MS)
    first, second, third = *world.acting(PART), *sorted({*FIVE[:3]} - {*world.acting(PART)})
    world.power_off(second)
    world.run(world.now_ns + 500 * MS)
    world.power_off(first)
    world.run(world.now_ns + 1_000 * MS)
    world.power_on(first)
    world.run(world.now_ns + 1_000 * MS)
    (acting,) = world.acting(PART)
    assert seen_at(world, acting, PART).epoch == 2, "of three, two have elected it"
    for name in FIVE[:4]:
        take(world, name, FIVE[:4])
    idle = first if acting == third else third
    after = tuple(name for name in FIVE[:4] if name != idle)
    told = {name: known_at(world, name) for name in FIVE[:4]}
    assert unaware(FIVE[:4], after, told) == {PART: (2, sorted((second, FIVE[3])))}
    world.power_off(idle)
    world.power_off(acting)
    for name in after:
        take(world, name, after)
        if name != acting:
            world.power_on(name)
    with pytest.raises(Broken, match="epoch 2 of /team/part is"):
        world.run(world.now_ns + 3_000 * MS)


def test_two_members_at_a_time_would_let_two_robots_act() -> None:
    """The check above can fail: two teams that differ by two members have majorities without a common member."""
    world = World(1, [in_team(config, FIVE[:3], Rule.MAJORITY) for config in elective(5, (SPEC,))], (Invariants({PART}, True),))
    for name in FIVE[:3]:
        world.power_on(name)
    world.run(1_500 * MS)
    (acting,) = world.acting(PART)
    for name in (acting, *FIVE[3:]):
        take(world, name, FIVE)
        world.power_on(name)
    rest = [name for name in FIVE[:3] if name != acting]
    world.run(world.now_ns + 200 * MS)
    world.network.cuts |= {pair for one in rest for other in (acting, *FIVE[3:]) for pair in ((one, other), (other, one))}
    with pytest.raises(Broken, match=r"acts at|while the lease of|epoch"):
        world.run(world.now_ns + 3_000 * MS)
