"""All items of a board as a person looks at them: the declaration, the newest value and the counters of each."""

from __future__ import annotations

import contextlib
from typing import Any, Final

from msgspec import Struct

from failover.boards import boottime
from failover.boards.board import Board
from failover.boards.fence import FENCE
from failover.boards.item import values_for
from failover.boards.mapping import MappedFile, uid_of
from failover.core.board import ages, layout
from failover.core.board.banks import get_carefully
from failover.core.board.item_values import Values
from failover.core.board.layout import Record
from failover.core.board.owners import Owners
from failover.errors import BoardError, BoardGoneError, ItemError, NeverWrittenError, ValueMisfitError

AREAS: Final = {layout.PRIVATE: "private", layout.OWN: "own", layout.PEER: "peer"}


class Seen(Struct, frozen=True, kw_only=True):
    """One item of one robot.

    Attributes:
        id: the item's number. area: "private", "own" or "peer".
        type: its text, see `failover.core.board.item_types`. size: bytes of a value.
        put: number of the newest put; 0: there was none, and then the next four are None or False.
        age_ns: at least. age_max_ns: at most; None where that is not known.
        bound_ns: past it a reading is stale; 0: there is none.
        complaint: why its value cannot be shown; "".
        writer: pid as the writer sees itself; 0: none so far, or at another robot.
        refused: puts. frames, lost: that carried it, and in between. transit_us: their newest bound.
    """

    robot: str
    item: str
    id: int
    area: str
    type: str
    size: int
    period: int
    phase: int
    banks: int
    put: int = 0
    value: Any = None
    age_ns: int | None = None
    age_max_ns: int | None = None
    stale: bool = False
    bound_ns: int = 0
    complaint: str = ""
    writer: int = 0
    refused: int = 0
    frames: int = 0
    lost: int = 0
    transit_us: int = 0


class Overview:
    """A board that is looked at again and again: what only a change of a table changes is read once."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self._known: dict[str, tuple[MappedFile, int, list[_Row]]] = {}

    def look(self) -> list[Seen]:
        """Every item of every robot, this robot's first, guests last; a damaged one says so and does not hide the others.

        Raises:
            BoardError: the board itself cannot be read.
        """
        board = self._board
        with board.guard:
            opened = board.ensured()
            files = [(opened.robot, file) for file in opened.files]
            for robot in (*opened.peer_names(), *opened.guest_names()):
                with contextlib.suppress(BoardGoneError):
                    files.append((robot, opened.peer(robot)))
            now_ns = boottime.now_ns(board.skew_ns)
            known, damaged = {}, list[Seen]()
            uids = opened.uids()
            for robot, file in files:
                if uid_of(file.path) not in uids:
                    known[str(file.path)] = self._rows(robot, file)
            for uid in uids:
                try:
                    file = opened.of_user(uid)
                    known[str(file.path)] = self._rows(opened.robot, file)
                except BoardError as error:
                    damaged += _complaints(opened.robot, opened.owners(), uid, str(error))
            self._known = known
            return [*[_seen(row, now_ns) for _, _, rows in known.values() for row in rows], *damaged]

    def _rows(self, robot: str, file: MappedFile) -> tuple[MappedFile, int, list[_Row]]:
        generation = file.generation
        known = self._known.get(str(file.path))
        if known is not None and known[0] is file and known[1] == generation and generation % 2 == 0:
            return known
        return file, generation, [_Row(robot, file, record) for record in file.records()]


class _Row:
    """One item, and where it lies."""

    __slots__ = ("declared", "file", "place", "record", "values", "why")

    def __init__(self, robot: str, file: MappedFile, record: Record) -> None:
        self.file, self.record, self.place = file, record, file.place(record)
        self.declared: dict[str, Any] = {
            "robot": robot,
            "item": record.name,
            "id": record.id,
            "area": next(word for flag, word in AREAS.items() if file.header.flags & flag),
            "type": record.text or f"bytes[{record.size}]",
            "size": record.size,
            "period": record.period,
            "phase": record.phase,
            "banks": record.banks,
        }
        self.values: Values | None = None
        self.why = ""
        try:
            self.values = values_for(record, None)
        except (BoardError, ItemError) as error:
            self.why = str(error)


def overview(board: Board) -> list[Seen]:
    """`Overview.look`, once."""
    return Overview(board).look()


def _complaints(robot: str, owners: Owners, uid: int, why: str) -> list[Seen]:
    """The items of a user whose file cannot be read."""
    nothing: dict[str, Any] = {"area": "own", "type": "", "size": 0, "period": 1, "phase": 0, "banks": 0}
    theirs = [(name, owner.number) for name, owner in owners.items() if owner.uid == uid]
    return [Seen(robot=robot, item=name, id=number, complaint=why, **nothing) for name, number in theirs]


def _seen(row: _Row, now_ns: int) -> Seen:
    record, words, place = row.record, row.file.words, row.place
    bound_ns = record.bound_ns or words[place.formula]
    counted: dict[str, Any] = {
        "bound_ns": bound_ns,
        "writer": 0 if row.declared["area"] == "peer" else row.file.word32(record.at + layout.PID_FIELD),
        "refused": words[(record.at + layout.REFUSED_FIELD) // 8],
        "frames": words[(record.at + layout.FRAMES_FIELD) // 8],
        "lost": words[(record.at + layout.LOST_FIELD) // 8],
        "transit_us": row.file.word32(record.at + layout.TRANSIT_FIELD),
    }
    try:
        found = get_carefully(place, FENCE)
    except NeverWrittenError:
        return Seen(**row.declared, **counted)
    except BoardError as error:
        return Seen(**row.declared, **counted, complaint=str(error))
    age_ns = max(now_ns - found.stamp_ns, 0)  # it may be put after the look at the clock
    most_ns = ages.age_max_ns(age_ns, found.error_us)
    value, complaint = None, row.why
    if row.values is not None:
        try:
            value = row.values.unpack(found.value)
        except (ValueMisfitError, BoardError) as error:
            complaint = str(error)
    return Seen(
        **row.declared,
        **counted,
        put=found.number,
        value=value,
        age_ns=age_ns,
        age_max_ns=None if most_ns == ages.UNBOUNDED_NS else most_ns,
        stale=ages.is_stale(most_ns, bound_ns),
        complaint=complaint,
    )
