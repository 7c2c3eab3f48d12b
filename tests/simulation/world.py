"""A team of robots in one process: clocks, disks, programs and network are made up; the rules are the daemon's own ``Node``.

Everything that happens comes from one seed. True time is the world's alone (nanoseconds from 0); each robot reads a clock of its
own that drifts and jumps. A robot works off one step at a time: the ballot is durable some time later, then the beats leave and
the acts begin after that, and a power cut in between loses what had not happened yet.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from random import Random

from checkpoint.model import Position
from failover.core import acts, wire
from failover.core.ballot import decode, encode
from failover.core.events import (
    ActFailed,
    Captured,
    CaptureFailed,
    Event,
    Exited,
    Received,
    Restored,
    ShipEnded,
    Started,
    Stopped,
    Stored,
    StoreFailed,
    Tick,
    Unchanged,
    Warmed,
)
from failover.core.node import Node
from failover.core.story import Decision
from failover.core.types import MS, PEERS_MAX, Ballot, ComponentSpec, Config, Found, Held, Launch, Rule

TEAM = "simulated"
KEY = bytes(range(32))
QUEUE_MAX = 4_096
"""Events that may wait for one robot; more means that somebody floods."""

TORN = 0.5
"""Of the writes that a crash interrupts: those that got to the disk all the same."""


REFUSES = 1 << 8
"""The wait status of a program that cannot read its state."""


@dataclass(frozen=True, slots=True)
class NewDisk:
    """A robot has lost its checkpoints; ``ballot``: and its votes."""

    ballot: bool
    lost: tuple[Position, ...]


KEEPS_STATE = "cooperative"
"""The engine of programs that keep their state, and so wait at a standby."""

WARM_FAILS = 0.2
"""Of the programs that are started in advance."""


@dataclass(slots=True)
class Clock:
    """One robot's clock: ``rate`` local nanoseconds per true one, from ``origin``."""

    rate: float
    origin_ns: int
    since_ns: int = 0

    def read(self, true_ns: int) -> int:
        return self.origin_ns + int((true_ns - self.since_ns) * self.rate)

    def true(self, local_ns: int) -> int:
        """The first true instant at which this clock shows ``local_ns`` or more."""
        return self.since_ns + int((local_ns - self.origin_ns) / self.rate) + 1

    def jump(self, true_ns: int, by_ns: int) -> None:
        self.origin_ns, self.since_ns = self.read(true_ns) + by_ns, true_ns


@dataclass(slots=True)
class Program:
    """A running copy and its guard.

    Attributes:
        value: how much it has computed, in true nanoseconds of running.
        frozen: by order; lapsed: because its lease ran out. A new lease lets it go on then, not after an order.
    """

    epoch: int
    lease_ns: int
    value: int = 0
    frozen: bool = False
    lapsed: bool = False
    since_ns: int = 0
    exit_status: int | None = None


@dataclass(slots=True)
class Robot:
    """One robot: a clock, a disk, programs, and (while its agent lives) the rules."""

    name: str
    config: Config
    clock: Clock
    boot: int = 0
    ballot: bytes = b""
    store: dict[str, list[Position]] = field(default_factory=dict)
    node: Node | None = None
    programs: dict[str, Program] = field(default_factory=dict)
    keeper: dict[str, Position] = field(default_factory=dict)
    admitted: dict[str, tuple[str, int]] = field(default_factory=dict)
    serial: dict[str, int] = field(default_factory=dict)
    leases: dict[str, int] = field(default_factory=dict)
    capturing: set[str] = field(default_factory=set)
    unheld: set[str] = field(default_factory=set)
    warm: dict[str, Launch] = field(default_factory=dict)
    inbox: list[Event] = field(default_factory=list)
    receiver: wire.Receiver = field(default_factory=lambda: wire.Receiver(TEAM))
    life: int = 0
    busy: bool = False
    stalled_until_ns: int = 0
    slow: float = 1
    broken_store: bool = False
    refuses: bool = False
    pending: Ballot | None = None
    told: list[Decision] = field(default_factory=list)
    writing: list[tuple[str, Position]] = field(default_factory=list)


@dataclass(slots=True)
class Network:
    """How messages fare. ``cuts``: directed pairs that nothing passes; ``healed``: for good, whatever storm is still to pass."""

    loss: float = 0.0
    duplicate: float = 0.0
    delay_ns: int = 1 * MS
    spread_ns: int = 1 * MS
    cuts: set[tuple[str, str]] = field(default_factory=set)
    healed: bool = False

    def calm(self, weather: tuple[float, float, int]) -> None:
        """Set loss, duplication and spread as they were before a storm."""
        if not self.healed:
            self.loss, self.duplicate, self.spread_ns = weather

    def heal(self) -> None:
        """From now on everything arrives, soon."""
        self.cuts.clear()
        self.calm((0, 0, 1 * MS))
        self.healed = True


Watcher = Callable[["World", str, object], None]
"""Called with (world, robot, what happened): an act that is carried out, a ballot that became durable, beats that leave."""


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
        self._watchers = watchers
        self._agenda: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._digests = itertools.count(1)
        self._requests = itertools.count(1)
        self.robots: dict[str, Robot] = {}
        for config in configs:
            clock = Clock(
                1 + self.random.choice((-1, 1, -1, 1, self.random.uniform(-1, 1))) * drift, self.random.randrange(10**15)
            )
            self.robots[config.robot] = Robot(config.robot, config, clock)

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
            self._tell("", None)
        self.now_ns = until_ns

    def note(self, sentence: str) -> None:
        """Something for whoever reads the story afterwards."""
        self.log.append(f"{self.now_ns / MS:10.3f}  {sentence}")

    def _tell(self, robot: str, what: object) -> None:
        for watcher in self._watchers:
            watcher(self, robot, what)

    def _soon(self, low_ms: float, high_ms: float) -> int:
        return int(self.random.uniform(low_ms, high_ms) * self.pace * MS)

    # Lives of robots

    def power_on(self, name: str) -> None:
        """Start a robot's agent; whatever its guards kept is found."""
        robot = self.robots[name]
        if robot.node is not None:
            return
        robot.boot += 1
        robot.life += 1
        robot.inbox, robot.busy, robot.receiver = [], False, wire.Receiver(TEAM)
        robot.admitted.clear()
        robot.capturing.clear()
        robot.keeper.clear()
        for other in self.robots:
            if other != name:
                robot.receiver.accept(other, KEY + other.encode())
        keep = {
            record.name for record in decode(robot.ballot).records if record.spec and record.spec.launch.engine == KEEPS_STATE
        }
        held = tuple(
            Held(component, tuple(positions[-8:]), component in keep) for component, positions in robot.store.items() if positions
        )
        found = tuple(
            Found(component, program.epoch, program.exit_status is None, program.exit_status or 0)
            for component, program in robot.programs.items()
        )
        robot.node = Node(robot.config, robot.boot, decode(robot.ballot), self.local(robot), held, found)
        self.note(f"{name} starts, life {robot.boot}")
        self._feed(robot, Tick())

    def agent_dies(self, name: str) -> None:
        """Kill the agent and the keepers; guards and programs live on. What was being written is written, or is not."""
        robot = self.robots[name]
        self._tear(robot)
        robot.node = None
        robot.life += 1
        robot.warm.clear()
        for component in robot.serial:
            robot.serial[component] += 1
        self.note(f"{name}: its agent dies")

    def _tear(self, robot: Robot) -> None:
        """A rename, or a new file, that was on its way to the disk: it got there and nobody was told, or it did not."""
        if robot.pending is not None and self.random.random() < TORN:
            robot.ballot = encode(robot.pending)
            self._tell(robot.name, robot.pending)
        for component, position in robot.writing:
            if self.random.random() < TORN:
                robot.store.setdefault(component, []).append(position)
        robot.pending = None
        robot.writing.clear()

    def new_disk(self, name: str, ballot: bool) -> None:
        """The checkpoints of a robot that is off are gone; perhaps what it has decided, too (not how often it started)."""
        robot = self.robots[name]
        lost = tuple(position for positions in robot.store.values() for position in positions)
        robot.store.clear()
        robot.ballot = robot.ballot if not ballot else b""
        self.note(f"{name} gets a new disk{', and forgets its votes' if ballot else ''}")
        self._tell(name, NewDisk(ballot, lost))

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
        self._feed(self.robots[name], event)

    def request(self) -> int:
        """A fresh number for a command."""
        return next(self._requests)

    def program_ends(self, name: str, component: str, status: int) -> None:
        """The program at a robot exits or is killed, if it is there and not frozen."""
        robot = self.robots[name]
        program = robot.programs.get(component)
        if program is None or program.exit_status is not None or not self.unfrozen(robot, component):
            return
        self._settle(robot, program)
        program.exit_status = status
        self.note(f"{name}: {component} ends with status {status}")
        self._feed(robot, Exited(component, program.epoch, status))

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

    # The loop of one robot

    def _feed(self, robot: Robot, event: Event) -> None:
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
        disk_ns = self._soon(0.1, 4) * robot.slow if ready.persist is not None else 0
        self.after(disk_ns, lambda: self._persisted(robot, life, ready))

    def _persisted(self, robot: Robot, life: int, ready: acts.Ready) -> None:
        if robot.life != life:
            return
        robot.pending = None
        if ready.persist is not None:
            robot.ballot = encode(ready.persist)
            self._tell(robot.name, ready.persist)
        wait_ns = self._soon(0, 0.2) if ready.persist is not None else 0
        self.after(wait_ns, lambda: self._obey(robot, life, ready))

    def _obey(self, robot: Robot, life: int, ready: acts.Ready) -> None:
        if robot.life != life:
            return
        robot.busy = False
        robot.told += ready.told
        for beat in ready.send:
            self._tell(robot.name, beat)
            frame = wire.seal(beat, TEAM, KEY + robot.name.encode())
            for other in self.robots.values():
                if other is not robot:
                    self._transmit(robot.name, other, frame)
        for act in ready.act:
            self._tell(robot.name, act)
            self._carry_out(robot, act)
        if robot.inbox:
            self.after(0, lambda: self._work(robot))
        elif robot.node is not None:
            self.at(robot.clock.true(robot.node.next_deadline_ns()), lambda: self._work(robot))

    # The network

    def passes(self, sender: str, receiver: str) -> bool:
        """Whether a message gets through at this instant."""
        return (sender, receiver) not in self.network.cuts and self.random.random() >= self.network.loss

    def _transmit(self, sender: str, to: Robot, frame: bytes) -> None:
        copies = 1 + (self.random.random() < self.network.duplicate)
        for _ in range(copies):
            if self.passes(sender, to.name):
                delay_ns = self.network.delay_ns + int(self.random.random() * self.network.spread_ns)
                self.after(delay_ns, lambda: self._arrive(to, frame))

    def _arrive(self, robot: Robot, frame: bytes) -> None:
        if robot.node is None:
            return
        beat = robot.receiver.open(frame)
        if not isinstance(beat, wire.Refused):
            self._feed(robot, Received(beat, "wire"))

    # Acts

    def _carry_out(self, robot: Robot, act: acts.Act) -> None:
        match act:
            case acts.Start() | acts.Restore() | acts.Stop():
                self._whole_program(robot, act)
            case acts.Capture():
                self._capture(robot, act)
            case acts.Ship():
                self._ship(robot, act)
            case acts.Acknowledge():
                robot.keeper[act.component] = act.position
            case acts.Admit():
                robot.admitted[act.component] = (act.sender, act.epoch)
            case acts.Forget():
                kept = [position for position in robot.store.get(act.component, []) if position.generation not in act.generations]
                robot.store[act.component] = kept
            case acts.Drop():
                robot.store.pop(act.component, None)
            case acts.Freeze() | acts.Thaw() | acts.SetLease() | acts.End() | acts.LetGo():
                self._guard(robot, act)
            case acts.Warm() | acts.Cool():
                self._warm(robot, act)
            case acts.Answer():
                self.note(f"{robot.name} answers: {'; '.join((act.sentence, *act.risks))}")

    def _guard(self, robot: Robot, act: acts.Freeze | acts.Thaw | acts.SetLease | acts.End | acts.LetGo) -> None:
        program = robot.programs.get(act.component)
        if isinstance(act, acts.SetLease):
            robot.leases[act.component] = act.until_ns
        if program is None or program.exit_status is not None:
            return
        self._settle(robot, program)
        program.epoch = max(program.epoch, act.epoch)
        match act:
            case acts.Freeze():
                program.frozen = True
            case acts.Thaw():
                robot.unheld.add(act.component)
                program.frozen, program.lapsed, program.lease_ns = False, False, act.lease_until_ns
            case acts.SetLease():
                program.lease_ns = act.until_ns
                program.lapsed = program.lapsed and 0 < act.until_ns <= self.local(robot)
            case acts.End():
                self.program_ends(robot.name, act.component, act.signal)
            case acts.LetGo():
                del robot.programs[act.component]

    def _warm(self, robot: Robot, act: acts.Warm | acts.Cool) -> None:
        """A program that waits takes a while to get there, and sometimes fails and is tried again."""
        name, life = act.component, robot.life
        robot.warm.pop(name, None)
        if isinstance(act, acts.Cool):
            return
        launch = robot.warm[name] = replace(act.spec.launch)  # one of its own, to be told from the next

        def done(ready: bool) -> None:
            if robot.life != life or robot.warm.get(name) is not launch:
                return
            self._feed(robot, Warmed(name, act.epoch, ready, "" if ready else "it ended at once"))
            if not ready:
                self.after(self._soon(50, 100), lambda: done(True))

        fails = self.random.random() < WARM_FAILS
        self.after(self._soon(20, 200) * robot.slow, lambda: done(not fails))

    def _settle(self, robot: Robot, program: Program) -> None:
        """Add up what the program has computed, and let a lease that has run out freeze it until the next one."""
        ran_until_ns = self.now_ns
        if program.lease_ns and self.local(robot) >= program.lease_ns:
            ran_until_ns = min(robot.clock.true(program.lease_ns), self.now_ns)
        if not program.frozen and not program.lapsed and program.exit_status is None:
            program.value += max(ran_until_ns - program.since_ns, 0)
        program.lapsed = program.lapsed or ran_until_ns < self.now_ns
        program.since_ns = self.now_ns

    def _whole_program(self, robot: Robot, act: acts.Start | acts.Restore | acts.Stop) -> None:
        name, life = act.component, robot.life
        robot.serial[name] = serial = robot.serial.get(name, 0) + 1
        robot.capturing.discard(name)
        robot.warm.pop(name, None)
        if not isinstance(act, acts.Stop):
            robot.leases[name] = act.lease_until_ns
        if isinstance(act, acts.Restore):
            robot.programs.pop(name, None)
        if not isinstance(act, acts.Start):
            robot.keeper.pop(name, None)

        def done() -> None:
            if robot.life != life or robot.serial[name] != serial:
                return
            match act:
                case acts.Stop():
                    robot.programs.pop(name, None)
                    self._feed(robot, Stopped(name, act.epoch))
                case acts.Start():
                    robot.programs[name] = Program(act.epoch, robot.leases[name], since_ns=self.now_ns)
                    self._feed(robot, Started(name, act.epoch))
                case acts.Restore():
                    self._restored(robot, act)

        self.after(self._soon(2, 40) * robot.slow, done)

    def _restored(self, robot: Robot, act: acts.Restore) -> None:
        if act.position not in robot.store.get(act.component, []):
            self._feed(robot, ActFailed(act.component, act.epoch, f"{act.position} is not in the store"))
            return
        program = Program(act.epoch, robot.leases[act.component], self.values[act.position], since_ns=self.now_ns)
        robot.programs[act.component] = program
        self.note(f"{robot.name}: {act.component} goes on from {act.position.generation}/{act.position.sequence}")
        self._feed(robot, Restored(act.component, act.epoch, act.position))
        if robot.refuses:
            self._refuse(robot, act.component, program)

    def _refuse(self, robot: Robot, component: str, program: Program) -> None:
        """The program cannot read its state here, and says so by its exit code."""
        program.exit_status = REFUSES
        self._feed(
            robot, Exited(component, program.epoch, REFUSES, f"{component} ended with exit code 1 before it kept anything")
        )

    def _capture(self, robot: Robot, act: acts.Capture) -> None:
        name, life, serial = act.component, robot.life, robot.serial.get(act.component, 0)
        program = robot.programs.get(name)
        if program is not None:
            program.epoch = max(program.epoch, act.epoch)
        robot.capturing.add(name)
        robot.unheld.discard(name)

        def done() -> None:
            if robot.life != life or robot.serial.get(name, 0) != serial:
                return
            robot.capturing.discard(name)
            program = robot.programs.get(name)
            if program is None or program.exit_status is not None:
                self._feed(robot, CaptureFailed(name, act.epoch, "the program is gone"))
                return
            if not self.unfrozen(robot, name):
                self._feed(robot, CaptureFailed(name, act.epoch, "its guard holds it still"))
                return
            known = robot.keeper.get(name)
            may_be_unchanged = self.unchanged and known is not None and not act.base and not act.hold
            if known is not None and may_be_unchanged and self.random.random() < self.unchanged:
                self._feed(robot, Unchanged(name, act.epoch, act.sequence, known))
                return
            self._settle(robot, program)
            program.frozen = program.frozen or (act.hold and name not in robot.unheld)
            position = Position(act.generation, act.sequence, next(self._digests).to_bytes(8, "big"))
            parent = None if act.base else robot.keeper.get(name)
            self.values[position] = program.value
            self._write(robot, name, position, Captured(name, act.epoch, position, parent, freeze_us=900))

        self.after(self._soon(1, 8) * robot.slow, done)

    def _write(self, robot: Robot, component: str, position: Position, then: Event) -> None:
        """Keep a snapshot in a robot's store, durably; only then it is told."""
        life, written = robot.life, (component, position)
        robot.writing.append(written)

        def done() -> None:
            if robot.life != life:
                return
            robot.writing.remove(written)
            if position not in robot.store.get(component, []):
                robot.store[component] = [*robot.store.get(component, []), position]
            self._feed(robot, then)

        self.after(self._soon(0, 2) * robot.slow, done)

    def _ship(self, robot: Robot, act: acts.Ship) -> None:
        life, to = robot.life, self.robots[act.to]

        def arrive() -> None:
            ok = (
                robot.life == life and self.passes(robot.name, act.to) and self.passes(act.to, robot.name) and to.node is not None
            )
            sender, epoch = to.admitted.get(act.component, ("", 0))
            admitted = sender == robot.name and epoch_of(act.position) >= epoch
            if robot.life == life:
                self._feed(robot, ShipEnded(act.component, act.epoch, act.position, act.to, ok and admitted))
            if ok and admitted:
                self._store(to, robot.name, act)

        self.after((self._soon(2, 30) + self.network.delay_ns) * robot.slow, arrive)

    def _store(self, robot: Robot, sender: str, act: acts.Ship) -> None:
        life = robot.life

        def done() -> None:
            if robot.life != life:
                return
            kept = robot.store.get(act.component, [])
            if robot.broken_store:
                self._feed(robot, StoreFailed(act.component, epoch_of(act.position), sender, "no space left", False))
            elif act.parent is not None and act.parent not in kept:
                self._feed(robot, StoreFailed(act.component, epoch_of(act.position), sender, "its parent is not here", True))
            else:
                keeps = act.spec.launch.engine == KEEPS_STATE
                stored = Stored(act.component, epoch_of(act.position), act.position, sender, act.spec, keeps)
                self._write(robot, act.component, act.position, stored)

        self.after(self._soon(1, 10) * robot.slow, done)


def pair(components: tuple[ComponentSpec, ...] = (), names: tuple[str, ...] = ("robot1", "robot2")) -> list[Config]:
    """Configurations of a small team, with times that make a minute of life cheap to simulate."""
    plain = Config(names[0], (), components, 25, 150, 20, 10, 300, 200, 2_000, 400, 3_000, 2_000)
    return [replace(plain, robot=name, peers=tuple(other for other in names if other != name)) for name in names]


def elective(
    robots: int,
    components: tuple[ComponentSpec, ...] = (),
    servers: int = 0,
    witnesses: int = 0,
    patience_ms: int = 60_000,
    lease_ms: int = 150,
) -> list[Config]:
    """Configurations of a team that votes."""
    kinds = {"robot": robots, "server": servers, "witness": witnesses}
    names = {kind: tuple(f"{kind}{number + 1}" for number in range(count)) for kind, count in kinds.items()}
    return [
        replace(
            config,
            rule=Rule.MAJORITY,
            servers=names["server"],
            witnesses=names["witness"],
            patience_ms=patience_ms,
            lease_ms=lease_ms,
            margin_percent=12,
            archive_ms=500,
            components=components if config.robot in names["robot"] else (),
        )
        for config in pair(components, sum(names.values(), ()))
    ]


def epoch_of(position: Position) -> int:
    """The epoch under which a snapshot was captured, as its file says."""
    return position.generation // (PEERS_MAX + 1)


def ballot_of(robot: Robot) -> Ballot:
    """What the robot will remember after a power cut at this instant."""
    return decode(robot.ballot)
