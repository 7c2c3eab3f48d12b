"""A team of robots in one process: clocks, disks, programs and network are made up; the rules are the daemon's own ``Node``.

Everything that happens comes from one seed. True time is the world's alone (nanoseconds from 0); each robot reads a clock of its
own that drifts and jumps. A robot carries out one step at a time: the vote record is durable some time later, then the heartbeats
leave and the acts begin after that, and a power cut in between loses what had not happened yet.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from random import Random

from msgspec.structs import replace

from checkpoint.model import Position
from failover.core import acts
from failover.core.events import Event, Exited, Leave, Received, Tick, Unread
from failover.core.frames.lane import FrameLane, Heard
from failover.core.frames.roster import roster
from failover.core.node import Node
from failover.core.types import MS, Config, Found, Held
from failover.core.vote_record import decode, encode
from failover.core.wire.messages import Beat
from tests.simulation.archive import SimulatedArchive
from tests.simulation.coordinator import Coordination
from tests.simulation.deeds import Deeds
from tests.simulation.liars import fitting
from tests.simulation.robots import KEEPS_STATE, KEY, TEAM, Clock, Network, NewDisk, Program, Robot

QUEUE_MAX = 4_096
"""Events that may wait for one robot; more means that somebody floods."""

NOISE_NS = 100 * MS
"""Between two datagrams of somebody who sends under another's address."""

TORN = 0.5
"""Of the writes that a crash interrupts: those that got to the disk all the same."""


Watcher = Callable[["World", str, object], None]
"""Called with (world, robot, what happened): an act that is carried out, a vote record that became durable, beats that leave."""


class World:
    """All robots, the network between them, and what is going to happen."""

    def __init__(self, seed: int, configs: list[Config], watchers: tuple[Watcher, ...] = (), drift: float = 0.01) -> None:
        """
        Args:
            drift: how far a clock's rate may be off, of 1.
        """
        self.random = Random(seed)
        self.pace = 1.0
        self.faults = 0
        self.now_ns = 0
        self.unchanged = 0.0
        """Share of captures that find nothing new: of programs that commit seldom."""
        self.network = Network()
        self.values: dict[Position, int] = {}
        self.log: list[str] = []
        self.restarts: list[tuple[str, bool]] = []
        """Planned ones: of whose agent, and whether its peers had promised to wait."""
        self._watchers = watchers
        self._agenda: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._deeds = Deeds(self)
        self._requests = itertools.count(1)
        self.coordination: Coordination | None = None
        self.robots: dict[str, Robot] = {}
        for config in configs:
            clock = Clock(
                1 + self.random.choice((-1, 1, -1, 1, self.random.uniform(-1, 1))) * drift, self.random.randrange(10**15)
            )
            self.robots[config.robot] = Robot(config.robot, config, clock)
        self.archive: SimulatedArchive | None = None
        if configs[0].coordinator:
            self.coordination = Coordination(self, self.random)
        if any(config.copies_ms for config in configs):
            self.archive = SimulatedArchive(self, Random(seed ^ 0xA5C4))
            self.archive.begin()

    # Time

    def at(self, true_ns: int, happen: Callable[[], None]) -> None:
        """Let something happen at an instant."""
        heapq.heappush(self._agenda, (max(true_ns, self.now_ns), next(self._order), happen))

    def after(self, delay_ns: int, happen: Callable[[], None]) -> None:
        """Let something happen after a while."""
        self.at(self.now_ns + delay_ns, happen)

    def run(self, until_ns: int) -> None:
        """Let the world go on until an instant."""
        while self._agenda and self._agenda[0][0] <= until_ns:
            self.now_ns, _, happen = heapq.heappop(self._agenda)
            happen()
            self.tell("", None)
        self.now_ns = until_ns

    def note(self, sentence: str) -> None:
        """Something for the log that a failed seed prints."""
        self.log.append(f"{self.now_ns / MS:10.3f}  {sentence}")

    def tell(self, robot: str, what: object) -> None:
        """Tell the watchers of something that happened at a robot."""
        for watcher in self._watchers:
            watcher(self, robot, what)

    def soon(self, low_ms: float, high_ms: float) -> int:
        """How long something takes this time, ns."""
        return int(self.random.uniform(low_ms, high_ms) * self.pace * MS)

    # Lives of robots

    def power_on(self, name: str) -> None:
        """Start a robot's agent; whatever its guards kept is found."""
        robot = self.robots[name]
        if robot.node is not None:
            return
        robot.boot += 1
        robot.life += 1
        robot.inbox, robot.busy = [], False
        robot.read.clear()
        robot.unread_ns.clear()
        robot.admitted.clear()
        robot.capturing.clear()
        robot.keeper.clear()
        robot.lane = FrameLane(name, TEAM, roster(self.robots), robot.boot, robot.config.beat_ms * 1_000)
        for other in self.robots:
            if other != name:
                robot.lane.hear(other, KEY + other.encode())
                robot.lane.speak(other, KEY + name.encode())
        keep = {
            record.name
            for record in decode(robot.vote_record).records
            if record.spec and record.spec.launch.engine == KEEPS_STATE
        }
        held = tuple(
            Held(component, tuple(positions[-8:]), component in keep) for component, positions in robot.store.items() if positions
        )
        found = tuple(
            Found(
                component,
                program.epoch,
                program.exit_status is None,
                program.exit_status or 0,
                program.lease_ns if self.unfrozen(robot, component) else 0,
            )
            for component, program in robot.programs.items()
        )
        robot.node = Node(robot.config, robot.boot, decode(robot.vote_record), self.local(robot), held, found)
        self.note(f"{name} starts, life {robot.boot}")
        self.feed(robot, Tick())

    def agent_dies(self, name: str) -> None:
        """Kill the agent and the keepers; guards and programs live on. What was being written is written, or is not."""
        robot = self.robots[name]
        self._tear(robot)
        robot.node = robot.away_ns = None
        robot.life += 1
        robot.warm.clear()
        for component in robot.serial:
            robot.serial[component] += 1
        self.note(f"{name}: its agent dies")

    def restart(self, name: str, away_ns: int) -> None:
        """Restart an agent as planned: it announces that, ends when its rules say so, and another one starts a while later."""
        robot = self.robots[name]
        if robot.node is not None and robot.away_ns is None:
            robot.away_ns = away_ns
            self.note(f"{name}: its agent is about to restart")
            self.feed(robot, Leave())

    def _leave(self, robot: Robot, away_ns: int) -> None:
        assert robot.node is not None
        exposed = robot.node.exposed(self.local(robot))
        self.restarts.append((robot.name, not exposed))
        self.note(f"{robot.name}: its agent goes for {away_ns / MS:.0f} ms{f', not waited for: {exposed}' if exposed else ''}")
        self.agent_dies(robot.name)
        self.after(away_ns, lambda: self.power_on(robot.name))

    def _tear(self, robot: Robot) -> None:
        """A rename, or a new file, that was on its way to the disk: it got there and nobody was told, or it did not."""
        if robot.pending is not None and self.random.random() < TORN:
            robot.vote_record = encode(robot.pending)
            self.tell(robot.name, robot.pending)
        for component, position in robot.writing:
            if self.random.random() < TORN:
                robot.store.setdefault(component, []).append(position)
        robot.pending = None
        robot.writing.clear()

    def new_disk(self, name: str, vote_record: bool) -> None:
        """The checkpoints of a robot that is off are gone; perhaps what it has decided, too (not how often it started)."""
        robot = self.robots[name]
        lost = tuple(position for positions in robot.store.values() for position in positions)
        robot.store.clear()
        robot.vote_record = robot.vote_record if not vote_record else b""
        self.note(f"{name} gets a new disk{', and forgets its votes' if vote_record else ''}")
        self.tell(name, NewDisk(vote_record, lost))

    def later(self, name: str, epochs: int) -> None:
        """Switch a robot off; so many epochs more have passed when it comes back, as its disk says."""
        self.power_off(name)
        robot = self.robots[name]
        durable = decode(robot.vote_record)
        records = tuple(replace(record, epoch=record.epoch + epochs) for record in durable.records)
        robot.vote_record = encode(replace(durable, records=records))

    def power_off(self, name: str) -> None:
        """Take everything that is not on the disk."""
        self.agent_dies(name)
        self.robots[name].programs.clear()
        self.note(f"{name} loses its power")

    def stall(self, name: str, for_ns: int) -> None:
        """The agent's loop gets no processor for a while; guards do."""
        robot = self.robots[name]
        robot.stalled_until_ns = max(robot.stalled_until_ns, self.now_ns + for_ns)
        self.note(f"{name} stalls for {for_ns / MS:.0f} ms")
        self.at(robot.stalled_until_ns, lambda: self._work(robot))

    def jump(self, name: str, by_ns: int) -> None:
        """The robot's clock leaps ahead."""
        self.robots[name].clock.jump(self.now_ns, by_ns)
        self.note(f"the clock of {name} leaps by {by_ns / MS:.0f} ms")

    def command(self, name: str, event: Event) -> None:
        """An operator's command."""
        self.note(f"operator at {name}: {event}")
        self.feed(self.robots[name], event)

    def request(self) -> int:
        """A fresh number for a command."""
        return next(self._requests)

    def program_ends(self, name: str, component: str, status: int) -> None:
        """The program at a robot exits or is killed, if it is there and not frozen."""
        robot = self.robots[name]
        program = robot.programs.get(component)
        if program is None or program.exit_status is not None or not self.unfrozen(robot, component):
            return
        self.settle(robot, program)
        program.exit_status = status
        self.note(f"{name}: {component} ends with status {status}")
        self.feed(robot, Exited(component, program.epoch, status))

    def local(self, robot: Robot) -> int:
        """What the robot's clock shows."""
        return robot.clock.read(self.now_ns)

    def unfrozen(self, robot: Robot, component: str) -> bool:
        """Whether a copy computes at this very instant."""
        program = robot.programs.get(component)
        if program is None or program.exit_status is not None or program.frozen or program.lapsed:
            return False
        return not program.lease_ns or self.local(robot) < program.lease_ns

    def acting(self, component: str) -> list[str]:
        """The robots where the component computes at this instant."""
        return [name for name, robot in self.robots.items() if self.unfrozen(robot, component)]

    def settle(self, robot: Robot, program: Program) -> None:
        """Add up what the program has computed, and let a lease that has run out freeze it until the next one."""
        ran_until_ns = self.now_ns
        if program.lease_ns and self.local(robot) >= program.lease_ns:
            ran_until_ns = min(robot.clock.true(program.lease_ns), self.now_ns)
        if not program.frozen and not program.lapsed and program.exit_status is None:
            program.value += max(ran_until_ns - program.since_ns, 0)
        program.lapsed = program.lapsed or ran_until_ns < self.now_ns
        program.since_ns = self.now_ns

    # The loop of one robot

    def feed(self, robot: Robot, event: Event) -> None:
        """Tell a robot's rules of an event, when they get to it; an agent that is off hears nothing."""
        if robot.node is None:
            return
        robot.inbox.append(event)
        assert len(robot.inbox) <= QUEUE_MAX, f"{robot.name}: {len(robot.inbox)} events wait"
        self._work(robot)

    def _work(self, robot: Robot) -> None:
        """Step once, if there is something to step and nothing in the way."""
        if robot.node is None or robot.busy or self.now_ns < robot.stalled_until_ns:
            return
        now_ns = self.local(robot)
        if not robot.inbox:
            if robot.node.next_deadline_ns() > now_ns:
                return
            robot.inbox.append(Tick())
        ready = robot.node.step(robot.inbox.pop(0), now_ns)
        life = robot.life
        robot.busy = True
        robot.pending = ready.persist
        disk_ns = self.soon(0.1, 4) * robot.slow if ready.persist is not None else 0
        self.after(disk_ns, lambda: self._persisted(robot, life, ready))

    def _persisted(self, robot: Robot, life: int, ready: acts.Ready) -> None:
        if robot.life != life:
            return
        robot.pending = None
        if ready.persist is not None:
            robot.vote_record = encode(ready.persist)
            self.tell(robot.name, ready.persist)
        wait_ns = self.soon(0, 0.2) if ready.persist is not None else 0
        self.after(wait_ns, lambda: self._obey(robot, life, ready))

    def _obey(self, robot: Robot, life: int, ready: acts.Ready) -> None:
        if robot.life != life:
            return
        robot.busy = False
        robot.told += ready.told
        for beat in ready.send:
            self.tell(robot.name, beat)
            self._send(robot, beat)
        for act in ready.act:
            self.tell(robot.name, act)
            self._deeds.carry_out(robot, act)
        if robot.away_ns is not None and robot.node is not None and robot.node.may_go(self.local(robot)):
            self._leave(robot, robot.away_ns)
            return
        if self.coordination is not None:
            self.coordination.look(robot)
        if robot.inbox:
            self.after(0, lambda: self._work(robot))
        elif robot.node is not None:
            self.at(robot.clock.true(robot.node.next_deadline_ns()), lambda: self._work(robot))

    def _send(self, robot: Robot, beat: Beat) -> None:
        """One frame for all; whoever lies makes one for each."""
        assert robot.lane is not None
        others = [other for other in self.robots.values() if other is not robot]
        for part in others if robot.lie is not None else [None]:
            said = beat if robot.lie is None or part is None else fitting(robot.lie(self, beat, part.name), len(self.robots))
            made, _ = robot.lane.seal(said, (), self.local(robot))
            for sealed in made:
                for other in others if part is None else [part]:
                    if other.name in sealed.to:
                        for datagram in sealed.datagrams:
                            self.transmit(robot.name, other, datagram)

    # The network

    def passes(self, sender: str, receiver: str) -> bool:
        """Whether a message gets through at this instant."""
        return (sender, receiver) not in self.network.cuts and self.random.random() >= self.network.loss

    def transmit(self, sender: str, to: Robot, frame: bytes) -> None:
        """Put a frame on the network: it may be lost, doubled or late."""
        copies = 1 + (self.random.random() < self.network.duplicate)
        for _ in range(copies):
            if self.passes(sender, to.name):
                delay_ns = self.network.delay_ns + int(self.random.random() * self.network.spread_ns)
                self.after(delay_ns, lambda: self._arrive(sender, to, frame))

    def noise(self, sender: str, receiver: str, until_ns: int) -> None:
        """Let somebody send from a robot's address what that robot did not seal."""
        if self.now_ns < until_ns:
            self.feed(self.robots[receiver], self._unread(sender, self.robots[receiver]))
            self.after(NOISE_NS, lambda: self.noise(sender, receiver, until_ns))

    def _unread(self, sender: str, robot: Robot) -> Unread:
        return Unread(sender if sender in robot.config.peers else "", "a wrong key")

    def _arrive(self, sender: str, robot: Robot, frame: bytes) -> None:
        if robot.node is None:
            return
        if (sender, robot.name) in self.network.sealed:
            robot.unread_ns[sender] = self.now_ns
            self.feed(robot, self._unread(sender, robot))
            return
        assert robot.lane is not None
        heard = robot.lane.open(frame, self.local(robot))
        if isinstance(heard, Heard) and heard.part.beat is not None:
            robot.read.add(sender)
            self.feed(robot, Received(heard.part.beat, "wire"))
