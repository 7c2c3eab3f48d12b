"""One seed, one life: which team, which faults, when, and how it ends well."""

from __future__ import annotations

from random import Random
from unittest.mock import patch

from msgspec.structs import replace

from failover.core import beat_builder
from failover.core.frames.frame import beat_size_max
from failover.core.types import MS, ComponentSpec, Config, Launch, OnLoss, Restart, Rule, Rules, WhenAlone
from tests.simulation import planned
from tests.simulation.archive import COPIES_MS
from tests.simulation.coordinator import Fault
from tests.simulation.freshness import Freshness
from tests.simulation.invariants import Broken, Invariants
from tests.simulation.liars import LIES, ROBOTS_LIES
from tests.simulation.robots import KEEPS_STATE
from tests.simulation.teams import coordinated, elective, pair, with_copies
from tests.simulation.troubles import PAUSES_MS, Trouble
from tests.simulation.world import World

TROUBLE_NS = 3_000 * MS
FAULT_NS = 200 * MS
"""Between two faults of a long life, on the average."""

HEALING_NS = 4_000 * MS
LOOK_NS = 250 * MS
"""Between two looks whether a healed world is well."""

NARROW = 5
"""Every so many-th seed has beats that hold one entry, so that components are told of in turn."""

NARROW_BEAT_SIZE = 130
ECHO_SIZE = 14

SELDOM = 7
"""Every so many-th seed has programs that commit seldom, so that most captures find nothing new."""


ENGINES = ("ptrace", KEEPS_STATE)

TEAMS = ((2, 0, 0), (2, 0, 0), (3, 0, 0), (2, 0, 1), (2, 1, 0), (3, 0, 2), (3, 1, 1))
"""Robots, servers, witnesses. Two alone live by the rule ``pair``, the others elect."""

DRIFTS = (0.01, 0.05, 0.05)
"""How far rates are off; with 0.05 both ways a lease of 150 ms and a loyalty of 170 are but 4 ms apart."""

HARSH = 3
"""Every so many-th voting team has a long lease, on which drift weighs more than beats and disks do; the robot whose name is the
least, which tends to be the primary, has the slowest clock, and everybody else the fastest."""

LONG_LEASE_MS = 600
DRIFT_MAX = 0.05

CAREFUL = 4
BOOT_PATIENCE_MS = 1_500
"""Every so many-th pair waits that long after a start for a word of the robot that ran a component."""

LIARS_TEAMS = tuple(team for team in TEAMS if sum(team) > 2)
"""Those that vote: of two, a liar is the other half of every decision."""

COORDINATED = (2, 2, 2, 4, 3)
"""Robots that vote together with etcd."""

DEAF_LIVES = 0.3
"""Of their lives: those in which they hear each other no more from some instant on, until all is healed."""

EMPTIED = 0.7
"""Of the lives of voters with an archive: those in which robots lose their disks, perhaps all of them."""

LIE_NS = 300 * MS
"""After so long, on the average, a liar says something else."""

PACES = (1.0, 0.02)
"""How long disks, captures and restores take: as on a robot, or next to nothing, so that no delay hides a mistake."""


def life(
    seed: int,
    engines: tuple[str, ...] = ENGINES,
    team: tuple[int, int, int] | None = None,
    faults: int = 0,
    *,
    liars: bool = False,
    etcd: bool = False,
    apart: bool = False,
    archive: bool = False,
    failing: bool = False,
    restart: Restart = Restart.UNDECLARED,
    restarts: int = 0,
) -> World:
    """Play one seed to its end; raises ``Broken`` when an invariant does not hold.

    Args:
        team: of ``TEAMS``; None for what the seed says.
        faults: how many, in a life that is as long as they take and whose programs do not end; 0 for what the seed says.
        restart: of all components, without a limit.
        restarts: of agents, planned, at random instants; a life is as long as they take at least.
        liars: an attacker has the key of a member, and lies by it until the world is healed.
        etcd: the robots decide by the rule ``etcd``, and etcd has faults, too.
        apart: the same, and until all is healed they never hear each other: they have but etcd, and an archive with faults.
        archive: the team votes, and its robots go on from an archive with faults where none of them has a checkpoint any more.
        failing: restores fail, too, some of them several times in a row.
    """
    random, engine = Random(seed ^ 0x5EED), Random(seed)
    specs = tuple(_spec(random, index, engine.choice(engines)) for index in range(random.choice((1, 1, 2, 3))))
    specs = tuple(replace(spec, rules=replace(spec.rules, restart=restart, restart_limit=0)) for spec in specs)
    teams = LIARS_TEAMS if liars or archive else TEAMS
    robots, servers, witnesses = team or teams[seed // HARSH % len(teams)]
    configs = pair(specs, boot_patience_ms=0 if seed % CAREFUL else BOOT_PATIENCE_MS)
    if robots + servers + witnesses > 2:
        configs = elective(robots, specs, servers, witnesses, lease_ms=150 if seed % HARSH else LONG_LEASE_MS)
    if archive:
        configs = with_copies(configs, COPIES_MS)
    if etcd or apart:
        configs = coordinated(COORDINATED[seed // HARSH % len(COORDINATED)], specs, 150 if seed % HARSH else LONG_LEASE_MS)
        if seed % 2 or apart:
            configs = with_copies(configs, COPIES_MS)
    narrow = NARROW_BEAT_SIZE + ECHO_SIZE * (len(configs) - 2)
    size_max = beat_size_max if seed % NARROW else lambda _: narrow
    if restarts:
        configs = planned.with_grace(configs)
    with patch.object(beat_builder, "beat_size_max", size_max):
        return _live(seed, random, configs, specs, faults, restarts, liars=liars, apart=apart, failing=failing)


def _live(
    seed: int,
    random: Random,
    configs: list[Config],
    specs: tuple[ComponentSpec, ...],
    faults: int,
    restarts: int,
    *,
    liars: bool,
    apart: bool,
    failing: bool,
) -> World:
    votes = configs[0].rule is not Rule.PAIR
    safe = {spec.name for spec in specs if votes or spec.rules.when_alone is WhenAlone.FREEZE}
    invariants = Invariants(safe=safe, votes=votes)
    freshness = (Freshness(invariants),) if configs[0].copies_ms and configs[0].coordinator else ()
    world = World(seed, configs, (invariants, *freshness), random.choice(DRIFTS))
    _weather(world, random)
    world.unchanged = 0.8 if seed % SELDOM == SELDOM - 2 else 0.0
    if votes and not seed % HARSH:
        _make_harsh(world)
    for name in world.robots:
        world.at(random.randrange(300) * MS, lambda name=name: world.power_on(name))
    trouble_ns = max(faults * FAULT_NS or TROUBLE_NS, restarts * planned.GAP_NS)
    for _ in range(faults or (random.randrange(4, 16) if votes else random.randrange(1, 9))):
        world.at(random.randrange(trouble_ns), Trouble(world, invariants, random, specs, endless=faults > 0))
    planned.beside_faults(world, Random(seed ^ 0x9E57A27), restarts, trouble_ns)
    if world.coordination is not None:
        faulty = world.coordination.faults() + (2 * world.archive.faults() if world.archive is not None else ())
        _trouble_etcd(world, faulty, Random(seed ^ 0xE7CD), trouble_ns, faults, apart=apart)
    elif world.archive is not None:
        _happen(world, world.archive.faults(), Random(seed ^ 0xE7CD), trouble_ns, faults)
        _lose_disks(world, Random(seed ^ 0xD15C), trouble_ns)
    if apart:
        _die_ahead(world, specs[0].name, Random(seed ^ 0xF2E5), trouble_ns)
    if liars:
        _let_one_lie(world, invariants, Random(seed ^ 0x11A2), trouble_ns)
    elif votes and random.random() < 0.3 and (world.archive is None or world.coordination is not None):
        _lose_a_disk(world, random)
    if failing:
        _let_restores_fail(world, Random(seed ^ 0xFA11), trouble_ns)
    world.run(trouble_ns)
    _heal(world)
    while True:
        world.run(world.now_ns + LOOK_NS)
        try:
            invariants.ended_well(world)
            return world
        except Broken:
            if world.now_ns >= trouble_ns + HEALING_NS:
                raise


def _spec(random: Random, index: int, engine: str) -> ComponentSpec:
    alone = random.choice((WhenAlone.RUN, WhenAlone.FREEZE))
    loss = random.choice((OnLoss.TAKEOVER, OnLoss.TAKEOVER, OnLoss.HOLD))
    return ComponentSpec(
        f"/team/part{index}", launch=Launch(("part",), engine=engine), rules=Rules(when_alone=alone, on_loss=loss, crash_limit=20)
    )


def _weather(world: World, random: Random) -> None:
    network = world.network
    network.loss = random.choice((0, 0, 0.02, 0.2))
    network.duplicate = random.choice((0, 0.1))
    network.spread_ns = random.choice((1, 5, 30, 60)) * MS
    world.pace = random.choice(PACES)
    if world.pace < 1:
        network.delay_ns, network.spread_ns = MS // 20, random.choice((MS // 20, network.spread_ns))
    for robot in world.robots.values():
        robot.slow = random.choice((1, 1, 1, 4))


def _make_harsh(world: World) -> None:
    world.pace, world.network.delay_ns, world.network.spread_ns = min(PACES), MS // 20, MS // 20
    for place, robot in enumerate(world.robots.values()):
        robot.slow, robot.clock.rate = 1, 1 + DRIFT_MAX * (1 if place else -1)


def _trouble_etcd(world: World, faulty: tuple[Fault, ...], random: Random, until_ns: int, faults: int, *, apart: bool) -> None:
    """Faults of etcd and of the archive, half where something acts; some while robots do not hear each other, or never do."""
    names = list(world.robots)
    ways = {(one, other) for one in names for other in names if one != other}
    if random.random() < DEAF_LIVES or apart:
        at_ns = random.choice((0, random.randrange(until_ns // 2)))
        world.at(0 if apart else at_ns, lambda: world.network.cuts.update(ways))
    _happen(world, faulty, random, until_ns, faults)


def _happen(world: World, faulty: tuple[Fault, ...], random: Random, until_ns: int, faults: int) -> None:
    """Faults of etcd or of the archive, half where something acts."""
    names, specs = list(world.robots), [spec.name for spec in next(iter(world.robots.values())).config.components]
    for _ in range(faults or random.randrange(2, 12)):
        fault, name, for_ns = (
            random.choice(faulty),
            random.choice(names),
            random.choice(PAUSES_MS) * MS + random.randrange(2),
        )

        def happen(fault: Fault = fault, name: str = name, for_ns: int = for_ns) -> None:
            world.faults += 1
            acting = [robot for component in specs for robot in world.acting(component)]
            fault(acting[0] if acting and for_ns % 2 else name, for_ns)

        world.at(random.randrange(until_ns), happen)


def _die_ahead(world: World, component: str, random: Random, until_ns: int) -> None:
    """The robot that runs a component loses its power while the others do not reach the archive, which has newer copies."""

    def cut() -> None:
        acting = world.acting(component)
        if not acting or world.archive is None:
            return
        world.faults += 1
        others, ahead_ns = set(world.robots) - set(acting), random.randrange(300, 600) * MS
        world.note(f"{' and '.join(sorted(others))} do not reach the archive, and {acting[0]} is about to lose its power")
        world.archive.cut |= others
        world.after(ahead_ns, lambda: world.power_off(acting[0]))
        world.after(ahead_ns + random.randrange(50, 400) * MS, lambda: _reach_again(world, others))
        world.after(ahead_ns + random.randrange(500, 1_500) * MS, lambda: world.power_on(acting[0]))

    world.at(random.randrange(until_ns // 3), cut)
    world.at(random.randrange(until_ns // 2, until_ns - 600 * MS), cut)


def _reach_again(world: World, robots: set[str]) -> None:
    assert world.archive is not None
    world.archive.cut -= robots


def _let_one_lie(world: World, invariants: Invariants, random: Random, until_ns: int) -> None:
    """A member, and one lie after the other."""
    name = random.choice(list(world.robots))
    lies = LIES
    if world.robots[name].config.runs(name):
        invariants.liar, lies = name, ROBOTS_LIES

    def lie() -> None:
        if world.now_ns < until_ns:
            world.faults += 1
            world.robots[name].lie = chosen = random.choice(lies)
            world.note(f"{name} lies: {chosen.__name__}")
            world.after(int(random.expovariate(1) * LIE_NS), lie)

    world.at(random.randrange(500) * MS, lie)


def _lose_a_disk(world: World, random: Random) -> None:
    """One robot of the team, once: it comes back empty."""
    name, vote_record = random.choice(list(world.robots)), random.random() < 0.3
    at_ns = random.randrange(TROUBLE_NS)

    def lose() -> None:
        world.faults += 1
        world.power_off(name)
        world.new_disk(name, vote_record)

    world.at(at_ns, lose)
    world.at(at_ns + random.randrange(10, 500) * MS, lambda: world.power_on(name))


def _lose_disks(world: World, random: Random, until_ns: int) -> None:
    """Robots come back empty, one after the other or all at once; servers and witnesses keep what they have."""
    if random.random() > EMPTIED:
        return
    robots = [name for name, robot in world.robots.items() if robot.config.runs(name)]
    at_ns, apart_ns = random.randrange(until_ns // 3, until_ns - 1_500 * MS), random.choice((0, 0, 300 * MS))
    for place, name in enumerate(random.sample(robots, random.choice((1, len(robots), len(robots))))):

        def lose(name: str = name, vote_record: bool = random.random() < 0.5) -> None:
            world.faults += 1
            world.power_off(name)
            world.new_disk(name, vote_record)

        world.at(at_ns + place * apart_ns, lose)
        world.at(at_ns + place * apart_ns + random.randrange(10, 800) * MS, lambda name=name: world.power_on(name))


def _let_restores_fail(world: World, random: Random, until_ns: int) -> None:
    """At random instants the next restores of a robot come to nothing."""
    robots = [robot for robot in world.robots.values() if robot.config.runs(robot.name)]
    for _ in range(random.randrange(1, 3 * len(robots))):
        robot, count = random.choice(robots), random.choice((1, 1, 2, 3))
        world.at(random.randrange(until_ns), lambda robot=robot, count=count: setattr(robot, "failing", count))


def _heal(world: World) -> None:
    world.note("healing")
    world.network.heal()
    for robot in world.robots.values():
        robot.failing = 0
    world.unchanged = 0.0  # forty captures in a row that find nothing look like a checkpoint that is too old (seed 2504)
    if world.coordination is not None:
        world.coordination.heal()
    if world.archive is not None:
        world.archive.heal()
    for name, robot in world.robots.items():
        robot.slow, robot.broken_store, robot.lie = 1, False, None
        world.power_on(name)
