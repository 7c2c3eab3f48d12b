"""What processes have in common and open: files without a name, pipes, sockets, pidfds, a terminal, epoll instances."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.checkpoint.engines.ptrace.capture.test_trees import three_lives
from tests.checkpoint.engines.ptrace.restore.families import PREAMBLE, goes_through_three_lives
from tests.checkpoint.round_trip import (
    ended,
    expect_ok,
    start,
)

pytestmark = pytest.mark.root

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


def test_a_file_without_a_name_that_two_processes_have_opened_is_one_file(tmp_path: Path) -> None:
    goes_through_three_lives(NAMELESS, tmp_path)


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
