"""The board in the main loop: takes what is due from this robot's items, puts what came into the files of the other robots.

Nothing here waits: a get that is overtaken, or a value that does not fit, is counted and left out. Programs of a group may write
anything into `own`; every size is checked before it is believed, and nothing of it raises here.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

from msgspec import Struct

from agent.main_loop.board_files import BoardFiles
from agent.main_loop.own_items import OwnItems, number_in
from agent.main_loop.urgent_items import UrgentItems
from failover.boards import futex
from failover.boards.fence import FENCE
from failover.boards.mapping import MappedFile
from failover.core.board import layout
from failover.core.board.ages import NO_ERROR_BOUND, NS_PER_US, bound_ns, received, sent_age_us
from failover.core.board.banks import Place, put_carefully
from failover.core.board.due import Bucket, Sent, Turns
from failover.core.board.layout import Record
from failover.core.frames.frame import Portion
from failover.core.frames.lane import Heard
from failover.errors import BoardError, OvertakenError

UNREADABLE: Final = "own items that could not be read"
UNKNOWN: Final = "items with numbers that are not known here"
TOO_LARGE: Final = "values larger than declared"

REMOVE_ROUNDS: Final = 3
"""Missed rounds after which a robot may have left."""

WORST_FALLS: Final = 1000
"""Frames in which the longest way is forgotten by two thirds: what is longer than it is about one frame of a thousand."""


class _Slot(Struct):
    """One item of a peer.

    Attributes:
        put: number of its newest put, as the peer counts them.
        round: of the peer's frame that brought it last.
    """

    record: Record
    place: Place
    address: int
    put: int = 0
    round: int = -1


class _Peer(Struct):
    """A peer's file, and what is known of its frames.

    Attributes:
        worst_ns: the longest way lately; falls slowly.
    """

    file: MappedFile
    slots: dict[int, _Slot]
    boot: int = 0
    heard_ns: int = 0
    state: int = layout.NOT
    worst_ns: int = 0


class BoardLink:
    """This robot's board.

    Attributes:
        dropped: by reason.
        wakes: readable when an urgent item was put.
    """

    def __init__(self, files: BoardFiles, round_ns: int) -> None:
        self._files = files
        self._round_ns = round_ns
        self.turns = Turns()
        self.dropped: Counter[str] = Counter()
        self._own = OwnItems(files.own)
        self._gone: dict[int, int] = {}
        self._buckets: dict[int, Bucket] = {}
        self.wakes = UrgentItems(files.own, self._own)
        self._peers = {name: _Peer(file, _slots(file)) for name, file in files.peers.items()}

    # --- Out ---

    def due(self, round_: int, now_ns: int) -> list[Portion]:
        """What goes into the frame of this round, with its age at ``now_ns``."""
        try:
            if self._own.look(now_ns):
                self.turns.hold(Sent(one.id, one.period, one.phase) for one in self._own.records.values())
            numbers = self.turns.due(round_)
            return self._portions(numbers, self._own.newest(), now_ns) if numbers else []
        except (BoardError, OSError):
            self.dropped[UNREADABLE] += 1
            return []

    def urgent(self, now_ns: int) -> list[Portion]:
        """Urgent items that were put since they last went, as often as `Bucket` allows it."""
        try:
            table = self._own.newest()
        except (BoardError, OSError):
            self.dropped[UNREADABLE] += 1
            return []
        put = [one.id for one in self._own.urgent if number_in(table, one) > self._gone.get(one.id, 0)]
        allowed = [number for number in put if self._buckets.setdefault(number, Bucket()).take(now_ns)]
        return self._portions(allowed, table, now_ns)

    def placed(self, portions: Sequence[Portion], count: int) -> None:
        """The first ``count`` of what was due found room in the frame."""
        self.turns.left(portion.number for portion in portions[count:])
        self.went(portions[:count])

    def went(self, portions: Sequence[Portion]) -> None:
        """These are on their way: what is urgent of them need not go again."""
        self._gone.update((portion.number, portion.put) for portion in portions)

    def _portions(self, numbers: Sequence[int], table: bytes, now_ns: int) -> list[Portion]:
        found = []
        for number in numbers:
            try:
                bank = self._own.get(self._own.records[number], table)
            except (OvertakenError, BoardError, OSError):
                self.dropped[UNREADABLE] += 1
                continue
            if bank is not None:
                found.append(Portion(number, sent_age_us(bank.stamp_ns, now_ns), bank.number, bank.value))
        return found

    # --- In ---

    def take(self, heard: Heard, came_ns: int) -> None:
        """Put what a frame brought into the file of its sender."""
        part = heard.part
        peer = self._peers.get(part.sender)
        if peer is None or not part.alike:
            return
        if part.boot != peer.boot:
            self._begin_life(peer, part.boot)
        self._note_frame(peer, heard.way_ns, came_ns)
        way_us = NO_ERROR_BOUND if heard.way_ns is None else heard.way_ns // NS_PER_US + 1
        for portion in heard.items:
            slot = peer.slots.get(portion.number)
            if slot is None:
                self.dropped[UNKNOWN] += 1
            elif len(portion.value) > slot.record.size:
                self.dropped[TOO_LARGE] += 1
            else:
                self._note_item(peer, slot, part.round, way_us)
                if portion.put > slot.put:
                    slot.put = portion.put
                    self._put(slot, portion, came_ns, way_us)

    def _put(self, slot: _Slot, portion: Portion, came_ns: int, way_us: int) -> None:
        place = slot.place
        stamp_ns, error_us = received(portion.age_us, came_ns, way_us)
        put_carefully(place, place.words[place.newest] + 1, portion.value, max(stamp_ns, 0), error_us, FENCE)
        futex.wake(slot.address)

    def _begin_life(self, peer: _Peer, boot: int) -> None:
        """The peer's agent began anew, and perhaps its board with it: its puts are counted from any number."""
        peer.boot = boot
        for slot in peer.slots.values():
            slot.put, slot.round = 0, -1

    def _note_frame(self, peer: _Peer, way_ns: int | None, came_ns: int) -> None:
        words = peer.file.words
        peer.heard_ns = words[layout.HEARD_AT // 8] = max(came_ns, 1)
        if way_ns is not None:
            peer.worst_ns = max(way_ns, peer.worst_ns - peer.worst_ns // WORST_FALLS)

    def _note_item(self, peer: _Peer, slot: _Slot, round_: int, way_us: int) -> None:
        """Count the frame, and those that were lost since the last one with this item; tell the bound that follows."""
        words, at = slot.place.words, slot.record.at
        words[(at + layout.FRAMES_FIELD) // 8] += 1
        words[(at + layout.TRANSIT_FIELD) // 8] = round_ << 32 | way_us
        missing = (round_ - slot.round) // slot.record.period - 1
        if slot.round >= 0 and missing > 0:
            words[(at + layout.LOST_FIELD) // 8] += missing
        slot.round = round_
        cycle_ns = slot.record.period * self._round_ns
        words[(at + layout.FORMULA_FIELD) // 8] = bound_ns(slot.record.period, cycle_ns, peer.worst_ns, self._round_ns, 1)

    def tell_states(self, now_ns: int, lease_ns: int) -> None:
        """Note of each robot whether it is there: heard in the last rounds, missed, or silent for a lease."""
        for peer in self._peers.values():
            silent_ns = now_ns - peer.heard_ns
            state = (
                layout.RUN
                if silent_ns < REMOVE_ROUNDS * self._round_ns
                else layout.REMOVE
                if silent_ns < lease_ns
                else layout.NOT
            )
            if peer.state != state and peer.heard_ns:
                peer.state = state
                peer.file.set_word32(layout.STATE_AT, state)

    def close(self) -> None:
        """Give the locks back; the files stay for the agent that comes after."""
        self.wakes.close()
        for file in (self._files.own, *self._files.peers.values()):
            file.close()


def _slots(file: MappedFile) -> dict[int, _Slot]:
    base = file.address(0)
    return {record.id: _Slot(record, file.place(record), base + record.at + layout.NEWEST_FIELD) for record in file.records()}
