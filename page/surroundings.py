"""What the page sees beside the agent: the board, the tasks and the drivers of its robot, as any program of its user may.

Where there is none of these, or this user may not see it, there is nothing to show. Each look is one of a thread's: it may take
a while.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, Final

import msgspec

from failover.boards import directory
from failover.boards.board import Board, board
from failover.boards.overview import Overview
from failover.core.board.json_values import plain
from failover.drivers.here import here
from failover.drivers.lookup import whole_tree
from failover.errors import FailoverError
from failover.schedule import overview as schedule

NAME: Final = "failover page"
"""Of this program among the board's users."""

MISSING_S: Final = 2.0
"""Between two looks whether there is a board by now."""

NS_PER_MS: Final = 1e6

Rows = list[dict[str, Any]]


class Around(msgspec.Struct, frozen=True):
    """One look. Rows are as `page.picture` and `page.exposition` take them.

    Attributes:
        owners: task → the component whose program runs it.
    """

    items: Rows = []
    tasks: Rows = []
    owners: Mapping[str, str] = {}


class Surroundings:
    """The board and the schedule. One thread at a time."""

    def __init__(self) -> None:
        self._board: Board | None = None
        self._overview: Overview | None = None
        self._board_again_s = 0.0

    def look(self, status: Mapping[str, Any] | None) -> Around:
        """Board and tasks.

        Args:
            status: of the agent; for whose the tasks are. None: it is not told.
        """
        tasks, owners = _tasks(status)
        return Around(self._items(), tasks, owners)

    def close(self) -> None:
        """Leave the board."""
        if self._board is not None:
            self._board.close()
            self._board = self._overview = None

    def _items(self) -> Rows:
        try:
            if self._board is None:
                self._board = self._opened()
                self._overview = Overview(self._board) if self._board is not None else None
            return [_item(one) for one in self._overview.look()] if self._overview is not None else []
        except (FailoverError, OSError):
            self.close()
            return []

    def _opened(self) -> Board | None:
        """The board, if there is one: looking at it must not make it."""
        if time.monotonic() < self._board_again_s:
            return None
        self._board_again_s = time.monotonic() + MISSING_S
        place = directory.find()
        return board(place, NAME) if (place / directory.OWN_NAME).exists() else None


def drivers() -> Rows:
    """The drivers of this user, and those of other robots that these have heard of; takes some seconds where there are none."""
    try:
        return [_driver(place) for place in whole_tree(here()).under()]
    except (FailoverError, OSError):
        return []  # none runs for this user


def _item(one: Any) -> dict[str, Any]:
    return {
        "robot": one.robot,
        "item": one.item,
        "type": one.type,
        "value": plain(one.value),
        "put": one.put,
        "age_ms": _ms(one.age_ns),
        "age_max_ms": _ms(one.age_max_ns),
        "bound_ms": _ms(one.bound_ns),
        "stale": one.stale,
        "lost": one.lost,
        "complaint": one.complaint,
    }


def _ms(span_ns: int | None) -> int | None:
    return None if span_ns is None else round(span_ns / NS_PER_MS)


def _tasks(status: Mapping[str, Any] | None) -> tuple[Rows, Mapping[str, str]]:
    try:
        file = schedule.open_schedule()
    except (FailoverError, OSError):
        return [], {}
    try:
        seen = schedule.overview(file)
        return [msgspec.structs.asdict(one) for one in seen], schedule.owners(file, seen, status)
    except (FailoverError, OSError):
        return [], {}
    finally:
        file.close()


def _driver(place: Any) -> dict[str, Any]:
    record = place.record
    return {
        "path": record.path,
        "kind": str(record.kind),
        "robot": place.robot,
        "aliases": list(record.aliases),
        "versions": list(record.versions),
        "reach": str(place.reach),
        "rivals": list(place.rivals),
        "refused": place.refused,
        "verbs": {name: dict(one) for name, one in msgspec.to_builtins(record.verbs).items() if not name.startswith("_")},
    }
