"""Learn from earlier freezes how many pages a freeze may copy within its time budget."""

from __future__ import annotations

from typing import Final

from checkpoint.linux import abi

FIRST_REST_NS: Final = 1_000_000
"""What a freeze takes besides copying, before one was seen."""
FIRST_PAGE_NS: Final = 2_000
"""What copying a page takes, before it was seen."""
TELLING_COUNT: Final = 64
"""Pages from which on their copying tells what one of them takes."""
WEIGHT: Final = 0.2
"""Of the newest freeze in what is expected of the next."""


class FreezeBudget:
    """Of one component.

    Args:
        budget_ns: how long it may stand still for a snapshot; 0: as short as can be.
    """

    def __init__(self, budget_ns: int) -> None:
        self._budget_ns = budget_ns
        self._rest_ns: float = FIRST_REST_NS
        self._page_ns: float = FIRST_PAGE_NS

    def __bool__(self) -> bool:
        """Whether there is one."""
        return bool(self._budget_ns)

    @property
    def page_count(self) -> int:
        """Pages that the next freeze may copy; at least one, for where nothing is left of the budget no pass helps."""
        return max(1, int((self._budget_ns - self._rest_ns) / self._page_ns))

    def note(self, freeze_ns: int, copy_ns: int, size: int) -> None:
        """Learn from a freeze.

        Args:
            freeze_ns: how long it took.
            copy_ns: the part of that in which ``size`` bytes of pages were copied.
        """
        count = size // abi.PAGE_SIZE
        if count >= TELLING_COUNT:
            self._page_ns += WEIGHT * (copy_ns / count - self._page_ns)
        self._rest_ns += WEIGHT * (freeze_ns - copy_ns - self._rest_ns)
