"""One seed, one life: what goes wrong, when, and how it ends well."""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from unittest.mock import patch

from failover.core import speaker
from failover.core.events import Handover
from failover.core.types import MS, ComponentSpec, Launch, OnLoss, Rules, WhenAlone
from tests.simulation.invariants import Broken, Invariants
from tests.simulation.world import KEEPS_STATE, World, pair

TROUBLE_NS = 3_000 * MS
HEALING_NS = 4_000 * MS
LOOK_NS = 250 * MS
"""Between two looks whether a healed world is well."""

CRASH = 11
FINISHES = 0.3
"""Of the occasions: a life whose programs have all ended shows little."""

NARROW = 5
"""Every so many-th seed has frames that hold one entry, so that components are told of in turn."""

NARROW_BODY_SIZE = 130

SELDOM = 7
"""Every so many-th seed has programs that commit seldom, so that most captures find nothing new."""


ENGINES = ("ptrace", KEEPS_STATE)


def life(seed: int, engines: tuple[str, ...] = ENGINES) -> World:
    """Play one seed to its end; raises ``Broken`` when an invariant does not hold."""
    random, engine = Random(seed ^ 0x5EED), Random(seed)
    specs = tuple(_spec(random, index, engine.choice(engines)) for index in range(random.choice((1, 1, 2, 3))))
    with patch.object(speaker, "BODY_SIZE_MAX", speaker.BODY_SIZE_MAX if seed % NARROW else NARROW_BODY_SIZE):
        return _live(seed, random, specs)


def _live(seed: int, random: Random, specs: tuple[ComponentSpec, ...]) -> World:
    invariants = Invariants(safe={spec.name for spec in specs if spec.rules.when_alone is WhenAlone.FREEZE})
    world = World(seed, pair(specs), (invariants,))
    _weather(world, random)
    world.unchanged = 0.8 if seed % SELDOM == SELDOM - 2 else 0.0
    for name in world.robots:
        world.at(random.randrange(300) * MS, lambda name=name: world.power_on(name))
    for _ in range(random.randrange(1, 9)):
        world.at(random.randrange(TROUBLE_NS), _trouble(world, invariants, random, specs))
    world.run(TROUBLE_NS)
    _heal(world)
    while True:
        world.run(world.now_ns + LOOK_NS)
        try:
            invariants.ended_well(world)
            return world
        except Broken:
            if world.now_ns >= TROUBLE_NS + HEALING_NS:
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
    for robot in world.robots.values():
        robot.slow = random.choice((1, 1, 1, 4))


def _trouble(world: World, invariants: Invariants, random: Random, specs: tuple[ComponentSpec, ...]) -> Callable[[], None]:
    name = random.choice(list(world.robots))
    other = next(robot for robot in world.robots if robot != name)
    spec = random.choice(specs)
    pause_ns = int(random.choice((30, 100, 200, 400, 900)) * MS * random.uniform(0.5, 1.5))

    def cut(*ways: tuple[str, str]) -> None:
        world.note(f"cut {ways} for {pause_ns / MS:.0f} ms")
        world.network.cuts.update(ways)
        world.after(pause_ns, lambda: world.network.cuts.difference_update(ways))

    def outage(stop: Callable[[str], None]) -> None:
        stop(name)
        world.after(pause_ns, lambda: world.power_on(name))

    def crash() -> None:
        invariants.crashing.add((name, spec.name))
        world.program_ends(name, spec.name, CRASH)

    def finish() -> None:
        if random.random() < FINISHES:
            world.program_ends(name, spec.name, 0)

    def full() -> None:
        world.robots[name].broken_store = True
        world.after(pause_ns, lambda: setattr(world.robots[name], "broken_store", False))

    kinds: list[Callable[[], None]] = [
        lambda: cut((name, other), (other, name)),
        lambda: cut((name, other)),
        lambda: outage(world.power_off),
        lambda: outage(world.power_off),
        lambda: outage(world.agent_dies),
        lambda: world.stall(name, pause_ns),
        lambda: world.jump(name, pause_ns),
        lambda: world.command(name, Handover(world.request(), spec.name)),
        crash,
        finish,
        full,
    ]
    return random.choice(kinds)


def _heal(world: World) -> None:
    world.note("healing")
    world.network.cuts.clear()
    world.network.loss = world.network.duplicate = 0
    world.network.spread_ns = 1 * MS
    for name, robot in world.robots.items():
        robot.slow, robot.broken_store = 1, False
        world.power_on(name)
