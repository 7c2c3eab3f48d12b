"""All items of a board as a person looks at them: the declaration, the newest value and the counters of each."""

from __future__ import annotations

import contextlib
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import replace

from failover.boards import boottime
from failover.boards.board import Board
from failover.boards.fence import FENCE
from failover.boards.item import values_for
from failover.boards.mapping import MappedFile
from failover.core.board import ages, layout
from failover.core.board.banks import get_carefully
from failover.core.board.layout import Record
from failover.errors import BoardError, BoardGoneError, NeverWrittenError, ValueMisfitError

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


def overview(board: Board) -> list[Seen]:
    """Every item of every robot, this robot's first; a damaged one says so and does not hide the others.

    Raises:
        BoardError: the board itself cannot be read.
    """
    with board.guard:
        opened = board.ensured()
        files = [(opened.robot, file) for file in opened.files]
        for robot in opened.peer_names():
            with contextlib.suppress(BoardGoneError):
                files.append((robot, opened.peer(robot)))
        now_ns = boottime.now_ns(board.skew_ns)
        return [_seen(robot, file, record, now_ns) for robot, file in files for record in file.records()]


def _seen(robot: str, file: MappedFile, record: Record, now_ns: int) -> Seen:
    area = next(word for flag, word in AREAS.items() if file.header.flags & flag)
    seen = Seen(
        robot=robot,
        item=record.name,
        id=record.id,
        area=area,
        type=record.text or f"bytes[{record.size}]",
        size=record.size,
        period=record.period,
        phase=record.phase,
        banks=record.banks,
        writer=0 if area == "peer" else file.word32(record.at + layout.PID_FIELD),
        refused=file.words[(record.at + layout.REFUSED_FIELD) // 8],
        frames=file.words[(record.at + layout.FRAMES_FIELD) // 8],
        lost=file.words[(record.at + layout.LOST_FIELD) // 8],
        transit_us=file.word32(record.at + layout.TRANSIT_FIELD),
    )
    return _with_value(seen, file, record, now_ns)


def _with_value(seen: Seen, file: MappedFile, record: Record, now_ns: int) -> Seen:
    place = file.place(record)
    bound_ns = record.bound_ns or place.words[place.formula]
    seen = replace(seen, bound_ns=bound_ns)
    try:
        found = get_carefully(place, FENCE)
    except NeverWrittenError:
        return seen
    except BoardError as error:
        return replace(seen, complaint=str(error))
    age_ns = max(now_ns - found.stamp_ns, 0)  # it may be put after the look at the clock
    most_ns = ages.age_max_ns(age_ns, found.error_us)
    seen = replace(
        seen,
        put=found.number,
        age_ns=age_ns,
        age_max_ns=None if most_ns == ages.UNBOUNDED_NS else most_ns,
        stale=ages.is_stale(most_ns, bound_ns),
    )
    try:
        return replace(seen, value=values_for(record, None).unpack(found.value))
    except (ValueMisfitError, BoardError) as error:
        return replace(seen, complaint=str(error))
