"""The board in the main loop: takes what is due from this robot's items, puts what came into the files of the other robots.

Nothing here waits: a get that is overtaken, or a value that does not fit, is counted and left out. Programs of a group may write
anything into `own`; every size is checked before it is believed, and nothing of it raises here.
"""

from __future__ import annotations

import contextlib
import logging
from collections import Counter
from collections.abc import Callable, Container, Mapping, Sequence
from pathlib import Path
from typing import Final

from msgspec import Struct

from agent.main_loop.announcements import Announcements
from agent.main_loop.own_items import UNREADABLE, Newest, own_items
from agent.main_loop.primaries import LEFT_OUT, Primaries
from agent.main_loop.urgent_items import UrgentItems
from failover.boards import boottime, directory
from failover.boards.agents_file import AgentsFile
from failover.boards.mapping import USER_PREFIX, uid_of
from failover.boards.received import ReceivedItems
from failover.boards.unmapped_file import UnmappedFile
from failover.core.beat_pace import URGENT_GAP_NS
from failover.core.board import layout
from failover.core.board.ages import NO_ERROR_BOUND, NS_PER_US, bound_ns, sent_age_us
from failover.core.board.announcements import RESERVED
from failover.core.board.due import Bucket, Sent, Turns
from failover.core.board.owners import Owners
from failover.core.frames.frame import Portion
from failover.core.frames.lane import Heard
from failover.errors import BoardError, OvertakenError

WAITED: Final = "items that waited a round for room in a frame"

REMOVE_ROUNDS: Final = 3
"""Missed rounds after which a robot may have left."""

BOUNDS_TOLD_NS: Final = 1_000_000_000
"""Between two computations of the bounds of a peer's items."""

WORST_FALLS: Final = 1000
"""Frames in which the longest way is forgotten by two thirds: what is longer than it is about one frame of a thousand."""


log = logging.getLogger("failover.heart")


class _Peer(Struct):
    """A peer's file, and what is known of its frames.

    Attributes:
        worst_ns: the longest way lately; falls slowly.
        round_ns: the longest round of its frames, as they come here; 0 until that is told.
    """

    items: ReceivedItems
    boot: int = 0
    heard_ns: int = 0
    state: int = layout.NOT
    worst_ns: int = 0
    told_ns: int = 0
    round_ns: int = 0


class BoardLink:
    """This robot's board. Instants are those of this process's clock; in the files they are the machine's (`boottime`).

    Attributes:
        dropped: by reason.
        wakes: readable when a program told that it put an urgent item.
    """

    def __init__(
        self,
        own: Sequence[UnmappedFile],
        peers: Mapping[str, ReceivedItems],
        round_ns: int,
        primaries: Primaries | None = None,
        owners: Owners | None = None,
    ) -> None:
        self._files = own
        self._round_ns, self._skew_ns = round_ns, boottime.skew_ns()
        self._turns: dict[int, Turns] = {}
        self.dropped: Counter[str] = Counter()
        self._own = own_items([(file, uid_of(file.path)) for file in own], owners, self.dropped)
        self._gone: dict[tuple[int, int], int] = {}
        self._looked: dict[int, int] = {}
        self._buckets: dict[tuple[int, int], Bucket] = {}
        self.wakes = UrgentItems(own)
        self._urgent_ns = 0
        self._peers = {name: _Peer(items) for name, items in peers.items()}
        self._announcements = Announcements(own[0].header().rank, peers)
        self._primaries = primaries

    @classmethod
    def open(cls, place: Path, round_ns: int, far: Container[str] = ()) -> BoardLink:
        """The board that the worker process has made.

        Args:
            far: robots of other sites: the worker writes their files.

        Raises:
            BoardError, OSError: there is none.
        """
        own, owners = [UnmappedFile.open(place / directory.OWN_NAME)], AgentsFile(place).owners()
        for uid in sorted({owner.uid for owner in (owners or {}).values() if owner.uid is not None}):
            try:
                own.append(UnmappedFile.open(place / f"{USER_PREFIX}{uid}"))
            except OSError as error:
                log.warning("items of uid %d are not sent: %s", uid, error)
        prefix = directory.PEER_PREFIX
        named = {path.name.removeprefix(prefix): path for path in sorted(place.glob(f"{prefix}*"))}
        peers = {name: ReceivedItems.open(path) for name, path in named.items() if name not in far}
        agents = Primaries.open(place) if (place / directory.AGENT_NAME).exists() else None
        return cls(own, peers, round_ns, agents, owners)

    # --- Out ---

    def due(self, round_: int, now_ns: int, medium: int = 0, since: int | None = None) -> list[Portion]:
        """What goes into the frame of this round, with its age at ``now_ns``; first what is told of items that were added.

        Args:
            medium: each has turns of its own, as each has room of its own; 0: the links without slots.
            since: see `Turns.due`.
        """
        try:
            if self._own.look(now_ns):
                self._hold(*self._turns.values())
                self._announcements.hold(self._own.records.values())
                self._own.ask()
            told = self._announcements.due(round_, medium)
            due = self._turns_of(medium).due(round_, since)
            if not due:
                return told
            return told + self._portions(self._own.newest(due), now_ns)
        except (BoardError, OSError):
            self.dropped[UNREADABLE] += 1
            return []

    def _turns_of(self, medium: int) -> Turns:
        if medium not in self._turns:
            self._turns[medium] = Turns()
            self._hold(self._turns[medium])
        return self._turns[medium]

    def _hold(self, *turns: Turns) -> None:
        items = [Sent(one.id, one.period, one.phase) for one in self._own.records.values()]
        for one in turns:
            one.hold(items)

    def urgent_due_ns(self, sent_ns: int) -> int:
        """When to look for urgent items that are put now: a moment after the last frame, and after the last look.

        A program that puts one all the time makes no frames beyond what `Bucket` allows; it costs the loop a look each moment.
        """
        return max(sent_ns, self._urgent_ns) + URGENT_GAP_NS

    def urgent(self, now_ns: int, medium: int = 0) -> list[Portion]:
        """Urgent items that were put since they last went over this medium, as often as `Bucket` allows it there."""
        own, gone, may = self._own, self._gone, []
        if medium == 0:
            self._urgent_ns = now_ns
        try:
            numbers = own.urgent_numbers()
        except OSError:
            self.dropped[UNREADABLE] += 1
            return []
        if medium == 0:
            self._looked = numbers
        for record in own.urgent:
            lane, number = (medium, record.id), numbers.get(record.id, 0)
            if number > gone.get(lane, 0) and self._bucket(lane).take(now_ns):
                may.append((record, number))
        return self._portions(may, now_ns)

    def _bucket(self, lane: tuple[int, int]) -> Bucket:
        bucket = self._buckets.get(lane)
        if bucket is None:
            bucket = self._buckets[lane] = Bucket()
        return bucket

    def seen_to(self) -> bool:
        """What `urgent` gave is on its way: programs are to tell of their next put. Whether there was one since it looked."""
        self.wakes.heed()
        try:
            self._own.ask()
        except OSError:
            self.dropped[UNREADABLE] += 1
        return self.has_urgent()

    def has_urgent(self) -> bool:
        """Whether an urgent item was put since `urgent` looked for the links without slots."""
        if not self._own.urgent:
            return False
        try:
            return self._own.urgent_numbers() != self._looked
        except OSError:
            self.dropped[UNREADABLE] += 1
            return False

    def leave_for_slot(self, now_ns: int) -> None:
        """Urgent items that were put wait for this robot's slot."""
        self._urgent_ns = now_ns
        try:
            self._looked = self._own.urgent_numbers()
        except OSError:
            self.dropped[UNREADABLE] += 1

    def placed(self, portions: Sequence[Portion], count: int, medium: int = 0) -> None:
        """The first ``count`` of what was due found room in the frame."""
        self._turns_of(medium).left([portion.number for portion in portions[count:] if portion.number < RESERVED])
        self.went(portions[:count], medium)

    def went(self, portions: Sequence[Portion], medium: int = 0) -> None:
        """These are on their way over this medium: what is urgent of them need not go there again."""
        if self._own.urgent:
            self._gone.update([((medium, portion.number), portion.put) for portion in portions])

    def _portions(self, newest: Newest, now_ns: int) -> list[Portion]:
        """Of items with the numbers of their newest puts."""
        found, left_ns, get = [], now_ns - self._skew_ns, self._own.get
        if len(newest) > 1:
            with contextlib.suppress(OSError):  # told for each item below
                self._own.read_ahead(newest)
        for record, number in newest:
            try:
                bank = get(record, number)
            except (OvertakenError, BoardError, OSError):
                self.dropped[UNREADABLE] += 1
                continue
            if bank is not None:
                found.append(Portion(record.id, sent_age_us(bank.stamp_ns, left_ns), bank.number, bank.value))
        return found

    # --- In ---

    def take(self, heard: Heard, came_ns: int) -> None:
        """Put what a frame brought into the file of its sender."""
        part = heard.part
        peer = self._peers.get(part.sender)
        if peer is None or not part.alike or part.boot < peer.boot:
            return  # of an earlier life: a frame that was recorded on a medium of which nothing came in this life
        if part.boot > peer.boot:
            peer.boot = part.boot
            peer.items.begin_life()
            self._announcements.begin_life(part.sender)
        came_ns -= self._skew_ns
        items = heard.items
        if items and items[0].number >= RESERVED:
            items = self._announcements.take(part.sender, items)
        if items:
            way_ns = heard.way_ns  # values are older than told by this at most, and by what it and their ages were rounded
            error_us = NO_ERROR_BOUND if way_ns is None else min(way_ns // NS_PER_US + 2, NO_ERROR_BOUND)
            peer.items.take(items, came_ns, error_us, part.round, heard.missing)
        self._note_frame(peer, heard.way_ns, came_ns)

    def _note_frame(self, peer: _Peer, way_ns: int | None, came_ns: int) -> None:
        """Tell when it came; from time to time the bounds that follow from the longest ways."""
        peer.heard_ns = max(came_ns, 1)
        peer.items.heard(peer.heard_ns)
        if way_ns is None:
            return
        peer.worst_ns = max(way_ns, peer.worst_ns - peer.worst_ns // WORST_FALLS)
        if came_ns - peer.told_ns > BOUNDS_TOLD_NS:
            peer.told_ns = came_ns
            round_ns, worst_ns = peer.round_ns or self._round_ns, peer.worst_ns
            peer.items.bound(lambda period: bound_ns(period, period * round_ns, worst_ns, round_ns, 1))

    def tell_states(self, now_ns: int, lease_ns: int, round_of: Callable[[str], int]) -> None:
        """Note of each robot whether it is there: heard in the last rounds, missed, or silent for a lease.

        Args:
            round_of: the longest round of a robot's frames, ns: one that is heard by radio only is heard more seldom.
        """
        for name, peer in self._peers.items():
            peer.round_ns = round_of(name)
            silent_ns = now_ns - self._skew_ns - peer.heard_ns
            state = layout.REMOVE if silent_ns < lease_ns else layout.NOT
            if silent_ns < REMOVE_ROUNDS * peer.round_ns:
                state = layout.RUN
            if peer.state != state and peer.heard_ns:
                peer.state = state
                peer.items.tell_state(state)

    def tell_primaries(self, primaries: Mapping[str, tuple[str, int]], now_ns: int) -> None:
        """Tell programs which robot runs which component: component → robot, epoch."""
        if self._primaries is not None:
            self._primaries.tell(primaries, now_ns - self._skew_ns)

    def close(self) -> None:
        """Give the locks back; the files stay for the agent that comes after."""
        self.wakes.close()
        if self._primaries is not None:
            self._primaries.close()
        for file in self._files:
            file.close()
        for peer in self._peers.values():
            peer.items.file.close()

    def left_out(self) -> Counter[str]:
        """Values that were not taken, by reason, and those that waited."""
        counts = sum((peer.items.dropped for peer in self._peers.values()), self.dropped) + self._announcements.refused()
        left_out = self._primaries.left_out if self._primaries is not None else 0
        waited = sum(sum(turns.waited.values()) for turns in self._turns.values())
        return counts + Counter({WAITED: waited, LEFT_OUT: left_out})
