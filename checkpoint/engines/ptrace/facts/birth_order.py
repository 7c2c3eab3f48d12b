"""Plan the order in which a restore creates the processes of a component, so that parents, sessions and process groups match.

A child is created in the session and the process group of its parent. A process cannot join a session, and can join a group only
within its session. So a leader makes its session after the creation of its children that have an older session, and before that
of its other children. Some processes are created with the help of a *stand-in*, a process that ends when it has done its part, as
the process that it replaces has ended. These are: processes that have lost their parent; processes in a session or group whose
leader has ended; and processes that were given to another parent, one that asks for orphans. The last kind is created below that
parent and given to it once more. Where this finds no order, the plan searches places for all of them
(`checkpoint.engines.ptrace.facts.birth_parents`): first it creates all processes, then it gives those with stand-ins to their
parents, the deepest first.

Pure: it touches no process. Sources: fork(2), setsid(2), setpgid(2), credentials(7); PR_SET_CHILD_SUBREAPER of prctl(2).
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

from msgspec import Struct, field

from checkpoint.capability import Area, preserved, refused
from checkpoint.engines.ptrace.facts import birth_parents
from checkpoint.engines.ptrace.facts.birth_parents import Places, Wanted
from checkpoint.errors import RestoreError
from checkpoint.linux.procfs.procfs import Status
from checkpoint.model import Member, ProcessState, Snapshot, Zombie
from checkpoint.resources.process import shared_with_parent

CAPABILITIES: Final = (
    preserved(
        Area.PROCESS,
        "child processes, zombies and orphans: parents, process groups, sessions, exit statuses",
        "all together, under their PIDs. Orphans: all, if `failover run` started the program; otherwise those that "
        "failover knows by their session, or by standard streams that only the program has",
    ),
    preserved(
        Area.MEMORY,
        "shared memory of the processes of one program",
        "one object again, carried once",
    ),
    preserved(
        Area.MEMORY,
        "private memory that processes share since a fork (copy-on-write)",
        "shared until one process writes to it, and carried once",
    ),
    refused(
        Area.PROCESS,
        "a session or process group of another program; a namespace in which only a child lives",
        "start such processes as components of their own",
        "namespace of its own, which is not kept yet",
    ),
    refused(
        Area.PROCESS,
        "child processes on a kernel without kcmp(2); more than 16,383 of them",
        "boot a kernel with CONFIG_KCMP; start fewer",
        "and this kernel does not tell what they share",
        "processes, which is the limit",
    ),
    refused(
        Area.THERE,
        "PIDs of a program of several processes that are taken, or that failover may not choose",
        "free them, or start the program with `failover run`, which gives it PIDs of its own",
        "by which they know it, is not available",
        "processes, which takes the right to choose their pids",
    ),
)

SIGCHLD: Final = 17
GENERATIONS_MAX: Final = 200
"""In how many generations processes may descend from one another: the plan of a birth calls itself for the children."""


class Birth(Struct, frozen=True):
    """``parent`` gives birth to ``pid``.

    Attributes:
        pid: below zero: of a stand-in, which the steps know by it and which may have any of `spare_pids` instead.
        exit_signal: what the parent is sent at its end.
        flags: of clone(2): what both share from then on.
    """

    parent: int
    pid: int
    exit_signal: int = SIGCHLD
    flags: int = 0


class NewSession(Struct, frozen=True):
    """``pid`` becomes the leader of a session."""

    pid: int


class Join(Struct, frozen=True):
    """``pid`` goes to a process group, or makes it when that is its own."""

    pid: int
    group: int


class End(Struct, frozen=True):
    """``pid`` ends, and nothing is left of it: its parent takes note."""

    parent: int
    pid: int


class Reaper(Struct, frozen=True):
    """``pid`` is given the orphans among its descendants from now on, or no more.

    Attributes:
        is_one: True while it is given them.
    """

    pid: int
    is_one: bool


Step = Birth | NewSession | Join | End | Reaper


class Person(Struct, frozen=True):
    """The facts of a process that matter here; pids are as the component sees them."""

    pid: int
    ppid: int
    pgid: int
    sid: int
    exit_signal: int = SIGCHLD
    flags: int = 0


class NoWayError(RestoreError):
    """Processes that cannot be born into the sessions and groups that they were in."""


def steps_of(state: Snapshot, is_taken: Callable[[int], bool]) -> list[Step]:
    """Every step, beginning with the first process alone.

    Args:
        is_taken: whether another process has a pid, so that no process can stand in for a leader that had it.

    Raises:
        NoWayError: there is none.
    """
    return steps(_person(state.process), _persons(state.members, state.zombies), is_taken)


def spare_pids(state: Snapshot, end: int) -> Iterator[int]:
    """Pids below ``end`` that no process of the component uses, the highest first: those above its own are lent next."""
    persons = [_person(state.process), *_persons(state.members, state.zombies)]
    wanted = {number for one in persons for number in (one.pid, one.pgid, one.sid)} | _thread_ids(state)
    return (number for number in range(end - 1, 1, -1) if number not in wanted)


def _persons(members: Sequence[Member], zombies: Sequence[Zombie]) -> list[Person]:
    living = [_person(member.process, member.exit_signal, shared_with_parent.flags_of(member.resources)) for member in members]
    return [*living, *(Person(one.pid, one.ppid, one.pgid, one.sid, one.exit_signal) for one in zombies)]


def _person(process: ProcessState, exit_signal: int = SIGCHLD, flags: int = 0) -> Person:
    return Person(process.pid, process.ppid, process.pgid, process.sid, exit_signal, flags)


def _thread_ids(state: Snapshot) -> set[int]:
    threads = [*state.threads, *(thread for member in state.members for thread in member.threads)]
    return {thread.tid for thread in threads}


def refuse(first: Status, members: Sequence[Member], zombies: Sequence[Zombie], is_taken: Callable[[int], bool]) -> Iterator[str]:
    """Why processes could not be born again.

    Args:
        first: of the first process.
        is_taken: whether a process has this pid, as they see it.
    """
    yield from refuse_persons(first, _persons(members, zombies), is_taken)


def refuse_persons(first: Status, others: Sequence[Person], is_taken: Callable[[int], bool]) -> Iterator[str]:
    """As `refuse`, for processes of which only these numbers are known."""
    try:
        steps(Person(first.pids[-1], 0, first.pgids[-1], first.sids[-1]), others, is_taken)
    except NoWayError as error:
        yield str(error)


def persons(statuses: Sequence[Status]) -> list[Person]:
    """All of these processes, by the numbers of their own namespace."""
    inner = {status.pids[0]: status.pids[-1] for status in statuses}
    return [Person(one.pids[-1], inner.get(one.ppid, 0), one.pgids[-1], one.sids[-1]) for one in statuses]


def steps(first: Person, others: Sequence[Person], is_taken: Callable[[int], bool] = lambda _: False) -> list[Step]:
    """As `steps_of`."""
    _require_few_generations({one.pid: one.ppid for one in others})
    try:
        return _Plan(first, others, is_taken).made()
    except NoWayError:
        places = birth_parents.found(_wanted(first), {one.pid: one for one in _wanted_of(first, others)})
        if places is None:
            raise
        return _Plan(first, others, is_taken).made_at(places)


def _wanted(person: Person) -> Wanted:
    return Wanted(person.pid, person.ppid, person.sid)


def _wanted_of(first: Person, others: Sequence[Person]) -> Iterator[Wanted]:
    """The wanted states of all but the first, and of leaders that have ended."""
    yield from map(_wanted, others)
    there = {first.sid, first.pid, *(one.pid for one in others)}
    yield from (Wanted(session, 0, session) for session in sorted({one.sid for one in others} - there))


def _require_few_generations(parents: Mapping[int, int]) -> None:
    for pid in parents:
        ancestor, generations = pid, 0
        while ancestor in parents:
            ancestor, generations = parents[ancestor], generations + 1
            if generations > GENERATIONS_MAX:
                raise NoWayError(f"process {pid} has more than {GENERATIONS_MAX} ancestors in it, which is the limit")


class _Plan(Struct):
    """One plan in the making.

    Attributes:
        session: the one that a process is in by now.
        given: children that had another parent first, with the parents that they were given to.
        standins: processes that stand for a session's ended leader, and are not ended themselves yet; their parents.
    """

    first: Person
    others: Sequence[Person]
    is_taken: Callable[[int], bool]
    steps: list[Step] = field(default_factory=list)
    session: dict[int, int] = field(default_factory=dict)
    given: list[tuple[int, Person]] = field(default_factory=list)
    standins: dict[int, int] = field(default_factory=dict)

    def made(self) -> list[Step]:
        for person in self.others:
            self._children[person.ppid].append(person)
        self._begin()
        self._grow(self.first)
        for orphan in [one for one in self.others if one.ppid not in self._everybody]:
            self._bear_orphan(orphan)
        self._give_all()
        for person in self.others:
            assert person.pid in self.session, "each process has a parent, or none that lives"
        self._group()
        for pid, parent in reversed(self.standins.items()):
            self.steps.append(End(parent, pid))
        return self.steps

    def _begin(self) -> None:
        self._everybody = {person.pid: person for person in (self.first, *self.others)}
        self.session[self.first.pid] = self.first.sid

    _everybody: dict[int, Person] = field(default_factory=dict)
    _spare: Iterator[int] = field(default_factory=lambda: itertools.count(-1, -1))
    _children: dict[int, list[Person]] = field(default_factory=lambda: defaultdict(list))
    _needs: dict[int, int | None] = field(default_factory=dict)

    # Sessions

    def _needed(self, person: Person) -> int | None:
        """The session that a process must be born in; None: any."""
        if person.sid != person.pid:
            return person.sid
        if person.pid not in self._needs:
            self._needs[person.pid] = self._needed_by_leader(person)
        return self._needs[person.pid]

    def _needed_by_leader(self, person: Person) -> int | None:
        """The same of a process that has left that session since: the session of its children that were not given to it."""
        older = {need for child in self._children[person.pid] if (need := self._needed(child)) not in (None, person.pid)}
        if older:
            beyond = (session for session in older if self._reaches_beyond(session, person.pid))
            older = older & self._sessions_of_ancestors(person) or set(beyond)
        if len(older) > 1:
            raise NoWayError(f"the children of process {person.pid} are of several sessions that it was never in itself")
        return next(iter(older), None)

    def _sessions_of_ancestors(self, person: Person) -> set[int]:
        """The sessions that a process was born in, unless it was given to its parent later."""
        found = set()
        while person.ppid in self._everybody:
            person = self._everybody[person.ppid]
            found.add(person.sid)
        return found

    def _reaches_beyond(self, session: int, ancestor: int) -> bool:
        """Whether a session has members that do not descend from a process."""
        return any(one.sid == session and not self._is_below(one.pid, ancestor) for one in self._everybody.values())

    def _grow(self, person: Person) -> None:
        """Have a process, which is born, come to its session and give birth to its children."""
        children = self._children[person.pid]
        leads_already = self.session[person.pid] == person.pid
        later = [child for child in children if self._needed(child) in (None, person.sid)]
        for child in children:
            if child not in later:
                self._bear(person.pid, child)
        if person.sid == person.pid and not leads_already:
            self.steps.append(NewSession(person.pid))
            self.session[person.pid] = person.pid
        for child in later:
            self._bear(person.pid, child)

    def _bear(self, parent: int, child: Person) -> None:
        needed = self._needed(child)
        if needed is not None and self.session[parent] != needed:
            self.given.append((parent, child))
            return
        self._birth(parent, child.pid, child.exit_signal, child.flags)
        self._grow(child)

    def _birth(self, parent: int, pid: int, exit_signal: int, flags: int = 0) -> None:
        self.steps.append(Birth(parent, pid, exit_signal, flags))
        self.session[pid] = self.session[parent]

    # Processes that have lost their parent or the leader of their session

    def _give_all(self) -> None:
        """Have those born that were given to their parents; first those whose session the plan has already."""
        while self.given:
            parent, child = next((one for one in self.given if self._can_give(one[1])), self.given[0])
            self.given.remove((parent, child))
            self._give(parent, child)

    def _can_give(self, child: Person) -> bool:
        session = self._needed(child)
        return session not in self._everybody or session in self.session

    def _give(self, parent: int, child: Person) -> None:
        """By a stand-in for the parent that has ended, below the one that was given the child then."""
        session = self._needed(child)
        assert session is not None, "a process that may be born anywhere is born by its parent"
        if child.flags:
            raise NoWayError(f"process {child.pid} shares its open files or directory with a parent that it was given to later")
        if session not in self._everybody and session not in self.standins:
            self._stand_in_for_leader(parent, session)
        if self.session.get(session) != session or not self._is_below(session, parent):
            raise NoWayError(
                f"process {child.pid} is of session {session}, in which its parent {child.ppid} is not (any more), which is not "
                "kept yet"
            )
        between = next(self._spare)
        self._birth(session, between, 0)
        self._bear(between, child)
        self.steps += [Reaper(parent, True), End(session, between), Reaper(parent, False)]

    def _is_below(self, pid: int, ancestor: int) -> bool:
        """Whether a process descends from another, by those that live now."""
        while pid != ancestor and (pid in self.standins or pid in self._everybody):
            pid = self.standins[pid] if pid in self.standins else self._everybody[pid].ppid
        return pid == ancestor

    def _stand_in_for_leader(self, parent: int, session: int) -> None:
        if self.is_taken(session):
            raise NoWayError(f"session {session} is that of another program, which has its number: start both as one")
        self._birth(parent, session, 0)
        self.steps.append(NewSession(session))
        self.session[session] = session
        self.standins[session] = parent

    def _bear_orphan(self, orphan: Person) -> None:
        """By a stand-in for its parent, in the session that it must be born in."""
        source = self._in_session(self._needed(orphan))
        if source in self.standins:
            self._bear(source, orphan)
            return
        parent = next(self._spare)
        self._birth(source, parent, 0)
        self._bear(parent, orphan)
        self.steps.append(End(source, parent))

    def _in_session(self, session: int | None) -> int:
        """The process that may give birth in a session: its leader, a stand-in for it, or the first process for its own."""
        if session is None or session == self.session[self.first.pid]:
            return self.first.pid
        if session not in self._everybody and session not in self.standins:
            self._stand_in_for_leader(self.first.pid, session)
        if self.session.get(session) != session:
            raise NoWayError(f"session {session} has lost its leader in a way that is not kept yet")
        return session

    # At places

    def made_at(self, places: Places) -> list[Step]:
        """As `made`, with every process born at a place, and given to its parent when all are born.

        Raises:
            NoWayError: a place is of no use: its number is taken, or the process shares something with its parent.
        """
        self._begin()
        below = defaultdict(list)
        for pid, place in places.items():
            below[place.below].append(pid)
        ends: list[Step] = []
        self._grow_at(self.first.pid, below, places, ends)
        born = dict(self.standins)
        self._group()
        for pid in reversed([pid for pid in self.standins if pid not in born]):
            self.steps.append(End(self.standins[pid], pid))
        self.steps += ends
        return self.steps

    def _grow_at(self, pid: int, below: Mapping[int, list[int]], places: Places, ends: list[Step]) -> None:
        """Have one that is born give birth to all that are born below it, before it makes its session and afterwards."""
        leads = pid != self.first.pid and (pid not in self._everybody or self._everybody[pid].sid == pid)
        earlier = [one for one in below[pid] if leads and places[one].session == self.session[pid]]
        for child in earlier:
            self._bear_at(pid, child, below, places, ends)
        if leads:
            self.steps.append(NewSession(pid))
            self.session[pid] = pid
        for child in below[pid]:
            if child not in earlier:
                self._bear_at(pid, child, below, places, ends)

    def _bear_at(self, source: int, pid: int, below: Mapping[int, list[int]], places: Places, ends: list[Step]) -> None:
        """Plan one birth. A stand-in's child is given to its parent at the end, when all below it have been."""
        person = self._everybody.get(pid)
        if person is None:
            if self.is_taken(pid):
                raise NoWayError(f"session {pid} is that of another program, which has its number: start both as one")
            self._birth(source, pid, 0)
            self.standins[pid] = source
            self._grow_at(pid, below, places, ends)
            ends.append(End(source, pid))
            return
        if person.ppid == source:
            self._birth(source, pid, person.exit_signal, person.flags)
            self._grow_at(pid, below, places, ends)
            return
        if person.flags:
            raise NoWayError(f"process {pid} shares its open files or directory with a parent that it was given to later")
        between = next(self._spare)
        self._birth(source, between, 0)
        self._birth(between, pid, person.exit_signal)
        self._grow_at(pid, below, places, ends)
        end = End(source, between)
        ends += [Reaper(person.ppid, True), end, Reaper(person.ppid, False)] if person.ppid in self._everybody else [end]

    # Groups

    def _group(self) -> None:
        """Put each process into its group; the group's leader makes it first."""
        ours = {self.first.pid: self.session[self.first.pid], **self.session}
        waiting = []
        left = {person.pgid for person in self.others} & {one.pid for one in self.others if one.pgid != one.pid}
        for person in self.others:
            makes_group = person.pgid == person.pid and person.sid != person.pid
            if makes_group or person.pid in left:
                self.steps.append(Join(person.pid, person.pid))
            if person.pid in left or (not makes_group and person.pgid not in (person.pid, self._inherited(person))):
                waiting.append(person)
        waiting.sort(key=lambda one: one.pid in left)  # a process that has left the group that it made goes last
        for person in waiting:
            if person.pgid not in self._everybody and person.pgid not in self.standins:
                source = self._in_session(ours[person.pid])
                if self.is_taken(person.pgid):
                    raise NoWayError(
                        f"process group {person.pgid} is that of another program, which has its number: start both as one"
                    )
                self._birth(source, person.pgid, 0)
                self.steps.append(Join(person.pgid, person.pgid))
                self.standins[person.pgid] = source
            self.steps.append(Join(person.pid, person.pgid))

    def _inherited(self, person: Person) -> int:
        """The group that a process has if it joins none: of its session's leader, or what the first process brought along."""
        session = self.session[person.pid]
        return self.first.pgid if session == self.session[self.first.pid] else session
