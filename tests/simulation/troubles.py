"""Faults of a simulated world: each method is one fault, which begins now and ends by itself."""

from __future__ import annotations

from collections.abc import Callable
from random import Random

from failover.core.events import Handover, Prefer, Promote
from failover.core.types import MS, ComponentSpec
from tests.simulation.invariants import Invariants
from tests.simulation.world import World

CRASH = 11
FINISHES = 0.3
"""Of the occasions: a life whose programs have all ended shows little."""

PAUSES_MS = (30, 100, 200, 400, 900)
"""Around a lease, and far longer."""


SEALED = 0.5
"""Of the starts in long lives of careful pairs: those with a wrong key, which is put right so long after the start:"""
SEALED_MS = 3_000

PROMOTED_MS = 300
"""After the loss, and again after as long, an operator gives his order: with short leases the first one is in time."""


class Trouble:
    """One trouble, drawn from the dice when it is made: the robot that it hits, for how long, by what."""

    def __init__(
        self, world: World, invariants: Invariants, random: Random, specs: tuple[ComponentSpec, ...], *, endless: bool = False
    ) -> None:
        """
        Args:
            endless: no program ends or crashes too often to be resumed.
        """
        self._world = world
        self._invariants = invariants
        self._random = random
        self._endless = endless
        self._names = list(world.robots)
        self._name = random.choice(self._names)
        self._other = random.choice([robot for robot in self._names if robot != self._name])
        self._spec = random.choice(specs)
        self._pause_ns = int(random.choice(PAUSES_MS) * MS * random.uniform(0.5, 1.5))
        self._begin = random.choice([kind for kind in self._kinds() if not endless or kind not in (self._finish, self._crash)])

    def __call__(self) -> None:
        self._world.faults += 1
        self._begin()

    def _kinds(self) -> list[Callable[[], None]]:
        kinds = [
            self._cut,
            self._one_way,
            self._power_cut,
            self._power_cut,
            self._agent_dies,
            self._stall,
            self._jump,
            self._handover,
            self._crash,
            self._finish,
            self._full,
        ]
        if len(self._names) > 2:
            kinds += [self._partition, self._shut_out, self._deaf, self._mute, self._storm, self._slow, self._blink, self._prefer]
            kinds += [self._mute_primary, self._stall_primary, self._stall_primary, self._standby_out, self._worst, self._worst]
            kinds += [self._promote]
        return kinds

    # The network

    def _cut(self) -> None:
        self._cut_ways((self._name, self._other), (self._other, self._name))

    def _one_way(self) -> None:
        self._cut_ways((self._name, self._other))

    def _partition(self) -> None:
        """Two groups that do not hear each other, or only one of them hears the other."""
        group = {name for name in self._names if self._random.random() < 0.5}
        across = [(one, other) for one in self._names for other in self._names if (one in group) and (other not in group)]
        self._cut_ways(*across, *(way[::-1] for way in across if self._random.random() < 0.8))

    def _shut_out(self) -> None:
        self._cut_ways(*self._ways_out(), *(way[::-1] for way in self._ways_out()))

    def _deaf(self) -> None:
        """One robot hears no other, and all hear it."""
        self._cut_ways(*(way[::-1] for way in self._ways_out()))

    def _mute(self) -> None:
        """One robot hears all, and no other hears it."""
        self._cut_ways(*self._ways_out())

    def _mute_primary(self) -> None:
        """Its lease lasts as long as it can."""
        self._aim()
        self._mute()

    def _worst(self) -> None:
        """The primary loses its power while its standby is cut off."""
        self._aim()
        primary, self._name = self._name, self._standby()
        self._shut_out()
        self._name = primary
        self._power_cut()

    def _standby_out(self) -> None:
        """The standby is away long enough for another one to be chosen."""
        self._aim()
        self._name, self._pause_ns = self._standby(), max(self._pause_ns, 400 * MS)
        self._power_cut()

    def _aim(self) -> None:
        """At the robot where the component acts, if there is one."""
        self._name = next(iter(self._world.acting(self._spec.name)), self._name)

    def _standby(self) -> str:
        robot = self._world.robots[self._name]
        views = robot.node.status(self._world.local(robot)).components if robot.node is not None else ()
        return next((view.standby for view in views if view.name == self._spec.name and view.standby), self._other)

    def _storm(self) -> None:
        """For a while half of everything is lost, and the rest is late, out of order, and twice there."""
        network = self._world.network
        before = (network.loss, network.duplicate, network.spread_ns)
        network.loss, network.duplicate, network.spread_ns = 0.5, 0.3, 250 * MS
        self._world.note(f"a storm for {self._pause_ns / MS:.0f} ms")
        self._world.after(self._pause_ns, lambda: network.calm(before))

    def _ways_out(self) -> list[tuple[str, str]]:
        return [(self._name, other) for other in self._names if other != self._name]

    def _cut_ways(self, *ways: tuple[str, str]) -> None:
        cuts = self._world.network.cuts
        self._world.note(f"cut {' '.join('>'.join(way) for way in ways)} for {self._pause_ns / MS:.0f} ms")
        cuts.update(ways)
        self._world.after(self._pause_ns, lambda: cuts.difference_update(ways))

    # Robots

    def _power_cut(self) -> None:
        self._outage(self._world.power_off)

    def _agent_dies(self) -> None:
        self._outage(self._world.agent_dies)

    def _blink(self) -> None:
        """The agent is back at once: before any robot can miss it."""
        self._pause_ns = self._random.randrange(1, 20) * MS
        self._outage(self._world.agent_dies)

    def _outage(self, stop: Callable[[str], None]) -> None:
        stop(self._name)
        is_careful = self._endless and self._world.robots[self._name].config.boot_patience_ms > 0
        if is_careful and self._random.random() < SEALED:
            self._seal()
        self._world.after(self._pause_ns, lambda: self._world.power_on(self._name))

    def _seal(self) -> None:
        """It comes back with a key that its team does not know, and has the right one some time later."""
        sealed = self._world.network.sealed
        ways = {*self._ways_out(), *(way[::-1] for way in self._ways_out())}
        self._world.note(f"{self._name} comes back with a wrong key")
        sealed.update(ways)
        self._world.after(self._pause_ns + SEALED_MS * MS, lambda: sealed.difference_update(ways))

    def _stall(self) -> None:
        self._world.stall(self._name, self._pause_ns)

    def _stall_primary(self) -> None:
        """Only its guard knows of the lease, until after that is over."""
        self._aim()
        self._pause_ns += self._world.robots[self._name].config.loyalty_ns
        self._stall()

    def _jump(self) -> None:
        self._world.jump(self._name, self._pause_ns)

    def _slow(self) -> None:
        robot = self._world.robots[self._name]
        before, robot.slow = robot.slow, 10
        self._world.after(self._pause_ns, lambda: setattr(robot, "slow", before))

    def _full(self) -> None:
        robot = self._world.robots[self._name]
        robot.broken_store = True
        self._world.after(self._pause_ns, lambda: setattr(robot, "broken_store", False))

    # Programs and operators

    def _crash(self) -> None:
        self._invariants.crashing.add((self._name, self._spec.name))
        self._world.program_ends(self._name, self._spec.name, CRASH)

    def _finish(self) -> None:
        if self._random.random() < FINISHES:
            self._world.program_ends(self._name, self._spec.name, 0)

    def _handover(self) -> None:
        self._world.command(self._name, Handover(self._world.request(), self._spec.name))

    def _promote(self) -> None:
        """The primary is lost and its standby out of reach: an operator has another robot run it, as soon as that may be."""
        self._pause_ns = max(self._pause_ns, PROMOTED_MS * MS)
        self._worst()
        for after_ms in PROMOTED_MS, 2 * PROMOTED_MS:
            order = Promote(self._world.request(), self._spec.name)
            self._world.after(after_ms * MS, lambda order=order: self._world.command(self._other, order))

    def _prefer(self) -> None:
        """It is to run elsewhere from now on, where something is lacking now and then."""
        self._world.robots[self._other].lacks = None
        self._world.command(self._name, Prefer(self._world.request(), self._spec.name, self._other))
