"""Another robot's items, as its frames bring them: the one file that its receiver writes and all others only read.

One thread of one process uses it. Nothing here waits, and no frame can do harm: what does not fit is counted and dropped.

Puts have numbers of this file's own, one after the other. The writer's numbers only tell a new put from a repeated one. They skip
puts that no frame carried; one that is greater by a multiple of the banks would go into the bank that readers read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

from failover.boards import futex
from failover.boards.fence import FENCE
from failover.boards.mapping import MappedFile
from failover.core.board import layout
from failover.core.board.banks import put_carefully
from failover.core.board.layout import Record

UNKNOWN: Final = "items with numbers that are not known here"
MISFIT: Final = "values of another size than declared"

Take = Callable[[int, bytes, int, int, int], bool | None]
"""``(number, value, stamp_ns, error_us, round)`` → whether it was put; None: it does not fit."""


class ReceivedItems:
    """The file ``peer-ROBOT`` of one robot, open for its receiver.

    Attributes:
        file: as mapped.
        dropped: by reason.
    """

    def __init__(self, file: MappedFile) -> None:
        self.file = file
        self.dropped: Counter[str] = Counter()
        self._items: dict[int, Take] = {}
        self._generation = -1

    @classmethod
    def open(cls, path: Path) -> ReceivedItems:
        """The file that the agent has made.

        Raises:
            BoardError, FileNotFoundError: it is none, or is not there.
        """
        return cls(MappedFile.open(path, writable=True))

    def begin_life(self) -> None:
        """The robot's agent began anew, and perhaps its board with it: its puts are counted from any number."""
        self._generation = -1

    def heard(self, came_ns: int) -> None:
        """Note a frame from the robot, whatever it carried; ``came_ns``: BOOTTIME."""
        self.file.words[layout.HEARD_AT // 8] = came_ns

    def tell_state(self, state: int) -> None:
        """Whether the robot is there: `layout.NOT` … `layout.REMOVE`."""
        self.file.set_word32(layout.STATE_AT, state)

    def put(self, item: int, number: int, value: bytes, stamp_ns: int, error_us: int, *, round: int = 0) -> bool:
        """Take an item out of a frame.

        Args:
            item, number: of the item, and of the put by its writer.
            stamp_ns, error_us: as `failover.core.board.ages.received` says.
            round: of the sender; frames with the item that were missed since the last one are counted by it.

        Returns:
            Whether it was put: False for an item that is not known, a value that does not fit, and a put that is not newer.
        """
        if self.file.words[layout.GENERATION_AT // 8] != self._generation:
            self._generation = self.file.generation
            self._items = {record.id: _taker(self.file, record) for record in self.file.records()}
        take = self._items.get(item)
        is_put = take(number, value, stamp_ns, error_us, round) if take is not None else None
        if is_put is None:
            self.dropped[UNKNOWN if take is None else MISFIT] += 1
        return bool(is_put)

    def bound(self, compute: Callable[[int], int]) -> None:
        """Tell how old each item may be while all works, used where none is declared.

        Args:
            compute: the bound in ns of an item with this period, by `failover.core.board.ages.bound_ns`.
        """
        for record in self.file.records():
            self.file.words[(record.at + layout.FORMULA_FIELD) // 8] = compute(record.period)


def _taker(file: MappedFile, record: Record) -> Take:
    place = file.place(record)
    words, newest, least, limit, base = place.words, place.newest, place.least, place.limit, record.at // 8
    frames, transit = base + layout.FRAMES_FIELD // 8, base + layout.TRANSIT_FIELD // 8
    lost, refused = base + layout.LOST_FIELD // 8, base + layout.REFUSED_FIELD // 8
    period, wake = record.period, futex.waker(file.address(record.at + layout.NEWEST_FIELD))
    following, last_number, last_round = words[newest] + 1, 0, -1

    def take(number: int, value: bytes, stamp_ns: int, error_us: int, round_: int) -> bool | None:
        nonlocal following, last_number, last_round
        words[frames] += 1
        words[transit] = (round_ & 0xFFFF_FFFF) << 32 | error_us
        if 0 <= last_round < round_ - period:
            words[lost] += (round_ - last_round) // period - 1
        last_round = round_
        if not least <= len(value) <= limit:
            words[refused] += 1
            return None
        if number <= last_number:
            return False
        last_number = number
        put_carefully(place, following, value, stamp_ns, error_us, FENCE)
        following += 1
        wake()  # who reads cannot say that it waits
        return True

    return take
