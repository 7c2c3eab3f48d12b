"""A file of a board, read and written without a mapping.

Who may write the file may make it shorter at any time. The kernel ends a process that touches a lost page of a mapping
(SIGBUS); a read only comes back short. So the agent maps no file of a board that a program may write.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Self

from failover.boards.shared_file import GENERATION
from failover.core.board import layout
from failover.core.board.items import BLOCK_SIZE_MAX, ITEMS_MAX
from failover.core.board.layout import GONE, Header, Record
from failover.errors import BoardError


class UnmappedFile:
    """One file, open.

    Attributes:
        path: for messages.
        descriptor: -1: closed.
    """

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path, self.descriptor = path, descriptor

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open a file to read and write it; what it holds is not looked at.

        Raises:
            OSError: it cannot be opened.
        """
        return cls(path, os.open(path, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW))

    def header(self) -> Header:
        """As it is now.

        Raises:
            BoardError: it is damaged, or no board's.
            OSError: it cannot be read.
        """
        return self._header_of(os.pread(self.descriptor, layout.names_at(ITEMS_MAX), 0))

    def table(self) -> tuple[Header, list[Record]]:
        """The header and all records, as they are now.

        Raises:
            BoardError: one is damaged, or it is no board's file.
            OSError: it cannot be read.
        """
        content = os.pread(self.descriptor, min(os.fstat(self.descriptor).st_size, BLOCK_SIZE_MAX), 0)
        header = self._header_of(content)
        try:
            return header, list(layout.read_records(content, header))
        except BoardError as error:
            raise BoardError(f"{self.path}: {error}") from None

    def _header_of(self, content: bytes) -> Header:
        try:
            return layout.read_header(content)
        except BoardError as error:
            raise type(error)(f"{self.path}: {error}") from None

    def retire(self) -> None:
        """Tell all who have the file open that it is another one now.

        Raises:
            OSError: it cannot be written.
        """
        os.pwrite(self.descriptor, layout.WORD.pack(GONE), GENERATION * 8)

    def close(self) -> None:
        """Give the descriptor back. A second call does nothing."""
        descriptor, self.descriptor = self.descriptor, -1
        if descriptor >= 0:
            os.close(descriptor)
