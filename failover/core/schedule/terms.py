"""What a task is declared with: period, phase, deadline, order, limits; and the checks that give each mistake its sentence."""

from __future__ import annotations

import enum
import math
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from failover.core.schedule.course import Overrun
from failover.core.wire.names import text_size
from failover.errors import ScheduleError

TASKS_MAX: Final = 256
"""Tasks of one robot: half a MiB of table."""
PREDECESSORS_MAX: Final = 16
MODES_MAX: Final = 4
"""Of one task: full, eco, and two more."""
NAME_SIZE_MAX: Final = 200
"""Bytes of UTF-8 of a task's name: it may be a component's."""
MODE_SIZE_MAX: Final = 24
CPUS_MAX: Final = 64
PRIORITY_MAX: Final = 99
"""Of SCHED_FIFO. Source: sched(7)."""
PERIOD_MAX_NS: Final = 10**15
"""A million seconds: longer ones are calendar entries."""
PERIOD_MIN_NS: Final = 100_000
"""A wake-up takes some 60 µs on a common machine: shorter periods are loops that poll."""
_NS: Final = 1_000_000_000


class Kind(enum.IntEnum):
    """When a task is due: again and again; once; whenever something happens."""

    PERIODIC = 0
    ONE_SHOT = 1
    SPORADIC = 2


KINDS: Final = ("periodic", "one-shot", "sporadic")


class Mode(Struct, frozen=True):
    """A quality of a task: what may change when the robot has less time for it.

    Attributes:
        cpus: bit i: it may run on processor i; 0: as the task itself.
    """

    name: str
    period_ns: int
    deadline_ns: int = 0
    budget_ns: int = 0
    cpus: int = 0


class Terms(Struct, frozen=True):
    """A task as its row has it.

    Attributes:
        period_ns: 0 for all but periodic ones.
        phase_ns: from the schedule's origin to its first activation; below the period.
        deadline_ns: from due to ended; 0: none.
        at_ns: when a one-shot task is due.
        distance_ns: the least time between two activations of a sporadic task.
        budget_ns: what an activation may take of a processor; 0: not declared.
        cpus: bit i: it may run on processor i; 0: on all.
        priority: of SCHED_FIFO; 0: by the order of deadlines.
        mode: index of its quality mode.
        after: rows of its predecessors.
        strict: a predecessor that does not run holds it for ever, not until its deadline.
        at_next: the task adopts these terms when its next activation begins; else before.
    """

    kind: Kind = Kind.PERIODIC
    period_ns: int = 0
    phase_ns: int = 0
    deadline_ns: int = 0
    at_ns: int = 0
    distance_ns: int = 0
    budget_ns: int = 0
    cpus: int = 0
    priority: int = 0
    mode: int = 0
    overrun: Overrun = Overrun.SKIP
    strict: bool = False
    at_next: bool = False
    after: tuple[int, ...] = ()


class Declaration(Struct, frozen=True):
    """A task as people declare it: predecessors by their names.

    Attributes:
        modes: the first one is the mode that it begins in; none: the terms are the only one.
        notes: what was understood otherwise than it was written.
    """

    name: str
    terms: Terms
    after: tuple[str, ...] = ()
    modes: tuple[Mode, ...] = ()
    notes: tuple[str, ...] = ()


def nanoseconds(seconds: float, what: str) -> int:
    """A time that a person gave.

    Raises:
        ScheduleError: it is no time.
    """
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not math.isfinite(seconds):
        raise ScheduleError(f"{what} is {seconds!r}: give seconds, such as 0.01")
    if not 0 <= seconds <= PERIOD_MAX_NS / _NS:
        raise ScheduleError(f"{what} is {seconds:g} s: 0 to {PERIOD_MAX_NS // _NS:,} s are possible")
    return round(seconds * _NS)


def checked(declaration: Declaration, cpus_there: int = 0) -> Declaration:
    """The declaration, in the form in which a table keeps it.

    Args:
        cpus_there: bit i: the machine has processor i; 0: not known.

    Raises:
        ScheduleError: something in it cannot be; names it.
    """
    terms, what = declaration.terms, f"cannot schedule {declaration.name!r}"
    if not declaration.name.strip() or text_size(declaration.name) > NAME_SIZE_MAX or "\0" in declaration.name:
        raise ScheduleError(f"{what}: a name has 1 to {NAME_SIZE_MAX} bytes of UTF-8")
    if len(declaration.after) > PREDECESSORS_MAX:
        raise ScheduleError(f"{what}: {len(declaration.after)} predecessors; {PREDECESSORS_MAX} are possible")
    if declaration.name in declaration.after:
        raise ScheduleError(f"{what}: it is to run after itself")
    if len(declaration.modes) > MODES_MAX or any(not 0 < text_size(mode.name) <= MODE_SIZE_MAX for mode in declaration.modes):
        raise ScheduleError(f"{what}: it may have {MODES_MAX} modes, with names of 1 to {MODE_SIZE_MAX} bytes")
    for mode in declaration.modes:
        checked_terms(in_mode(terms, declaration.modes, mode.name), f"{what} in mode {mode.name!r}", cpus_there)
    terms, notes = checked_terms(terms, what, cpus_there)
    after = tuple(dict.fromkeys(declaration.after))
    return replace(declaration, terms=terms, after=after, notes=(*declaration.notes, *notes))


def checked_terms(terms: Terms, what: str, cpus_there: int = 0) -> tuple[Terms, tuple[str, ...]]:
    """The terms as a table keeps them, and what was understood otherwise than it was written."""
    notes = []
    if terms.kind is Kind.PERIODIC:
        if not PERIOD_MIN_NS <= terms.period_ns <= PERIOD_MAX_NS:
            raise ScheduleError(
                f"{what}: a period of {terms.period_ns / _NS:g} s; {PERIOD_MIN_NS / _NS:g} to 1,000,000 s are possible"
            )
        if terms.phase_ns >= terms.period_ns:
            notes.append(f"phase {terms.phase_ns / _NS:g} s is taken modulo the period {terms.period_ns / _NS:g} s")
            terms = replace(terms, phase_ns=terms.phase_ns % terms.period_ns)
        if terms.deadline_ns > terms.period_ns:
            if terms.overrun is Overrun.SKIP:
                raise ScheduleError(
                    f"{what}: its deadline, {terms.deadline_ns / _NS:g} s, is longer than its period, "
                    f"{terms.period_ns / _NS:g} s, and activations that fall due meanwhile are skipped; "
                    "take overrun = 'queue', or a shorter deadline"
                )
            notes.append("its deadline is longer than its period: activations that fall due meanwhile wait")
        terms = replace(terms, deadline_ns=terms.deadline_ns or terms.period_ns)
    else:
        terms = replace(terms, period_ns=0, phase_ns=0)
    for name in ("phase_ns", "deadline_ns", "distance_ns", "budget_ns"):
        if not 0 <= getattr(terms, name) <= PERIOD_MAX_NS:
            raise ScheduleError(
                f"{what}: {name.removesuffix('_ns')} is {getattr(terms, name) / _NS:g} s; 0 to 1,000,000 s are possible"
            )
    if terms.deadline_ns and terms.budget_ns > terms.deadline_ns:
        raise ScheduleError(
            f"{what}: its budget, {terms.budget_ns / _NS:g} s, is longer than its deadline, {terms.deadline_ns / _NS:g} s"
        )
    if not 0 <= terms.priority <= PRIORITY_MAX:
        raise ScheduleError(f"{what}: priority {terms.priority}; 1 to {PRIORITY_MAX} are possible, 0: by the order of deadlines")
    absent = terms.cpus & ~cpus_there
    if terms.cpus >> CPUS_MAX or (cpus_there and absent):
        raise ScheduleError(f"{what}: processor {(absent or terms.cpus).bit_length() - 1} is not there")
    return terms, tuple(notes)


def in_mode(terms: Terms, modes: tuple[Mode, ...], name: str) -> Terms:
    """A task's terms in one of its quality modes.

    Raises:
        ScheduleError: it has no such mode.
    """
    for index, mode in enumerate(modes):
        if mode.name == name:
            return replace(
                terms,
                mode=index,
                period_ns=mode.period_ns,
                deadline_ns=mode.deadline_ns or mode.period_ns,
                budget_ns=mode.budget_ns or terms.budget_ns,
                cpus=mode.cpus or terms.cpus,
            )
    known = ", ".join(mode.name for mode in modes) or "none"
    raise ScheduleError(f"there is no mode {name!r}; it has: {known}")
