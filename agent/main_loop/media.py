"""How this robot's frames leave over each of its links: by cast or by unicast, at once or in a slot.

The worker process tells which interface each link is now, and whether it is wireless (`LinksAre`). Before it does, frames leave
at once by unicast. Heartbeats decide about takeovers, so two rules stand above all others:

1. A member that has not said that it hears this robot's casts of the last moments gets its frames by unicast, too.
2. A robot that has no slot on a medium, because it still listens or must not speak, sends heartbeats there without one.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Final

from msgspec import Struct, field

from agent.config import MediumConfig, Settings
from agent.main_loop.beat_sockets import BeatLane
from agent.main_loop.messages import LinkNow, MediumView
from agent.system import clock
from failover.core.board.ages import effective_round_ns
from failover.core.frames.casts import LINKS_MAX, Casts
from failover.core.frames.frame import SLOTTED, Part, Portion
from failover.core.frames.lane import FrameLane, Sealed
from failover.core.frames.lanes import MEDIA_MAX, FrameLanes
from failover.core.frames.media import Cast, Casting
from failover.core.frames.roster import Roster
from failover.core.frames.terms import Own, SlotsView, SlotView, Terms
from failover.core.types import BEATS_IN_LEASE_MIN, MS
from failover.core.wire.messages import Beat

if TYPE_CHECKING:
    from failover.core.frames.slots import Slots

RECENT_PERIODS: Final = 2.5
"""A member hears our casts if it has said so of one that left in so many periods: two were lost, or what it said, before it gets
unicast. A lease is at least four."""

HEARD_NS: Final = 1_000_000_000
"""A member of which a frame came in this time over a link could hear us there."""

TRY_AGAIN_NS: Final = 60_000_000_000
"""What the kernel refused when a link was opened to casts is tried again after a minute: memory or descriptors were short."""

CAST_MEMBERS_MIN: Final = 2
"""For one receiver a cast saves nothing."""

RADIO_UNICAST: Final = "a radio acknowledges and repeats unicast, and has no slots here"

log = logging.getLogger("failover.heart")


class Link(Struct):
    """One link, by its place among the beat addresses.

    Attributes:
        now: what the worker told of it last.
        reached: the members that could hear a cast.
        casting: None where nothing is cast; ``why``: why not.
        slots: None where frames leave at once; ``no_slots``: why they do, though it is a radio.
        heard_ns: member → when a frame of it came over this link; ``bytes``: of its frames here, and of ours that left.
        by_unicast: the members that got the last frame by unicast besides.
        sent_ns: when the last frame without a slot left.
        turned: round of the board that the last frame in a slot told of.
        try_again_ns: when the kernel is asked again to open it to casts; 0: it did not refuse.
    """

    place: int
    period_ns: int
    now: LinkNow = LinkNow()
    reached: frozenset[str] = frozenset()
    casting: Casting | None = None
    why: str = "the agent does not know its interface yet"
    slots: Slots | None = None
    no_slots: str = ""
    lane: FrameLane | None = None
    heard_ns: dict[str, int] = field(default_factory=dict)
    bytes: dict[str, int] = field(default_factory=dict)
    by_unicast: tuple[str, ...] = ()
    sent_ns: int = 0
    turned: int = 0
    try_again_ns: int = 0

    @property
    def number(self) -> int:
        """Of its medium in frames."""
        return self.place + 1

    @property
    def has_slot(self) -> bool:
        """Whether frames wait for a slot here; if not, they leave at once."""
        return self.slots is not None and self.slots.own is Own.RUNNING


class Media:
    """This robot's links, as far as frames leave by them.

    Attributes:
        wireless: names of the interfaces of those that are radios, or have slots.
    """

    def __init__(self, settings: Settings, beats: BeatLane, lanes: FrameLanes, roster: Roster) -> None:
        self._settings, self._beats, self._lanes, self._roster = settings, beats, lanes, roster
        self._rank = roster.ranks[settings.config.robot]
        self._beat_ns = settings.config.beat_ms * MS
        self._ways = {roster.ranks[name]: beats.ways(name) for name in settings.peers}
        self._links = tuple(Link(place, self._beat_ns) for place in range(len(settings.me.beats)))
        self._by_name: dict[str, Link] = {}
        self._slotted: tuple[Link, ...] = ()
        self.wireless: frozenset[str] = frozenset()
        self._lane = lanes.lane(0)
        self._open_casts(self._lane)

    def _open_casts(self, lane: FrameLane) -> None:
        if lane.is_shared and lane.casts is None:
            lane.casts = Casts(self._rank, len(self._roster), self._ways)

    # --- What the links are ---

    def take(self, links: Sequence[LinkNow], now_ns: int) -> None:
        """The worker has looked at the links."""
        for link, now in zip(self._links, links, strict=False):
            if now != link.now:
                link.now = now
                self._set_up(link, now_ns)
        self._by_name = {link.now.name: link for link in reversed(self._links) if link.now.name}
        self._slotted = tuple(link for link in self._links if link.slots is not None)
        self.wireless = frozenset(link.now.name for link in self._links if link.now.is_wireless or link.slots is not None)

    def _set_up(self, link: Link, now_ns: int) -> None:
        config = self._settings.config.medium(link.now.name)
        link.no_slots = self._no_slots(link, config)
        has_slots = bool(link.now.name) and self._wants_slots(link, config) and not link.no_slots
        if has_slots and link.slots is None:
            from failover.core.frames.slots import Slots  # here: a team on wires does not load it

            link.slots = Slots(self._rank, self._roster, Terms(config.t_tup_ms), now_ns)
            link.lane = self._lanes.lane(link.number)
            self._open_casts(link.lane)
        elif not has_slots:
            link.slots = link.lane = None
        link.period_ns = config.t_tup_ms * MS if has_slots else self._beat_ns
        link.try_again_ns = 0
        link.why = self._hindrance(link, config, now_ns)
        link.casting = None if link.why else Casting(Cast(config.cast))
        self._forget_proofs(link)
        if link.casting is not None:
            log.info("frames are cast over %s: %s", link.now.name, link.casting.now)

    def _wants_slots(self, link: Link, config: MediumConfig) -> bool:
        return link.now.is_wireless if config.slots == "auto" else bool(config.slots)

    def _no_slots(self, link: Link, config: MediumConfig) -> str:
        """Why frames leave at once here though this medium is a radio. Whoever asks for slots by name gets them."""
        if not self._wants_slots(link, config):
            return ""
        if link.number > MEDIA_MAX:
            return f"only the first {MEDIA_MAX} links can have slots"
        least_ms = lease_needed_ms(config.t_tup_ms, len(self._roster))
        lease_ms = self._settings.config.lease_ms
        if config.slots == "auto" and lease_ms < least_ms:
            return (
                f"in rounds of {config.t_tup_ms} ms a lease must last {least_ms} ms, and lease_ms is {lease_ms}: set it to "
                f"{least_ms} on all robots, or slots = true in [media.{link.now.name}]"
            )
        return ""

    def _hindrance(self, link: Link, config: MediumConfig, now_ns: int) -> str:
        """Why nothing is cast over this link; "" if it is."""
        if not link.now.name:
            return "no interface has its address now"
        if link.now.is_loopback:
            return "it is the loopback"
        cast, lane = Cast(config.cast), self._lanes.lane(0)
        link.reached = frozenset(self._beats.reached(link.place))
        refusal = self._beats.open_to_casts(link.place, link.now.index) if lane.is_shared and link.place < LINKS_MAX else ""
        if cast is Cast.UNICAST:
            return "the configuration says so"
        if not lane.is_shared:
            return "in a team of this size each member gets a datagram of its own"
        if link.place >= LINKS_MAX:
            return f"frames are cast over the first {LINKS_MAX} links only"
        if len(link.reached) < CAST_MEMBERS_MIN:
            return f"fewer than {CAST_MEMBERS_MIN} members listen at its port over IPv4"
        if cast is Cast.AUTO and link.now.is_wireless and link.slots is None:
            return RADIO_UNICAST
        link.try_again_ns = now_ns + TRY_AGAIN_NS if refusal else 0
        return refusal

    # --- What is heard ---

    def heard(self, sender: str, link: str, size: int, now_ns: int) -> None:
        """A datagram of that member came over an interface."""
        if ours := self._by_name.get(link):
            ours.heard_ns[sender] = now_ns
            ours.bytes[sender] = ours.bytes.get(sender, 0) + size

    def heard_cast(self, place: int, medium: int, rank: int, boot: int, counter: int) -> None:
        """An authentic part came by cast over our link ``place``."""
        casts = self._lanes.lane(medium).casts
        if casts is not None and rank >= 0:
            casts.heard(place, rank, boot, counter)

    def heard_cast_copy(self, place: int, medium: int, sender: str, counter: int) -> None:
        """A copy of a recent part of that member came by cast."""
        casts = self._lanes.lane(medium).casts
        if casts is not None and sender in self._roster.ranks:
            casts.heard_again(place, self._roster.ranks[sender], counter)

    def heard_slots(self, part: Part, link: str, came_ns: int) -> None:
        """An authentic part that tells of its sender's slots."""
        ours = self._by_name.get(link)
        if ours is None or ours.slots is None or part.slots is None or not part.flags & SLOTTED or part.rank < 0:
            return
        ours.slots.heard(SlotView(part.rank, part.boot, part.counter, part.slots), came_ns)

    # --- What leaves ---

    @property
    def is_slotted(self) -> bool:
        """Whether a link has slots, so that frames must be read when they come."""
        return bool(self._slotted)

    @property
    def at_once(self) -> bool:
        """Whether frames leave over a link that never has slots: its pace is the board's."""
        return len(self._slotted) < len(self._links)

    @property
    def round_ns(self) -> int:
        """The longest round of items: a heartbeat's period; where all links have slots, a round that the reference stretched."""
        if self.at_once:
            return self._beat_ns
        return max(self._longest_ns(link) for link in self._slotted)

    def round_of(self, peer: str, now_ns: int) -> int:
        """The longest round of a member's frames, ns: of the fastest link over which one came lately; `round_ns` if over none."""
        if not self._slotted:
            return self._beat_ns
        lately = [link for link in self._links if now_ns - link.heard_ns.get(peer, -HEARD_NS) < HEARD_NS]
        return min((self._longest_ns(link) for link in lately), default=self.round_ns)

    def _longest_ns(self, link: Link) -> int:
        return self._beat_ns if link.slots is None else effective_round_ns(link.period_ns, max(len(self._roster), 2))

    def all_wait(self, now_ns: int) -> bool:
        """Whether a heartbeat leaves over no link now: it waits for a slot, and a newer one may take its place."""
        return not self.at_once and not any(self._goes_at_once(link, now_ns) for link in self._links)

    def is_first(self, link: Link) -> bool:
        """Whether this is the first link on which this robot has a slot: the pace of the board where all links have slots."""
        return link is next((one for one in self._slotted if one.has_slot), None)

    def paces(self, now_ns: int) -> bool:
        """Whether a frame that leaves at once begins a round of the board: one over a link that never has slots.

        Or, where all have them and this robot has a slot on none, any frame: primaries, states and items go on.
        """
        if self.at_once:
            return True
        return not any(link.has_slot for link in self._slotted) and any(self._goes_at_once(link, now_ns) for link in self._links)

    def wakes_ns(self) -> int | None:
        """When `due` is to be asked next; None without slots."""
        return min(link.slots.next_ns() for link in self._slotted if link.slots is not None) if self._slotted else None

    def due(self) -> Iterator[Link]:
        """The links whose frame is to leave now, in a slot."""
        for link in self._slotted:
            if link.slots is not None and link.slots.due(clock.now_ns()):
                yield link

    def send(self, beat: Beat | None, items: Sequence[Portion], now_ns: int, round_: int, *, patience_ns: int = 0) -> int:
        """One frame at once, over each link where none waits for a slot; how many of the items are in it.

        On a medium with slots it counts among the frames of that medium: a member that hears no other one misses none of others.

        Args:
            patience_ns: by how much longer than usual members may take to say what they heard: they rest.
        """
        made: tuple[list[Sealed], int] | None = None
        placed: int | None = None
        for link in self._links:
            if 0 < link.try_again_ns <= now_ns:
                self._set_up(link, now_ns)
            if link.slots is not None and not self._goes_at_once(link, now_ns):
                continue
            link.sent_ns = now_ns
            if link.lane is not None:
                sealed, count = link.lane.seal(beat, items, now_ns, round_=round_)
                placed = count if placed is None else placed
                self._deliver(link, link.lane, sealed, now_ns, self._beat_ns, patience_ns)
                continue
            if made is None:
                made = self._lane.seal(beat, items, now_ns, round_=round_)
            self._deliver(link, self._lane, made[0], now_ns, self._beat_ns, patience_ns)
        return made[1] if made is not None else placed or 0

    def _goes_at_once(self, link: Link, now_ns: int) -> bool:
        """On a medium with slots a robot without one speaks as seldom as those that have one."""
        if link.slots is None:
            return True
        return not link.has_slot and now_ns - link.sent_ns > link.period_ns - self._beat_ns // 2

    def send_in_slot(self, link: Link, beat: Beat, items: Sequence[Portion], round_: int) -> int:
        """The frame of this robot's slot; how many of the items are in it."""
        slots, lane = link.slots, link.lane
        assert slots is not None and lane is not None, "only a link with slots has one"
        now_ns, before = clock.now_ns(), lane.counter
        made, placed = lane.seal(beat, items, now_ns, slots.says(now_ns), flags=SLOTTED, round_=round_)
        left_ns = clock.now_ns()
        slots.sent(left_ns, before + 1)
        self._deliver(link, lane, made, left_ns, link.period_ns, 0)
        return placed

    def _deliver(
        self, link: Link, lane: FrameLane, made: Sequence[Sealed], now_ns: int, period_ns: int, patience_ns: int
    ) -> None:
        """By cast to all, and by unicast to each member that has not said lately that it hears casts."""
        casts, casting, place = lane.casts, link.casting, link.place
        if casting is None or casts is None or casting.now is Cast.UNICAST:
            for sealed in made:
                self._unicast(link, sealed.to, sealed.datagrams)
            if casting is not None and casting.round_over(0, 0):
                self._cast_otherwise(link)
            return
        since_ns = now_ns - round(RECENT_PERIODS * period_ns) - patience_ns
        for sealed in made if any(one.to for one in made) else []:
            refusal = self._beats.cast(place, casting.now, sealed.datagrams)
            self._count_left(link, 1, sealed.datagrams)
            if refusal and casting.failed(refusal):
                self._cast_otherwise(link)
            for counter in range(lane.counter - len(sealed.datagrams) + 1, lane.counter + 1):
                casts.left(place, counter, now_ns)
            ranks, reached = self._roster.ranks, link.reached
            missing = [peer for peer in sealed.to if peer not in reached or not casts.hears(ranks[peer], place, since_ns)]
            self._unicast(link, missing, sealed.datagrams)
            link.by_unicast = tuple(missing)
            self._choose(link, sealed.to, now_ns)

    def _unicast(self, link: Link, to: Sequence[str], datagrams: Sequence[bytes]) -> None:
        unicast, place = self._beats.unicast, link.place
        for peer in to:
            unicast(peer, place, datagrams)
        self._count_left(link, len(to), datagrams)

    def _count_left(self, link: Link, times: int, datagrams: Sequence[bytes]) -> None:
        name = self._settings.config.robot
        link.bytes[name] = link.bytes.get(name, 0) + times * sum(map(len, datagrams))

    def _choose(self, link: Link, to: Sequence[str], now_ns: int) -> None:
        """Try another way to cast where those that we hear do not hear us."""
        assert link.casting is not None
        present = [peer for peer in to if peer in link.reached and now_ns - link.heard_ns.get(peer, 0) < HEARD_NS]
        hearing = sum(peer not in link.by_unicast for peer in present)
        if link.casting.round_over(len(present), hearing):
            self._cast_otherwise(link)

    def _cast_otherwise(self, link: Link) -> None:
        """Frames are cast in another way now: until members say that they hear it they get unicast besides."""
        assert link.casting is not None
        why = link.casting.why or "it is tried again"
        log.log(
            logging.WARNING if link.casting.why else logging.INFO,
            "frames go by %s over %s: %s",
            link.casting.now,
            link.now.name,
            why,
        )
        self._forget_proofs(link)

    def _forget_proofs(self, link: Link) -> None:
        for lane in filter(None, (self._lanes.lane(0), link.lane)):
            if lane.casts is not None and link.place < LINKS_MAX:
                lane.casts.forget(link.place)

    # --- For people ---

    def views(self) -> tuple[MediumView, ...]:
        """Each link."""
        return tuple(self._view(link) for link in self._links)

    def _view(self, link: Link) -> MediumView:
        now = link.casting.now if link.casting is not None else Cast.UNICAST
        why = link.casting.why if link.casting is not None else link.why
        is_cast = link.casting is not None and now is not Cast.UNICAST
        slots = link.slots.view() if link.slots is not None else None
        period_ms = link.period_ns // MS
        by_unicast = link.by_unicast if is_cast else ()
        return MediumView(link.now.name, str(now), why, by_unicast, period_ms, link.no_slots, slots, link.bytes)

    def troubles(self) -> tuple[str, ...]:
        """Sentences for the status: what a person should do something about."""
        return tuple(sentence for link in self._links for sentence in self._troubles(link))

    def _troubles(self, link: Link) -> Iterator[str]:
        name = link.now.name
        if link.no_slots:
            yield f"{name} is a radio and has no slots: {link.no_slots}"
        if link.slots is None:
            return
        view = link.slots.view()
        if view.why:
            yield f"{name}: this robot takes no slot: {view.why} ([media.{name}] in agent.toml)"
        for listener, speaker in view.deaf:
            yield f"{name}: {listener} does not hear {speaker}"
        if not self.at_once:
            yield from self._lease_of_slots_alone(link, view)

    def _lease_of_slots_alone(self, link: Link, view: SlotsView) -> Iterator[str]:
        least_ms = lease_needed_ms(link.period_ns // MS, view.count)
        lease_ms = self._settings.config.lease_ms
        if lease_ms < least_ms:
            yield (
                f"{link.now.name}: rounds may last {least_ms // BEATS_IN_LEASE_MIN} ms, and leases {lease_ms} ms: fewer than "
                f"{BEATS_IN_LEASE_MIN} lost frames can freeze this robot; set lease_ms to {least_ms} on all robots"
            )


def lease_needed_ms(t_tup_ms: int, robots: int) -> int:
    """A lease in which as many of the longest rounds pass as of a heartbeat's periods: the reference stretches rounds."""
    return math.ceil(BEATS_IN_LEASE_MIN * effective_round_ns(t_tup_ms * MS, max(robots, 2)) / MS)
