"""etcd as the rules see it, and what goes wrong with it: it is down, slow, out of reach of one robot; its lease clock jumps;

answers are lost after what they tell of was done; requests that were given up arrive later;"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import TYPE_CHECKING

import msgspec

from failover.core.election.coordinator import (
    Answer,
    Arbiter,
    Dialogue,
    Grant,
    KeepAlive,
    Leased,
    Put,
    Request,
    Round,
    Said,
    Seat,
    Swap,
    Swapped,
    Word,
)
from failover.core.events import Received
from failover.core.types import MS
from tests.simulation.robots import TEAM, Clock, Robot

if TYPE_CHECKING:
    from tests.simulation.world import World

Fault = Callable[[str, int], None]
"""Called with the robot that it hits, and for how long (ns)."""

LEAP_NS = 1_000 * MS
"""More than any lease lasts."""

LATE = 20
"""A request that is held up arrives so many patiences later at most: long after it was given up."""


@dataclass(slots=True)
class Etcd:
    """The store. ``leases``: until when each lasts, by its own clock, and for how long; ``votes``: all ever given."""

    clock: Clock
    revision: int = 1
    kept: dict[str, tuple[bytes, int, int]] = field(default_factory=dict)
    leases: dict[int, tuple[int, int]] = field(default_factory=dict)
    granted: int = 0
    votes: set[tuple[str, int, str]] = field(default_factory=set)
    cluster: int = 1

    def answer(self, request: Request, true_ns: int) -> Answer:
        """Carry a request out."""
        now_ns = self.clock.read(true_ns)
        over = {lease for lease, (until_ns, _) in self.leases.items() if now_ns >= until_ns}
        self.leases = {lease: terms for lease, terms in self.leases.items() if lease not in over}
        for key in [key for key, (_, _, lease) in self.kept.items() if lease in over]:
            del self.kept[key]
            self.revision += 1
        match request:
            case Grant(ttl_ms):
                self.granted += 1
                self.leases[self.granted] = now_ns + ttl_ms * MS, ttl_ms * MS
                return Leased(self.granted)
            case KeepAlive(lease):
                if lease not in self.leases:
                    return Leased(0)
                self.leases[lease] = now_ns + self.leases[lease][1], self.leases[lease][1]
                return Leased(lease)
        return self._swap(request)

    def _swap(self, request: Swap) -> Answer:
        if any(put.lease and put.lease not in self.leases for put in request.puts):
            return Leased(0)
        before = dict(self.kept)
        done = [put for put in request.puts if all((before[key][1] if key in before else 0) == at for key, at in put.compared)]
        if done:
            self.revision += 1
            self.kept.update({put.key: (put.value, self.revision, put.lease) for put in done})
            self._note_votes(request.prefix, done)
        found = {key: kept[:2] for key, kept in self.kept.items() if key.startswith(request.prefix)}
        return Swapped(len(done) == len(request.puts), self.revision, found, self.cluster)

    def _note_votes(self, prefix: str, done: list[Put]) -> None:
        for put in done:
            kind, _, name = put.key.removeprefix(prefix).partition("/")
            if kind == "component":
                seat = msgspec.msgpack.decode(put.value, type=Seat)
                self.votes.add((f"/{name}", seat.epoch, seat.primary))


@dataclass(slots=True)
class Client:
    """One robot's process that speaks with etcd, in one life of its agent."""

    arbiter: Arbiter
    dialogue: Dialogue
    life: int
    is_busy: bool = False


class Coordination:
    """etcd and the ways to it, in one world.

    Attributes:
        down: nothing is answered. cut: robots out of its reach. slow: its answers take so many times as long.
        lost: share of the requests, and of the answers, that are lost; held: share of the requests that arrive far too late.
    """

    def __init__(self, world: World, random: Random) -> None:
        self._world = world
        self._random = random
        self.etcd = Etcd(Clock(1 + random.uniform(-0.05, 0.05), 0))
        self._clients: dict[str, Client] = {}
        self.down = False
        self.cut: set[str] = set()
        self._late: set[str] = set()
        self.slow, self.lost, self.held = 1.0, 0.0, 0.0
        self.rounds = 0

    def heal(self) -> None:
        """From now on it answers, soon."""
        self.down, self.slow, self.lost, self.held = False, 1.0, 0.0, 0.0
        self.cut.clear()
        self._late.clear()

    def look(self, robot: Robot) -> None:
        """A turn of a robot's main loop is over: perhaps a round is due."""
        if robot.node is None or robot.busy:
            return
        client = self._client(robot)
        word, now_ns = robot.node.word(), self._world.local(robot)
        if not client.is_busy and client.dialogue.is_due(word, now_ns):
            self._begin(robot, client, word)

    def _client(self, robot: Robot) -> Client:
        known = self._clients.get(robot.name)
        if known is None or known.life != robot.life:
            known = Client(Arbiter(robot.config, TEAM), Dialogue(robot.config), robot.life)
            self._clients[robot.name] = known
        return known

    def _begin(self, robot: Robot, client: Client, word: Word) -> None:
        client.is_busy = True
        self.rounds += 1
        steps = client.arbiter.round(word)
        self._ask(robot, client, steps, next(steps))

    def _ask(self, robot: Robot, client: Client, steps: Round, request: Request) -> None:
        """Send a request; its answer, or its absence, goes on with the round."""
        patience_ns, open_ = robot.config.lease_ns // 2, [True]

        def arrive() -> None:
            if self.down or robot.name in self.cut:
                return
            answer = self.etcd.answer(request, self._world.now_ns)
            if self._random.random() >= self.lost:
                self._world.after(self._way_ns(), lambda: settle(answer))

        def settle(answer: Answer | None) -> None:
            if not open_[0]:
                return
            open_[0] = False
            if client.life == robot.life and robot.node is not None:
                self._go_on(robot, client, steps, answer)

        if self._random.random() >= self.lost:
            is_held = self._random.random() < self.held
            held_ns = int(self._random.random() * LATE * patience_ns) if is_held else 0
            if robot.name in self._late:
                held_ns = int(self._random.random() * patience_ns)
            self._world.after(self._way_ns() + held_ns, arrive)
        self._world.after(patience_ns, lambda: settle(None))

    def _go_on(self, robot: Robot, client: Client, steps: Round, answer: Answer | None) -> None:
        said = Said(0, 0)
        if answer is not None:
            try:
                self._ask(robot, client, steps, steps.send((answer, self._world.local(robot))))
                return
            except StopIteration as end:
                said = end.value
        client.is_busy = False
        beat = client.dialogue.beat(said)
        if beat is not None:
            self._world.tell(robot.name, said)
            self._world.feed(robot, Received(beat, "etcd", paces=False))
        self._world.at(robot.clock.true(client.dialogue.next_ns()), lambda: self.look(robot))

    def _way_ns(self) -> int:
        return int(self._random.uniform(0.05, 2) * self._world.pace * self.slow * MS)

    # Faults

    def faults(self) -> tuple[Fault, ...]:
        """Each begins now, hits one robot or etcd, and ends by itself after that time."""
        often = (self._stop, self._shut_out, self._shut_out, self._leap, self._worst, self._worst, self._back_at_the_last)
        return (*often, self._be_slow, self._lose, self._hold, self._forget, self._go_back)

    def _stop(self, _robot: str, for_ns: int) -> None:
        self._world.note(f"etcd is down for {for_ns / MS:.0f} ms")
        self.down = True
        self._world.after(for_ns, lambda: setattr(self, "down", False))

    def _shut_out(self, robot: str, for_ns: int) -> None:
        self._world.note(f"{robot} does not reach etcd for {for_ns / MS:.0f} ms")
        self.cut.add(robot)
        self._world.after(for_ns, lambda: self.cut.discard(robot))

    def _worst(self, robot: str, for_ns: int) -> None:
        """All at once: a robot that acts, perhaps, reaches neither the others nor etcd, and its lease there is over too soon."""
        self._leave_alone(robot, for_ns)
        self._shut_out(robot, for_ns)
        self._leap(robot, LEAP_NS)

    def _back_at_the_last(self, robot: str, _for_ns: int) -> None:
        """A robot alone is back at etcd when its lease is just over, and the requests of the others are on their way."""
        for_ns = int(self._world.robots[robot].config.loyalty_ns * self._random.uniform(0.9, 2.5))
        self._leave_alone(robot, 3 * for_ns)
        self._shut_out(robot, for_ns)
        self._late |= set(self._world.robots) - {robot}
        self._world.after(3 * for_ns, self._late.clear)

    def _leave_alone(self, robot: str, for_ns: int) -> None:
        ways = {way for other in self._world.robots if other != robot for way in ((robot, other), (other, robot))}
        self._world.note(f"{robot} hears no other robot, nor they it, for {for_ns / MS:.0f} ms")
        self._world.network.cuts |= ways
        self._world.after(for_ns, lambda: self._world.network.cuts.difference_update(ways))

    def _be_slow(self, _robot: str, for_ns: int) -> None:
        self.slow = self._random.choice((20, 100))
        self._world.note(f"etcd is {self.slow:.0f} times as slow for {for_ns / MS:.0f} ms")
        self._world.after(for_ns, lambda: setattr(self, "slow", 1.0))

    def _lose(self, _robot: str, for_ns: int) -> None:
        self._world.note(f"half of etcd's requests and answers are lost for {for_ns / MS:.0f} ms")
        self.lost = 0.5
        self._world.after(for_ns, lambda: setattr(self, "lost", 0.0))

    def _hold(self, _robot: str, for_ns: int) -> None:
        self._world.note(f"half of the requests to etcd arrive late for {for_ns / MS:.0f} ms")
        self.held = 0.5
        self._world.after(for_ns, lambda: setattr(self, "held", 0.0))

    def _forget(self, _robot: str, _for_ns: int) -> None:
        self._world.note("all keys of etcd are deleted")
        self.etcd.kept.clear()
        self.etcd.revision += 1

    def _go_back(self, _robot: str, for_ns: int) -> None:
        """What is there now is restored later, with a revision that is as it was, or above all."""
        kept, revision = dict(self.etcd.kept), self.etcd.revision

        def restore() -> None:
            self._world.note(f"etcd is restored from a backup of {for_ns / MS:.0f} ms ago")
            self.etcd.kept = dict(kept)
            self.etcd.revision = revision if self._random.random() < 0.5 else self.etcd.revision + 1_000

        self._world.after(for_ns, restore)

    def _leap(self, _robot: str, for_ns: int) -> None:
        by_ns = for_ns if for_ns == LEAP_NS else self._random.choice((1, 1, 1, -1)) * for_ns
        self._world.note(f"etcd's lease clock leaps by {by_ns / MS:.0f} ms")
        self.etcd.clock.jump(self._world.now_ns, by_ns)
