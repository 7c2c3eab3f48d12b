"""The archive as the rules see it, and what goes wrong with it: it is away, slow, or shows an old state; puts arrive late.

Each robot copies the newest checkpoint of what runs there into it, and takes from it what it may have to run, as its worker does
(`agent.worker.archiving`, `agent.worker.fetching`). A copy of an epoch before the newest one is refused, unless it is on its way.
"""

from __future__ import annotations

from random import Random
from typing import TYPE_CHECKING

from checkpoint.model import Position
from failover.core.events import Archived, Fetched, Looked
from failover.core.types import MS, PEERS_MAX, ComponentSpec, State
from tests.simulation.robots import KEEPS_STATE, Robot, vote_record_of

if TYPE_CHECKING:
    from tests.simulation.coordinator import Fault
    from tests.simulation.world import World

COPIES_MS = 200
"""Between two copies of a component, in lives with an archive."""

LATE_MS = 1_500
"""A put that was begun before a robot was replaced arrives so late at most."""

KEPT = 3

FAILS = 0.1
"""Of the copies that a robot wants; it lists them again in the next period."""


class SimulatedArchive:
    """The copies, and the ways to them.

    Attributes:
        down: nothing is answered. cut: robots out of its reach. slow: everything takes so many times as long.
        aged: it gives what it had when that began; true_since_ns: when that was over the last time.
    """

    def __init__(self, world: World, random: Random) -> None:
        self._world, self._random = world, random
        self._copies: dict[str, list[Position]] = {}
        self._specs: dict[str, ComponentSpec] = {}
        self.down = False
        self.cut: set[str] = set()
        self.slow = 1.0
        self.aged: dict[str, list[Position]] | None = None
        self.true_since_ns = 0
        self.puts = self.taken = self.late = 0

    def begin(self) -> None:
        """Every robot turns to it each period, from now on."""
        for robot in self._world.robots.values():
            if robot.config.copies_ms:
                self._turn(robot)

    def heal(self) -> None:
        """From now on it answers, soon."""
        self.down, self.slow = False, 1.0
        self._be_true()
        self.cut.clear()

    def copies_of(self, component: str) -> list[Position]:
        """All that it has of a component now, whatever it shows."""
        return list(self._copies.get(component, ()))

    def look(self, robot: Robot, wanted: str = "") -> None:
        """A robot's worker lists the copies, and takes what is newer than its own."""
        life, begun_ns = robot.life, self._world.local(robot)
        if robot.node is None or not self._reaches(robot):
            return
        given = {name: list(kept) for name, kept in (self._copies if self.aged is None else self.aged).items()}
        self._world.after(self._while_ns(), lambda: self._listed(robot, life, begun_ns, given, wanted))

    def _turn(self, robot: Robot) -> None:
        for component in list(robot.programs):
            self._put(robot, component)
        self.look(robot)
        self._world.after(robot.config.copies_ms * MS, lambda: self._turn(robot))

    def _reaches(self, robot: Robot) -> bool:
        return not self.down and robot.name not in self.cut

    def _while_ns(self) -> int:
        return int(self._random.uniform(1, 20) * self.slow * MS)

    def _put(self, robot: Robot, component: str) -> None:
        kept = robot.store.get(component, [])
        spec = next((one.spec for one in vote_record_of(robot).records if one.name == component), None)
        if robot.node is None or not kept or spec is None or not self._reaches(robot):
            return
        position, begun_ns, life = kept[-1], self._world.local(robot), robot.life
        there = self._copies.setdefault(component, [])
        if position in there or (there and _epoch(max(there)) > _epoch(position)):
            return
        is_late = self._random.random() < 0.1
        late_ns = int(self._random.random() * LATE_MS * MS) if is_late else 0
        self.late += is_late

        def arrive() -> None:
            self.puts += 1
            there.append(position)
            self._specs[component] = spec
            for oldest in sorted(there)[:-KEPT]:
                there.remove(oldest)
            if robot.life == life and robot.node is not None:
                self._world.feed(robot, Archived(component, _epoch(position), position, begun_ns))

        self._world.after(self._while_ns() + late_ns, arrive)

    def _listed(self, robot: Robot, life: int, begun_ns: int, given: dict[str, list[Position]], looked_for: str) -> None:
        if robot.life != life or robot.node is None or not self._reaches(robot):
            return
        wanted, skipped = {}, []
        for component, copies in given.items():
            own = robot.store.get(component, [])
            if not self._takes(robot, component, looked_for):
                skipped.append(component)
            elif copies and (not own or max(own) < max(copies)):
                wanted[component] = max(copies)
        looked = Looked(begun_ns, tuple(wanted), tuple(skipped))
        self._world.tell(robot.name, looked)
        self._world.feed(robot, looked)
        for component, newest in wanted.items():
            position, proves_ns = newest, begun_ns
            if self._random.random() < FAILS:  # the newest does not come: the one before it does, and proves nothing
                older = sorted(one for one in given[component] if one < newest)
                own = robot.store.get(component, [])
                if not older or (own and older[-1] <= max(own)):
                    continue
                position, proves_ns = older[-1], 0
            self._world.after(self._while_ns(), lambda c=component, p=position, b=proves_ns: self._come(robot, life, b, c, p))  # type: ignore[misc]

    def _takes(self, robot: Robot, component: str, looked_for: str) -> bool:
        assert robot.node is not None
        view = robot.node.status(self._world.local(robot))
        known = next((one for one in view.components if one.name == component), None)
        heard = {peer.robot for peer in view.peers if peer.state in ("alive", "suspect", "restarting")}
        return known is None or (
            known.state in (State.ABSENT, State.STANDBY) and (component == looked_for or known.primary not in heard)
        )

    def _come(self, robot: Robot, life: int, begun_ns: int, component: str, position: Position) -> None:
        if robot.life != life or robot.node is None or not self._reaches(robot):
            return
        self.taken += 1
        if position not in robot.store.setdefault(component, []):
            robot.store[component] = sorted([*robot.store[component], position])
        spec = self._specs[component]
        keeps_state = spec.launch.engine == KEEPS_STATE
        self._world.feed(robot, Fetched(component, _epoch(position), position, spec, begun_ns, keeps_state=keeps_state))

    # Faults

    def faults(self) -> tuple[Fault, ...]:
        """Each begins now, hits one robot or the archive, and ends by itself after that time."""
        return (self._stop, self._shut_out, self._shut_out, self._be_slow, self._age)

    def _stop(self, _robot: str, for_ns: int) -> None:
        self._world.note(f"the archive is down for {for_ns / MS:.0f} ms")
        self.down = True
        self._world.after(for_ns, lambda: setattr(self, "down", False))

    def _shut_out(self, robot: str, for_ns: int) -> None:
        self._world.note(f"{robot} does not reach the archive for {for_ns / MS:.0f} ms")
        self.cut.add(robot)
        self._world.after(for_ns, lambda: self.cut.discard(robot))

    def _be_slow(self, _robot: str, for_ns: int) -> None:
        self.slow = self._random.choice((20, 100))
        self._world.note(f"the archive is {self.slow:.0f} times as slow for {for_ns / MS:.0f} ms")
        self._world.after(for_ns, lambda: setattr(self, "slow", 1.0))

    def _age(self, _robot: str, for_ns: int) -> None:
        self._world.note(f"the archive shows what it has now, and nothing newer, for {for_ns / MS:.0f} ms")
        self.aged = {component: list(copies) for component, copies in self._copies.items()}
        self._world.after(for_ns, self._be_true)

    def _be_true(self) -> None:
        if self.aged is not None:
            self.aged, self.true_since_ns = None, self._world.now_ns


def _epoch(position: Position) -> int:
    return position.generation // (PEERS_MAX + 1)
