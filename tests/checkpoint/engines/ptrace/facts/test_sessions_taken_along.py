"""Children in sessions that their parent never was in: they were given to it, and their leaders may be elsewhere since."""

from __future__ import annotations

from pathlib import Path

import pytest

from checkpoint.engines.ptrace.facts import birth_parents
from checkpoint.engines.ptrace.facts.birth_order import Person
from checkpoint.engines.ptrace.facts.birth_parents import Wanted
from tests.checkpoint.engines.ptrace.facts.test_birth_order import FIRST, played
from tests.checkpoint.engines.ptrace.restore.families import goes_through_three_lives


@pytest.mark.parametrize(
    "others",
    [
        [Person(3, 2, 3, 3), Person(5, 2, 5, 5), Person(7, 3, 5, 5), Person(8, 2, 8, 8), Person(9, 3, 8, 8)],
        [Person(3, 2, 2, 2), Person(5, 0, 5, 5), Person(7, 3, 5, 5)],
        [Person(3, 2, 3, 3), Person(4, 3, 3, 3), Person(5, 3, 5, 5), Person(7, 4, 5, 5)],
        [Person(3, 2, 2, 2), Person(4, 3, 2, 2), Person(6, 3, 5, 5), Person(7, 2, 5, 5), Person(8, 6, 5, 5), Person(9, 8, 9, 9)],
        [Person(3, 2, 2, 2), Person(4, 2, 2, 2), Person(6, 3, 6, 6), Person(7, 4, 6, 6), Person(8, 6, 6, 6)],
        [Person(3, 2, 4, 2), Person(4, 2, 2, 2), Person(5, 3, 5, 5)],
    ],
    ids=[
        "children of two sessions, whose leaders were given away",
        "a child whose leader has lost its parent",
        "a child of a session of its parent's sibling",
        "children of a session whose leader has ended, of two parents",
        "children of one session, of parents that are siblings of each other",
        "a group whose leader has gone to another",
    ],
)
def test_everybody_is_what_it_was(others: list[Person]) -> None:
    assert played(others) == {one.pid: one for one in (FIRST, *others)}


def test_a_leader_below_its_own_members_has_no_place() -> None:
    wanted = (Wanted(3, 4, 3), Wanted(4, 2, 3))
    assert birth_parents.found(Wanted(2, 0, 2), {one.pid: one for one in wanted}) is None


PROGRAM = """
import ctypes
PR_SET_CHILD_SUBREAPER = 36
libc = ctypes.CDLL(None)
first = os.getpid()
read_end, write_end = os.pipe()

def ask_for_orphans(wants):
    expect("that orphans are given", libc.prctl(PR_SET_CHILD_SUBREAPER, wants, 0, 0, 0), 0)

def lead(parent):
    os.setsid()
    born(lambda: born(lambda: follow(parent, os.getsid(0))) and 0)
    os.wait()
    wait_for_go()
    expect("the leader's parent and session", (os.getppid(), os.getsid(0)), (first, os.getpid()))

def follow(parent, session):
    while os.getppid() != parent:
        time.sleep(0.001)
    os.write(write_end, b".")
    wait_for_go()
    expect("the follower's parent and session", (os.getppid(), os.getsid(0)), (parent, session))

def adopt():
    os.setsid()
    own = os.getpid()
    ask_for_orphans(1)
    between = [born(lambda: born(lambda: lead(own)) and signal.pause()) for _ in range(2)]
    for _ in between:
        os.read(read_end, 1)
    ask_for_orphans(0)
    for one in between:
        os.kill(one, signal.SIGKILL)
        os.waitpid(one, 0)
    os.write(write_end, b".")
    wait_for_go()
    for _ in between:
        expect("the end of one that was given", os.wait()[1], 0)

ask_for_orphans(1)
child = born(adopt)
while True:
    children = Path(f"/proc/self/task/{first}/children").read_text().split()
    if len(children) == 3:
        break
    time.sleep(0.001)
is_ready()
for _ in children:
    expect("the end of a child", os.wait()[1], 0)
print("ok", flush=True)
"""


@pytest.mark.root
def test_children_of_sessions_whose_leaders_went_elsewhere_live_on_in_them(tmp_path: Path) -> None:
    goes_through_three_lives(PROGRAM, tmp_path)
