"""Another robot's items, as its frames bring them: the one file that its receiver writes and all others only read.

One thread of one process uses it. Nothing here waits, and no frame can do harm: what does not fit is counted and dropped.

A robot that has started anew counts its puts from 1 again. For it the receiver makes the file anew (`directory.dismiss`, then
`directory.make_file`): its readers go there by themselves, and no number stands for two values in one file.
"""

from __future__ import annotations

from pathlib import Path

from failover.boards import futex
from failover.boards.fence import FENCE
from failover.boards.mapping import MappedFile
from failover.core.board import layout
from failover.core.board.banks import Place, put_carefully
from failover.core.board.layout import Record


class ReceivedItems:
    """The file ``peer-ROBOT`` of one robot, open for its receiver.

    Attributes:
        file: as mapped.
    """

    def __init__(self, file: MappedFile) -> None:
        self.file = file
        self._items: dict[int, tuple[Record, Place]] = {}
        self._generation = -1

    @classmethod
    def open(cls, path: Path) -> ReceivedItems:
        """The file that the agent has made.

        Raises:
            BoardError, FileNotFoundError: it is none, or is not there.
        """
        return cls(MappedFile.open(path, writable=True))

    def heard(self, state: int, came_ns: int) -> None:
        """Note a frame from the robot, whatever it carried; ``state``: `layout.NOT` … `layout.REMOVE`, ``came_ns``: BOOTTIME."""
        self.file.set_word32(layout.STATE_AT, state)
        self.file.words[layout.HEARD_AT // 8] = came_ns

    def put(self, item: int, number: int, value: bytes, stamp_ns: int, error_us: int, *, lost: int = 0, round: int = 0) -> bool:
        """Take an item out of a frame.

        Args:
            item, number: of the item, and of the put by its writer.
            stamp_ns, error_us: as `failover.core.board.ages.received` says.
            lost: frames with it that were missed since the last one.
            round: of the sender.

        Returns:
            Whether it was put: False for an item that is not known, a value that does not fit, and a put that is not newer.
        """
        found = self._known().get(item)
        if found is None:
            return False
        record, place = found
        words, base = place.words, record.at // 8
        words[base + layout.FRAMES_FIELD // 8] += 1
        words[base + layout.LOST_FIELD // 8] += lost
        self.file.set_word32(record.at + layout.TRANSIT_FIELD, error_us)
        self.file.set_word32(record.at + layout.ROUND_FIELD, round & 0xFFFF_FFFF)
        if not place.least <= len(value) <= place.limit:
            words[base + layout.REFUSED_FIELD // 8] += 1
            return False
        if number <= words[place.newest]:
            return False
        put_carefully(place, number, value, stamp_ns, error_us, FENCE)
        futex.wake(self.file.address(record.at + layout.NEWEST_FIELD))  # who reads cannot say that it waits
        return True

    def bound(self, item: int, bound_ns: int) -> None:
        """How old an item may be while all works, by `failover.core.board.ages.bound_ns`; used where none is declared."""
        found = self._known().get(item)
        if found is not None:
            found[1].words[found[1].formula] = bound_ns

    def _known(self) -> dict[int, tuple[Record, Place]]:
        if self.file.generation != self._generation:
            self._items = {record.id: (record, self.file.place(record)) for record in self.file.records()}
            self._generation = self.file.generation
        return self._items
