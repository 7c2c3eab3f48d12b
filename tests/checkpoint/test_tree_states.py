"""What a child is to its parent besides being there: stopped, told of or not; who it runs as; what both have open."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.checkpoint.round_trip import Program, ended, expect_ok, start
from tests.checkpoint.test_trees import three_lives

pytestmark = pytest.mark.root

PREAMBLE = """
import os, signal, struct, sys, time
from pathlib import Path

def born(act):
    child = os.fork()
    if child == 0:
        os._exit(act() or 0)
    return child

def wait_for_go():
    while not Path("go").exists():
        time.sleep(0.01)

def expect(what, found, wanted):
    if found != wanted:
        print(f"{what}: {found!r} instead of {wanted!r}", flush=True)
        os._exit(1)

def expect_child(child):
    expect("the child", os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), 0)

def is_ready():
    print("ready", flush=True)
    wait_for_go()
"""


def goes_through_three_lives(program: str, directory: Path) -> None:
    """It says what differs afterwards."""
    begun = start([sys.executable, "-c", PREAMBLE + program], directory, isolate=True)

    def is_ready(one: Program) -> bool:
        return "ready\n" in one.output

    last, _ = three_lives(begun, is_ready)
    with ended(last):
        last.tell()
        expect_ok(last)


STOPPED = """
heard = []
signal.signal(signal.SIGCHLD, lambda *_: heard.append(1))
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])
untold, told, by_terminal = (born(signal.pause) for _ in range(3))
for child, number in ((untold, signal.SIGSTOP), (told, signal.SIGSTOP), (by_terminal, signal.SIGTSTP)):
    os.setpgid(child, child)
    os.kill(child, number)
    os.waitid(os.P_PID, child, os.WSTOPPED | (0 if child == told else os.WNOWAIT))
signal.sigtimedwait([signal.SIGCHLD], 1)
is_ready()
expect("signals of the restore", signal.sigtimedwait([signal.SIGCHLD], 0), None)
for child, status in ((untold, signal.SIGSTOP), (by_terminal, signal.SIGTSTP)):
    expect("what is told of the stop", os.waitpid(child, os.WUNTRACED | os.WNOHANG), (child, status << 8 | 0x7F))
expect("what was told already", os.waitpid(-1, os.WUNTRACED | os.WNOHANG), (0, 0))
for child in (untold, told, by_terminal):
    state = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[0]
    expect("the state of a child", state, "T")
    os.kill(child, signal.SIGCONT)
    expect("what is told of going on", os.waitpid(child, os.WCONTINUED), (child, 0xFFFF))
    os.kill(child, signal.SIGTERM)
    expect("its end", os.waitpid(child, 0), (child, signal.SIGTERM))
print("ok", flush=True)
"""


def test_stopped_children_stay_so_and_their_parent_is_told_once(tmp_path: Path) -> None:
    goes_through_three_lives(STOPPED, tmp_path)
