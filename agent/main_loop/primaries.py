"""Tells the programs of this robot which robot is the primary of which component: in a file that the agent alone writes."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from failover.boards.agents_file import PRIMARIES
from failover.boards.component_item import Primary, decode, encode
from failover.boards.directory import AGENT_NAME
from failover.boards.received import ReceivedItems
from failover.core.board.banks import get_carefully
from failover.core.board.item_types import ITEM_SIZE_MAX
from failover.core.frames.frame import Portion
from failover.errors import BoardError

NUMBER: Final = 0
"""Of the item, which is the only one of that file."""

LEFT_OUT: Final = "components for which the table of primaries had no room"


class Primaries:
    """The file ``agent`` of this robot's board.

    Attributes:
        left_out: components that found no room.
    """

    def __init__(self, items: ReceivedItems) -> None:
        self._items = items
        self._table = _remembered(items)
        self._said: Mapping[str, tuple[str, int]] | None = None
        self._put = self.left_out = 0

    @classmethod
    def open(cls, place: Path) -> Primaries:
        """The file that the worker process has made.

        Raises:
            BoardError, FileNotFoundError: there is none.
        """
        return cls(ReceivedItems.open(place / AGENT_NAME))

    def tell(self, primaries: Mapping[str, tuple[str, int]], now_ns: int) -> None:
        """Put the table if it is another one than before.

        Args:
            primaries: component → robot, epoch. now_ns: BOOTTIME of the machine.
        """
        if primaries == self._said:
            return
        self._said = primaries
        self._table = {name: self._since(name, robot, epoch, now_ns) for name, (robot, epoch) in primaries.items()}
        content, fitting = encode(self._table), dict(self._table)
        while len(content) > ITEM_SIZE_MAX:
            for name in list(fitting)[-max(len(fitting) // 8, 1) :]:
                del fitting[name]
            content = encode(fitting)
        self.left_out = len(self._table) - len(fitting)
        self._put += 1
        self._items.take((Portion(NUMBER, 0, self._put, content),), now_ns, 0, 0)

    def _since(self, name: str, robot: str, epoch: int, now_ns: int) -> Primary:
        known = self._table.get(name)
        return Primary(robot, epoch, known.since_ns if known is not None and known.robot == robot else now_ns)

    def close(self) -> None:
        """Give the locks back."""
        self._items.file.close()


def _remembered(items: ReceivedItems) -> dict[str, Primary]:
    """The table that the agent before has left."""
    record = items.file.record(PRIMARIES)
    try:
        return dict(decode(get_carefully(items.file.place(record)).value)) if record is not None else {}
    except BoardError:  # never written, or damaged
        return {}
