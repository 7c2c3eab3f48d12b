"""States of a child besides its existence: stopped, killed, reported to its parent or not; its user."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest

from checkpoint.linux.procfs import procfs
from tests.checkpoint.engines.ptrace.capture.test_trees import three_lives
from tests.checkpoint.engines.ptrace.restore.families import PREAMBLE, goes_through_three_lives
from tests.checkpoint.round_trip import (
    Program,
    ended,
    expect_ok,
    start,
)

pytestmark = pytest.mark.root

STOPPED = """
heard = []
signal.signal(signal.SIGCHLD, lambda *_: heard.append(1))
signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGCHLD])
untold, told, by_terminal = (born(signal.pause) for _ in range(3))
for child, number in ((untold, signal.SIGSTOP), (told, signal.SIGSTOP), (by_terminal, signal.SIGTSTP)):
    os.setpgid(child, child)
    os.kill(child, number)
    os.waitid(os.P_PID, child, os.WSTOPPED | (0 if child == told else os.WNOWAIT))
while signal.sigtimedwait([signal.SIGCHLD], 2):  # a stop can be waited for a moment before the kernel sends the signal for it
    pass
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


CONTINUED = """
child = born(signal.pause)
os.kill(child, signal.SIGSTOP)
os.waitpid(child, os.WUNTRACED)
os.kill(child, signal.SIGCONT)
os.waitid(os.P_PID, child, os.WCONTINUED | os.WNOWAIT)
is_ready()
expect("what is told of a stop", os.waitpid(child, os.WUNTRACED | os.WNOHANG), (0, 0))
expect("what is told of going on", os.waitpid(child, os.WCONTINUED | os.WNOHANG), (child, 0xFFFF))
expect("what is told twice", os.waitpid(child, os.WCONTINUED | os.WNOHANG), (0, 0))
os.kill(child, signal.SIGTERM)
expect("its end", os.waitpid(child, 0), (child, signal.SIGTERM))
print("ok", flush=True)
"""


def test_that_a_child_goes_on_is_told_its_parent_once_over_three_lives(tmp_path: Path) -> None:
    goes_through_three_lives(CONTINUED, tmp_path)


ALL_STOPPED = """
child = born(wait_for_go) if sys.argv[1:] == ["parent"] else 0
is_ready()
if child:
    expect_child(child)
print("ok", flush=True)
"""


def state_of(program: Program) -> str:
    return procfs.stat(program.pid).state


@pytest.mark.parametrize("kind", ["alone", "parent"])
def test_a_program_that_is_stopped_stays_so(kind: str, tmp_path: Path) -> None:
    program = start([sys.executable, "-c", PREAMBLE + ALL_STOPPED, kind], tmp_path, isolate=True)
    program.wait_for_line("ready")
    os.kill(program.pid, signal.SIGSTOP)
    last, _ = three_lives(program, lambda program: state_of(program) == "T")
    with ended(last):
        last.wait_until(lambda: state_of(last) == "T", "that it is stopped")
        last.tell()
        os.kill(last.pid, signal.SIGCONT)
        expect_ok(last)


RIGHTS = """
import ctypes
libc = ctypes.CDLL(None, use_errno=True)
SECBITS, NO_NEW_PRIVS, CAPBSET_DROP = 28, 38, 24
LINES = ("Uid:", "Gid:", "Groups:", "NoNewPrivs:", "CapInh:", "CapPrm:", "CapEff:", "CapBnd:", "CapAmb:")

def rights():
    return [line.split() for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(LINES)] + [
        libc.prctl(27, 0, 0, 0, 0)
    ]

def one(act):
    def work():
        act()
        before = rights()
        os.write(write_end, b".")
        while not os.path.exists("go"):
            time.sleep(0.01)
        expect("who it runs as", rights(), before)
    return work

def with_file_ids():
    os.setgroups([5, 7])
    os.setresgid(10, 11, 12)
    libc.setfsgid(13)
    os.setresuid(20, 21, 22)

def with_a_file_user():
    libc.setfsuid(1000)

def with_securebits():
    libc.prctl(CAPBSET_DROP, 22, 0, 0, 0)
    libc.prctl(NO_NEW_PRIVS, 1, 0, 0, 0)
    expect("securebits", libc.prctl(SECBITS, 0xF, 0, 0, 0), 0)
    os.setresuid(30, 30, 30)

def with_few():
    libc.prctl(8, 1, 0, 0, 0)
    os.setresuid(40, 41, 40)

os.chmod(".", 0o755)
read_end, write_end = os.pipe()
children = [born(one(act)) for act in (with_file_ids, with_a_file_user, with_securebits, with_few)]
for _ in children:
    os.read(read_end, 1)
is_ready()
for child in children:
    expect_child(child)
print("ok", flush=True)
"""


def test_every_child_runs_as_whom_it_ran(tmp_path: Path) -> None:
    goes_through_three_lives(RIGHTS, tmp_path)


KILLED = """
children = [born(signal.pause) for _ in range(4)]
for child, number in zip(children, (signal.SIGKILL, signal.SIGTERM, signal.SIGUSR1, signal.SIGKILL)):
    os.kill(child, number)
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
is_ready()
for child, number in zip(children, (signal.SIGKILL, signal.SIGTERM, signal.SIGUSR1, signal.SIGKILL)):
    expect("its end", os.waitpid(child, 0), (child, number))
print("ok", flush=True)
"""


def test_who_was_killed_and_not_asked_for_is_still_to_be_asked_for(tmp_path: Path) -> None:
    goes_through_three_lives(KILLED, tmp_path)
