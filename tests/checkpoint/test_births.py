"""In which order processes are born again: parents, sessions and groups come out as they were, whoever has ended meanwhile."""

from __future__ import annotations

import pytest

from checkpoint.engines.births import Birth, End, Join, NewSession, NoWayError, Person, Step, steps

FIRST = Person(2, 0, 2, 2)


def played(others: list[Person], first: Person = FIRST) -> dict[int, Person]:
    """What the kernel would make of a plan: who is there at its end."""
    world = {first.pid: first}
    for step in steps(first, others, set()):
        _play(world, step)
    return world


def _play(world: dict[int, Person], step: Step) -> None:
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
            del world[pid]
            for one in [one for one in world.values() if one.ppid == pid]:
                world[one.pid] = Person(one.pid, 0, one.pgid, one.sid)


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
    ],
)
def test_everybody_is_what_it_was(others: list[Person]) -> None:
    assert played(others) == {one.pid: one for one in (FIRST, *others)}


def test_a_session_that_nobody_can_be_born_into_is_refused() -> None:
    with pytest.raises(NoWayError, match="process 4 is of session 3"):
        steps(FIRST, [Person(3, 2, 3, 3), Person(4, 2, 3, 3)], set())
