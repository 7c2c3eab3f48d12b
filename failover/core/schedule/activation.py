"""One task and its activations: when the next begins, what it waits for, what is counted. Pure: every instant is an argument.

    IDLE    -- begin -->                                             WAITING
    WAITING -- due, and each predecessor has ended what covers it --> RUNNING
    WAITING -- due, and one has not -->                               HELD
    HELD    -- they have -->                                          RUNNING
    HELD    -- past the deadline, one that has not does not run -->   RUNNING    counted: missed, orphaned
    RUNNING -- ended -->                                              WAITING    what fell due meanwhile: see `Overrun`
    RUNNING -- ended, and there is no next one -->                    DONE
    DONE    -- due once more, or triggered -->                        WAITING
    any     -- left -->                                               IDLE

*Covers*: of a predecessor, the newest activation that is due at this one's instant or before. So periods may differ: a fast
predecessor has ended its newest one, a slow one the one that its successors share. A skipped activation counts as ended.

A change of the terms is adopted between two activations, never within one: at once while the task waits, or, if it says so, when
its next activation begins. A changed period goes on from the last instant that was due; a changed phase from the origin.

Invariants: an activation's instant depends on its course alone, not on lateness; numbers only grow; the deadline of an activation
is fixed when it begins; what is counted is never taken back.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from failover.core.schedule.course import Course
from failover.core.schedule.terms import Kind, Terms


class State(enum.IntEnum):
    """Of a task: no process runs it; until it is due; until its predecessors have ended; under way; until it is due once more."""

    IDLE = 0
    WAITING = 1
    HELD = 2
    RUNNING = 3
    DONE = 4


STATES: Final = ("idle", "waiting", "held", "running", "done")

NO_ROW: Final = -1


class Predecessor(Struct, frozen=True):
    """What a task sees of one that it runs after.

    Attributes:
        is_declared: else no task waits for it.
        settled: activations below this number have ended, or were skipped.
    """

    is_declared: bool
    course: Course
    settled: int

    def has_ended(self, instant_ns: int) -> bool:
        """Whether what covers an instant has ended."""
        return not self.is_declared or self.settled > self.course.covering(instant_ns)


Look = Callable[[int], Predecessor]
"""Row → what is seen of it."""
Lives = Callable[[int], bool]
"""Row → whether a process runs it; asked at the deadline only."""


class Sleep(Struct, frozen=True):
    """To wait for.

    Attributes:
        until_ns: when to look again at the latest; None: whenever something changes.
        row: the predecessor to wait for; `NO_ROW`: for the instant, or a change of the own row.
    """

    until_ns: int | None
    row: int = NO_ROW


class Tick(Struct, frozen=True):
    """An activation that begins.

    Attributes:
        number: of the activation.
        due_ns: when it was due, CLOCK_MONOTONIC as this process reads it.
        late_ns: from then to its beginning.
        missed: activations that were not run since the one before.
    """

    number: int
    due_ns: int
    late_ns: int
    missed: int


class Counts(Struct):
    """What is counted, over the life of a row.

    Attributes:
        misses: of the deadline.
        overruns: activations that fell due while an earlier one was under way; ``skipped``: those of them that were not run.
        orphaned: activations that began without a predecessor, which did not run.
    """

    started: int = 0
    ended: int = 0
    misses: int = 0
    overruns: int = 0
    skipped: int = 0
    orphaned: int = 0


class Task:
    """The activations of one task, as the one process that runs it counts them.

    Attributes:
        number: of the activation under way, or of the next one.
        limit_ns: when the activation under way is to have ended; 0: whenever.
        started_ns, ended_ns: of the newest one.
        blamed: row of the predecessor for which a deadline was missed last; `NO_ROW`: none was.
    """

    def __init__(self, terms: Terms, origin_ns: int, counts: Counts | None = None) -> None:
        self.terms = terms
        self.origin_ns = origin_ns
        self.counts = counts or Counts()
        self.course = first_course(terms, origin_ns)
        self.state = State.IDLE
        self.number = 0
        self.limit_ns = 0
        self.started_ns = 0
        self.ended_ns = 0
        self.blamed = NO_ROW
        self._ordered: Terms | None = None
        self._is_missed = False
        self._skipped = 0
        self._counted = 0
        """Activations below this number are no overruns any more: they began, or were counted."""
        self._triggered_ns: int | None = None

    @property
    def due_ns(self) -> int:
        """When the activation under way was due, or the next one is."""
        return self.course.due_ns(self.number)

    @property
    def settled(self) -> int:
        """Activations below this number have ended, were skipped, or were before this task began."""
        return self.number + (self.state is State.DONE)

    # --- Arrows ---

    def begin(self, now_ns: int, course: Course | None = None, number: int = 0) -> None:
        """A process runs the task from now on.

        Args:
            course: as an earlier one has left it, if its terms are still in force.
            number: what an earlier one has `settled`.
        """
        assert self.state is State.IDLE
        if course is None:
            fresh = first_course(self.terms, self.origin_ns)
            first = fresh.first_from(now_ns)
            course = Course(max(number, first), fresh.due_ns(first), fresh.period_ns)
        self.course, self.number = course, max(number, course.number)
        self.state = State.WAITING
        if self.terms.kind is Kind.PERIODIC:
            self.number = max(self.number, course.first_from(now_ns))
        elif self.number > course.number:
            self.number -= 1
            self.state = State.DONE
        elif self.terms.kind is Kind.SPORADIC:
            self.state = State.DONE
        self._counted = self.number + 1

    def poll(self, now_ns: int, look: Look, lives: Lives) -> Sleep | Tick:
        """Begin the next activation if its time has come; else what to wait for."""
        assert self.state in (State.WAITING, State.HELD, State.DONE)
        if self.state is State.DONE:
            return Sleep(None)
        due_ns = self.course.due_ns(self.number)
        if now_ns < due_ns:
            return Sleep(due_ns)
        if self.terms.after:
            row = self._blocking(now_ns, look, lives)
            if row != NO_ROW:
                self.state = State.HELD
                until_ns = self._limit_ns()
                return Sleep(until_ns if until_ns > now_ns else None, row)
        return self._start(now_ns, due_ns)

    def end(self, now_ns: int) -> None:
        """The activation under way has ended."""
        assert self.state is State.RUNNING
        self.ended_ns = now_ns
        self.counts.ended += 1
        if self.limit_ns and now_ns > self.limit_ns and not self._is_missed:
            self.counts.misses += 1
        self.limit_ns = 0
        self._is_missed = False
        self.state = State.WAITING
        if self.terms.kind is Kind.PERIODIC:
            number = self.course.following(self.number, now_ns, self.terms.overrun)
            self._count_overruns(now_ns)
            self._skipped = number - self.number - 1
            self.counts.skipped += self._skipped
            self.number = number
        else:
            self.state = State.DONE
            self._take_trigger()
        if self._ordered is not None and not self._ordered.at_next:
            self._adopt(self._ordered, now_ns)

    def order(self, terms: Terms, now_ns: int) -> None:
        """The task's terms change; in the middle of an activation nothing does."""
        if self.state is State.RUNNING or (terms.at_next and self.state is not State.DONE):
            self._ordered = terms
        else:
            self._adopt(terms, now_ns)

    def trigger(self, now_ns: int) -> None:
        """What a sporadic task waits for has happened.

        An activation that is due already covers it; while one is under way, one is remembered.
        """
        if self.state in (State.WAITING, State.HELD):
            return
        if self._triggered_ns is None:
            self._triggered_ns = now_ns
        else:
            self.counts.overruns += 1
            self.counts.skipped += 1
        if self.state is State.DONE:
            self._take_trigger()

    def leave(self) -> None:
        """The process runs the task no more. An activation under way has not ended."""
        self.state = State.IDLE

    # --- Parts ---

    def _start(self, now_ns: int, due_ns: int) -> Tick:
        """The program waits for this: what is not needed before its work is done in `end`."""
        if self._ordered is not None:
            self._adopt_from_here(self._ordered)
        self.state = State.RUNNING
        self.started_ns = now_ns
        deadline_ns = self.terms.deadline_ns
        self.limit_ns = due_ns + deadline_ns if deadline_ns else 0
        self.counts.started += 1
        skipped, self._skipped = self._skipped, 0
        return Tick(self.number, due_ns, now_ns - due_ns, skipped)

    def _count_overruns(self, now_ns: int) -> None:
        """Each activation that has fallen due before this one ended counts once, whether it will run or not."""
        fallen, known = self.course.first_from(now_ns), max(self._counted, self.number + 1)
        self.counts.overruns += max(fallen - known, 0)
        self._counted = max(fallen, known)

    def _limit_ns(self) -> int:
        return self.due_ns + self.terms.deadline_ns if self.terms.deadline_ns else 0

    def _blocking(self, now_ns: int, look: Look, lives: Lives) -> int:
        """The row of a predecessor to wait for."""
        limit_ns = self._limit_ns()
        for row in self.terms.after:
            if look(row).has_ended(self.due_ns):
                continue
            if limit_ns and now_ns >= limit_ns:
                self._blame(row)
                if not self.terms.strict and not lives(row):
                    self.counts.orphaned += 1
                    continue
            return row
        return NO_ROW

    def _blame(self, row: int) -> None:
        if not self._is_missed:
            self._is_missed = True
            self.counts.misses += 1
            self.blamed = row

    def _take_trigger(self) -> None:
        """A sporadic task is due: when it was triggered, and not too soon after the one before."""
        if self._triggered_ns is None:
            return
        due_ns = self._triggered_ns if not self.number else max(self._triggered_ns, self.due_ns + self.terms.distance_ns)
        self.number += 1
        self.course = Course(self.number, due_ns, 0)
        self._triggered_ns = None
        self.state = State.WAITING

    def _adopt(self, terms: Terms, now_ns: int) -> None:
        """New terms between two activations."""
        old, self.terms, self._ordered = self.terms, terms, None
        if terms.kind is not Kind.PERIODIC:
            self._adopt_single(old)
        elif old.kind is not Kind.PERIODIC or (old.phase_ns, old.at_ns) != (terms.phase_ns, terms.at_ns):
            self._begin_course(first_course(terms, self.origin_ns), now_ns)
        elif old.period_ns != terms.period_ns:
            if self.due_ns <= now_ns:  # it is late, or waits behind others: it stays
                self.course = Course(self.number, self.due_ns, terms.period_ns)
            else:
                last_ns = self.course.due_ns(self.number - 1)
                self._begin_course(Course(0, last_ns + terms.period_ns, terms.period_ns), now_ns)

    def _begin_course(self, course: Course, now_ns: int) -> None:
        """Go on with other instants, the first of them not before now; numbers go on."""
        due_ns = course.due_ns(course.first_from(now_ns))
        self.number += self.state is State.DONE
        self.course = Course(self.number, due_ns, course.period_ns)
        self.state = State.WAITING

    def _adopt_single(self, old: Terms) -> None:
        if self.terms.kind is Kind.ONE_SHOT and (old.kind is not Kind.ONE_SHOT or old.at_ns != self.terms.at_ns):
            self.number += self.state is State.DONE
            self.course = Course(self.number, self.terms.at_ns, 0)
            self.state = State.WAITING
        elif self.terms.kind is Kind.SPORADIC and old.kind is not Kind.SPORADIC:
            self.course = Course(self.number, self.due_ns, 0)
            self.state = State.DONE

    def _adopt_from_here(self, terms: Terms) -> None:
        """New terms with the activation that begins now: its instant stays, its deadline and what follows are new."""
        if terms.kind is not self.terms.kind or terms.phase_ns != self.terms.phase_ns:
            self._ordered = replace(terms, at_next=False)  # other instants: from its end on
        else:
            self.course = Course(self.number, self.due_ns, terms.period_ns)
            self.terms, self._ordered = terms, None


def first_course(terms: Terms, origin_ns: int) -> Course:
    """The instants of a new row."""
    if terms.kind is Kind.PERIODIC:
        return Course(0, origin_ns + terms.phase_ns, terms.period_ns)
    return Course(0, terms.at_ns, 0)
