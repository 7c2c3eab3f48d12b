"""What the rules of one robot tell those of another, as msgspec structs. The bytes are in ``PROTOCOL.md``.

Beats carry state, never news: a lost beat is repaired by the next, so there is nothing to repeat and nothing to time out. A claim,
a vote, a standby's acknowledgement and its wish for a base are fields of beats. Snapshots travel on the bulk lane, whose messages
are the agent's own (``agent/lane_messages.py``).
"""

from __future__ import annotations

import msgspec

from checkpoint.model import Position

VERSION = 1
"""Of the beat; a frame of another version is refused by name."""


class Echo(msgspec.Struct, frozen=True, array_like=True):
    """The newest beat that the sender has heard of one robot: what lets that robot count its lease from the asking."""

    robot: str
    boot: int
    counter: int


class Entry(msgspec.Struct, frozen=True, array_like=True):
    """One component as the sender of the beat holds it.

    Attributes:
        state: index into ``STATES``.
        primary: whom the sender takes for the primary of ``epoch``; naming a peer *is* the vote for it.
        generation, sequence, digest: newest position it can restore from; for a standby, its acknowledgement. Sequence 0: none.
        standby: (primary) the robot it has entrusted, "" if none.
        yields_to: (primary, handing over) the robot that may claim now.
        flags: ``NEEDS_BASE`` (standby), ``UNPROTECTED`` (primary has stopped protecting), ``HOLDS`` (on_loss is hold).
        status: of a finished component, waitpid's.
    """

    name: str
    state: int
    epoch: int
    primary: str = ""
    generation: int = 0
    sequence: int = 0
    digest: bytes = b""
    standby: str = ""
    yields_to: str = ""
    flags: int = 0
    status: int = 0

    @property
    def position(self) -> Position | None:
        """What the sender can restore from."""
        return Position(self.generation, self.sequence, self.digest) if self.sequence else None


NEEDS_BASE = 1
UNPROTECTED = 2
HOLDS = 4


class Beat(msgspec.Struct, frozen=True, array_like=True):
    """ "I live", and all that follows from it.

    Attributes:
        boot: start count of the sender's agent; ``counter``: of its beats since then, from 1.
        settled: counter of the beat since which no entry of the sender has changed its epoch, its state or its primary.
            Whoever knows an entry only from a beat older than that does not know enough to act on it.
        load: of the sender, 0 to 255.
        entries: those that fit; the others follow in the next beats, in turn. The changed ones go first.
        total: how many there are altogether.
    """

    sender: str
    boot: int
    counter: int
    settled: int = 0
    load: int = 0
    total: int = 0
    echoes: tuple[Echo, ...] = ()
    entries: tuple[Entry, ...] = ()
