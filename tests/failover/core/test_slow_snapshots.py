"""Status of snapshots that are rare because they take long: it says so while they do, and not afterwards."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest

from checkpoint.model import Position
from failover.core import acts
from failover.core.election.consent import STATES
from failover.core.events import Captured, CaptureFailed, Event, Received, Run, Started, Tick
from failover.core.node import Node
from failover.core.types import MS, ComponentSpec, Config, Launch, Rules, State, VoteRecord
from failover.core.wire.messages import Beat, Echo, Entry

PART = "/lab/x"
BEAT_MS = 20
SLOW_MS = 1_000
INSTEAD = "instead of every"


@dataclass(slots=True)
class Primary:
    """robot1, which runs the component and was told that robot2 follows it."""

    rules: Rules = field(default_factory=Rules)
    node: Node = field(
        default_factory=lambda: Node(Config("robot1", ("robot2",), beat_ms=BEAT_MS, grace_ms=100), 1, VoteRecord(), 0)
    )
    now_ms: int = 0
    beats: int = 0
    sent: int = 0
    held: Position | None = None
    captures: list[acts.Capture] = field(default_factory=list)

    def step(self, event: Event) -> None:
        ready = self.node.step(event, self.now_ms * MS)
        self.sent = max([self.sent, *(beat.counter for beat in ready.send)])
        self.captures += [act for act in ready.act if isinstance(act, acts.Capture)]

    def pass_ms(self, ms: int) -> None:
        """Time goes by, and robot2 beats."""
        for _ in range(ms // BEAT_MS):
            self.now_ms += BEAT_MS
            self.beats += 1
            held = self.held or Position(0, 0, b"")
            word = Entry(PART, STATES.index(State.STANDBY), 1, "robot1", held.generation, held.sequence, held.digest)
            echoes = (Echo("robot1", 1, self.sent),) if self.sent else ()
            self.step(Received(Beat("robot2", 1, self.beats, 1, 0, 1, echoes, (word,)), "wire"))
            self.step(Tick())

    def begin(self, cpu_us: int = 0) -> None:
        """Until a first checkpoint has arrived."""
        self.step(Run(1, ComponentSpec(PART, launch=Launch(("x",)), rules=self.rules)))
        self.pass_ms(200)
        self.step(Started(PART, 1))
        self.deliver(BEAT_MS, cpu_us=cpu_us)

    def deliver(self, ms: int, freeze_us: int = 0, cpu_us: int = 0) -> None:
        """The next snapshot, which arrives so much later."""
        capture = self.ordered()
        parent = None if capture.base else self.held
        taken = Position(capture.generation, capture.sequence, b"d" * 16)
        self.step(Captured(PART, 1, taken, parent, freeze_us=freeze_us, cpu_us=cpu_us))
        self.pass_ms(ms)
        self.held = taken
        self.pass_ms(BEAT_MS)

    def ordered(self) -> acts.Capture:
        """The next order of a snapshot."""
        for _ in range(200):
            if self.captures:
                return self.captures.pop(0)
            self.pass_ms(BEAT_MS)
        raise AssertionError("no snapshot is ordered")

    def notes(self) -> str:
        return "; ".join(self.node.status(self.now_ms * MS).components[0].notes)


@pytest.fixture
def slow() -> Primary:
    """Its last delta took long to arrive."""
    primary = Primary()
    primary.begin()
    assert INSTEAD not in primary.notes()
    primary.deliver(SLOW_MS)
    assert INSTEAD in primary.notes()
    return primary


def test_one_that_arrives_soon_ends_it(slow: Primary) -> None:
    slow.deliver(BEAT_MS)
    assert INSTEAD not in slow.notes()


def test_where_none_is_taken_any_more_that_is_said_and_nothing_else(slow: Primary) -> None:
    slow.ordered()
    slow.step(CaptureFailed(PART, 1, "fd 7 is a socket", unsupported=True))
    assert "not captured: fd 7 is a socket" in slow.notes()
    assert INSTEAD not in slow.notes()


def ordered_after_ms(primary: Primary) -> int:
    """How much later the next snapshot is ordered than now."""
    now_ms = primary.now_ms
    primary.captures.insert(0, primary.ordered())
    return primary.now_ms - now_ms


def test_a_program_stands_still_for_no_more_than_a_tenth_of_its_time() -> None:
    primary = Primary()
    primary.begin()
    for _ in range(2):
        primary.deliver(BEAT_MS, freeze_us=60_000)
    assert "captured every 0.6 s instead of every 0.1 s: each capture stops it for 60 ms" in primary.notes()
    assert 500 <= ordered_after_ms(primary) <= 600
    primary.deliver(BEAT_MS, freeze_us=2_000)
    assert INSTEAD not in primary.notes()
    assert ordered_after_ms(primary) <= 100


def test_one_long_freeze_among_short_ones_changes_nothing() -> None:
    primary = Primary()
    primary.begin()
    for freeze_us in (2_000, 2_000, 90_000):
        primary.deliver(BEAT_MS, freeze_us=freeze_us)
    assert ordered_after_ms(primary) <= 100


def test_captures_take_no_more_processor_time_than_their_share() -> None:
    primary = Primary(Rules(cpu_share=0.05))
    primary.begin()
    for _ in range(2):
        primary.deliver(BEAT_MS, cpu_us=40_000)
    assert "captured every 0.8 s instead of every 0.1 s: each capture takes 40 ms of processor time" in primary.notes()
    assert "captures may take 5.0% of a core (cpu_share)" in primary.notes()
    assert 700 <= ordered_after_ms(primary) <= 800
    primary.deliver(BEAT_MS, cpu_us=4_000)
    assert INSTEAD not in primary.notes()
    assert ordered_after_ms(primary) <= 100


def test_what_a_base_takes_does_not_slow_the_deltas_down() -> None:
    primary = Primary(Rules(cpu_share=0.05))
    primary.begin(cpu_us=3_000_000)
    assert ordered_after_ms(primary) <= 100
