"""Another robot's items, as its frames bring them: the one file that its receiver writes and all others only read.

One thread of one process uses it. Nothing here waits, and no frame can do harm: what does not fit is counted and dropped.

The writer's numbers tell a new put from a repeated one. Puts here have numbers of this file's own (`Reception`): the writer's
skip puts that no frame carried, and one that is greater by a multiple of the banks would go into the bank that readers read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final

from failover.boards import futex
from failover.boards.fence import FENCE
from failover.boards.mapping import MappedFile
from failover.core.board import layout
from failover.core.board.ages import UNBOUNDED_NS
from failover.core.board.items import BLOCK_SIZE_MAX
from failover.core.board.layout import ADDED, Record, Wanted
from failover.core.board.reception import Reception, Slot
from failover.core.frames.frame import Portion
from failover.errors import BoardError

UNKNOWN: Final = "items with numbers that are not known here"
MISFIT: Final = "values of another size than declared"
NO_ROOM: Final = "items added by other robots for which there is no room here"

GROWTH: Final = 64 << 10
"""A file becomes longer by so much, or by half of its size: what was mapped before stays mapped, so it is to be done seldom."""

_GENERATION: Final = layout.GENERATION_AT // 8
_CHANGED: Final = layout.CHANGED_AT // 8


class ReceivedItems:
    """The file ``peer-ROBOT`` of one robot, open for its receiver.

    Attributes:
        file: as mapped.
        dropped: by reason.
    """

    def __init__(self, file: MappedFile) -> None:
        self.file = file
        self.dropped: Counter[str] = Counter()
        self._reception = Reception({})
        self._records: dict[int, Record] = {}
        self._first_area = file.area  # `_wake` has an address in it
        self._wake = futex.waker(file.address(layout.CHANGED_AT))
        self._generation = -1

    @classmethod
    def open(cls, path: Path) -> ReceivedItems:
        """The file that the agent has made.

        Raises:
            BoardError, FileNotFoundError: it is none, or is not there.
        """
        file = MappedFile.open(path, writable=True)
        file.mend()  # an agent was killed while it changed the table
        return cls(file)

    def begin_life(self) -> None:
        """The robot's agent began anew, and perhaps its board with it: its puts are counted from any number."""
        self._generation = -1

    def heard(self, came_ns: int) -> None:
        """Note a frame from the robot, whatever it carried; ``came_ns``: BOOTTIME."""
        self.file.words[layout.HEARD_AT // 8] = came_ns

    def tell_state(self, state: int) -> None:
        """Whether the robot is there: `layout.NOT` … `layout.REMOVE`."""
        self.file.set_word32(layout.STATE_AT, state)
        self._reception.settle()

    def take(self, items: Sequence[Portion], came_ns: int, error_us: int, round_: int, missing: int = 0) -> int:
        """Put what a frame brought.

        Args:
            items: whole values, with their ages when the frame left.
            came_ns: when the frame came; BOOTTIME.
            error_us: how much older the values may be than these two say; `NO_ERROR_BOUND`: not known.
            round_: of the sender; ``missing``: frames of it that did not come over the medium of this one since the last one
                there. An item was in as many of them as its turns fell into the rounds between: rounds of which this medium
                carries no frame lose none.

        Returns:
            How many were put. The others are not known here, do not fit, or are not newer than what is there.
        """
        if self.file.words[_GENERATION] != self._generation:
            self._look()
        puts, unknown, misfits = self._reception.take(items, came_ns, error_us, round_, missing)
        if unknown:
            self.dropped[UNKNOWN] += unknown
        if misfits:
            self.dropped[MISFIT] += misfits
        if puts:
            self.file.words[_CHANGED] += 1
            self._wake()  # once for all of them: programs that read this file cannot say that they wait, nor for what
        return puts

    def _look(self) -> None:
        self._generation = self.file.generation
        self._records = {record.id: record for record in self.file.records()}
        self._reception.settle()
        self._reception = Reception({number: self._slot(record) for number, record in self._records.items()})

    def _slot(self, record: Record) -> Slot:
        return Slot(self.file.place(record), record.at // 8, record.period, FENCE)

    # --- Items that the robot adds and removes ---

    def added(self) -> list[Record]:
        """The items here that the robot has added."""
        if self.file.words[_GENERATION] != self._generation:
            self._look()
        return [record for record in self._records.values() if record.flags & ADDED]

    def change(self, removed: Iterable[int], added: Iterable[Wanted]) -> None:
        """Remove items by their numbers, then add others; what is there as it is wanted stays.

        What has no room, or a name that is declared already, is counted.

        Raises:
            BoardError: another process holds the table; nothing was changed.
        """
        known = {record.id: record for record in self.added()}
        fresh = [wanted for wanted in added if not layout.is_exactly(known.get(wanted.id), wanted)]
        gone = [known[number] for number in {*removed, *(wanted.id for wanted in fresh)} if number in known]
        if not fresh and not gone:
            return
        with self.file.changing(patience_s=0):
            for record in gone:
                self._remove(record)
            for wanted in fresh:
                self._add(wanted)
        self._generation = self.file.generation

    def _remove(self, record: Record) -> None:
        self.file.remove(record)
        del self._records[record.id]
        self._reception.remove(record.id)

    def _add(self, wanted: Wanted) -> None:
        there = next((record for record in self._records.values() if record.name == wanted.name), None)
        if there is not None and there.flags & ADDED:
            self._remove(there)  # its name was given anew, and what told of its removal was lost
            there = None
        if there is not None:
            self.dropped[NO_ROOM] += 1
            return
        try:
            record = self.file.add(wanted)
            end = record.offset + record.banks * record.stride
            if end > len(self.file.area):
                self.file.grow(min(max(end, len(self.file.area) * 3 // 2, len(self.file.area) + GROWTH), BLOCK_SIZE_MAX))
        except BoardError:
            self.dropped[NO_ROOM] += 1
            return
        self._records[record.id] = record
        self._reception.add(record.id, self._slot(record))

    def bound(self, compute: Callable[[int], int]) -> None:
        """Tell how old each item may be while all works, used where none is declared.

        Args:
            compute: the bound in ns of an item with this period, by `failover.core.board.ages.bound_ns`.
        """
        if self.file.words[_GENERATION] != self._generation:
            self._look()
        bounds: dict[int, int] = {}
        for record in self._records.values():
            if record.period not in bounds:
                bounds[record.period] = min(compute(record.period), UNBOUNDED_NS)
            self.file.words[(record.at + layout.FORMULA_FIELD) // 8] = bounds[record.period]
