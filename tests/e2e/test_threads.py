"""A program of several threads at one robot, whose power fails: all resume at the other one, confined as they were."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.e2e import robots

pytestmark = pytest.mark.root


COUNTING = """
import ctypes, os, queue, struct, threading, time
getitimer, rt_sigtimedwait, getppid = {"x86_64": (36, 128, 110), "aarch64": (102, 137, 173)}[os.uname().machine]
load, kill, answer, allow = (0x20, 0, 0, 0), (6, 0, 0, 0x80000000), (6, 0, 0, 0x50000 | 18), (6, 0, 0, 0x7FFF0000)
equal = lambda number: (0x15, 0, 1, number)
code = [load, equal(getitimer), kill, equal(rt_sigtimedwait), kill, equal(getppid), answer, allow]
content = ctypes.create_string_buffer(b"".join(struct.pack("<HBBI", *one) for one in code))
libc = ctypes.CDLL(None, use_errno=True)
assert libc.prctl(38, 1, 0, 0, 0) == 0
assert libc.prctl(22, 2, struct.pack("HxxxxxxP", len(code), ctypes.addressof(content)), 0, 0) == 0
there, back = queue.Queue(2), queue.Queue(2)
counted = {"first": 0, "second": 0, "third": 0}
def pass_on():
    while True:
        counted["second"] += 1
        back.put(there.get())
def beside():
    while True:
        assert libc.syscall(getppid) == -1 and ctypes.get_errno() == 18
        counted["third"] += 1
        time.sleep(0.005)
def feed():
    number = 0
    while True:
        there.put(number)
        number += 1
        counted["first"] += 1
        time.sleep(0.01)
for act in (pass_on, beside, feed):
    threading.Thread(target=act, daemon=True).start()
while True:
    assert libc.syscall(getppid) == -1 and ctypes.get_errno() == 18
    print(back.get(), flush=True)
"""
"""Counts by handing each number from thread to thread.

It runs under a seccomp filter that kills for calls which only a capture makes in it (getitimer, rt_sigtimedwait), and by which
getppid answers EXDEV.
"""


def test_all_threads_of_a_program_go_on_at_the_other_robot(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, "") as (first, second):
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNTING)
        robots.until_protected(first)
        robots.counts_on_elsewhere(first, second, 50)
