"""Find the process below which to create each process that its own parent cannot create: sessions that their leaders took along.

A process gets its session from the process that creates it. Later it may be given to any process above that one: the creator is
then a stand-in that ends, and the parent asks for orphans meanwhile. So two conditions hold for a *place*: a process at this
place is in the wanted session, and the parent is on the way up from it. Only leaders can be created in any session, so the search
moves leaders, together with all processes below them. It moves a leader below the parents of members of its session (these
parents were there when the leader left), and the restore gives it back at the end. Or the search creates a leader in the session
of its children, and the leader leaves that session after them.

The search continues from the plan with the fewest wrong places. Pure. Sources: setsid(2), PR_SET_CHILD_SUBREAPER of prctl(2).
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator, Mapping
from typing import Final

from msgspec import Struct

WORK_MAX: Final = 400_000
"""Places that are looked at in one search, over all its steps: some tenths of a second."""
ATTEMPTS_MIN: Final = 50
"""Steps of a search however many processes there are."""


class Wanted(Struct, frozen=True):
    """The state that a process must have when all are born.

    Attributes:
        parent: 0: none of them.
        session: of which it is the leader if that is its own pid.
    """

    pid: int
    parent: int
    session: int

    @property
    def leads(self) -> bool:
        """Whether it is the leader of its session."""
        return self.session == self.pid


class Place(Struct, frozen=True):
    """Where a process is born.

    Attributes:
        below: the process that bears it, or a stand-in for it.
        session: in which; None: of a leader, in any.
    """

    below: int
    session: int | None


Places = dict[int, Place]


class _Search:
    """One search.

    Attributes:
        first: the process that is there already, in its session, above all others.
    """

    def __init__(self, first: Wanted, others: Mapping[int, Wanted]) -> None:
        self._first = first
        self._all = {**others, first.pid: first}
        self._others = others

    def found(self) -> Places | None:
        serial = itertools.count()
        begin = self._beginning()
        if not self._is_tree(begin):
            return None
        queue = [(len(self._wrong(begin)), 0, next(serial), begin)]
        seen = set()
        for _ in range(max(ATTEMPTS_MIN, WORK_MAX // max(len(begin), 1))):
            if not queue:
                return None
            _, depth, _, places = heapq.heappop(queue)
            wrong = self._wrong(places)
            if not wrong:
                return places
            for other in self._mended(places, wrong[0]):
                key = frozenset(other.items())
                if key not in seen:
                    seen.add(key)
                    heapq.heappush(queue, (len(self._wrong(other)), depth + 1, next(serial), other))
        return None

    def _beginning(self) -> Places:
        """Each below its parent where that is in the session, else below the session's leader; leaders below their parents."""
        return {one.pid: self._plain(one.pid, None if one.leads else one.session) for one in self._others.values()}

    def _plain(self, pid: int, session: int | None) -> Place:
        parent = self._all.get(self._all[pid].parent)
        if session is None:
            return Place(parent.pid if parent else self._first.pid, None)
        return Place(parent.pid if parent and parent.session == session else self._leader(session), session)

    def _leader(self, session: int) -> int:
        return self._first.pid if session == self._first.session else session

    def _is_tree(self, places: Places) -> bool:
        """Whether the first process is above all others."""
        for pid in places:
            if not any(above == self._first.pid for above in itertools.islice(self._above(places, pid), len(places) + 1)):
                return False
        return True

    def _above(self, places: Places, pid: int) -> Iterator[int]:
        """The processes on the way up, itself first; the first process is the last."""
        yield pid
        while pid != self._first.pid:
            pid = places[pid].below
            yield pid

    def _wrong(self, places: Places) -> list[int]:
        """The processes whose parent is nowhere above them."""
        parents = ((one.pid, one.parent) for one in self._others.values() if one.parent in self._all)
        return [
            pid for pid, parent in parents if places[pid].below != parent and parent not in self._above(places, places[pid].below)
        ]

    def _mended(self, places: Places, pid: int) -> Iterator[Places]:
        """Places that may bring the parent of a process above it: it, or one above it, is born below that parent instead."""
        parent = self._all[self._all[pid].parent]
        above_parent = set(self._above(places, parent.pid))
        for moved in self._above(places, pid):
            if moved in above_parent:
                return
            session = places[moved].session
            if session is None or session == parent.session or self._is_born_in(places, parent.pid, session):
                yield places | {moved: Place(parent.pid, session)}
            elif parent.leads and parent is not self._first and places[parent.pid].session is None:
                earlier = self._plain(parent.pid, session)
                if not {parent.pid, moved} & set(self._above(places, earlier.below)):
                    yield places | {parent.pid: earlier, moved: Place(parent.pid, session)}

    def _is_born_in(self, places: Places, pid: int, session: int) -> bool:
        return pid != self._first.pid and places[pid].session == session


def found(first: Wanted, others: Mapping[int, Wanted]) -> Places | None:
    """A place for each of the others, all of them below the first; None where none was found.

    Args:
        others: by pid; leaders that have ended are among them, without a parent.
    """
    return _Search(first, others).found()
