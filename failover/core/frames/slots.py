"""RA-TDMA of one medium: when this robot sends, and which robots share the round. Pure: every instant is an argument.

Each robot sends once in a round of T_tup. The *reference*, the lowest rank that is heard, gives the phase: each other robot sends
place × T_tup / K after the reference's frame left, measured at that frame's arrival; its place is that in the *set* which the
reference says. No clocks are compared, nothing is acknowledged. If frames of others leave late, because of alien traffic, the
reference makes its round longer by as much: the team gives way to periodic traffic instead of colliding with it again and again.

What a robot sees of each other one, at the end of each own round (`TABLE`; a frame of a higher boot: `Slots._reborn`):

    NOT    -- heard -->                                            INSERT
    INSERT -- not heard in two rounds -->                          NOT
    INSERT -- every running peer that it hears sees it -->         RUN
    INSERT -- heard for remove_at_most rounds without that -->     RUN
    RUN    -- not heard in this round -->                          REMOVE
    REMOVE -- heard -->                                            RUN
    REMOVE -- missed remove_after, and no running peer runs it --> NOT
    REMOVE -- missed remove_at_most -->                            NOT
    any    -- a frame of a higher boot (at once) -->               INSERT

Invariants: never two sends within half a slot; none later than two rounds after the one before, if the caller is on time; a peer
counts once; own lateness makes no other robot missed; no frame, however odd, raises.

Source: RA-TDMA is due to F. Santos, L. Almeida, L. S. Lopes (ETFA 2008).
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec import Struct

from failover.core.frames.roster import SEEN_BITS, SEEN_MASK, Roster, pack_seen, place_in, ranks_in, seen_of, word
from failover.core.frames.terms import US, Own, PeerSlot, Said, Seen, SlotsView, SlotView, Terms
from failover.core.frames.transit import Transit

HOLD_US_MAX = (1 << 32) - 1
"""Longer holds are not told: an hour."""

WHOLE_ROUND = 3 / 4
"""A round of less than this part of T_tup, cut short by a move of the slot or by own lateness, tells of no robot's silence."""

WIDE = 2 / 3
"""A gap of this part of the widest one is wide, too: jitter makes no choice."""

ECHO_ROUNDS = 2
"""Rounds for which a frame is echoed."""

SMOOTHED = 16
"""Frames over which jitter is smoothed. Source: RFC 3550, 6.4.1."""


class Peer(Struct):
    """What is known of one member on this medium.

    Attributes:
        left_ns: when its last frame left, by our clock; ``came_ns``: when it came.
        heard: in the present round.
        missed: rounds in a row without a frame; ``waited``: rounds in INSERT.
        since: round in which it became RUN.
        views: what it said it sees, two bits a rank; ``set``: the set it said.
        offset_ns: from its slot to its last frame; ``jitter_ns``: by how much that changes from frame to frame, smoothed.
        awaited: whole rounds in which a frame of it was expected; ``lost``: of these, rounds without one.
    """

    rank: int
    seen: Seen = Seen.NOT
    boot: int = 0
    counter: int = 0
    left_ns: int = 0
    came_ns: int = 0
    heard: bool = False
    missed: int = 0
    waited: int = 0
    since: int = 0
    views: int = 0
    set: int = 0
    set_round: int = 0
    offset_ns: int = 0
    jitter_ns: int = 0
    awaited: int = 0
    lost: int = 0

    def sees(self, rank: int) -> int:
        """Its view of another one."""
        return self.views >> SEEN_BITS * rank & SEEN_MASK


# --- The conditions of the arrows; ``running``: the peers that were RUN when the round was closed -----------------------


def _is_heard(_terms: Terms, peer: Peer, _running: tuple[Peer, ...]) -> bool:
    return peer.heard


def _is_missed(_terms: Terms, peer: Peer, _running: tuple[Peer, ...]) -> bool:
    return not peer.heard


def _is_missed_twice(_terms: Terms, peer: Peer, _running: tuple[Peer, ...]) -> bool:
    """A newcomer speaks in a gap: one frame that the medium delays beyond the end of our round is not missing yet."""
    return peer.missed > 1


def _is_agreed(_terms: Terms, peer: Peer, running: tuple[Peer, ...]) -> bool:
    """Heard, and every running peer that it hears sees it, too; whom it does not hear is not asked."""
    return peer.heard and all(one.sees(peer.rank) != Seen.NOT for one in running if peer.sees(one.rank) != Seen.NOT)


def _waited_enough(terms: Terms, peer: Peer, _running: tuple[Peer, ...]) -> bool:
    return peer.waited >= terms.remove_at_most


def _is_missed_by_all(terms: Terms, peer: Peer, running: tuple[Peer, ...]) -> bool:
    return peer.missed >= terms.remove_after and all(one.sees(peer.rank) in _AWAY for one in running)


def _is_missed_for_long(terms: Terms, peer: Peer, _running: tuple[Peer, ...]) -> bool:
    return peer.missed >= terms.remove_at_most


Condition = Callable[[Terms, Peer, tuple[Peer, ...]], bool]

TABLE: dict[Seen, tuple[tuple[Condition, Seen], ...]] = {
    Seen.NOT: ((_is_heard, Seen.INSERT),),
    Seen.INSERT: ((_is_missed_twice, Seen.NOT), (_is_agreed, Seen.RUN), (_waited_enough, Seen.RUN)),
    Seen.RUN: ((_is_missed, Seen.REMOVE),),
    Seen.REMOVE: ((_is_heard, Seen.RUN), (_is_missed_by_all, Seen.NOT), (_is_missed_for_long, Seen.NOT)),
}
"""Every arrow; the first whose condition holds is taken."""

_AWAY = frozenset({Seen.REMOVE, Seen.NOT})
_COUNTED = frozenset({Seen.RUN, Seen.REMOVE})
_HEARD = frozenset({Seen.INSERT, Seen.RUN})


class Slots:
    """The slots of one medium, as one robot computes them.

    The caller, for each instant `next_ns`: reads what has come (`heard`), asks `due`; if that is True builds a frame with `says`
    and calls `sent` right before it leaves. `heard` may move `next_ns`.
    """

    def __init__(self, me: int, roster: Roster, terms: Terms, now_ns: int) -> None:
        self.me = me
        self.roster = roster
        self.terms = terms
        self.transit = Transit(terms.transit_us)
        self.peers = {rank: Peer(rank) for rank in range(len(roster)) if rank != me}
        self.own = Own.LISTENING
        self.why = ""
        self.round = 0
        self.followed = self.outside = self.ignored = 0
        self.late_ns = self.late_ns_max = 0
        self._own_offset_ns = self._jitter_ns = 0
        self._t_ns = terms.t_tup_ns
        self._odd: dict[int, tuple[int, int]] = {}
        self._listen(now_ns)

    def _listen(self, now_ns: int) -> None:
        """Begin anew: nothing that was heard before counts."""
        self.own = Own.LISTENING if self.terms.transmit else Own.SILENT
        for peer in self.peers.values():
            peer.seen, peer.heard, peer.missed, peer.waited = Seen.NOT, False, 0, 0
        self.set, self.set_round = word((self.me,)), self.round
        self._lead = self.me
        self._left_out = 0
        self._listened_ns = now_ns + self.terms.listen_rounds * self._t_ns
        self._sent_ns: int | None = None
        self._before_ns: int | None = None
        self._closed_ns = now_ns
        self._delay_ns = 0
        self._next_ns = self._listened_ns + self._spread_ns(0)

    def _spread_ns(self, rank: int) -> int:
        """How much later than that rank this robot begins, less than a round."""
        return (self.me - rank) * self._t_ns // len(self.roster) % self._t_ns if self.terms.spread else 0

    # --- A frame came ---------------------------------------------------------------------------------------------------

    def heard(self, frame: SlotView, came_ns: int) -> None:
        """Take in an authenticated frame; ``came_ns``: the kernel's stamp of its arrival."""
        peer, said = self.peers.get(frame.rank), frame.said
        if peer is None or frame.boot < peer.boot:
            return
        views = seen_of(said.views, len(self.roster))
        if said.t_tup_us * US != self._t_ns:
            self._odd[frame.rank] = (said.t_tup_us, self.round)
            views = None
        if views is None or not said.set >> frame.rank & 1 or said.set & ~self.roster.everybody:
            self.ignored += 1
            return
        if frame.boot > peer.boot:
            self._reborn(peer, frame.boot)
        for rank, counter, hold_us in said.echo:
            if rank == self.me:
                self.transit.echoed(peer.rank, counter, hold_us, came_ns)
        peer.heard, peer.counter, peer.views, peer.set, peer.set_round = True, frame.counter, views, said.set, said.set_round
        before_ns, peer.came_ns, peer.left_ns = peer.left_ns, came_ns, came_ns - self.transit.likely_ns(peer.rank)
        self._measure(peer, before_ns)
        if self.own is Own.LISTENING:
            self._place_first()
        elif self._lead == self.me:
            self._adapt(peer)
        elif self._lead == peer.rank:
            self._follow(peer)

    def _measure(self, peer: Peer, before_ns: int) -> None:
        """How far from its slot its frame left: for people, no rule uses it."""
        if self.own is not Own.LISTENING and self.set >> peer.rank & 1:
            offset_ns = self._offset_ns(peer.rank, peer.left_ns, before_ns)
            if peer.awaited:
                peer.jitter_ns = _smoothed(peer.jitter_ns, offset_ns - peer.offset_ns)
            peer.offset_ns = offset_ns

    def _offset_ns(self, rank: int, left_ns: int, before_ns: int | None) -> int:
        """From its planned instant to its frame, within half a round.

        It is counted from the reference's newest frame; of the reference itself, a round after its frame before.
        """
        if self._lead == rank:
            origin_ns = before_ns
        else:
            origin_ns = self._sent_ns if self._lead == self.me else self.peers[self._lead].left_ns
        if not origin_ns or not self.set >> self._lead & 1:
            return 0
        half_ns = self._t_ns // 2
        return (left_ns - origin_ns - self._apart(rank, self._lead) * self._slot_ns() + half_ns) % self._t_ns - half_ns

    def _reborn(self, peer: Peer, boot: int) -> None:
        """It began a new life: what it was is void."""
        if peer.boot and peer.seen is not Seen.NOT:
            peer.seen = Seen.INSERT
        peer.boot, peer.missed, peer.waited = boot, 0, 0
        self.transit.forget(peer.rank)
        self._lead = self._leader()

    def _place_first(self) -> None:
        """Where the first frame goes: into a team's largest gap; among robots that begin like us, by rank."""
        lowest = min((peer for peer in self.peers.values() if peer.heard), key=_rank)
        if lowest.set.bit_count() > 1:
            first_ns = self._widest_gap(lowest)
        elif self.terms.spread:
            first_ns = lowest.left_ns + self._spread_ns(lowest.rank)
        else:
            return
        self._next_ns = self._listened_ns + (first_ns - self._listened_ns) % self._t_ns

    def _widest_gap(self, first: Peer) -> int:
        """The middle of a wide gap between the sends that were heard; which, is told by rank, as others may join with us."""
        phases = sorted((peer.left_ns - first.left_ns) % self._t_ns for peer in self.peers.values() if peer.heard)
        gaps = [after - before for before, after in zip(phases, [*phases[1:], self._t_ns], strict=True)]
        wide = [place for place, gap in enumerate(gaps) if gap >= WIDE * max(gaps)]
        place = wide[self.me % len(wide)]
        return first.left_ns + phases[place] + gaps[place] // 2

    def _adapt(self, peer: Peer) -> None:
        """As the reference: the longest delay that is worth following makes this round longer."""
        if self._sent_ns is None or not self.set >> peer.rank & 1:
            return
        sent_ns, slot_ns = self._sent_ns, self._slot_ns()
        if peer.left_ns < sent_ns and self._before_ns is not None:  # it left before our frame and came after it
            sent_ns = self._before_ns
        delay_ns = peer.left_ns - sent_ns - self._apart(peer.rank, self.me) * slot_ns
        if self._is_worth(delay_ns, slot_ns):
            self._delay_ns = max(self._delay_ns, delay_ns)
            self._next_ns = self._sent_ns + self._t_ns + self._delay_ns
        elif abs(delay_ns) >= self.terms.epsilon * slot_ns:
            self.outside += 1

    def _is_worth(self, delay_ns: int, slot_ns: int) -> bool:
        return self.terms.delta_min_us * US < delay_ns < self.terms.epsilon * slot_ns

    def _apart(self, one: int, other: int) -> int:
        """By how many slots the one is after the other in the set."""
        return (place_in(self.set, one) - place_in(self.set, other)) % self.set.bit_count()

    def _follow(self, lead: Peer) -> None:
        """Take the reference's set and phase."""
        if self._is_in(lead):
            self.set, self.set_round = lead.set, lead.set_round
        elif self._left_out < self.terms.remove_at_most:
            return  # it has not accepted us yet: we keep our phase, and move once only
        if not self.set >> lead.rank & 1 or self._sent_ns is None or lead.came_ns >= self._next_ns:
            return  # the last: our frame is due already, and leaves now
        target_ns = lead.left_ns + self._apart(self.me, lead.rank) * self._slot_ns()
        early_ns = self._sent_ns + self._t_ns // 2 - target_ns
        if early_ns > 0:  # we have spoken in this round
            target_ns += -(-early_ns // self._t_ns) * self._t_ns
        self._next_ns = max(min(target_ns, self._sent_ns + 2 * self._t_ns), lead.came_ns)

    def _is_in(self, lead: Peer) -> bool:
        return bool(lead.set >> self.me & 1)

    # --- A frame is due -------------------------------------------------------------------------------------------------

    def next_ns(self) -> int:
        """When `due` is to be asked next."""
        return self._next_ns

    def due(self, now_ns: int) -> bool:
        """Whether a frame is to be built and sent now; closes the round."""
        late_ns = now_ns - self._next_ns
        if late_ns < 0:
            return False
        if late_ns > self._t_ns:  # the machine slept: the team has forgotten us, and we what it does
            self._listen(now_ns)
            return False
        self.late_ns, self.late_ns_max = late_ns, max(self.late_ns_max, late_ns)
        self.followed += self._delay_ns > 0
        self._close(now_ns)
        self._next_ns = now_ns + self._t_ns
        self.why = self._refusal()
        if self.why or not self.terms.transmit:
            self.own = Own.SILENT
            return False
        if self.own is Own.SILENT:
            self._listen(now_ns)
            return False
        self.own = Own.RUNNING
        return True

    def sent(self, left_ns: int, counter: int = 0) -> None:
        """Our frame of this number leaves now; to be read right before the send."""
        self.transit.left(counter, left_ns)
        offset_ns = self._offset_ns(self.me, left_ns, self._sent_ns)
        if self._sent_ns is not None:
            self._jitter_ns = _smoothed(self._jitter_ns, offset_ns - self._own_offset_ns)
        self._own_offset_ns = offset_ns
        self._before_ns, self._sent_ns = self._sent_ns, left_ns
        self._delay_ns = 0
        self._next_ns = left_ns + self._t_ns

    def says(self, now_ns: int) -> Said:
        """What the frame that is built now says of the slots."""
        seen = [Seen.NOT] * len(self.roster)
        echo = []
        fresh_ns = now_ns - ECHO_ROUNDS * self._t_ns
        for rank, peer in self.peers.items():
            seen[rank] = peer.seen
            if peer.boot and peer.came_ns > fresh_ns:
                echo.append((rank, peer.counter, min(max(now_ns - peer.came_ns, 0) // US, HOLD_US_MAX)))
        seen[self.me] = Seen.RUN
        return Said(self._t_ns // US, self.set, self.set_round, pack_seen(seen), tuple(echo))

    def _close(self, now_ns: int) -> None:
        """The end of our round: what is seen of each peer, whose frames give the phase, and which set we use."""
        is_whole = now_ns - self._closed_ns >= WHOLE_ROUND * self._t_ns and self.late_ns <= self._slot_ns() // 2
        self._closed_ns = now_ns
        self.round += 1
        running = tuple(peer for peer in self.peers.values() if peer.seen is Seen.RUN)
        if is_whole:
            self._count_lost()
        for peer, seen in [(peer, self._moved(peer, running)) for peer in self.peers.values() if peer.heard or is_whole]:
            if seen is not peer.seen:
                peer.waited, peer.since = 0, self.round
            peer.seen, peer.heard = seen, False
        self._lead = self._leader()
        self._choose_set()

    def _count_lost(self) -> None:
        for peer in self.peers.values():
            if peer.seen in _COUNTED:
                peer.awaited += 1
                peer.lost += not peer.heard

    def _moved(self, peer: Peer, running: tuple[Peer, ...]) -> Seen:
        """The arrow that it takes."""
        peer.missed = 0 if peer.heard else peer.missed + 1
        peer.waited += 1
        return next((to for condition, to in TABLE[peer.seen] if condition(self.terms, peer, running)), peer.seen)

    def _leader(self) -> int:
        """Whose frames give the phase.

        The lowest rank that we hear. If a running peer hears a still lower one, which we do not, we keep in step by that peer.
        """
        near = [peer for peer in self.peers.values() if peer.seen in _COUNTED and peer.missed < self.terms.remove_after]
        lowest = min([self.me, *(peer.rank for peer in near)])
        hidden = min((rank for rank in self._vouched() if rank < lowest), default=None)
        return lowest if hidden is None else min(peer.rank for peer in near if peer.sees(hidden) == Seen.RUN)

    def _vouched(self) -> list[int]:
        """Ranks that we hear no longer, but a running peer does: they send, so a slot is theirs."""
        lost = [rank for rank, peer in self.peers.items() if peer.seen is Seen.NOT or peer.missed >= self.terms.remove_after]
        return [rank for rank in lost if self._is_run_by_one(rank)]

    def _is_run_by_one(self, rank: int) -> bool:
        return any(peer.seen is Seen.RUN and peer.sees(rank) == Seen.RUN for peer in self.peers.values())

    def _choose_set(self) -> None:
        """The reference makes the set; a follower takes it from the reference's frames, and makes its own only when left out."""
        if self._lead == self.me:
            self._left_out = 0
            self._use(self._own_view())
        elif self._is_in(self.peers[self._lead]):
            self._left_out = 0
            self.set, self.set_round = self.peers[self._lead].set, self.peers[self._lead].set_round
        else:
            self._left_out += 1
            if self._left_out >= self.terms.remove_at_most:
                self._use(self._own_view())

    def _own_view(self) -> int:
        """Who has a slot, as far as we know: ourselves, whom we run, and whom a running peer runs."""
        members = [rank for rank, peer in self.peers.items() if peer.seen in _COUNTED or self._is_run_by_one(rank)]
        return word([self.me, *members] if self.terms.transmit else members)

    def _use(self, members: int) -> None:
        if members != self.set:
            self.set, self.set_round = members, self.round

    def _slot_ns(self) -> int:
        """w: the length of a slot."""
        return self._t_ns // max(self.set.bit_count(), 1)

    def _refusal(self) -> str:
        """Why this robot must not speak: the reference's round is another one."""
        fresh = {rank: t_us for rank, (t_us, at) in self._odd.items() if self.round - at < self.terms.remove_after}
        if not fresh or any(peer.seen is not Seen.NOT for peer in self.peers.values()):
            return ""
        odd = min(fresh)
        if self.own is Own.RUNNING and self.me < odd:
            return ""
        return (
            f"{self.roster.names[odd]} sends once in {fresh[odd] / 1_000:g} ms, this robot is to send once in "
            f"{self.terms.t_tup_ms} ms: t_tup_ms must be the same at every robot"
        )

    # --- For people -----------------------------------------------------------------------------------------------------

    def view(self) -> SlotsView:
        """What there is to show."""
        names = self.roster.names
        is_member = bool(self.set >> self.me & 1)
        return SlotsView(
            self.own,
            self.why,
            self.round,
            self.set.bit_count(),
            place_in(self.set, self.me) if is_member else None,
            tuple(names[rank] for rank in ranks_in(self.set)),
            names[self._lead],
            self._round_ns() // US,
            self._own_offset_ns // US,
            self._jitter_ns // US,
            self._least_gap_ns() // US,
            self.late_ns // US,
            self.late_ns_max // US,
            self.followed,
            self.outside,
            self.ignored,
            tuple((names[listener], names[speaker]) for listener, speaker in self._deaf()),
            tuple(self._peer_slot(peer) for peer in self.peers.values()),
        )

    def _peer_slot(self, peer: Peer) -> PeerSlot:
        hears = [rank for rank in range(len(self.roster)) if rank != peer.rank and peer.sees(rank) in _HEARD]
        return PeerSlot(
            self.roster.names[peer.rank],
            peer.seen,
            peer.missed,
            peer.lost,
            peer.awaited,
            peer.offset_ns // US,
            peer.jitter_ns // US,
            self.transit.likely_ns(peer.rank) // US,
            tuple(self.roster.names[rank] for rank in hears) if peer.seen is not Seen.NOT else (),
        )

    def _round_ns(self) -> int:
        """Between our last two frames."""
        return 0 if self._sent_ns is None or self._before_ns is None else self._sent_ns - self._before_ns

    def _least_gap_ns(self) -> int:
        """Between two sends of the last round."""
        sends = [peer.left_ns for peer in self.peers.values() if peer.seen is Seen.RUN]
        sends += [] if self._sent_ns is None else [self._sent_ns]
        phases = sorted(instant % self._t_ns for instant in sends)
        gaps = [(after - before) % self._t_ns for before, after in zip(phases, phases[1:] + phases[:1], strict=True)]
        return min(gaps) if len(gaps) > 1 else 0

    def _deaf(self) -> list[tuple[int, int]]:
        """Who does not hear whom, though we hear both, or one of them is we."""
        patience = self.terms.remove_at_most
        settled = [one for one in self.peers.values() if one.seen is Seen.RUN and self.round - one.since >= patience]
        pairs = [(self.me, rank) for rank in self._vouched()]
        pairs += [(one.rank, self.me) for one in settled if one.sees(self.me) == Seen.NOT]
        return pairs + [
            (one.rank, other.rank)
            for one in settled
            for other in settled
            if one is not other and one.sees(other.rank) == Seen.NOT
        ]


def _smoothed(jitter_ns: int, change_ns: int) -> int:
    return jitter_ns + (abs(change_ns) - jitter_ns) // SMOOTHED


def _rank(peer: Peer) -> int:
    return peer.rank
