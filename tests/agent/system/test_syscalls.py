"""System calls that the main loop and the guards make for themselves."""

from __future__ import annotations

import errno
import os
import re
import resource
import subprocess
import sys
import threading
from typing import Final

import pytest

from agent.guard import server
from agent.system import clock, syscalls
from tests.checkpoint.round_trip import as_nobody

LOCKED: Final = """
import threading
from agent.system import syscalls as kernel
kernel.small_stacks()
try:
    kernel.lock_memory()
except OSError:
    print("not allowed")
    raise SystemExit
def resident_kb():
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) for line in file if line.startswith("VmRSS:"))
before = resident_kb()
go = threading.Event()
threads = [threading.Thread(target=go.wait) for _ in range(2)]
for thread in threads:
    thread.start()
print(resident_kb() - before)
go.set()
for thread in threads:
    thread.join()
"""


def test_two_threads_of_a_process_that_is_locked_take_little_memory() -> None:
    found = subprocess.run([sys.executable, "-c", LOCKED], capture_output=True, text=True, check=True, timeout=60).stdout
    if "not allowed" in found:
        pytest.skip("this user may not lock memory")
    assert int(found) < 4096


LOCKED_FILES: Final = """
import mmap, sys, tempfile
from agent.system import syscalls as kernel
with tempfile.TemporaryFile() as file:
    file.truncate(1 << 20)
    unread = mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ, flags=mmap.MAP_PRIVATE)
    unused = mmap.mmap(-1, 1 << 20, flags=mmap.MAP_PRIVATE)
    try:
        kernel.lock_memory()
    except OSError:
        print("not allowed")
        raise SystemExit
    later = mmap.mmap(-1, 3 << 20, flags=mmap.MAP_PRIVATE)
    print(open("/proc/self/smaps").read())
"""


def test_of_a_process_that_is_locked_all_files_are_there_and_what_it_maps_later_but_no_memory_that_it_has_not_used() -> None:
    found = subprocess.run([sys.executable, "-c", LOCKED_FILES], capture_output=True, text=True, check=True, timeout=60).stdout
    if "not allowed" in found:
        pytest.skip("this user may not lock memory")
    mappings = [mapping.split() for mapping in re.split(r"(?m)^(?=[0-9a-f]+-[0-9a-f]+ )", found) if mapping.strip()]
    assert mappings
    mapped = [(fields[1], fields[4] != "0", kb_of(fields, "Size:"), kb_of(fields, "Rss:"), "lo" in fields) for fields in mappings]
    assert [one for one in mapped if one[0].startswith("r") and one[1] and (one[2] != one[3] or not one[4])] == []
    assert ("rw-p", False, 3072, 3072, True) in mapped
    resident = sum(rss for _, of_file, _, rss, _ in mapped if not of_file)
    assert resident <= sum(size for _, of_file, size, _, _ in mapped if not of_file) - 1024
    assert all(is_locked for mode, _, _, rss, is_locked in mapped if rss and mode.startswith("rw"))  # not the vdso


SOME_MAPPINGS: Final = """\
00400000-0041f000 r--p 00000000 08:01 131                        /usr/bin/python3.11
Size:                124 kB
Swap:                  0 kB
01c6b000-02054000 rw-p 00000000 00:00 0                          [heap]
Size:               4004 kB
Swap:                  0 kB
7f0000000000-7f0000021000 rw-p 00000000 00:00 0
Size:                132 kB
Swap:                  8 kB
7f0000021000-7f0004000000 ---p 00000000 08:01 132                /usr/lib/libz.so.1 (deleted)
Size:              65404 kB
Swap:                  0 kB
"""


def test_what_may_lie_on_a_disk_are_files_and_what_was_swapped_out() -> None:
    assert syscalls.on_disk(SOME_MAPPINGS.splitlines()) == [(0x400000, 0x1F000), (0x7F0000000000, 0x21000)]


def kb_of(fields: list[str], name: str) -> int:
    """A size out of one mapping's words in smaps."""
    return int(fields[fields.index(name) + 1])


@pytest.mark.root
@pytest.mark.parametrize("limit", [0, 1])
def test_a_user_whose_limit_allows_little_gets_that_and_is_told(limit: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The refusals are made here, as the kernel makes them: to raise our own limit would take CAP_SYS_RESOURCE."""
    had = os.SCHED_OTHER, 0

    def granted(_pid: int, policy: int, wanted: os.sched_param) -> None:
        nonlocal had
        if wanted.sched_priority > limit:
            raise PermissionError(errno.EPERM, "Operation not permitted")
        had = policy, wanted.sched_priority

    def settled() -> str:
        monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, limit))
        monkeypatch.setattr(os, "sched_setscheduler", granted)
        notes = [*server._settle(), *clock.become_realtime()]
        return "\n".join((f"{had[0]} {had[1]}", *notes))

    first, *notes = as_nobody(settled).splitlines()
    told = "\n".join(notes)
    if limit:
        assert first == f"{os.SCHED_FIFO | os.SCHED_RESET_ON_FORK} 1"
        assert "the guard has real-time priority 1, as keepers have" in told
        assert "beats run at real-time priority 1: " in told
    else:
        assert first == f"{os.SCHED_OTHER} 0"
        assert "the guard has no real-time priority" in told
        assert "beats run at normal priority" in told


@pytest.mark.root
def test_who_may_have_any_priority_gets_what_is_wanted_for_all_of_its_threads() -> None:
    before = {int(thread): policy_of(int(thread)) for thread in os.listdir("/proc/self/task")}
    end = threading.Event()
    another = threading.Thread(target=end.wait)
    another.start()
    try:
        assert (
            syscalls.become_realtime(server.REALTIME_PRIORITY) == os.sched_getparam(0).sched_priority == server.REALTIME_PRIORITY
        )
        assert another.native_id is not None
        assert policy_of(another.native_id) == policy_of(0) == (os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, server.REALTIME_PRIORITY)
    except PermissionError as error:
        pytest.skip(f"no real-time priority here: {error.strerror}")
    finally:
        end.set()
        another.join()
        for thread, (policy, priority) in before.items():
            os.sched_setscheduler(thread, policy, os.sched_param(priority))


def policy_of(thread: int) -> tuple[int, int]:
    return os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority
