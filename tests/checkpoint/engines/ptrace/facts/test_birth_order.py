"""Order in which processes are created again: parents, sessions and groups come out as before, whichever have ended meanwhile."""

from __future__ import annotations

import pytest

from checkpoint.engines.ptrace.facts.birth_order import (
    GENERATIONS_MAX,
    Birth,
    End,
    Join,
    NewSession,
    NoWayError,
    Person,
    Reaper,
    Step,
    steps,
)

FIRST = Person(2, 0, 2, 2)


def played(others: list[Person], first: Person = FIRST) -> dict[int, Person]:
    """What the kernel would make of a plan: who is there at its end."""
    world = {first.pid: first}
    reapers: set[int] = set()
    for step in steps(first, others):
        _play(world, reapers, step)
    assert not reapers, "who asks for orphans is said later"
    return world


def _heir(world: dict[int, Person], reapers: set[int], pid: int) -> int:
    while pid and pid not in reapers:
        pid = world[pid].ppid
    return pid


def _play(world: dict[int, Person], reapers: set[int], step: Step) -> None:
    match step:
        case Birth(parent, pid):
            assert pid not in world
            world[pid] = Person(pid, parent, world[parent].pgid, world[parent].sid)
        case NewSession(pid):
            assert world[pid].pgid != pid, "a leader of a group makes no session"
            world[pid] = Person(pid, world[pid].ppid, pid, pid)
        case Join(pid, group):
            assert world[pid].sid != pid, "a leader of a session stays in its group"
            leader = world[group]
            assert leader.sid == world[pid].sid
            assert leader.pgid == group or pid == group
            world[pid] = Person(pid, world[pid].ppid, group, world[pid].sid)
        case End(parent, pid):
            assert world[pid].ppid == parent
            heir = _heir(world, reapers, parent)
            del world[pid]
            for one in [one for one in world.values() if one.ppid == pid]:
                world[one.pid] = Person(one.pid, heir, one.pgid, one.sid)
        case Reaper(pid, is_one):
            (reapers.add if is_one else reapers.remove)(pid)


@pytest.mark.parametrize(
    "others",
    [
        [Person(3, 2, 2, 2), Person(4, 3, 2, 2)],
        [Person(3, 2, 3, 3), Person(4, 3, 3, 3), Person(5, 3, 5, 3)],
        [Person(3, 2, 3, 2), Person(4, 2, 3, 2)],
        [Person(4, 2, 3, 2), Person(5, 2, 3, 2)],
        [Person(4, 0, 2, 2)],
        [Person(4, 0, 3, 3), Person(5, 4, 5, 3)],
        [Person(4, 0, 4, 4), Person(5, 0, 4, 4)],
        [Person(3, 2, 3, 3), Person(4, 3, 2, 2)],
        [Person(5, 0, 4, 3), Person(6, 0, 4, 3)],
        [Person(4, 2, 3, 3), Person(5, 4, 3, 3)],
        [Person(3, 2, 2, 2), Person(5, 3, 4, 4), Person(6, 3, 6, 4), Person(7, 3, 7, 7), Person(8, 2, 8, 7)],
        [Person(3, 2, 3, 3), Person(6, 3, 5, 5), Person(7, 3, 3, 3), Person(8, 3, 2, 2)],
    ],
    ids=[
        "children of children",
        "a session with groups",
        "a group",
        "a group whose leader has ended",
        "an orphan",
        "an orphan in a session whose leader has ended, with a child",
        "orphans, one of them the leader of the other's session",
        "a child that is older than its parent's session",
        "orphans whose leaders of group and session have ended",
        "an orphan that the first process was given, with a child",
        "orphans that a child was given, and one of a session that lives",
        "an orphan that the leader of another session was given",
    ],
)
def test_everybody_is_what_it_was(others: list[Person]) -> None:
    assert played(others) == {one.pid: one for one in (FIRST, *others)}


def test_a_session_that_nobody_can_be_born_into_is_refused() -> None:
    with pytest.raises(NoWayError, match="process 4 is of session 3"):
        steps(FIRST, [Person(3, 4, 3, 3), Person(4, 2, 3, 3)])


def test_a_session_or_group_of_somebody_else_is_refused() -> None:
    with pytest.raises(NoWayError, match="session 3 is that of another program"):
        steps(FIRST, [Person(4, 2, 3, 3)], lambda pid: pid == 3)
    with pytest.raises(NoWayError, match="process group 3 is that of another program"):
        steps(FIRST, [Person(4, 2, 3, 2)], lambda pid: pid == 3)


@pytest.mark.parametrize("led", [False, True])
def test_many_generations_are_born_again_and_too_many_are_refused(led: bool) -> None:
    line = [Person(pid, pid - 1, pid if led else 2, pid if led else 2) for pid in range(3, 3 + GENERATIONS_MAX)]
    assert played(line) == {one.pid: one for one in (FIRST, *line)}
    last = line[-1].pid
    with pytest.raises(NoWayError, match="which is the limit"):
        steps(FIRST, [*line, Person(last + 1, last, 2, 2), *(Person(pid, pid - 1, 2, 2) for pid in range(last + 2, 2000))])
