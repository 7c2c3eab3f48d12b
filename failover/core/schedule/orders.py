"""What people and programs order of a schedule: tasks added, removed, changed; all of one order, or nothing. Pure.

A predecessor that is not declared yet has a row without terms, so that its successors can name it; until it is declared, no task
waits for it. A row is used again when its task was removed and no other task names it.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from failover.core.schedule.terms import TASKS_MAX, Declaration, Mode, Terms, checked, in_mode
from failover.errors import ScheduleError

FIELDS: Final = frozenset(Terms.__struct_fields__) - {"mode", "after", "at_next", "kind"}
"""What an order may change of a task's terms, besides its predecessors and its mode."""


class Row(Struct, frozen=True):
    """One row as orders see it.

    Attributes:
        terms: the newest that were ordered; None: it is not declared, others name it.
    """

    name: str
    terms: Terms | None = None
    modes: tuple[Mode, ...] = ()


Rows = Mapping[int, Row]
"""Row's index → row; unused ones are not there."""


class Change(Struct, frozen=True):
    """What becomes of one task.

    Attributes:
        fields: of `Terms` → value.
        after: its predecessors from now on; None: as they are.
        mode: the quality mode that it goes into; "": as it is.
        at_next: in force from its next activation on; else before.
    """

    name: str
    fields: Mapping[str, object] = {}
    after: tuple[str, ...] | None = None
    mode: str = ""
    at_next: bool = False


class Outcome(Struct, frozen=True):
    """What an order makes of a schedule.

    Attributes:
        written: row's index → its new contents; all others stay as they are.
        notes: what was understood otherwise than it was written, and what is missing.
    """

    written: dict[int, Row]
    notes: tuple[str, ...] = ()


def added(rows: Rows, declarations: Iterable[Declaration], held: frozenset[int] = frozenset(), cpus_there: int = 0) -> Outcome:
    """Declare tasks; one that is declared already gets the new terms.

    Args:
        held: rows that a process runs: they are not used for another task.

    Raises:
        ScheduleError: one cannot be; nothing is to be written.
    """
    draft = _Draft(rows, held)
    notes: list[str] = []
    wanted = [checked(declaration, cpus_there) for declaration in declarations]
    for declaration in wanted:
        draft.place(declaration.name)
    for declaration in wanted:
        terms = declaration.terms
        if declaration.modes:
            terms = in_mode(terms, declaration.modes, declaration.modes[0].name)
        after = tuple(draft.place(name) for name in declaration.after)
        draft.write(draft.place(declaration.name), Row(declaration.name, replace(terms, after=after), declaration.modes))
        notes += [f"{declaration.name}: {note}" for note in declaration.notes]
    return draft.outcome(notes)


def changed(rows: Rows, changes: Iterable[Change], held: frozenset[int] = frozenset(), cpus_there: int = 0) -> Outcome:
    """Change tasks that are declared.

    Raises:
        ScheduleError: one cannot be; nothing is to be written.
    """
    draft = _Draft(rows, held)
    notes: list[str] = []
    for change in changes:
        index, row = draft.declared(change.name, "change")
        terms = row.terms
        assert terms is not None
        if change.mode:
            terms = in_mode(terms, row.modes, change.mode)
        unknown = sorted(set(change.fields) - FIELDS)
        if unknown:
            raise ScheduleError(
                f"cannot change {change.name!r}: a task has no {unknown[0]!r}; it has {', '.join(sorted(FIELDS))}"
            )
        fields = dict(change.fields)
        if "period_ns" in fields and "deadline_ns" not in fields and terms.deadline_ns == terms.period_ns:
            fields["deadline_ns"] = fields["period_ns"]
        terms = replace(terms, at_next=change.at_next, after=(), **fields)
        names = tuple(draft.rows[one].name for one in row.terms.after) if change.after is None else change.after  # type: ignore[union-attr]
        declaration = checked(Declaration(change.name, terms, names), cpus_there)
        after = tuple(draft.place(name) for name in declaration.after)
        draft.write(index, Row(row.name, replace(declaration.terms, after=after), row.modes))
        notes += [f"{change.name}: {note}" for note in declaration.notes]
    return draft.outcome(notes)


def removed(rows: Rows, names: Iterable[str]) -> Outcome:
    """Take tasks off the schedule. Those that run after them wait for them no more.

    Raises:
        ScheduleError: one is not declared; nothing is to be written.
    """
    draft = _Draft(rows, frozenset())
    for name in names:
        index, row = draft.declared(name, "remove")
        draft.write(index, Row(row.name))
    return draft.outcome([])


class _Draft:
    """Rows as they would be."""

    def __init__(self, rows: Rows, held: frozenset[int]) -> None:
        self.rows = dict(rows)
        self._held = held
        self._before = rows
        self._names = {row.name: index for index, row in rows.items()}

    def place(self, name: str) -> int:
        """The row of a task, a new one if it has none."""
        if name not in self._names:
            self._names[name] = index = self._free()
            self.rows[index] = Row(name)
        return self._names[name]

    def _free(self) -> int:
        unused = next((index for index in range(TASKS_MAX) if index not in self.rows), None)
        if unused is not None:
            return unused
        named = {row for one in self.rows.values() if one.terms is not None for row in one.terms.after}
        for index, row in self.rows.items():
            if row.terms is None and index in self._before and index not in named | self._held:
                del self._names[row.name]
                return index
        raise ScheduleError(f"cannot add a task: the schedule has {TASKS_MAX}, and no room for more; remove some")

    def declared(self, name: str, tried: str) -> tuple[int, Row]:
        index = self._names.get(name)
        if index is None or self.rows[index].terms is None:
            known = [row.name for row in self.rows.values() if row.terms is not None]
            nearest = difflib.get_close_matches(name, known, 1)
            cure = f"; did you mean {nearest[0]!r}?" if nearest else f"; it has: {', '.join(known) or 'none'}"
            raise ScheduleError(f"cannot {tried} {name!r}: the schedule has no such task{cure}")
        return index, self.rows[index]

    def write(self, index: int, row: Row) -> None:
        self.rows[index] = row

    def outcome(self, notes: list[str]) -> Outcome:
        """The rows that are to be written, if all of them together are a schedule."""
        circle = circle_of(self.rows)
        if circle:
            raise ScheduleError(
                f"these tasks would wait for one another: {' after '.join((*circle, circle[0]))}; break the circle"
            )
        written = {index: row for index, row in self.rows.items() if self._before.get(index) != row}
        for row in written.values():
            absent = [self.rows[one].name for one in (row.terms.after if row.terms else ()) if self.rows[one].terms is None]
            notes += [f"{row.name}: {name} is not declared yet; {row.name} does not wait for it until it is" for name in absent]
        return Outcome(written, tuple(notes))


def circle_of(rows: Rows) -> tuple[str, ...]:
    """The tasks of one circle of predecessors, each after the next one; () where there is none."""
    done: set[int] = set()
    for start in rows:
        path: list[int] = []
        found = _circle_from(rows, start, path, done)
        if found:
            return tuple(rows[index].name for index in found)
    return ()


def _circle_from(rows: Rows, index: int, path: list[int], done: set[int]) -> list[int]:
    if index in path:
        return path[path.index(index) :]
    row = rows.get(index)
    if index in done or row is None or row.terms is None:
        return []
    path.append(index)
    for other in row.terms.after:
        found = _circle_from(rows, other, path, done)
        if found:
            return found
    path.pop()
    done.add(index)
    return []
