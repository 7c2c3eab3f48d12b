"""Messages between the rules of two robots, as msgspec structs. The bytes are in ``PROTOCOL.md``.

Two kinds. *Heartbeats* carry state, never news: the next heartbeat repairs a lost one, so there is nothing to repeat and nothing
to time out. A claim, a vote, a standby's acknowledgement, its wish for a base are fields of heartbeats. The *replication link*
carries snapshots, in chunks, under credit.
"""

from __future__ import annotations

import msgspec

from checkpoint.model import Position
from failover.core.types import ComponentSpec, Rule

VERSION = 2
"""Of the replication link; a peer of another version is refused by name."""


class Echo(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The newest beat that the sender has heard of one robot: what lets that robot count its lease from the asking.

    Attributes:
        counter: of that beat; negative: heard, but no lease may be counted from it (that robot seems deaf to the sender).
    """

    robot: str
    boot: int
    counter: int


class Promise(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """The sender does not replace a robot whose agent restarts: its answer to ``Beat.grace_ms``, on its disk before it is said.

    Attributes:
        boot, counter: the newest beat of that robot that asked for it; the sender waits from when it heard that beat.
        ms: for so long, and its margin.
    """

    robot: str
    boot: int
    counter: int
    ms: int


class Entry(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """One component as the sender of the beat holds it.

    Attributes:
        state: index into ``STATES``.
        primary: whom the sender takes for the primary of ``epoch``; naming a peer *is* the vote for it.
        generation, sequence, digest: newest position it can restore from; for a standby, its acknowledgement. Sequence 0: none.
        standby: the robot that the primary has entrusted, "" if none; under majority its followers repeat what they have noted.
        yields_to: (primary, handing over) the robot that may claim now.
        flags: ``NEEDS_BASE`` (standby), ``UNPROTECTED`` (primary has stopped protecting), ``HOLDS`` (on_loss is hold),
            ``WARM`` (standby: its program waits there, started already); ``WANTS`` (a checkpoint, to run it);
            ``SAFE`` (primary: its newest position is acknowledged); ``STOOD`` (primary of a pair); ``FREE``, ``OPEN``,
            ``STARTS``, ``ORDERED``, ``BARE`` (majority); ``BEGUN``; ``FRESH`` (etcd); ``UNABLE``.
        status: of a finished component, waitpid's.
        born: epoch under which the sender's copy was started or restored; 0 does not tell.
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
    born: int = 0

    @property
    def position(self) -> Position | None:
        """What the sender can restore from."""
        return Position(self.generation, self.sequence, self.digest) if self.sequence else None


NEEDS_BASE = 1
UNPROTECTED = 2
HOLDS = 4
WARM = 8
FREE = 16
"""The sender is bound to no primary: it would vote for a robot that holds all that was acknowledged."""

OPEN = 32
"""It has waited long enough for those robots: it would vote for any other."""

STARTS = 64
"""It would start the component from the beginning, as configured."""

ORDERED = 128
"""An operator asked for this claim: a robot with an older checkpoint may have it."""

WANTS = 256
"""An operator wants the sender to run it, and it has no checkpoint: a member that keeps one sends it."""


SAFE = 512
"""The position that the sender, a primary, tells of counts as acknowledged: every robot that holds it may show its output."""


STOOD = 1024
"""The sender's copy stood still, or began without a word of the robots that ran it, since all its peers last agreed to it."""

BEGUN = 2048
"""A checkpoint of it was given away in this epoch or an earlier one: a robot that has none does not start it afresh."""


FRESH = 4096
"""The sender holds all that the archive had when the old primary's lease was over: `failover.core.replication.archived`."""

BARE = 8192
"""The sender has lost what it held: a position that it tells of came from elsewhere since, and may be older than what it had."""


UNABLE = 16384
"""The sender holds the position that it tells of, and could not resume it: another robot may, and is sent it."""


class Beat(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """ "I live", and all that follows from it.

    Attributes:
        boot: start count of the sender's agent; ``counter``: of its beats since then, from 1.
        settled: counter of the beat since which no entry of the sender has changed its epoch, its state or its primary.
            A receiver that knows an entry only from an older beat does not know enough to act on it.
        load: of the sender, 0 to 255.
        entries: those that fit; the others follow in the next beats, in turn. The changed ones go first.
        total: how many there are altogether.
        rule: the sender's, as its number in ``RULES``; 0 does not tell.
        grace_ms: the sender's agent is about to restart and asks not to be replaced for so long; `RETURNED`, or 0 where nothing
            is told.
        promises: to the robots that asked.
        drained: the sender is to run nothing: an operator has drained it.
    """

    sender: str
    boot: int
    counter: int
    settled: int = 0
    load: int = 0
    total: int = 0
    echoes: tuple[Echo, ...] = ()
    entries: tuple[Entry, ...] = ()
    rule: int = 0
    grace_ms: int = 0
    promises: tuple[Promise, ...] = ()
    drained: bool = False


RETURNED = -1
"""No guard of the sender has a lease that an earlier life of its agent arranged: promises to an earlier life are void."""

RULES = ("", *Rule)
"""A rule's place in here is its number in a beat."""

OTHER_SITES = -1
"""In the place of a rule, for a beat that came: its sender knows other sites of the members. No robot sends it."""


# The replication link: connection-oriented, authenticated and encrypted by the transport; in order while a connection lives.

CHUNK_SIZE_MAX = 256 * 1024
"""Bytes of a snapshot per chunk: at 1 Gbit/s a small message behind one waits 2 ms."""

WINDOW_CHUNKS = 8
"""Chunks that may be on their way without credit for more."""

BELONGINGS_MAX = 512
"""Files in one message: with long paths it stays a small one beside a chunk."""

SNAPSHOT_SIZE_MAX = 1 << 38
"""Bytes that an encoded snapshot may claim to have; the disk decides earlier."""


class Hello(msgspec.Struct, frozen=True, tag="hello"):
    """First message of each side on every new connection. Another version or team is answered by Goodbye.

    Attributes:
        boot: start count of the sender's agent.
        beat_key: random bytes of this life; the sender's beats to this receiver are sealed with it from now on.
        again: on a connection that stands, because the receiver has begun anew; what is under way on it goes on.
        change, members: how often failover has changed the sender's team, and a digest of who belongs to it.
        sites: where each member is, by name, as the sender's team.toml has it; None: its release knows no sites.
    """

    version: int
    team: str
    robot: str
    boot: int
    beat_key: bytes = b""
    again: bool = False
    change: int = 0
    members: int = 0
    sites: dict[str, str] | None = None


class Goodbye(msgspec.Struct, frozen=True, tag="goodbye"):
    """The connection ends; ``reason`` is a sentence."""

    reason: str


class Offer(msgspec.Struct, frozen=True, tag="offer"):
    """A snapshot is ready for you. Answered by Credit or Refuse.

    Attributes:
        transfer: chosen by the sender, never used twice in one life of it.
        size: bytes of the encoded snapshot (``checkpoint/snapshot/FORMAT.md``); ``digest``: blake3 of them, 32 bytes.
        parent: what it continues; None for a base.
        acknowledged: the newest position of its line that counts as acknowledged; None: not known, or an older agent.
        content: all bytes of a small one, which then needs neither credit nor chunk; b"" where they come in chunks. An older
            receiver does not know this field: it gives credit, and gets the chunk.
    """

    transfer: int
    component: str
    epoch: int
    position: Position
    parent: Position | None
    size: int
    digest: bytes
    spec: ComponentSpec
    acknowledged: Position | None = None
    content: bytes = b""


class Belonging(msgspec.Struct, frozen=True, array_like=True):
    """A file that a program needs wherever it goes on.

    Attributes:
        path: as the program names it, absolute.
        size: bytes; ``digest``: blake3 of them, 32 bytes, b"" where it was not taken: such a file cannot be brought.
        exact: only this content will do; otherwise whatever stands at the path.
    """

    path: str
    size: int
    digest: bytes
    exact: bool = True


class Belongings(msgspec.Struct, frozen=True, tag="belongings"):
    """What a program needs: which of it do you lack? Comes before the offer of a snapshot. Answered by Lacking.

    Attributes:
        number: chosen by the sender, never used twice in one life of it.
        files: at most ``BELONGINGS_MAX``; more are asked in several.
    """

    number: int
    component: str
    files: tuple[Belonging, ...]


class Lacking(msgspec.Struct, frozen=True, tag="lacking"):
    """Which of the files the sender has neither at their paths nor by content.

    Attributes:
        digests: of those that it will take; they may be offered to it from now on.
        reason: why it cannot take all that it lacks, a sentence that names files; "" when it can.
    """

    number: int
    digests: tuple[bytes, ...]
    reason: str = ""


class Content(msgspec.Struct, frozen=True, tag="content"):
    """The content of a file that you lack is ready for you. Answered by Credit or Refuse; Taken says that it is stored.

    Attributes:
        transfer: as of an Offer; of ``size`` bytes with this blake3 ``digest``.
    """

    transfer: int
    size: int
    digest: bytes


class Credit(msgspec.Struct, frozen=True, tag="credit"):
    """Bytes [0, ``until``) of the transfer may be sent."""

    transfer: int
    until: int


class Chunk(msgspec.Struct, frozen=True, tag="chunk"):
    """Bytes of a snapshot, in order, without gaps; the one that reaches ``Offer.size`` is the last."""

    transfer: int
    offset: int
    content: bytes


class Taken(msgspec.Struct, frozen=True, tag="taken"):
    """All bytes arrived, their digest is right, and the receiver has stored them, or has said by its heartbeat why not."""

    transfer: int


class Refuse(msgspec.Struct, frozen=True, tag="refuse"):
    """The offer, or the rest of it, is not wanted: stale epoch, wrong parent, no room. ``needs_base``: only a base would help."""

    transfer: int
    reason: str
    needs_base: bool = False


class Cancel(msgspec.Struct, frozen=True, tag="cancel"):
    """The sender gives up this transfer; what had arrived of it is forgotten."""

    transfer: int


class Errand(msgspec.Struct, frozen=True, tag="errand"):
    """An operator's order, given at the sender and meant for the robot where the component runs. Answered by ErrandDone.

    Attributes:
        number: chosen by the sender, never used twice in one life of it.
        verb: as on the control socket (`failover.client.control`).
        arguments: its arguments, a msgpack map.
        by: uid of the user who gave it, -1: the robot by itself; the robot that carries it out checks the right.
    """

    number: int
    verb: str
    arguments: bytes
    by: int = -1


class ErrandDone(msgspec.Struct, frozen=True, tag="errand_done"):
    """What became of an order.

    Attributes:
        content: the result, a msgpack map; empty when it was refused.
        refusal: why not, a sentence; "" when it was done.
        kind: class of the refusal, as on the control socket.
    """

    number: int
    content: bytes
    refusal: str = ""
    kind: str = "RefusedError"
    reasons: tuple[str, ...] = ()


Bulk = Hello | Goodbye | Belongings | Lacking | Content | Offer | Credit | Chunk | Taken | Refuse | Cancel | Errand | ErrandDone
