"""The interface by which a restore asks for a program's pages, where these are not consecutive in memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from checkpoint.pages.page_set import Buffer, Words

Taker = Callable[[Words, Buffer], None]
"""Does something with a set of pages and their bytes; several threads call it at once."""


class PageSource(Protocol):
    """The pages of one process.

    Attributes:
        tells_zeros: there may be pages of zeros among them that its memory has by itself.
    """

    tells_zeros: bool

    def within(self, wanted: Words) -> PageSource:
        """The same, which may leave out pages that are not in a set."""

    def each(self, take: Taker, threads: int) -> None:
        """Have all pages taken, some at a time.

        Raises:
            FormatError, ChainError: they are not what they were; some were taken.
        """

    def content_at(self, address: int, size: int) -> bytes | None:
        """Bytes of its memory, as far as its pages are carried in one run; None where they are not.

        Raises:
            FormatError: they are not what they were.
        """
