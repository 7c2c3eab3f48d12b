"""A program of several processes that checks what it is: run as ``family.py GO``; ends when the file GO is there.

It has a worker that shares memory, a pipe and a file's offset with it; two zombies, one killed; a child that leads a session of
its own, with a child in a group of its own; and an orphan. Says "ready", counts, then says what differs, or "ok".
"""

import contextlib
import mmap
import os
import signal
import struct
import sys
import time
from pathlib import Path

GO = Path(sys.argv[1])
STEP_S = 0.01
memory = mmap.mmap(-1, 3 * mmap.PAGESIZE)  # MAP_SHARED | MAP_ANONYMOUS
read_end, write_end = os.pipe()
lines = os.open("lines", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
secret = bytes(range(256)) * 4096
parent, group, session = os.getpid(), os.getpgid(0), os.getsid(0)


def count(place):
    """Add one to a number in the shared memory."""
    (before,) = struct.unpack_from("<q", memory, 8 * place)
    struct.pack_into("<q", memory, 8 * place, before + 1)


def wait_for_go():
    while not GO.exists():
        time.sleep(STEP_S)


def work():
    while not GO.exists():
        count(1)
        os.write(write_end, b"x")
        os.write(lines, b"c")
        time.sleep(STEP_S)
    return 7 if secret == bytes(range(256)) * 4096 and os.getppid() == parent else 1


def lead():
    os.setsid()
    inner = born(follow)
    wait_for_go()
    return 20 + os.waitstatus_to_exitcode(os.waitpid(inner, 0)[1])


def follow():
    os.setpgid(0, 0)
    wait_for_go()
    return int((os.getsid(0), os.getpgid(0)) != (os.getppid(), os.getpid()))


def leave_an_orphan():
    born(live_alone)
    return 0


def live_alone():
    wait_for_go()
    told = f"{os.getppid() != parent} {os.getpgid(0) == group} {os.getsid(0) == session}"
    Path("aside").write_text(told)
    Path("aside").rename("orphan")
    return 0


def born(act):
    """Have a child do something and end with what it answers."""
    child = os.fork()
    if child == 0:
        os._exit(act())
    return child


def expect(what, found, wanted):
    if found != wanted:
        print(f"{what}: {found} instead of {wanted}", flush=True)
        sys.exit(1)


def status_of(child):
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


worker = born(work)
ended, killed = born(lambda: 3), born(signal.pause)
os.kill(killed, signal.SIGTERM)
leader = born(lead)
os.waitpid(born(leave_an_orphan), 0)
print("ready", flush=True)
os.set_blocking(read_end, False)
got = 0
while not GO.exists():
    count(0)
    os.write(lines, b"p")
    with contextlib.suppress(BlockingIOError):
        got += len(os.read(read_end, 1))
    print(got, flush=True)
    time.sleep(STEP_S)

expect("the worker", status_of(worker), 7)
mine, its = struct.unpack_from("<qq", memory, 0)
with contextlib.suppress(BlockingIOError):
    while True:
        got += len(os.read(read_end, 4096))
expect("what came through the pipe", got, its)
written = Path("lines").read_text()
expect("the lines of both", (written.count("p"), written.count("c"), len(written)), (mine, its, mine + its))
expect("one that had ended", status_of(ended), 3)
expect("one that was killed", status_of(killed), -signal.SIGTERM)
expect("the leader of a session", status_of(leader), 20)
try:
    expect("further children", os.waitpid(-1, 0), None)
except ChildProcessError:
    pass
while not Path("orphan").exists():
    time.sleep(STEP_S)
expect("the orphan", Path("orphan").read_text(), "True True True")
print("ok", flush=True)
