"""Record of a decision for ``failover why``: the sentence, and the facts that this robot knew at that instant.

The newest heartbeats that a robot had heard order the event logs of several robots without a comparison of their clocks: a robot
that had heard a heartbeat sent after this robot's decision decided later (`failover.core.event_log.merge`).
"""

from __future__ import annotations

from typing import Final

from msgspec import Struct

SAID: Final = "; it said: "
"""Begins, at the end of a sentence of the status or the event log, the last line that a program wrote."""


class Sighting(Struct, frozen=True):
    """One peer, as this robot had heard it.

    Attributes:
        state: alive, suspect, dead or unheard.
        boot, counter: life and number of its newest beat; 0 before the first.
        silent_ns: since that beat, whichever link it came over; our own loop's lateness is taken off.
        limit_ns: silence from which on it counts as dead.
        links: (link, silence in ns) for each link it was ever heard on; nothing is taken off.
        hears_us: it has echoed a beat of ours within a lease.
        says: its words on the component: state there, epoch, primary; "" where it has said nothing, or too long ago.
    """

    robot: str
    state: str
    boot: int
    counter: int
    silent_ns: int
    limit_ns: int
    links: tuple[tuple[str, int], ...] = ()
    hears_us: bool = False
    says: str = ""


class Facts(Struct, frozen=True):
    """The facts that this robot knew when it decided.

    Attributes:
        counter: the first beat of ours that left after it.
        epoch_before, epoch: of the component, before this step and now.
        state: of the component here, now; "" for a decision about the robot itself.
        late_ns: the most that our own loop was late within the last loyalty, this step included.
        lease_left_ns: until this robot may no longer act; None without a lease, never below 0.
        checkpoint: number of the newest checkpoint that a robot could go on from, 0 for none.
        checkpoint_age_ns: since it was captured (at the primary), or since it came (at a standby); -1: not known.
        output_pending: bytes that the program has written here and that are in no acknowledged checkpoint; -1: not counted.
        seen: every peer.
    """

    counter: int = 0
    epoch_before: int = 0
    epoch: int = 0
    state: str = ""
    late_ns: int = 0
    lease_left_ns: int | None = None
    checkpoint: int = 0
    checkpoint_age_ns: int = -1
    output_pending: int = -1
    seen: tuple[Sighting, ...] = ()


class Decision(Struct, frozen=True):
    """One decision: its sentence, its component ("" for the robot), its instant by this robot's clock, and the facts known."""

    at_ns: int
    component: str
    sentence: str
    facts: Facts = Facts()


class Line(Struct, frozen=True):
    """One decision of one robot as it is kept and told.

    Attributes:
        life: of that robot's agent; ``number``: of the line in that life, from 1. Both only grow.
        kernel: names the robot's present boot: ``at_ns`` of two lines can be compared only when it is the same.
        wall_ns: the robot's calendar then, since 1970; it may be wrong, and may have been set since.
        repeats: how often the line before it about this component was said again, without being written again.
    """

    robot: str
    life: int
    number: int
    kernel: str
    wall_ns: int
    decision: Decision
    repeats: int = 0


def without_output(sentence: str) -> str:
    """The same without what a program wrote: for a reader who may not read its output."""
    before, said, _ = sentence.partition(SAID)
    return f"{before}; only its owner and root may read what it said" if said else sentence
