"""Values of the slots: their terms, what a frame says about them, what a status shows of them."""

from __future__ import annotations

import enum

from msgspec import Struct

from failover.core.types import MS

US = 1_000
"""Nanoseconds in a microsecond."""


class Seen(enum.IntEnum):
    """What a robot sees of a member, on one medium: two bits in each frame."""

    NOT = 0
    INSERT = 1
    RUN = 2
    REMOVE = 3


class Own(enum.StrEnum):
    """What this robot itself does on a medium."""

    LISTENING = "listening"
    RUNNING = "running"
    SILENT = "silent"


class Terms(Struct, frozen=True):
    """How a medium is shared; ``t_tup_ms`` must be the same at every robot, the others should be.

    Attributes:
        t_tup_ms: the round: in each, every robot sends once.
        epsilon: the reference follows delays of up to so many slots.
        delta_min_us: smaller delays are not followed.
        transit_us: how long a frame travels, until that was measured.
        remove_after: missed rounds after which a robot that all miss has left.
        remove_at_most: missed rounds after which a robot has left for us, whatever others say; likewise rounds after which we
            accept one that is not accepted by all, and use our own view where the reference does not count us.
        listen_rounds: before the first frame.
        spread: robots that start at one instant begin at different times, by rank.
        transmit: False only listens.
    """

    t_tup_ms: int = 50
    epsilon: float = 2 / 3
    delta_min_us: int = 1_000
    transit_us: int = 2_000
    remove_after: int = 3
    remove_at_most: int = 10
    listen_rounds: int = 1
    spread: bool = True
    transmit: bool = True

    @property
    def t_tup_ns(self) -> int:
        """The round."""
        return self.t_tup_ms * MS


class Said(Struct, frozen=True, array_like=True):
    """What a frame says of its sender's slots.

    Attributes:
        t_tup_us: its round.
        set: the ranks that share the round, as the sender computes its slot from them; the reference's counts for all.
        set_round: round of the reference in which it made that set.
        views: what the sender sees of each rank (`Seen`), as words of 32 ranks.
        echo: of each peer heard in the last two rounds (rank, counter of its last frame, µs since that came).
    """

    t_tup_us: int
    set: int
    set_round: int
    views: tuple[int, ...]
    echo: tuple[tuple[int, int, int], ...]


class SlotView(Struct, frozen=True):
    """An authenticated frame, as far as slots are concerned."""

    rank: int
    boot: int
    counter: int
    said: Said


class PeerSlot(Struct, frozen=True):
    """One member, for the status. Spans in µs.

    Attributes:
        missed: rounds in a row in which it was not heard.
        lost: of the ``awaited`` rounds in which a frame of it was expected those in which none came, since the slots began.
        offset_us: how much later than its slot its last frame left, counted from the reference's newest frame; of the reference,
            how much longer than T_tup its last round was. ``jitter_us``: the change of that from frame to frame, smoothed.
        transit_us: how long its frames are taken to travel.
        hears: whom it heard in its last round, as it says.
    """

    robot: str
    seen: Seen
    missed: int
    lost: int
    awaited: int
    offset_us: int
    jitter_us: int
    transit_us: int
    hears: tuple[str, ...]


class SlotsView(Struct, frozen=True):
    """One medium, for the status and for the item ``_slots``. Spans in µs.

    Attributes:
        why: what keeps it silent, "" otherwise.
        count: K, the robots that share the round; ``place``: among them, from 0, None outside.
        reference: whose frames give the phase; this robot's own name if it gives it.
        round_us: between this robot's last two frames, 0 before the second.
        offset_us, jitter_us: of this robot's own frames, as of a peer's.
        least_gap_us: between two sends of the last round, 0 if fewer than two robots are heard.
        late_us: how much later than due the last frame left, by this robot's own fault; ``late_us_max``: the most ever.
        followed: rounds that this robot as the reference stretched; ``outside``: delays that it did not follow.
        deaf: pairs (listener, speaker): the one does not hear the other, though this robot hears both.
        ignored: frames of another round, or whose words fit no roster of this size.
    """

    own: Own
    why: str
    round: int
    count: int
    place: int | None
    members: tuple[str, ...]
    reference: str
    round_us: int
    offset_us: int
    jitter_us: int
    least_gap_us: int
    late_us: int
    late_us_max: int
    followed: int
    outside: int
    ignored: int
    deaf: tuple[tuple[str, str], ...]
    peers: tuple[PeerSlot, ...]
