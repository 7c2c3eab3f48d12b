"""Parts of a simulated world: clocks, disks, programs, robots, the network between them."""

from __future__ import annotations

from dataclasses import dataclass, field

from checkpoint.model import Position
from failover.core.event_log.decisions import Decision
from failover.core.events import Event
from failover.core.frames.lane import FrameLane
from failover.core.node import Node
from failover.core.types import MS, Config, Launch, VoteRecord
from failover.core.vote_record import decode
from tests.simulation.liars import Lie

TEAM = "simulated"
KEY = bytes(range(32))

KEEPS_STATE = "cooperative"
"""The engine of programs that keep their state, and so wait at a standby."""


@dataclass(frozen=True, slots=True)
class NewDisk:
    """A robot has lost its checkpoints; ``vote_record``: and its votes."""

    vote_record: bool
    lost: tuple[Position, ...]


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
    """One robot: a clock, a disk, programs, and (while its agent lives) the rules.

    Attributes:
        lacks: what it says that it lacks when it is asked; None: something now and then.
        lie: what becomes of its beats on their way, while somebody else has its key.
        lane: the frames of this life.
        away_ns: its agent is about to restart, and stays away for so long.
        read: robots whose beats it has authenticated in this life; ``unread_ns``: when it last received what it could not.
    """

    name: str
    config: Config
    clock: Clock
    boot: int = 0
    vote_record: bytes = b""
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
    lane: FrameLane | None = None
    read: set[str] = field(default_factory=set)
    unread_ns: dict[str, int] = field(default_factory=dict)
    life: int = 0
    busy: bool = False
    stalled_until_ns: int = 0
    slow: float = 1
    broken_store: bool = False
    refuses: bool = False
    failing: int = 0
    lacks: tuple[str, ...] | None = ()
    pending: VoteRecord | None = None
    lie: Lie | None = None
    away_ns: int | None = None
    told: list[Decision] = field(default_factory=list)
    writing: list[tuple[str, Position]] = field(default_factory=list)


@dataclass(slots=True)
class Network:
    """How messages fare.

    Attributes:
        cuts: directed pairs that nothing passes.
        sealed: directed pairs between which nothing can be authenticated: one of them has a wrong key, or an old team file.
        healed: for good, whatever storm is still to pass.
    """

    loss: float = 0.0
    duplicate: float = 0.0
    delay_ns: int = 1 * MS
    spread_ns: int = 1 * MS
    cuts: set[tuple[str, str]] = field(default_factory=set)
    sealed: set[tuple[str, str]] = field(default_factory=set)
    healed: bool = False

    def calm(self, weather: tuple[float, float, int]) -> None:
        """Set loss, duplication and spread as they were before a storm."""
        if not self.healed:
            self.loss, self.duplicate, self.spread_ns = weather

    def heal(self) -> None:
        """From now on everything arrives, soon."""
        self.cuts.clear()
        self.sealed.clear()
        self.calm((0, 0, 1 * MS))
        self.healed = True


def vote_record_of(robot: Robot) -> VoteRecord:
    """What the robot will remember after a power cut at this instant."""
    return decode(robot.vote_record)
