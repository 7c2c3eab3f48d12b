"""What a takeover from the archive resumes: the newest copy that the archive had when etcd would vote for that robot."""

from __future__ import annotations

from dataclasses import dataclass, field

from checkpoint.model import Position
from failover.core import acts
from failover.core.election.coordinator import Said
from failover.core.events import Looked
from failover.core.types import MS, Resumption, State
from failover.core.wire.messages import FREE
from tests.simulation.deeds import epoch_of
from tests.simulation.invariants import Invariants, broken
from tests.simulation.robots import vote_record_of
from tests.simulation.world import World

CLOCKS = 0.8
"""Of a wait, as other clocks than the waiting robot's may count it."""


@dataclass(frozen=True, slots=True)
class Chance:
    """Since when etcd would vote for a robot: by true time, and by its clock; what the archive had then, None: nothing."""

    true_ns: int
    local_ns: int
    newest: Position | None


@dataclass(slots=True)
class Freshness:
    """Watches a world with an archive. docs/coordinator.md, "Robots that share only etcd and an archive", points 4 and 5.

    Attributes:
        chances: by robot and component; looked: when the last list that a robot got was asked for, by its clock.
        former: copies of a component's program before it was begun anew.
        claims: takeovers that a robot has claimed, and whether it then had to have what the archive had.
        compared: takeovers for which there was a copy in the archive, and it had to be that one or a later one.
    """

    invariants: Invariants
    chances: dict[tuple[str, str], Chance] = field(default_factory=dict)
    looked: dict[str, int] = field(default_factory=dict)
    former: dict[str, set[Position]] = field(default_factory=dict)
    claims: dict[tuple[str, str], bool] = field(default_factory=dict)
    compared: int = 0

    def __call__(self, world: World, robot: str, what: object) -> None:
        """Look at one thing that happened."""
        if robot in world.robots:
            self._note_claims(world, robot)
        match what:
            case Said():
                self._said(world, robot, what)
            case Looked():
                self.looked[robot] = what.begun_ns
            case acts.Start():
                self.former.setdefault(what.component, set()).update(_copies(world, what.component))
            case acts.Restore() if what.why is Resumption.TAKEN_OVER:
                self._resumes(world, robot, what)

    def _said(self, world: World, robot: str, said: Said) -> None:
        """etcd would vote for whom its seat is free; a component without a seat is anybody's."""
        bound = {entry.name for entry in said.entries if not entry.flags & FREE}
        for component in {spec.name for spec in world.robots[robot].config.components}:
            if component in bound:
                self.chances.pop((robot, component), None)
            elif (robot, component) not in self.chances:
                valid = (one for one in _copies(world, component) if self._may_resume(world, robot, component, one))
                newest = max(valid, default=None)
                self.chances[robot, component] = Chance(world.now_ns, world.local(world.robots[robot]), newest)

    def _note_claims(self, world: World, robot: str) -> None:
        """What was known when a robot claimed is what counts: a list that comes afterwards changes nothing."""
        node = world.robots[robot].node
        claimed = {name for name, one in node._components.items() if one.state is State.CLAIMING} if node is not None else set()
        for component in claimed - {name for of, name in self.claims if of == robot}:
            chance = self.chances.get((robot, component))
            freed_ns = node._components[component].freed_ns if node is not None else 0
            self.claims[robot, component] = chance is not None and not self._is_excused(world, robot, chance, freed_ns)
        for of, name in [one for one in self.claims if one[0] == robot and one[1] not in claimed]:
            if node is None or node._components[name].state is not State.TAKING_OVER:
                del self.claims[of, name]

    def _may_resume(self, world: World, robot: str, component: str, position: Position) -> bool:
        """Whether it is neither of a life of the component that has ended, nor of a line that lost."""
        record = next((one for one in vote_record_of(world.robots[robot]).records if one.name == component), None)
        is_lost = record is not None and (position.generation in record.lost or epoch_of(position) <= record.void)
        return not is_lost and position not in self.former.get(component, ())

    def _resumes(self, world: World, robot: str, act: acts.Restore) -> None:
        chance = self.chances.get((robot, act.component))
        is_lost = (act.component, act.epoch) in self.invariants.ordered
        if chance is None or chance.newest is None or is_lost or not self.claims.get((robot, act.component), False):
            return
        self.compared += 1
        if act.position < chance.newest and self._may_resume(world, robot, act.component, chance.newest):
            since_ms = (world.now_ns - chance.true_ns) / MS
            had = f"the archive had {chance.newest} when etcd would vote for it, {since_ms:.0f} ms ago"
            raise broken(world, f"{robot} resumes {act.component} from {act.position}: {had}")

    def _is_excused(self, world: World, robot: str, chance: Chance, freed_ns: int) -> bool:
        """Whether the archive showed what was old, or did not answer for as long as a takeover waits for it.

        Args:
            freed_ns: since when the robot waits, by its clock: since etcd would vote, or was not there to ask.
        """
        assert world.archive is not None
        if world.archive.aged is not None or world.archive.true_since_ns > chance.true_ns:
            return True
        now_ns = world.local(world.robots[robot])
        waited_ns = now_ns - (freed_ns or now_ns)
        answered = self.looked.get(robot, -1) >= chance.local_ns
        return not answered and waited_ns >= world.robots[robot].config.retry_ms * MS * CLOCKS


def _copies(world: World, component: str) -> list[Position]:
    assert world.archive is not None
    return world.archive.copies_of(component)
