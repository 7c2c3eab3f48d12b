"""The items of simulated robots on this robot's board: a file ``guest-WORLD.ROBOT`` each, like those of other robots."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from failover.boards import boottime, directory
from failover.boards.received import ReceivedItems
from failover.core.board import layout
from failover.core.board.items import Item
from failover.core.frames.frame import Portion
from failover.core.naming import worlds
from failover.errors import BoardError

FILE_MODE: Final = 0o640
NAME: Final = "failover simulate"
"""Of this program among the board's users."""


class Guest:
    """One robot's file, open for the process that simulates it; without that process another one makes it anew."""

    def __init__(self, place: Path, world: str, robot: str, items: Sequence[Item], group: int) -> None:
        """
        Args:
            place: of the board. group: whose its file is to be, as the board's others.

        Raises:
            BoardError: it cannot be made, or another process simulates a robot of that name.
        """
        self._path = place / f"{directory.GUEST_PREFIX}{worlds.guest(world, robot)}"
        self._skew_ns = boottime.skew_ns()
        self._clear()
        try:
            directory.make_file(
                self._path,
                layout.PEER,
                robot,
                items=dict(enumerate(items)),
                capacity=len(items),
                mode=FILE_MODE,
                group=group,
            )
        except OSError as error:
            raise BoardError(
                f"cannot put simulated robots on the board {place}: {error.strerror}; run as the user of its agent, or give "
                f"--board or {directory.VARIABLE} a directory of your own"
            ) from error
        self._received = ReceivedItems.open(self._path)
        self._received.file.enter(os.getpid(), os.geteuid(), NAME)

    def _clear(self) -> None:
        """Remove what a process has left that was killed."""
        try:
            left = ReceivedItems.open(self._path)
        except FileNotFoundError:
            return
        users = left.file.users()
        left.file.close()
        if users:
            raise BoardError(
                f"{self._path}: pid {users[0][0]} simulates this robot already; end that one first, or give this world a name"
            )
        directory.dismiss(self._path)

    def put(self, values: Sequence[tuple[int, bytes]], number: int) -> None:
        """Put values: (index of the item, its bytes); ``number``: of this put, higher each time."""
        now_ns = boottime.now_ns(self._skew_ns)
        self._received.heard(now_ns)
        self._received.take([Portion(item, 0, number, value) for item, value in values], now_ns, 0, number)

    def close(self) -> None:
        """Take the robot off the board."""
        self._received.file.close()
        directory.dismiss(self._path)
