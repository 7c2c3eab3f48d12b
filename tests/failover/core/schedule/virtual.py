"""Tasks in virtual time: an activation takes as long as a test says, a wake-up is as late as it says."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest.mock import patch

from msgspec import Struct

from failover.core.schedule.activation import Predecessor, Sleep, State, Task, Tick
from failover.core.schedule.course import Course
from failover.core.schedule.terms import Terms

MS = 1_000_000
ORIGIN = 5_000_000_000

Span = Callable[[str, int], int]
"""Task, number → nanoseconds."""


class Ran(Struct, frozen=True):
    """One activation that ended."""

    task: str
    tick: Tick
    started_ns: int
    ended_ns: int


def nothing(_task: str, _number: int) -> int:
    """Takes no time."""
    return 0


class World:
    """Some tasks on a machine with enough processors."""

    def __init__(self, terms: dict[str, Terms], takes: Span = nothing, late: Span = nothing, now_ns: int = ORIGIN) -> None:
        self.now_ns = now_ns
        self.names = list(terms)
        self.tasks = [Task(one, ORIGIN) for one in terms.values()]
        self.ran: list[Ran] = []
        self._takes = takes
        self._late = late
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._under_way: dict[int, Tick] = {}
        self._asked: dict[int, Sleep] = {}
        self.dead: set[int] = set()
        for index, task in enumerate(self.tasks):
            task.begin(now_ns)
            self.wake(index)

    def task(self, name: str) -> Task:
        return self.tasks[self.names.index(name)]

    def at(self, instant_ns: int, act: Callable[[], None]) -> None:
        """Something happens then."""
        heapq.heappush(self._events, (max(instant_ns, self.now_ns), next(self._order), act))

    def run_until(self, instant_ns: int) -> None:
        while self._events and self._events[0][0] <= instant_ns:
            self.now_ns, _, act = heapq.heappop(self._events)
            act()
        self.now_ns = instant_ns

    def order(self, name: str, terms: Terms) -> None:
        """The terms of a task change now, and it is woken."""
        self.task(name).order(terms, self.now_ns)
        self.wake(self.names.index(name))

    def trigger(self, name: str) -> None:
        self.task(name).trigger(self.now_ns)
        self.wake(self.names.index(name))

    def kill(self, name: str) -> None:
        index = self.names.index(name)
        self.dead.add(index)
        self._under_way.pop(index, None)
        self.tasks[index].leave()

    def look(self, row: int) -> Predecessor:
        task = self.tasks[row]
        return Predecessor(True, task.course, task.settled)

    def wake(self, index: int) -> None:
        """A task looks at what it waits for."""
        task = self.tasks[index]
        if index in self.dead or task.state not in (State.WAITING, State.HELD, State.DONE):
            return
        told = task.poll(self.now_ns, self.look, lambda row: row not in self.dead)
        if isinstance(told, Tick):
            self._under_way[index] = told
            self.at(self.now_ns + self._takes(self.names[index], told.number), lambda: self._end(index, told))
        elif told.until_ns is not None and told.until_ns > self.now_ns:
            late = self._late(self.names[index], task.number) if task.state is State.WAITING else 0
            self._asked[index] = told
            self.at(told.until_ns + late, lambda: self._wake_for(index, told))

    def _wake_for(self, index: int, asked: Sleep) -> None:
        if self._asked.get(index) is asked:
            self.wake(index)

    def _end(self, index: int, tick: Tick) -> None:
        if self._under_way.get(index) is not tick:
            return
        del self._under_way[index]
        task = self.tasks[index]
        started = task.started_ns
        task.end(self.now_ns)
        self.ran.append(Ran(self.names[index], tick, started, self.now_ns))
        for other in (index, *(one for one, each in enumerate(self.tasks) if index in each.terms.after)):
            self.wake(other)

    def of(self, name: str) -> list[Ran]:
        return [ran for ran in self.ran if ran.task == name]


# --- Deliberate mistakes ---------------------------------------------------------------------------------------------


@contextmanager
def lateness_accumulates() -> Iterator[None]:
    """The next activation is due a period after this one has begun."""
    honest = Task._start

    def start(self: Task, now_ns: int, due_ns: int) -> Tick:
        tick = honest(self, now_ns, due_ns)
        self.course = Course(self.number, now_ns, self.terms.period_ns)
        return tick

    with patch.object(Task, "_start", start):
        yield


@contextmanager
def precedence_by_count() -> Iterator[None]:
    """A predecessor must have ended as often as this task has begun; its period does not matter."""
    honest = Task._blocking

    def blocking(self: Task, now_ns: int, look: Any, lives: Any) -> int:
        begun = self.number

        def counted(row: int) -> Predecessor:
            seen = look(row)
            return Predecessor(seen.is_declared, Course(begun, 0, 0), seen.settled)

        return honest(self, now_ns, counted, lives)

    with patch.object(Task, "_blocking", blocking):
        yield


@contextmanager
def changes_within_an_activation() -> Iterator[None]:
    """New terms are in force at once, also in the middle of an activation."""

    def order(self: Task, terms: Terms, now_ns: int) -> None:
        is_running = self.state is State.RUNNING
        self._adopt(terms, now_ns)
        if is_running:
            self.state = State.RUNNING
            self.limit_ns = self._limit_ns()

    with patch.object(Task, "order", order):
        yield


MUTANTS = {one.__name__: one for one in (lateness_accumulates, precedence_by_count, changes_within_an_activation)}


@contextmanager
def mutant(name: str) -> Iterator[None]:
    """The rules with one mistake."""
    with ExitStack() as stack:
        stack.enter_context(MUTANTS[name]())
        yield
