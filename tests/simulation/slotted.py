"""A team of robots on one radio in virtual time: the same `Slots` as in the agent, or none, on clocks that differ and drift.

True time is the agenda's alone, from 0. Everything random comes from one seed.
"""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import Any, Final, Protocol

from failover.core.frames.roster import Roster, roster
from failover.core.frames.slots import Slots
from failover.core.frames.terms import Own, SlotView, Terms
from failover.core.types import MS
from tests.simulation.radio import US, Agenda, Packet, Radio, Rates

FRAME_SIZE: Final = 379
ECHO_SIZE: Final = 1_000
YEARS_NS: Final = 3 * 365 * 86_400 * 1_000 * MS


class Pacer(Protocol):
    """When a robot sends."""

    def next_ns(self) -> int: ...

    def due(self, now_ns: int) -> bool: ...

    def sent(self, left_ns: int, counter: int = 0) -> None: ...


class Unsynchronised:
    """What teams run: a timer of its own, with so much of random jitter (0.05: ± 5 % of the round)."""

    def __init__(self, terms: Terms, jitter: float, random: Random, now_ns: int) -> None:
        self._t_ns, self._jitter, self._random = terms.t_tup_ns, jitter, random
        self._next_ns = now_ns + self._t_ns

    def next_ns(self) -> int:
        return self._next_ns

    def due(self, now_ns: int) -> bool:
        return now_ns >= self._next_ns

    def sent(self, left_ns: int, counter: int = 0) -> None:
        self._next_ns += round(self._t_ns * (1 + self._jitter * (2 * self._random.random() - 1)))


class Robot:
    """One robot.

    Attributes:
        offset_ns, rate: its clock shows offset + rate × true time.
        slots: the rules; None while it is off, or where it runs without them.
        stands_until_ns: its loop gets no processor before.
        sends: true instants of its frames.
    """

    def __init__(self, rank: int, offset_ns: int, rate: float, terms: Terms) -> None:
        self.rank = rank
        self.offset_ns = offset_ns
        self.rate = rate
        self.terms = terms
        self.boot = self.counter = 0
        self.pacer: Pacer | None = None
        self.slots: Slots | None = None
        self.stands_until_ns = 0
        self.oversleeps_ns = 0
        self.is_deaf_meanwhile = False
        self.unread: list[tuple[SlotView, int]] = []
        self.wake = 0
        self.armed_ns = -1
        self.sends: list[int] = []

    def clock_ns(self, true_ns: int) -> int:
        """What its clock shows then."""
        return self.offset_ns + round(true_ns * self.rate)

    def true_ns(self, clock_ns: int) -> int:
        """When its clock shows that."""
        return round((clock_ns - self.offset_ns) / self.rate)


class Team:
    """Robots, their radio, its interference, and what was measured.

    Args:
        drift: how far a clock's rate may be off, of 1.
        wake_us: mean lateness of a wake-up (exponential).
        pacer: who decides when a robot sends, if not `Slots`.

    Attributes:
        delays_ns: of each frame from the hand-off to the end of its broadcast; ``lost``: frames that never had one.
        loss: share of receptions that fail besides; ``unheard``: pairs (from, to) that never succeed.
    """

    def __init__(
        self,
        seed: int,
        count: int,
        terms: Terms = Terms(),  # noqa: B008 (frozen)
        *,
        drift: float = 50e-6,
        wake_us: int = 100,
        rates: Rates = Rates(),  # noqa: B008 (frozen)
        size: int = FRAME_SIZE,
        pacer: Callable[[Terms, Random, int], Pacer] | None = None,
    ) -> None:
        self.random = Random(seed)
        self.agenda = Agenda()
        self.radio = Radio(self.agenda, self.random, self._broadcast, self._lost, rates)
        self.roster: Roster = roster(f"robot{number}" for number in range(1, count + 1))
        self.robots = [
            Robot(rank, self.random.randrange(-YEARS_NS, YEARS_NS), 1 + drift * (2 * self.random.random() - 1), terms)
            for rank in range(count)
        ]
        self.size = size
        self.loss = 0.0
        self.unheard: set[tuple[int, int]] = set()
        self.delays_ns: list[int] = []
        self.lost = 0
        self.watch: Callable[[Robot], None] | None = None
        self._wake_ns = wake_us * US
        self._pacer = pacer
        self._noise = (0, 0)

    # --- What happens to it -------------------------------------------------------------------------------------------------

    @property
    def now_ns(self) -> int:
        """True time."""
        return self.agenda.now_ns

    def run(self, until_ns: int) -> None:
        """Let time pass."""
        self.agenda.run(until_ns)

    def on(self, *ranks: int) -> None:
        """These robots start; each start is a life of its own."""
        for rank in ranks:
            robot = self.robots[rank]
            now_ns = robot.clock_ns(self.now_ns)
            robot.boot += 1
            robot.counter = 0
            robot.unread.clear()
            if self._pacer is None:
                robot.pacer = robot.slots = Slots(rank, self.roster, robot.terms, now_ns)
            else:
                robot.pacer = self._pacer(robot.terms, self.random, now_ns)
            self._arm(robot)

    def off(self, *ranks: int) -> None:
        """Their power is cut."""
        for rank in ranks:
            robot = self.robots[rank]
            robot.pacer = robot.slots = None
            robot.wake += 1

    def stall(self, rank: int, span_ns: int, *, is_deaf: bool = False) -> None:
        """Its loop gets no processor; what comes waits in its socket, or is lost where the whole machine sleeps."""
        robot = self.robots[rank]
        robot.stands_until_ns, robot.is_deaf_meanwhile = self.now_ns + span_ns, is_deaf
        self.agenda.at(robot.stands_until_ns, self._read, robot)

    def noise(self, every_ns: int, size: int = ECHO_SIZE) -> None:
        """An alien asks for echoes through the access point, so often; 0 ends it."""
        self._noise = (every_ns, size)
        if every_ns:
            self._echo(self._noise)

    def _echo(self, noise: tuple[int, int]) -> None:
        if noise is self._noise:
            self.radio.send(Packet(noise[1], -1, self.now_ns))
            self.agenda.at(self.now_ns + noise[0], self._echo, noise)

    # --- Sending ------------------------------------------------------------------------------------------------------------

    def _arm(self, robot: Robot) -> None:
        """Its timer is set to the instant that its pacer names; it wakes up a little later."""
        assert robot.pacer is not None
        robot.armed_ns = robot.pacer.next_ns()
        robot.wake += 1
        wakes_ns = robot.true_ns(robot.armed_ns) + 1 + round(self.random.expovariate(1) * self._wake_ns)
        self.agenda.at(max(wakes_ns, self.now_ns), self._woken, (robot, robot.wake))

    def _woken(self, whose: tuple[Robot, int]) -> None:
        robot, wake = whose
        if wake != robot.wake or robot.pacer is None:
            return
        if self.now_ns < robot.stands_until_ns:
            self.agenda.at(robot.stands_until_ns, self._woken, whose)
            return
        if robot.oversleeps_ns:
            span_ns, robot.oversleeps_ns = robot.oversleeps_ns, 0
            self.stall(robot.rank, span_ns)
            self.agenda.at(robot.stands_until_ns, self._woken, whose)
            return
        now_ns = robot.clock_ns(self.now_ns)
        if robot.pacer.due(now_ns):
            self._send(robot, now_ns)
        if self.watch is not None:
            self.watch(robot)
        self._arm(robot)

    def _send(self, robot: Robot, now_ns: int) -> None:
        assert robot.pacer is not None
        robot.counter += 1
        view = SlotView(robot.rank, robot.boot, robot.counter, robot.slots.says(now_ns)) if robot.slots is not None else None
        robot.pacer.sent(now_ns, robot.counter)
        robot.sends.append(self.now_ns)
        self.radio.send(Packet(self.size, robot.rank, self.now_ns, view))

    # --- Hearing ------------------------------------------------------------------------------------------------------------

    def _lost(self, packet: Packet) -> None:
        self.lost += packet.sender >= 0

    def _broadcast(self, packet: Packet) -> None:
        self.delays_ns.append(self.now_ns - packet.born_ns)
        if packet.content is None:
            return
        for robot in self.robots:
            if robot.slots is not None and robot.rank != packet.sender and self._gets_through(packet.sender, robot.rank):
                self._hear(robot, packet.content)

    def _gets_through(self, sender: int, to: int) -> bool:
        return (sender, to) not in self.unheard and (not self.loss or self.random.random() >= self.loss)

    def _hear(self, robot: Robot, frame: SlotView) -> None:
        came_ns = robot.clock_ns(self.now_ns)
        if self.now_ns < robot.stands_until_ns:
            if not robot.is_deaf_meanwhile:
                robot.unread.append((frame, came_ns))
            return
        self._take(robot, frame, came_ns)

    def _take(self, robot: Robot, frame: SlotView, came_ns: int) -> None:
        assert robot.slots is not None
        robot.slots.heard(frame, came_ns)
        if robot.slots.next_ns() != robot.armed_ns:
            self._arm(robot)
        if self.watch is not None:
            self.watch(robot)

    def _read(self, robot: Any) -> None:
        """Its loop runs again: what waited is read before its timer is looked at."""
        unread, robot.unread = robot.unread, []
        for frame, came_ns in unread if robot.slots is not None else []:
            self._take(robot, frame, came_ns)

    # --- What is seen -------------------------------------------------------------------------------------------------------

    def living(self) -> list[Robot]:
        """The robots that are on and may transmit."""
        return [robot for robot in self.robots if robot.slots is not None and robot.slots.own is not Own.SILENT]

    def agreed(self) -> bool:
        """Whether all that are on compute their slots from the same set: exactly those that are on."""
        living = self.living()
        wanted = sum(1 << robot.rank for robot in living)
        return all(robot.slots is not None and robot.slots.set == wanted for robot in living)

    def sends(self, since_ns: int = 0) -> list[tuple[int, int]]:
        """(true instant, rank) of all frames that were handed to a card, in order."""
        return sorted((at, robot.rank) for robot in self.robots for at in robot.sends if at >= since_ns)
