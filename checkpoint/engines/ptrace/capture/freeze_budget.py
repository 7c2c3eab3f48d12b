"""Keep a freeze within its time budget: learn what a freeze takes, and give one up that would take longer."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from checkpoint.errors import CaptureError
from checkpoint.linux import abi

FIRST_REST_NS: Final = 1_000_000
"""The time of a freeze besides copying, until one is measured."""
FIRST_PAGE_NS: Final = 2_000
"""The time to copy a page, until it is measured."""
TELLING_COUNT: Final = 64
"""Pages from which on their copying tells what one of them takes."""
WEIGHT: Final = 0.2
"""The weight of the newest freeze in the estimate for the next."""
LONG_COPY_NS: Final = 200_000_000
"""Where no budget is set: a freeze whose copying would take longer is given up for some more passes while the program runs."""
LONG_CAPTURE_NS: Final = 8_000_000_000
"""Where no budget is set: after so long a capture makes no pass that does not catch up with the program, and takes the rest in
one freeze, however long that is. Else an overloaded robot has no checkpoint of a program that writes 300 MB/s for minutes."""


class OverBudgetError(CaptureError):
    """A freeze was given up, and the program let go: it would have stood still for too long."""


class FreezeBudget:
    """The freeze budget of one component, with estimates of its freezes.

    Args:
        budget_ns: how long it may stand still for a snapshot; 0: as short as can be.
        overrun_ns: when no capture has kept to the budget for so long, one may take longer; 0: none may.
        clock: in ns.
    """

    def __init__(self, budget_ns: int, overrun_ns: int = 0, clock: Callable[[], int] = time.perf_counter_ns) -> None:
        self._budget_ns = budget_ns
        self._overrun_ns = overrun_ns
        self._clock = clock
        self._rest_ns: float = FIRST_REST_NS
        self._tail_ns: float = FIRST_REST_NS / 2
        self._page_ns: float = FIRST_PAGE_NS
        self._whole_ns = self._begun_ns = clock()
        self._until_ns = 0
        self._copy_ns: float = 0
        self._copied_ns = 0

    def __bool__(self) -> bool:
        """Whether there is one."""
        return bool(self._budget_ns)

    @property
    def page_count(self) -> int:
        """Pages that the next freeze may copy; at least one, for where nothing is left of the budget no pass helps."""
        return max(1, int((self._budget_ns - self._rest_ns) / self._page_ns))

    def begin_capture(self) -> None:
        """A capture begins, of several freezes if need be; or goes on after a freeze in whose middle processes came and went."""
        self._begun_ns = self._clock()

    def waited(self, duration_s: float) -> None:
        """The capture was ready meanwhile, and waited for the program's tasks: that makes it no long one."""
        self._begun_ns += int(duration_s * 1e9)

    @property
    def is_long(self) -> bool:
        """Whether the capture has taken so long that it ends with the next freeze."""
        return not self._budget_ns and self._clock() - self._begun_ns > LONG_CAPTURE_NS

    # In a freeze

    def begin(self, *, is_free: bool, is_last: bool) -> None:
        """A freeze begins.

        Args:
            is_free: it may take as long as it must.
            is_last: it is not tried again, where no budget is set.
        """
        now = self._clock()
        is_free = is_free or (bool(self._budget_ns) and self.overrun_in_ns(now) == 0)
        self._until_ns = now + self._budget_ns if self._budget_ns and not is_free else 0
        self._copied_ns = 0
        self._copy_ns = 0 if self._budget_ns or is_free or is_last or self.is_long else LONG_COPY_NS

    def overrun_in_ns(self, now: int | None = None) -> int | None:
        """When a freeze may take longer than the budget, from now on; None: never."""
        now = self._clock() if now is None else now
        return max(0, self._whole_ns + self._overrun_ns - now) if self._overrun_ns else None

    def left_ns(self) -> int | None:
        """How long threads may take to stop; None: as long as they need."""
        return max(0, self._until_ns - self._clock() - int(self._tail_ns)) if self._until_ns else None

    def require(self, size: int = 0) -> None:
        """See that there is time left to copy so many bytes, and to let the program go.

        Raises:
            OverBudgetError: there is not.
        """
        needed_ns = size // abi.PAGE_SIZE * self._page_ns
        is_late = self._until_ns and self._clock() + needed_ns + self._tail_ns > self._until_ns
        if is_late or (self._copy_ns and needed_ns > self._copy_ns):
            raise OverBudgetError(f"to copy {size / 1e6:.1f} MB more would take {needed_ns / 1e6:.1f} ms")

    @property
    def is_over(self) -> bool:
        """Whether no time is left."""
        return self.left_ns() == 0

    @property
    def is_strict(self) -> bool:
        """Whether this freeze ends at a certain time."""
        return bool(self._until_ns)

    def copied(self) -> None:
        """The last copy of the freeze is made: the tail follows."""
        self._copied_ns = self._clock()

    # After it

    def note(self, freeze_ns: int, copy_ns: int, size: int) -> None:
        """Learn from a freeze that brought a snapshot.

        Args:
            freeze_ns: how long it took.
            copy_ns: the part of that in which ``size`` bytes of pages were copied.
        """
        count = size // abi.PAGE_SIZE
        if count >= TELLING_COUNT:
            self._page_ns += WEIGHT * (copy_ns / count - self._page_ns)
        self._rest_ns += WEIGHT * (freeze_ns - copy_ns - self._rest_ns)
        self._whole_ns = self._clock()

    def ended(self, ended_ns: int) -> None:
        """The program was let go after a whole look."""
        if self._copied_ns:
            self._tail_ns += WEIGHT * (max(0, ended_ns - self._copied_ns) - self._tail_ns)
