"""States of a child besides its existence: stopped, reported to its parent or not; its user; what both have open."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder
from checkpoint.engines.ptrace.facts import memory_limits
from checkpoint.errors import UnsupportedError
from checkpoint.linux.procfs import descendants, procfs
from checkpoint.linux.spawn.vessel import Birth, discard, spawn_vessel
from tests.checkpoint.engines.ptrace.capture.test_trees import three_lives
from tests.checkpoint.round_trip import (
    Program,
    captured_at_last,
    ended,
    everybody_below,
    expect_ok,
    protected,
    restored,
    start,
    transported,
)

pytestmark = pytest.mark.root

FAMILY_MIB = int(os.environ.get("FAILOVER_TEST_FAMILY_MIB", "8"))
"""What each process of a family has, untouched since the fork; the issue says 100."""
MIB = 1 << 20
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


def goes_through_three_lives(program: str, directory: Path, *arguments: str) -> None:
    """It says what differs afterwards."""
    begun = start([sys.executable, "-c", PREAMBLE + program, *arguments], directory, isolate=True)

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


ENDED_FOR_SEVERAL = """
gone = born(signal.pause)
inherited = os.pidfd_open(gone)
read_end, write_end = os.pipe()

def work():
    own = os.pidfd_open(gone)
    os.write(write_end, b".")
    wait_for_go()
    expect("whom the child means", os.fstat(own).st_ino, os.fstat(inherited).st_ino)
    os.write(write_end, struct.pack("Q", os.fstat(own).st_ino))

child = born(work)
other = born(signal.pause)
of_other = os.pidfd_open(other)
os.read(read_end, 1)
for one in (gone, other):
    os.kill(one, signal.SIGKILL)
    os.waitpid(one, 0)
is_ready()
expect_child(child)
expect("whom both mean", struct.unpack("Q", os.read(read_end, 8))[0], os.fstat(inherited).st_ino)
expect("that these are two", os.fstat(of_other).st_ino == os.fstat(inherited).st_ino, False)
for one in (inherited, of_other):
    try:
        signal.pidfd_send_signal(one, 0)
    except ProcessLookupError:
        continue
    expect("that it has ended", False, True)
print("ok", flush=True)
"""


def test_pidfds_of_a_process_that_has_ended_mean_the_same_one_in_all_processes(tmp_path: Path) -> None:
    goes_through_three_lives(ENDED_FOR_SEVERAL, tmp_path)


NAMELESS = """
import fcntl
deleted = os.open("deleted", os.O_RDWR | os.O_CREAT)
sealed = os.memfd_create("sealed", os.MFD_ALLOW_SEALING)
plain = os.memfd_create("plain")
os.write(deleted, b"a" * 5000)
os.write(sealed, b"sealed")
os.write(plain, b"plain")
parent = os.getpid()
read_end, write_end = os.pipe()

def work():
    mine = [os.open(f"/proc/{parent}/fd/{one}", os.O_RDWR) for one in (deleted, sealed, plain)]
    for one in (deleted, sealed, plain):
        os.close(one)
    os.write(write_end, b".")
    wait_for_go()
    os.pwrite(mine[0], b"child", 5000)
    os.pwrite(mine[2], b"child", 100)
    expect("what the child reads of a sealed file", os.pread(mine[1], 10, 0), b"sealed")
    expect("its offset", os.lseek(mine[0], 0, os.SEEK_CUR), 0)

child = born(work)
os.read(read_end, 1)
os.unlink("deleted")
fcntl.fcntl(sealed, fcntl.F_ADD_SEALS, fcntl.F_SEAL_WRITE | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
is_ready()
expect_child(child)
expect("what the child has written", os.pread(deleted, 5100, 0), b"a" * 5000 + b"child")
expect("what it has written to memory", os.pread(plain, 200, 0), b"plain" + bytes(95) + b"child")
expect("seals", fcntl.fcntl(sealed, fcntl.F_GET_SEALS), fcntl.F_SEAL_WRITE | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
expect("the offset", os.lseek(deleted, 0, os.SEEK_CUR), 5000)
print("ok", flush=True)
"""


MAPPED_ALONE = """
import ctypes
libc = ctypes.CDLL(None)
libc.mmap.restype, libc.mmap.argtypes = ctypes.c_void_p, [ctypes.c_void_p, ctypes.c_size_t, *[ctypes.c_int] * 3, ctypes.c_long]

def mapped(number):
    file = os.memfd_create(f"of {number}")
    os.ftruncate(file, 4096)
    place = libc.mmap(None, 4096, 3, 1, file, 0)
    os.close(file)
    ctypes.memset(place, 65 + number, 1)
    return place

places = [mapped(number) for number in range(8)]

def work():
    wait_for_go()
    for number, place in enumerate(places):
        ctypes.memset(place + 1, 97 + number, 1)

child = born(work)
is_ready()
expect_child(child)
found = [ctypes.string_at(place, 3) for place in places]
expect("what each file holds", found, [bytes((65 + number, 97 + number, 0)) for number in range(8)])
print("ok", flush=True)
"""


def test_memory_files_that_processes_have_mapped_and_not_open_stay_each_its_own(tmp_path: Path) -> None:
    goes_through_three_lives(MAPPED_ALONE, tmp_path)


ON_THEIR_WAY = """
import socket
ours, theirs = socket.socketpair()
memory = os.memfd_create("memory")
os.write(memory, b"memory")
deleted = os.open("deleted", os.O_RDWR | os.O_CREAT)
os.write(deleted, b"deleted")
os.unlink("deleted")
socket.send_fds(ours, [b"x"], [memory, deleted])
os.close(memory)
os.close(deleted)
is_ready()
_, came, _, _ = socket.recv_fds(theirs, 10, 4)
expect("what came", [os.pread(one, 10, 0) for one in came], [b"memory", b"deleted"])
print("ok", flush=True)
"""


def test_files_without_a_name_that_are_on_their_way_and_open_nowhere_arrive(tmp_path: Path) -> None:
    program = start([sys.executable, "-c", PREAMBLE + ON_THEIR_WAY], tmp_path, isolate=True)
    program.wait_for_line("ready")
    last, _ = three_lives(program, lambda program: True)
    with ended(last):
        last.tell()
        expect_ok(last)


def test_a_file_without_a_name_that_two_processes_have_opened_is_one_file(tmp_path: Path) -> None:
    goes_through_three_lives(NAMELESS, tmp_path)


NAMED_PIPES = """
def full(mark):
    return mark * 60000

for name in ("plain", "deleted", "shared"):
    os.mkfifo(name)
shared = os.open("shared", os.O_RDWR)
os.write(shared, full(b"s"))

def work():
    mine = [os.open(name, os.O_RDONLY) for name in ("plain", "deleted", "shared")]
    wait_for_go()
    for descriptor, mark in zip(mine, (b"p", b"d", b"s")):
        expect("what the child reads of " + mark.decode(), os.read(descriptor, 100000), full(mark))
    os.write(answer, b"x")
    for descriptor in mine[:2]:
        expect("what it reads of its parent", os.read(descriptor, 100), b"more")
        expect("what it reads once its parent has closed it", os.read(descriptor, 100), b"")

told, answer = os.pipe()
child = born(work)
writers = [os.open(name, os.O_WRONLY) for name in ("plain", "deleted")]
for descriptor, mark in zip(writers, (b"p", b"d")):
    os.write(descriptor, full(mark))
while not os.readlink(f"/proc/{child}/fd/{max(map(int, os.listdir(f'/proc/{child}/fd')))}").endswith("/shared"):
    time.sleep(0.01)
os.unlink("deleted")
is_ready()
expect("the child's word", os.read(told, 1), b"x")
os.set_blocking(shared, False)
try:
    expect("what is left", os.read(shared, 100), b"nothing")
except BlockingIOError:
    pass
for descriptor in writers:
    os.write(descriptor, b"more")
    os.close(descriptor)
expect_child(child)
print("ok", flush=True)
"""


def test_named_pipes_that_two_processes_have_opened_are_filled_once(tmp_path: Path) -> None:
    goes_through_three_lives(NAMED_PIPES, tmp_path)


CONNECTED_AS_NOBODY = """
import socket, tempfile
os.setgroups([])
os.setresgid(65534, 65534, 65534)
os.setresuid(65534, 65534, 65534)
os.umask(0o77)
place = tempfile.mkdtemp()
listener = socket.socket(socket.AF_UNIX)
listener.bind(place + "/name")
listener.listen()

def work():
    client = socket.socket(socket.AF_UNIX)
    client.connect(place + "/name")
    wait_for_go()
    client.sendall(b"through")

child = born(work)
accepted, _ = listener.accept()
os.unlink(place + "/name")
is_ready()
expect("what comes through", accepted.recv(100), b"through")
expect_child(child)
os.rmdir(place)
print("ok", flush=True)
"""


def test_an_ordinary_user_s_connection_to_a_name_that_is_gone_is_made_again(tmp_path: Path) -> None:
    """Its file is made by who restores; whoever had connected to it may connect to that."""
    tmp_path.chmod(0o755)
    goes_through_three_lives(CONNECTED_AS_NOBODY, tmp_path)


OWNERS = """
import fcntl
heard = []
signal.signal(signal.SIGUSR1, lambda *_: heard.append(1))
read_end, write_end = os.pipe()

def work():
    wait_for_go()
    os.write(write_end, b"x")
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR1])
    while not Path("told").exists():
        time.sleep(0.01)
    expect("a signal to the child", signal.sigwait([signal.SIGUSR1]), signal.SIGUSR1)

signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGUSR1])
child = born(work)
other_read, other_write = os.pipe()
for descriptor, owner in ((read_end, os.getpid()), (other_read, child)):
    fcntl.fcntl(descriptor, fcntl.F_SETOWN, owner)
    fcntl.fcntl(descriptor, fcntl.F_SETSIG, signal.SIGUSR1)
    fcntl.fcntl(descriptor, fcntl.F_SETFL, os.O_ASYNC | os.O_NONBLOCK)
is_ready()
expect("the signal", signal.sigwait([signal.SIGUSR1]), signal.SIGUSR1)
expect("the flags", fcntl.fcntl(read_end, fcntl.F_GETFL) & (os.O_ASYNC | os.O_NONBLOCK), os.O_ASYNC | os.O_NONBLOCK)
os.write(other_write, b"x")
Path("told").touch()
expect_child(child)
print("ok", flush=True)
"""


def test_signals_of_what_processes_share_go_to_whom_they_went(tmp_path: Path) -> None:
    goes_through_three_lives(OWNERS, tmp_path)


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


STRAYS = """
if os.getsid(0) != os.getpid():
    os.setsid()

def lead():
    os.setsid()
    os.waitpid(born(leave_behind), 0)
    Path("led").touch()
    wait_for_go()

def leave_behind():
    born(live_alone)

def live_alone():
    mine = os.getpgid(0), os.getsid(0)
    Path(f"alone{os.getpid()}").touch()
    wait_for_go()
    expect("group and session of an orphan", (os.getpgid(0), os.getsid(0)), mine)
    Path(f"alone{os.getpid()}").unlink()

os.waitpid(born(leave_behind), 0)
leader = born(lead)
while len(list(Path(".").glob("alone*"))) < 2 or not Path("led").exists():
    time.sleep(0.01)
is_ready()
expect_child(leader)
while list(Path(".").glob("alone*")):
    time.sleep(0.01)
print("ok", flush=True)
"""


@pytest.mark.parametrize("crowded", [False, True], ids=["", "where stand-ins find their pids taken"])
def test_processes_that_have_lost_their_parent_are_told_by_their_session(crowded: bool, tmp_path: Path) -> None:
    program = start([sys.executable, "-c", PREAMBLE + STRAYS], tmp_path)
    with ended(program):
        program.wait_for_line("ready")
        strays = set(descendants.component(program.pid)) - set(everybody_below(program.pid))
        with protected(program) as session:
            snapshot = transported(captured_at_last(session, CaptureOrder(hold=True)))
            everybody = [member.process.pid for member in snapshot.members]
            assert (len(everybody), len(strays)) == (3, 2)
            for pid in everybody:
                os.kill(pid, signal.SIGKILL)
            program.kill()
        for pid in strays | set(everybody):
            with contextlib.suppress(ChildProcessError):
                os.waitpid(pid, 0)
    highest = (pid for pid in range(procfs.pid_max() - 1, 0, -1) if pid not in {program.pid, *everybody})
    there = [spawn_vessel(Birth(inner_pid=pid)) for pid in itertools.islice(highest, 2 if crowded else 0)]
    try:
        again = restored(snapshot, tmp_path)
    finally:
        for one in there:
            discard(one)
    with ended(again):
        again.tell()
        expect_ok(again)
    for pid in strays:
        os.waitpid(pid, 0)


LEFT_BEHIND = """
import ctypes
if sys.argv[1:] == ["asks"]:
    ctypes.CDLL(None).prctl(36, 1, 0, 0, 0)  # PR_SET_CHILD_SUBREAPER
read_end, write_end = os.pipe()

def lead():
    os.setsid()
    born(live_alone)

def live_alone():
    mine = os.getsid(0)
    while os.getppid() == mine:
        time.sleep(0.01)
    os.write(write_end, b".")
    wait_for_go()
    expect("its session", os.getsid(0), mine)
    return 21

os.waitpid(born(lead), 0)
os.read(read_end, 1)
is_ready()
if sys.argv[1:] == ["asks"]:
    expect("the end of an orphan", os.waitstatus_to_exitcode(os.waitpid(-1, 0)[1]), 21)
print("ok", flush=True)
"""
"""The leader of a session has ended, and somebody of it lives on."""


def test_an_orphan_of_a_session_that_has_lost_its_leader_is_again_its_foster_parent_s(tmp_path: Path) -> None:
    goes_through_three_lives(LEFT_BEHIND, tmp_path, "asks")


def test_an_orphan_of_a_session_that_has_lost_its_leader_is_told_by_its_standard_streams(tmp_path: Path) -> None:
    with ended(start([sys.executable, "-c", PREAMBLE + LEFT_BEHIND], tmp_path)) as program:
        program.wait_for_line("ready")
        (stray,) = set(descendants.component(program.pid)) - {program.pid}
        assert stray not in everybody_below(program.pid)
        program.tell()
        expect_ok(program)
        os.waitpid(stray, 0)


FORKED = """
import hashlib, mmap
size = int(sys.argv[1]) << 20
memory = mmap.mmap(-1, size, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
for offset in range(0, size, 1 << 20):
    memory[offset : offset + (1 << 20)] = os.urandom(1 << 20)
begin = hashlib.sha256(memory).digest()

def work():
    number = os.getpid()
    memory[:4096] = bytes([number % 256]) * 4096
    memory.madvise(mmap.MADV_DONTNEED, 8192, 4096)
    os.write(write_end, b".")
    wait_for_go()
    expect("its own page", memory[:4096], bytes([number % 256]) * 4096)
    expect("a page that it gave back", memory[8192:12288], bytes(4096))
    expect("the rest", hashlib.sha256(memory[12288:]).digest(), rest)

rest = hashlib.sha256(memory[12288:]).digest()
read_end, write_end = os.pipe()
children = [born(work) for _ in range(5)]
for _ in children:
    os.read(read_end, 1)
is_ready()
memory[4096] = 1 ^ memory[4096]
memory[4096] = 1 ^ memory[4096]
expect("the first one's memory", hashlib.sha256(memory).digest(), begin)
for child in children:
    expect_child(child)
print("ok", flush=True)
"""


def shared_out(pids: list[int]) -> int:
    """Bytes of memory that these processes take, what they have in common once (PSS)."""
    lines = [line for pid in pids for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()]
    return sum(int(line.split()[1]) << 10 for line in lines if line.startswith("Pss_Anon:"))


def test_memory_that_a_family_has_in_common_since_a_fork_is_there_once(tmp_path: Path) -> None:
    program = start([sys.executable, "-c", PREAMBLE + FORKED, str(FAMILY_MIB)], tmp_path, isolate=True)
    last, taken = three_lives(program, lambda one: "ready\n" in one.output)
    with ended(last):
        everybody = [last.pid, *everybody_below(last.pid)]
        assert len(everybody) == 6
        once = FAMILY_MIB * MIB
        assert shared_out(everybody) < 1.2 * once + 16 * MIB
        assert len(taken[-1].contents) < 1.2 * once + 16 * MIB
        last.tell()
        expect_ok(last)


TERMINAL = """
import fcntl, pty, termios
master, slave = pty.openpty()
name = os.ttyname(slave)
os.close(slave)
read_end, write_end = os.pipe()

def lead():
    os.close(master)
    os.setsid()
    heard = []
    signal.signal(signal.SIGHUP, lambda *_: heard.append(1))
    os.close(os.open(name, os.O_RDWR))
    other = born(wait_for_go)
    os.setpgid(other, other)
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTTOU])
    terminal = os.open("/dev/tty", os.O_RDWR)
    os.tcsetpgrp(terminal, other)
    os.close(terminal)
    os.write(write_end, b".")
    wait_for_go()
    expect_child(other)
    terminal = os.open("/dev/tty", os.O_RDWR)
    expect("the terminal", os.ttyname(terminal), "/dev/tty")
    expect("the foreground", os.tcgetpgrp(terminal), other)
    os.close(terminal)
    os.write(write_end, b".")
    while not heard:
        time.sleep(0.01)

child = born(lead)
os.read(read_end, 1)
is_ready()
os.read(read_end, 1)
os.close(master)
expect_child(child)
print("ok", flush=True)
"""


def test_a_terminal_that_nobody_has_open_is_still_that_of_its_session(tmp_path: Path) -> None:
    goes_through_three_lives(TERMINAL, tmp_path)


SERVERS = """
import select, socket, ctypes
libc = ctypes.CDLL(None, use_errno=True)
listener = socket.socket(socket.AF_UNIX)
listener.bind("server")
listener.listen(64)
listener.setblocking(False)
waiting = select.epoll()
waiting.register(listener, select.EPOLLIN | select.EPOLLEXCLUSIVE)
watch = libc.inotify_init1(0o2000000)
libc.inotify_add_watch(watch, b".", 0x100)  # IN_CREATE

def serve():
    while not Path("enough").exists():
        for descriptor, _ in waiting.poll(0.02):
            try:
                one, _ = listener.accept()
            except BlockingIOError:
                continue
            one.sendall(str(os.getpid()).encode())
            one.close()

def ask():
    one = socket.socket(socket.AF_UNIX)
    one.connect("server")
    return int(one.recv(100))

def look():
    said = os.read(watch, 4096)
    expect("who came first", said[16:].rstrip(b"\\0").split(b"\\0")[0], b"go")

servers = [born(serve) for _ in range(3)]
for _ in range(10):
    expect("a server", ask() in servers, True)
looker = born(look)
is_ready()
expect_child(looker)
for _ in range(50):
    expect("a server", ask() in servers, True)
Path("enough").touch()
for child in servers:
    expect_child(child)
os.unlink("server")
print("ok", flush=True)
"""


def test_servers_that_wait_at_one_epoll_instance_go_on_serving(tmp_path: Path) -> None:
    goes_through_three_lives(SERVERS, tmp_path)


def test_the_other_half_of_a_pipeline_of_a_shell_is_nobody_s_orphan(tmp_path: Path) -> None:
    pipeline = "set -m; sleep 60 | sleep 60 & jobs -p; wait"
    program = start(["/bin/bash", "-c", pipeline], tmp_path, isolate=True)
    with ended(program):
        program.wait_until(lambda: len(everybody_below(program.pid)) == 2, "both halves")
        leader, _ = everybody_below(program.pid)
        assert os.getpgid(leader) == leader
        assert descendants.component(leader) == []


def test_what_a_shell_has_started_together_and_left_behind_are_strangers(tmp_path: Path) -> None:
    shell = subprocess.run(
        ["/bin/bash", "-c", "sleep 60 >&2 & sleep 60 >&2 & jobs -p"], stdout=subprocess.PIPE, check=True, start_new_session=True
    )
    left = [int(line) for line in shell.stdout.split()]
    try:
        assert os.getsid(left[0]) == os.getsid(left[1])
        assert [descendants.component(pid) for pid in left] == [[], []]
    finally:
        for pid in left:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)


def test_a_thousand_children_are_all_seen(tmp_path: Path) -> None:
    """The kernel tells some seven hundred at once."""
    births = "for _ in range(1000):\n    if not os.fork():\n        time.sleep(600)\n"
    births = f"import os, time\n{births}print('ready', flush=True)\ntime.sleep(600)"
    program = start([sys.executable, "-c", births], tmp_path, isolate=True)
    with ended(program):
        program.wait_for_line("ready")
        children = descendants.Children(program.pid)
        assert len(set(children.read([program.pid]))) == len(set(descendants.children(program.pid))) == 1000
        children.close()


SHARED = """
import mmap
size = 64 * mmap.PAGESIZE
memory = mmap.mmap(-1, size)
read_end, write_end = os.pipe()

def write():
    memory[size // 2 : size // 2 + 5] = b"child"

def work():
    memory[size - 4 : size] = b"tail"
    os.write(write_end, b".")
    wait_for_go()
    expect("what was written by one that has ended", memory[size // 2 : size // 2 + 5], b"child")
    expect("what it has written itself", memory[size - 4 : size], b"tail")

os.waitpid(born(write), 0)
child = born(work)
os.read(read_end, 1)
is_ready()
expect_child(child)
expect("what a child has written", memory[size - 4 : size], b"tail")
print("ok", flush=True)
"""


def test_shared_memory_that_only_children_have_written_is_whole(tmp_path: Path) -> None:
    """The parent's page tables tell nothing of it."""
    goes_through_three_lives(SHARED, tmp_path)


BORN_LATE = """
import hashlib
read_end, write_end = os.pipe()

def work():
    memory = os.urandom(1 << 20)
    digest = hashlib.sha256(memory).digest()
    os.write(write_end, b".")
    wait_for_go()
    expect("its memory", hashlib.sha256(memory).digest(), digest)

print("begun", flush=True)
while not os.path.exists("fork"):
    time.sleep(0.01)
child = born(work)
os.read(read_end, 1)
is_ready()
expect_child(child)
print("ok", flush=True)
"""


def test_a_child_whose_first_delta_was_lost_is_whole_in_the_next(tmp_path: Path) -> None:
    program = start([sys.executable, "-c", PREAMBLE + BORN_LATE], tmp_path, isolate=True)
    with ended(program), protected(program) as session:
        program.wait_for_line("begun")
        base = captured_at_last(session, CaptureOrder(base=True, sequence=1))
        session.acknowledge(base.position)
        (tmp_path / "fork").touch()
        program.wait_for_line("ready")
        lost = captured_at_last(session, CaptureOrder(base=False, sequence=2))
        delta = captured_at_last(session, CaptureOrder(base=False, sequence=3, hold=True))
        assert lost.parent == delta.parent == base.position
        chain = [transported(base), transported(delta)]
        program.kill()
    program = restored(chain, tmp_path)
    with ended(program):
        program.tell()
        expect_ok(program)


CROWD = """
held = bytearray(os.urandom(1 << 20) * 8)
child = born(lambda: wait_for_go() or 0 if sum(held[:1 << 20]) else 1)
is_ready()
expect_child(child)
print("ok", flush=True)
"""


def test_a_family_for_which_there_is_no_room_is_refused_by_name_and_runs_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = start([sys.executable, "-S", "-c", PREAMBLE + CROWD], tmp_path)
    with ended(program):
        program.wait_for_line("ready")
        with protected(program) as session:
            with monkeypatch.context() as little:
                little.setattr(memory_limits, "free", lambda: 16 * MIB)
                with pytest.raises(UnsupportedError, match=r"its processes hold 0\.0 GB together, and copying them takes"):
                    session.capture(CaptureOrder())
            snapshot = captured_at_last(session, CaptureOrder())
        with monkeypatch.context() as little:
            little.setattr(memory_limits, "free", lambda: 16 * MIB)
            (reason,) = memory_limits.refuse_restore(snapshot)
            assert "its processes hold 0.0 GB where each has its own" in reason
        assert memory_limits.refuse_restore(snapshot) == ()
        program.tell()
        expect_ok(program)
