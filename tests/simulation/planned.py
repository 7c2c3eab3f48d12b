"""Planned restarts of agents: beside all other faults, where no promise may break, and in peace, where no program may notice."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random
from typing import Final

from msgspec.structs import replace

from failover.core.node import LEAVE_NS
from failover.core.types import MS, ComponentSpec, Config, Launch, Rules, WhenAlone
from tests.simulation.invariants import Broken, Invariants, seen_at
from tests.simulation.teams import elective, pair
from tests.simulation.world import World

GRACE_MS: Final = 1_000
UNHEARD_MS: Final = 300
AWAY_MS: Final = (20, 100, 300, 700, 900)
"""In time for the grace."""

AWAY_TOO_LONG_MS: Final = (1_000, 1_100, 1_300, 2_500)
TOO_LONG: Final = 0.3
"""Of the restarts beside other faults: those from which the agent comes back too late, or about then."""

BESIDE: Final = 0.6
"""Of them: those during which something happens to a peer, or between the two."""

SETTLING_NS: Final = 2_000 * MS
GAP_NS: Final = 800 * MS
"""Between two restarts: an agent is back, and its peers have heard it."""

CALM_TEAMS: Final = ((2, 0, 0), (3, 0, 0), (2, 0, 1), (2, 1, 0), (3, 0, 2))
CALM_RESTARTS: Final = 20
DRIFT: Final = 0.01


def with_grace(configs: list[Config], grace_ms: int = GRACE_MS) -> list[Config]:
    """The same team; its agents are waited for when they restart, longer than they wait for one that they have never heard."""
    return [replace(config, restart_grace_ms=grace_ms, grace_ms=UNHEARD_MS) for config in configs]


def beside_faults(world: World, random: Random, count: int, until_ns: int) -> None:
    """Plan so many restarts of any agents at any instants, and what happens meanwhile."""
    for _ in range(count):
        at_ns = random.randrange(until_ns - LEAVE_NS)  # by then it has gone, so the healing brings it back
        away_ms = random.choice(AWAY_TOO_LONG_MS if random.random() < TOO_LONG else AWAY_MS)
        name, other = random.sample(list(world.robots), 2)
        world.at(at_ns, lambda name=name, away_ms=away_ms: world.restart(name, away_ms * MS))
        if random.random() < BESIDE:
            _meanwhile(world, random, name, other, at_ns + random.randrange(GRACE_MS) * MS)


def _meanwhile(world: World, random: Random, name: str, other: str, at_ns: int) -> None:
    pause_ns = random.randrange(1, 1_500) * MS
    ways = {(name, other), (other, name)}

    def cut() -> None:
        world.note(f"cut {name} {other} for {pause_ns / MS:.0f} ms")
        world.network.cuts |= ways
        world.after(pause_ns, lambda: world.network.cuts.difference_update(ways))

    def end(how: str, robot: str) -> None:
        (world.agent_dies if how == "agent" else world.power_off)(robot)
        world.after(pause_ns, lambda: world.power_on(robot))

    happens = (
        cut,
        lambda: end("agent", other),
        lambda: end("power", other),
        lambda: end("power", name),
        lambda: world.stall(other, pause_ns),
        lambda: world.restart(other, pause_ns),
    )
    world.at(at_ns, random.choice(happens))


@dataclass(slots=True)
class Undisturbed:
    """Watches that a component neither moves nor stands still, once it is told where it runs."""

    component: str
    at: str = ""

    def __call__(self, world: World, robot: str, what: object) -> None:
        if self.at and what is None and world.acting(self.component) != [self.at]:
            story = "\n".join(world.log[-30:])
            raise Broken(f"{self.component} acts at {world.acting(self.component)}, not at {self.at}:\n{story}")


def calm(seed: int) -> World:
    """In a team where nothing else happens agents restart, one after the other: nothing moves, nothing stands still.

    Raises:
        Broken: it did, or was not waited for.
    """
    random = Random(seed ^ 0xCA17)
    robots, servers, witnesses = random.choice(CALM_TEAMS)
    alone = random.choice((WhenAlone.RUN, WhenAlone.FREEZE))
    spec = ComponentSpec("/team/part", launch=Launch(("part",)), rules=Rules(when_alone=alone))
    votes = robots + servers + witnesses > 2
    configs = with_grace(elective(robots, (spec,), servers, witnesses) if votes else pair((spec,)))
    is_safe = votes or alone is WhenAlone.FREEZE
    undisturbed = Undisturbed(spec.name)
    world = World(seed, configs, (Invariants(safe={spec.name} if is_safe else set(), votes=votes), undisturbed), DRIFT)
    for name in world.robots:
        world.power_on(name)
    world.run(SETTLING_NS)
    (undisturbed.at,) = (where,) = world.acting(spec.name)
    epoch = seen_at(world, where, spec.name).epoch
    for _ in range(CALM_RESTARTS):
        world.run(world.now_ns + random.randrange(300) * MS)
        world.restart(random.choice(list(world.robots)), random.choice(AWAY_MS) * MS)
        world.run(world.now_ns + max(AWAY_MS) * MS + GAP_NS)
        if seen_at(world, where, spec.name).epoch != epoch:
            raise Broken("the epoch has changed:\n" + "\n".join(world.log[-40:]))
    if len(world.restarts) < CALM_RESTARTS or not all(promised for _, promised in world.restarts):
        raise Broken(f"a restart was not waited for: {world.restarts}")
    return world
