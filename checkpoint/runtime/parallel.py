"""Run pieces of work on several processors at once, with results in order, for work that releases the interpreter's lock."""

from __future__ import annotations

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from itertools import islice
from typing import TYPE_CHECKING, Final, TypeVar

if TYPE_CHECKING:
    from concurrent.futures import Future, ThreadPoolExecutor

THREADS: Final = 4
"""No more: the memory's bandwidth is limited, and other programs work on this machine."""
AHEAD: Final = 4
"""Pieces a thread that are begun before the oldest result is taken: waiting results are held in memory."""

A = TypeVar("A")
B = TypeVar("B")


def thread_count() -> int:
    """How many threads can work at once here, `THREADS` at most."""
    return min(THREADS, len(os.sched_getaffinity(0)))


def in_order(work: Callable[[A], B], pieces: Iterable[A], threads: int) -> Generator[B, None, None]:
    """The answer of ``work`` for each piece, in their order; one thread is our own alone.

    An error of a piece is raised in its place, and so is one of the iterable: after the answers of all pieces before it.
    No thread is left when the generator is exhausted, closed or has raised. Each has the precedence that ours has at the first
    piece: a thread that waits for others comes no sooner than they do.
    """
    if threads < 2:
        yield from map(work, pieces)
        return
    from concurrent.futures import ThreadPoolExecutor  # a process without large work starts without it

    begun: deque[Future[B]] = deque()
    rest = iter(pieces)
    trouble: Exception | None = None
    with ThreadPoolExecutor(threads, initializer=_come_as, initargs=(os.sched_getscheduler(0), os.sched_getparam(0))) as pool:
        try:
            while True:
                while trouble is None and len(begun) < threads * AHEAD:
                    try:
                        piece = next(rest)
                    except StopIteration:
                        break
                    except Exception as error:  # noqa: BLE001  # raised below, in its place
                        trouble = error
                    else:
                        begun.append(_begin(pool, work, piece))
                if not begun:
                    break
                yield begun.popleft().result()
        finally:
            for one in begun:
                one.cancel()
    if trouble is not None:
        raise trouble


def in_rows(pieces: Iterable[A], count: int) -> Iterator[tuple[A, ...]]:
    """Pieces in rows of ``count``, as `in_order` takes them where each is soon done; the last row may be shorter."""
    rest = iter(pieces)
    while row := tuple(islice(rest, count)):
        yield row


class OwnBuffers:
    """A buffer of each thread's own, which stays in its processor's cache."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._of_thread = threading.local()

    @property
    def own(self) -> memoryview:
        """The buffer of the calling thread."""
        if not hasattr(self._of_thread, "buffer"):
            self._of_thread.buffer = memoryview(bytearray(self._size))
        return self._of_thread.buffer  # type: ignore[no-any-return]

    def give_away(self) -> None:
        """Leave it to the holders of its parts: the next one is new."""
        del self._of_thread.buffer


def _come_as(policy: int, priority: os.sched_param) -> None:
    """Have the calling thread scheduled as another one is: real-time policies may not be inherited (SCHED_RESET_ON_FORK)."""
    if policy != os.sched_getscheduler(0):
        with contextlib.suppress(OSError):  # an ordinary user, or a container
            os.sched_setscheduler(0, policy, priority)


def _begin(pool: ThreadPoolExecutor, work: Callable[[A], B], piece: A) -> Future[B]:
    """One piece in a thread; where no thread may be born (a limit of tasks), at once in ours."""
    from concurrent.futures import Future

    try:
        return pool.submit(work, piece)
    except RuntimeError:
        done: Future[B] = Future()
        try:
            done.set_result(work(piece))
        except Exception as error:  # noqa: BLE001  # raised in its place
            done.set_exception(error)
        return done
