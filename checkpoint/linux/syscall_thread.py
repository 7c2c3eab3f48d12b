"""Make system calls of a table in a second thread while the first makes others: halves the long queries of a freeze.

The second thread makes system calls in machine code and does nothing else. It needs the interpreter's lock only when it starts
and ends, so neither thread waits for the other in between. Two tables that are worked at the same time share no memory. The first
thread takes over the finished calls of the second, and makes the unfinished ones in a table of its own. So the second thread may
be late, or gone (after a fork), and the answers are the same.

Only the first thread traces: the calls must be ones that any thread may make.

Source: futex(2), sched(7).
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import threading
import weakref
from typing import Final

import numpy as np

from checkpoint.arch import stubs
from checkpoint.linux.batch_syscalls import ROW_SIZE, OwnCalls, instructions, row
from checkpoint.runtime.lazy_numpy import NDArray

ORDER, DONE_WITH, FIRST, END, MADE = range(5)
"""Words of the board, see `SECOND_LOOP` of the processor."""
RETURN: Final = 0xFFFFFFFF
_FUTEX_WAKE_PRIVATE: Final = 129
Standing = tuple[int, int]
"""Policy and priority of a thread."""


class SecondThread:
    """Started by `where_it_gains`; every call from the thread that made it. It ends with `close`, or with this object."""

    def __init__(self, address: int) -> None:
        """A thread that runs `SECOND_LOOP` at this address."""
        self._board = _Board(address)
        self._thread = threading.Thread(target=self._board.obey, name="second", daemon=True)
        self._thread.start()
        self._standing = _standing()
        self._end = weakref.finalize(self, self._board.order, RETURN)
        self._end.atexit = False

    @classmethod
    def where_it_gains(cls) -> SecondThread | None:
        """One, if there is a second processor for it, its kind has a loop for that, and the system lets us have it."""
        if len(os.sched_getaffinity(0)) < 2 or not stubs.SECOND_LOOP:
            return None
        try:
            return cls(instructions(stubs.SECOND_LOOP))
        except (OSError, RuntimeError):  # no instructions in memory, or no more threads
            return None

    def close(self) -> None:
        """End the thread; a second time it does nothing."""
        self._end()
        self._thread.join()

    def is_at_rest(self) -> bool:
        """Whether it is done with its last table: until then it may write to what that points to, also after `stop`."""
        return self._board.is_at_rest()

    def begin(self, table: OwnCalls, last: int, keeps: object = None) -> None:
        """Have it make the calls of the rows [0, last), at our own priority. It is at rest.

        Args:
            keeps: what the rows point to, which is kept alive as long as it needs it.
        """
        assert self._board.is_at_rest(), "it may still write to the table before"
        self._stand_as_we_do()
        self._board.begin(table, last, keeps)

    def made(self) -> int:
        """How many rows of the table have been made, results and all."""
        return self._board.made()

    def stop(self) -> None:
        """Have it make no further call."""
        self._board.stop()

    def _stand_as_we_do(self) -> None:
        """Give it the first thread's policy and priority (`checkpoint.linux.realtime_boost`); also while it sleeps."""
        ours = _standing()
        if ours != self._standing and self._thread.native_id is not None:
            self._standing = ours
            with contextlib.suppress(OSError):  # it has gone, or we may not any more: then it is of less use
                os.sched_setscheduler(self._thread.native_id, ours[0], os.sched_param(ours[1]))


def _standing() -> Standing:
    return os.sched_getscheduler(0), os.sched_getparam(0).sched_priority


class _Board:
    """The memory that the two threads share. The second holds on to it, and not to its `SecondThread`, or that could never go.

    Attributes:
        words: of `SECOND_LOOP`.
    """

    def __init__(self, address: int) -> None:
        self._loop = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(address)
        self._memory: NDArray[np.uint64] = np.zeros(MADE + 1, dtype=np.uint64)
        self.words = self._memory.data
        self._place = int(self._memory.ctypes.data)
        self._wake = OwnCalls([row("futex", self._place, _FUTEX_WAKE_PRIVATE, 1)])
        self._work: tuple[OwnCalls, object] | None = None

    def obey(self) -> None:
        """The second thread's life. Signals are for others."""
        signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
        self._loop(self._place)

    def is_at_rest(self) -> bool:
        """Whether it is done with the last table."""
        order = self.words[ORDER]
        return order != RETURN and self.words[DONE_WITH] + (1 - order % 2) >= order

    def begin(self, table: OwnCalls, last: int, keeps: object) -> None:
        """Give it a table; it does not need the earlier one any more."""
        self._work = table, keeps
        self.words[FIRST] = self.words[MADE] = table.address
        self.words[END] = table.address + last * ROW_SIZE
        self.order(self.words[ORDER] + 1)

    def made(self) -> int:
        """Rows that are made."""
        return (self.words[MADE] - self.words[FIRST]) // ROW_SIZE

    def stop(self) -> None:
        """Stop it without waking it."""
        self.words[ORDER] += 1

    def order(self, what: int) -> None:
        """Give an order, and have it heard."""
        self.words[ORDER] = what
        self._wake.run()
