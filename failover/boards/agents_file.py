"""What the agent tells the programs of its robot in a file of its own: where components run, who may put which item."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from failover.boards.directory import AGENT_NAME
from failover.boards.fence import FENCE
from failover.boards.mapping import MappedFile
from failover.core.board.banks import Place, get_carefully
from failover.core.board.owners import Owners, decode

PRIMARIES: Final = "primaries"
OWNERS: Final = "owners"
"""The two items of the file."""


class AgentsFile:
    """The file ``agent`` of a board, for readers; opened when it is asked for, and anew when it was made anew."""

    def __init__(self, directory: Path) -> None:
        self._directory = directory
        self._file: MappedFile | None = None
        self._table: Place | None = None
        self._number = 0
        self._owners: Owners = {}

    def opened(self) -> MappedFile | None:
        """The file; None where no agent has made this board.

        Raises:
            BoardError: it cannot be read.
        """
        if self._file is None or self._file.is_gone:
            self._file = self._table = None
            try:
                self._file = MappedFile.open(self._directory / AGENT_NAME, writable=False)
            except FileNotFoundError:
                return None
            record = self._file.record(OWNERS)
            self._table, self._number = None if record is None else self._file.place(record), 0
        return self._file

    def owners(self) -> Owners | None:
        """Whose the items are that one user alone may put; None where the agent tells nothing of that.

        Raises:
            BoardError: the file cannot be read.
        """
        if self.opened() is None or self._table is None:
            return None
        number = self._table.words[self._table.newest]
        if number != self._number:
            self._owners, self._number = decode(get_carefully(self._table, FENCE).value), number
        return self._owners
