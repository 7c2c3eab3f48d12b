"""What is new on a board since the last look: each newest put once.

A look only reads: the programs that write the items do not notice it. A put that is replaced between two looks is not seen; the
numbers of the puts tell how many there were.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

from msgspec import Struct

from checkpoint.sentences import near
from failover.boards import boottime, directory
from failover.boards.board import Board, RobotState
from failover.boards.fence import FENCE
from failover.boards.mapping import MappedFile
from failover.core.board import ages, layout
from failover.core.board.banks import EPOCH_SHIFT, Found, Place, get_carefully
from failover.core.board.layout import Record
from failover.errors import BoardError, BoardGoneError, NeverWrittenError, OvertakenError

LIST_S: Final = 1.0
"""Between two looks for robots and files that came or went."""


class Fresh(Struct, frozen=True):
    """A put that no earlier look gave.

    Attributes:
        place: the same object for each put of an item that is declared so.
        private: its robot sends it to no other.
        now_ns: BOOTTIME at which it was read.
        bound_ns: past it a reading is stale; 0: there is none.
        missed: puts between the one that was given before and this one.
    """

    robot: str
    record: Record
    place: object
    private: bool
    found: Found
    now_ns: int
    bound_ns: int
    missed: int

    @property
    def age_ns(self) -> int:
        """At least."""
        return max(self.now_ns - self.found.stamp_ns, 0)

    @property
    def age_max_ns(self) -> int:
        """At most; `UNBOUNDED_NS`: not known."""
        return ages.age_max_ns(self.age_ns, self.found.error_us)

    @property
    def is_stale(self) -> bool:
        return ages.is_stale(self.age_max_ns, self.bound_ns)


class Choice(Struct, frozen=True):
    """Which items: by patterns of robots and of items, with ``*``, ``?`` and ``[…]``; none: all."""

    robots: tuple[str, ...] = ()
    items: tuple[str, ...] = ()

    def has(self, robot: str, item: str) -> bool:
        """Whether an item of a robot is chosen."""
        return _matches(self.robots, robot) and _matches(self.items, item)

    def check(self, known: set[tuple[str, str]]) -> None:
        """Refuse a choice of which nothing is known.

        Args:
            known: robots and items that there are.

        Raises:
            BoardError: names the pattern, and the nearest name.
        """
        for what, patterns, names in (
            ("robot", self.robots, sorted({robot for robot, _ in known})),
            ("item", self.items, sorted({item for _, item in known})),
        ):
            for pattern in patterns:
                if not any(fnmatchcase(name, pattern) for name in names):
                    cure = near(pattern, names) or (f"; there are {', '.join(names[:8])}" if names else "; there are none yet")
                    raise BoardError(f"no {what} is called {pattern!r}{cure}")


def _matches(patterns: tuple[str, ...], name: str) -> bool:
    return not patterns or any(fnmatchcase(name, pattern) for pattern in patterns)


class _Row(Struct):
    """One item: its newest put that was given; 0: none. ``again``: to be given although it was."""

    record: Record
    place: Place
    given: int = 0
    again: bool = False


class _File(Struct):
    """One file: the items of it that were chosen, as of a generation."""

    robot: str
    file: MappedFile
    rows: list[_Row]
    generation: int = -1


def silent(_sentence: str) -> None:
    """Tells nothing."""


class Follower:
    """Looks at a board again and again.

    Attributes:
        tell: is given a sentence on each file that is damaged, once; the others are looked at nevertheless.
    """

    def __init__(self, board: Board, choice: Choice, tell: Callable[[str], None] = silent) -> None:
        """Raises: BoardError: nothing there is chosen."""
        self.tell = tell
        self._damaged: dict[str, str] = {}
        self._board = board
        self._choice = choice
        self._files: dict[str, _File] = {}
        self._listed_s = -LIST_S
        self._place = board.directory
        known = {(robot, record.name) for robot, file in self._there() for record in self._records(file)}
        choice.check(known)

    def look(self) -> list[Fresh]:
        """What was put since the last look.

        Raises:
            BoardError: there is no board any more; a later look may find another one.
        """
        with self._board.guard:
            self._list()
            found = [one for file in list(self._files.values()) for one in self._of(file)]
        return found

    def again(self, robot: str | None = None, item: str | None = None) -> None:
        """Give the newest puts with the next look once more: all, or those of one item."""
        for file in self._files.values():
            for row in file.rows:
                if (robot is None or robot == file.robot) and (item is None or item == row.record.name):
                    row.again = True

    def robots(self) -> dict[str, RobotState]:
        """Each chosen robot.

        Raises:
            BoardError: there is no board any more.
        """
        return {name: state for name, state in self._board.robots().items() if _matches(self._choice.robots, name)}

    def _there(self) -> Iterator[tuple[str, MappedFile]]:
        opened = self._board.ensured()
        yield from ((opened.robot, file) for file in opened.files)
        for robot in opened.peer_names():
            try:
                yield robot, opened.peer(robot)
            except BoardError as error:
                path = opened.path_of(robot)
                if path.exists():  # else it went in this moment
                    self._complain(path, error)

    def _records(self, file: MappedFile) -> list[Record]:
        """Of one file; none where its table is damaged, which is told."""
        try:
            records = file.records()
        except BoardGoneError:
            return []
        except BoardError as error:
            self._complain(file.path, error)
            return []
        self._damaged.pop(str(file.path), None)
        return records

    def _complain(self, path: Path, error: BoardError) -> None:
        said = str(error)
        if self._damaged.get(str(path)) != said:
            self._damaged[str(path)] = said
            self.tell(f"the items of {path.name} are left out: {said}; its agent or writer must make it anew")

    def _list(self) -> None:
        """Find files that came, and leave out those that went."""
        now_s = time.monotonic()
        is_gone = any(one.file.is_gone for one in self._files.values())
        if now_s < self._listed_s + LIST_S and not is_gone:
            return
        if is_gone and not (self._place / directory.OWN_NAME).exists():  # to open the board would make it
            raise BoardGoneError(f"the board {self._place} is gone, and there is no other one yet")
        self._place = self._board.directory
        there = {str(file.path): (robot, file) for robot, file in self._there()}
        kept = {path: one for path, one in self._files.items() if path in there and there[path][1] is one.file}
        self._files = {path: kept.get(path) or _File(robot, file, []) for path, (robot, file) in there.items()}
        self._listed_s = now_s

    def _of(self, file: _File) -> Iterator[Fresh]:
        if file.file.generation != file.generation:
            try:
                self._examine(file)
            except BoardGoneError:
                return
            except BoardError as error:
                self._complain(file.file.path, error)
                return
            self._damaged.pop(str(file.file.path), None)
        private = bool(file.file.header.flags & layout.PRIVATE)
        for row in file.rows:
            place = row.place
            if place.words[place.newest] == row.given and not row.again:
                continue
            try:
                found = get_carefully(place, FENCE)
            except (NeverWrittenError, OvertakenError, BoardError):
                continue  # the next look tries again
            missed = 0
            if row.given and found.number >> EPOCH_SHIFT == row.given >> EPOCH_SHIFT:
                missed = max(found.number - row.given - 1, 0)
            row.given, row.again = found.number, False
            now_ns = boottime.now_ns(self._board.skew_ns)
            bound_ns = row.record.bound_ns or place.words[place.formula]
            yield Fresh(file.robot, row.record, place, private, found, now_ns, bound_ns, missed)

    def _examine(self, file: _File) -> None:
        """Take the records as they are now; an item that is there still goes on.

        Raises:
            BoardGoneError: the file is another one by now.
            BoardError: it is damaged.
        """
        generation = file.file.generation
        known = {row.record: row for row in file.rows}
        records = [record for record in file.file.records() if self._choice.has(file.robot, record.name)]
        file.rows = [known.get(record) or _Row(record, file.file.place(record)) for record in records]
        file.generation = generation if generation % 2 == 0 else -1
