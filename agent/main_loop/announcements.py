"""Items that are added at run time: tells those of this robot in its frames, and makes those of others in their files.

`failover.core.board.announcements` has the rules. `BoardLink` calls this for each frame; nothing here waits.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from failover.boards.received import ReceivedItems
from failover.core.board.announcements import (
    PAGE,
    QUESTION,
    RESERVED,
    Announcer,
    Change,
    Learned,
    asks,
    question,
)
from failover.core.board.layout import ADDED, Record, wanted_of
from failover.core.frames.frame import Portion
from failover.errors import BoardError

log = logging.getLogger("failover.heart")


class Announcements:
    """The tables of this robot and of its peers.

    Args:
        rank: this robot's. peers: their files by their names; each knows its robot's rank.
    """

    def __init__(self, rank: int, peers: Mapping[str, ReceivedItems]) -> None:
        self._rank = rank
        self._announcer = Announcer(rank)
        self._files = peers
        self._learned = {name: Learned(items.file.header.rank, items.added()) for name, items in peers.items()}
        self._put = self._round = 0
        self._lacking: tuple[int, ...] = ()
        self._asked: set[int] = set()

    def hold(self, records: Iterable[Record]) -> None:
        """This robot's items that it sends, as its table is now."""
        self._announcer.hold(record for record in records if record.flags & ADDED)

    def due(self, round_: int, medium: int = 0) -> list[Portion]:
        """What to tell in the frame of this round, before its items: a value whose item is told in the same frame is not lost."""
        found = []
        page = self._announcer.due(round_, medium)
        if page is not None:
            found.append(self._portion(PAGE, page))
        if round_ != self._round:
            self._round = round_
            self._look()
        if self._lacking and medium not in self._asked:
            self._asked.add(medium)
            found.append(self._portion(QUESTION, question(self._lacking)))
        return found

    def _look(self) -> None:
        """Once a round: whose tables lack a part. The question goes once over each medium: the robot may hear but one of them."""
        ranks = tuple([self._files[name].file.header.rank for name, learned in self._learned.items() if learned.is_to_ask()])
        if ranks:
            self._lacking, self._asked = ranks, set()

    def _portion(self, number: int, content: bytes) -> Portion:
        self._put += 1
        return Portion(number, 0, self._put, content)

    def begin_life(self, robot: str) -> None:
        """The agent of a robot began anew."""
        self._learned[robot].begin_life()

    def take(self, robot: str, came: Sequence[Portion]) -> Sequence[Portion]:
        """See to what a frame of a robot brought before its items: the items."""
        for index, portion in enumerate(came):
            if portion.number == PAGE:
                self._change(robot, self._learned[robot].take(portion.put, portion.value))
            elif portion.number == QUESTION and asks(portion.value, self._rank):
                self._announcer.asked()
            elif portion.number < RESERVED:
                return came[index:]
        return ()

    def _change(self, robot: str, changes: Iterable[Change]) -> None:
        changes = list(changes)
        if not changes:
            return
        removed = [change.number for change in changes if change.item is None]
        added = [wanted_of(change.item, change.number, ADDED) for change in changes if change.item is not None]
        try:
            self._files[robot].change(removed, added)
        except (BoardError, OSError) as error:
            log.warning("items that %s has added wait for its next word: %s", robot, error)
            return
        for change in changes:
            self._learned[robot].note(change)

    def refused(self) -> Counter[str]:
        """What was not told or not taken, by reason."""
        return sum((learned.refused for learned in self._learned.values()), self._announcer.refused)
