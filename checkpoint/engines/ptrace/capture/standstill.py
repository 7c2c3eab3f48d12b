"""The time in which a component stands still: its threads stopped, left standing, or let go, and what our own process needs then.

While it lasts, this thread runs before all ordinary ones where it may, nothing of ours is collected, and no report of the traced
threads is lost.
"""

from __future__ import annotations

import gc
import time
from typing import Final

from checkpoint.engines.ptrace.capture.freeze_budget import FreezeBudget, OverBudgetError
from checkpoint.engines.ptrace.capture.process import CapturedProcess
from checkpoint.engines.ptrace.capture.tree import CapturedTree
from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.linux.realtime_boost import Precedence
from checkpoint.linux.trace.stop_events import Reports
from checkpoint.resources.sockets import tcp_handover

NS_PER_US: Final = 1000


class Standstill:
    """Stops the processes of one component and lets them go.

    Attributes:
        first: the first process; another thread may come to speak for it.
        is_held: they were left standing after a capture.
        longest_us: the longest time that they stood still, of this capture's freezes.
        departing: connections that are given back when the program is let go.
    """

    def __init__(self, first: CapturedProcess, tree: CapturedTree, budget: FreezeBudget) -> None:
        self.first = first
        self.is_held = False
        self.longest_us = 0
        self.departing = tcp_handover.NOBODY
        self._tree = tree
        self._budget = budget
        self._collects = False
        self._precedence = Precedence()
        self._reports = Reports()

    def freeze(self) -> int:
        """Stop them, nothing of ours half done inside; answers when it was first asked to, in ns: until then it runs."""
        if self.is_held:
            return time.perf_counter_ns()
        self._collects = gc.isenabled()
        gc.disable()
        self._reports.keep()
        self._precedence.take()
        self.first.threads.patience_ns = self._budget.left_ns()
        try:
            self.first.threads.freeze()
        except BaseException as error:
            self._be_ordinary()
            self.raise_if_late(error)
            raise
        return self.first.threads.asked_ns

    def hold(self) -> int:
        """Leave them standing; answers when that was, in ns."""
        self._precedence.give_back()
        self._reports.give_back()
        self.is_held = True
        self.first.threads.hold()
        self._tree.hold()
        return time.perf_counter_ns()

    def thaw(self) -> int:
        """Let them go; answers when the last of them was, in ns."""
        self.departing.stay(self.first.pid)
        self.departing = tcp_handover.NOBODY
        self.is_held = False
        try:
            self.first.threads.thaw()
        finally:
            try:
                self._tree.thaw()
                ended = time.perf_counter_ns()
            finally:
                self._be_ordinary()
        return ended

    def note(self, began: int, ended: int) -> int:
        """Note how long they stood still, of two instants in ns; answers with the longest time of this capture, in µs."""
        self.longest_us = max(self.longest_us, (ended - began) // NS_PER_US)
        return self.longest_us

    def raise_if_late(self, error: BaseException) -> None:
        """An error of a capture whose time is over counts as lack of time; only the program's end stays its end.

        Raises:
            OverBudgetError: the time is over.
        """
        if isinstance(error, CaptureError) and not isinstance(error, ProcessGoneError) and self._budget.is_over:
            raise OverBudgetError(str(error)) from error

    def _be_ordinary(self) -> None:
        """As before the freeze: what this thread makes may be collected, and it has no precedence."""
        self._precedence.give_back()
        self._reports.give_back()
        if self._collects:
            gc.enable()
