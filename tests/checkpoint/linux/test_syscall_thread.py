"""A second thread makes half of the calls about many sockets: however it fares, the answers are the same."""

from __future__ import annotations

import array
import contextlib
import gc
import os
import signal
import socket
import threading
import time
import weakref
from collections.abc import Callable, Iterator

import pytest

from checkpoint.arch import stubs
from checkpoint.linux import batch_syscalls
from checkpoint.linux.batch_syscalls import ROW, OwnCalls, row
from checkpoint.linux.net import socket_queries
from checkpoint.linux.net.socket_queries import WORTH_SHARING, Asking, Subject
from checkpoint.linux.syscall_thread import SecondThread
from checkpoint.resources.sockets import sockets

pytestmark = pytest.mark.skipif(not stubs.SECOND_LOOP, reason="this processor has no loop for a second thread")

COUNTS = (WORTH_SHARING - 1, WORTH_SHARING, WORTH_SHARING + 1, 3 * WORTH_SHARING)
LIMIT_S = 60


def wait_until(holds: Callable[[], bool]) -> None:
    deadline = time.monotonic() + LIMIT_S
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def second_thread() -> SecondThread:
    """One, on a machine of one processor, too."""
    return SecondThread(batch_syscalls.instructions(stubs.SECOND_LOOP))


@pytest.fixture
def second() -> Iterator[SecondThread]:
    with contextlib.closing(second_thread()) as made:
        yield made


@pytest.fixture
def descriptors() -> Iterator[list[int]]:
    """Of sockets that all answer differently."""
    with contextlib.ExitStack() as stack:
        made = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(max(COUNTS))]
        for ttl, one in enumerate(made, 1):
            one.bind(("127.0.0.1", 0))
            one.setsockopt(socket.IPPROTO_IP, socket.IP_TTL, ttl)
            one.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")  # who is asked with room for as much says no
        made[-2].setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16384)  # of which more is asked
        yield [one.fileno() for one in made]


def asking() -> Asking:
    """Questions to such sockets, for two threads."""
    form = sockets.Form(int(socket.AF_INET), int(socket.SOCK_DGRAM), socket.IPPROTO_UDP)
    made = Asking(Subject(form.family, form.type, form.protocol, socket_queries.sized(sockets.fresh_options(form))))
    made.reserve(max(COUNTS), is_shared=True)
    return made


class Stuck(SecondThread):
    """One that falls asleep after it has asked a few of its half, until something is written to the pipe."""

    AFTER = 3

    def __init__(self) -> None:
        super().__init__(batch_syscalls.instructions(stubs.SECOND_LOOP))
        self._pipe = os.pipe()
        self._read = bytearray(1)

    def begin(self, table: OwnCalls, last: int, keeps: object = None) -> None:
        each = last // (max(COUNTS) // 2)
        place = array.array("B", [0])
        rows = [tuple(map(int, one)) for one in table.entries[:last]]
        rows.insert(self.AFTER * each, row("read", self._pipe[0], place.buffer_info()[0], 1))
        super().begin(OwnCalls(rows), len(rows), (table, keeps, place))
        wait_until(lambda: self.made() == self.AFTER * each)

    def wake(self) -> None:
        os.write(self._pipe[1], b"!")

    def close(self) -> None:
        self.wake()
        super().close()
        for end in self._pipe:
            os.close(end)


@pytest.mark.parametrize("count", COUNTS)
def test_two_hear_what_one_hears(count: int, second: SecondThread, descriptors: list[int]) -> None:
    ours = asking()
    expected = ours.ask_each(descriptors)
    assert len(set(expected)) == len(expected)
    for _ in range(20):
        assert ours.ask_each(descriptors[:count], second) == expected[:count]
        wait_until(second.is_at_rest)


def test_the_second_has_asked_some_of_them(descriptors: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Its answers are those that are taken: nobody asks those sockets again."""
    with contextlib.closing(Stuck()) as second:
        ours, asked = asking(), []
        run = OwnCalls.run
        monkeypatch.setattr(OwnCalls, "run", lambda table, *rows: (asked.append((table, rows)), run(table, *rows)))
        ours.ask_each(descriptors, second)
        made = sum(last - first for table, (first, last) in ((t, r) for t, r in asked if r) if table is ours._sheet.table)
    assert made == (len(descriptors) - Stuck.AFTER) * ours._always


def test_one_that_gets_stuck_is_not_waited_for(descriptors: list[int]) -> None:
    ours = asking()
    expected = ours.ask_each(descriptors)
    with contextlib.closing(Stuck()) as second:
        for _ in range(3):
            assert ours.ask_each(descriptors, second) == expected
            assert not second.is_at_rest()
        second.wake()
        wait_until(second.is_at_rest)
        assert ours.ask_each(descriptors, second) == expected


@pytest.mark.parametrize("is_prepared", [False, True])
def test_nothing_of_an_earlier_answer_is_left_in_the_next_question(is_prepared: bool, descriptors: list[int]) -> None:
    """Whoever of the two has asked, and however many."""
    ours = asking()
    expected = ours.ask_each(descriptors)
    gone = SecondThread(batch_syscalls.instructions(b"\xc3"))
    with contextlib.closing(second_thread()) as working, contextlib.closing(Stuck()) as stuck:
        for second in (stuck, gone, None, working, working, stuck, working, None):
            for count in COUNTS[::-1]:
                if is_prepared:
                    ours.prepare(second)
                assert ours.ask_each(descriptors[:count], second) == expected[:count]
                wait_until(lambda second=second: second in (None, stuck, gone) or second.is_at_rest())
    gone.close()


def test_what_is_late_is_not_taken_for_an_answer(descriptors: list[int]) -> None:
    """It makes its last call when the next are asked already, of other sockets."""
    ours = asking()
    turned = descriptors[::-1]
    expected = ours.ask_each(turned)
    with contextlib.closing(Stuck()) as second:
        ours.ask_each(descriptors, second)
        assert ours.ask_each(turned, second) == expected
        second.wake()
        wait_until(second.is_at_rest)
        with contextlib.closing(second_thread()) as other:
            assert ours.ask_each(turned, other) == expected


def test_one_that_does_nothing_is_not_waited_for(descriptors: list[int]) -> None:
    ours = asking()
    expected = ours.ask_each(descriptors)
    gone = SecondThread(batch_syscalls.instructions(b"\xc3"))  # returns at once
    for _ in range(3):
        assert ours.ask_each(descriptors, gone) == expected
    gone.close()
    assert ours.ask_each(descriptors, gone) == expected


def test_a_child_of_a_fork_has_no_second_and_hears_the_same(second: SecondThread, descriptors: list[int]) -> None:
    ours = asking()
    expected = ours.ask_each(descriptors, second)
    child = os.fork()
    if child == 0:
        same = [ours.ask_each(descriptors, second) == expected for _ in range(3)]
        second.close()
        os._exit(0 if all(same) else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    wait_until(second.is_at_rest)
    assert ours.ask_each(descriptors, second) == expected


def test_it_makes_the_calls_of_one_table_after_the_other_in_order_and_stops_when_it_is_told(second: SecondThread) -> None:
    reading, writing = os.pipe()
    results = array.array("q", [7] * 4)
    place = results.buffer_info()[0]
    for _ in range(2):
        buffer = array.array("B", [0])
        table = OwnCalls(
            [
                row("getpid", to=place),
                row("close", -1, to=place + 8),
                row("read", reading, buffer.buffer_info()[0], 1, to=place + 16),
                row("getpid", to=place + 24),
            ]
        )
        results[:] = array.array("q", [7] * 4)
        second.begin(table, 4, buffer)
        wait_until(lambda: second.made() == 2)
        assert results.tolist() == [os.getpid(), -9, 7, 7]
        second.stop()
        assert not second.is_at_rest()
        os.write(writing, b"!")
        wait_until(second.is_at_rest)
        assert results.tolist() == [os.getpid(), -9, 1, 7]
    os.close(reading)
    os.close(writing)


def tids() -> set[int]:
    return set(map(int, os.listdir("/proc/self/task")))


def test_it_ends_with_close_and_with_the_object() -> None:
    before = tids()
    second = second_thread()
    (tid,) = tids() - before
    second.close()
    second.close()
    wait_until(lambda: tid not in tids())
    second = second_thread()
    (tid,) = tids() - before
    del second
    gc.collect()
    wait_until(lambda: tid not in tids())


def test_what_it_may_still_write_to_is_not_given_back() -> None:
    """Not even if everybody else has forgotten it."""
    with contextlib.closing(Stuck()) as second:
        table, keeps = OwnCalls([row("getpid")] * (max(COUNTS) // 2) * ROW), threading.Event()
        known = weakref.ref(keeps)
        second.begin(table, len(table.entries), keeps)
        second.stop()
        del table, keeps
        gc.collect()
        assert known() is not None
    del second
    gc.collect()
    assert known() is None


def test_signals_are_for_others(second: SecondThread) -> None:
    def blocked() -> int:
        with open(f"/proc/self/task/{second._thread.native_id}/status") as file:
            return next(int(line.split()[1], 16) for line in file if line.startswith("SigBlk"))

    wanted = sum(1 << (number - 1) for number in (signal.SIGTERM, signal.SIGINT, signal.SIGCHLD, signal.SIGALRM))
    wait_until(lambda: blocked() & wanted == wanted)


def test_there_is_none_where_there_is_one_processor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {1})
    assert SecondThread.where_it_gains() is None


def test_there_is_none_where_the_system_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})

    def refused(self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refused)
    assert SecondThread.where_it_gains() is None


@pytest.mark.root
def test_it_has_the_precedence_of_the_first(second: SecondThread) -> None:
    seen, tid = [], second._thread.native_id
    assert tid is not None
    try:
        for policy, priority in ((os.SCHED_RR, 1), (os.SCHED_OTHER, 0), (os.SCHED_RR, 1)):
            os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
            second.begin(OwnCalls([row("getpid")]), 1)
            second.stop()
            seen.append((os.sched_getscheduler(tid) & ~os.SCHED_RESET_ON_FORK, os.sched_getparam(tid).sched_priority))
            wait_until(second.is_at_rest)
    except PermissionError:
        pytest.skip("no real-time priorities here")
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    assert seen == [(os.SCHED_RR, 1), (os.SCHED_OTHER, 0), (os.SCHED_RR, 1)]
