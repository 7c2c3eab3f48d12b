"""Data that waits in sockets is read in place: the program's own looks (MSG_PEEK) find what they would find without us."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn

import pytest

from checkpoint.engine import CaptureOrder
from checkpoint.resources.sockets import sockets
from checkpoint.resources.survey import glance
from tests.checkpoint.round_trip import Program, captured_at_last, ended, expect_ok, protected, start

pytestmark = [pytest.mark.root]

PEEKING = """
import os, socket, sys
pairs = [socket.socketpair(socket.AF_UNIX, kind) for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM, socket.SOCK_SEQPACKET)]
pairs.append((socket.socket(socket.AF_INET, socket.SOCK_DGRAM), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)))
pairs[3][0].bind(("127.0.0.1", 0))
pairs[3][1].connect(pairs[3][0].getsockname())
for receiver, sender in pairs:
    if len(sys.argv) > 1:
        receiver.setsockopt(socket.SOL_SOCKET, 42, int(sys.argv[1]))
    for message in (b"first", b"second", b"third"):
        sender.send(message)
print("ready", [receiver.fileno() for receiver, _ in pairs], flush=True)
wrong = 0
while not os.path.exists("go"):
    for receiver, _ in pairs:
        if len(sys.argv) == 1:
            wrong += receiver.recv(5, socket.MSG_PEEK) != b"first"
print("ok" if not wrong else f"{wrong} looks found something else", flush=True)
"""


@contextlib.contextmanager
def peeking(directory: Path, *offset: str) -> Iterator[Program]:
    """A program that looks at what waits in its sockets, all the time; a program with an offset of its own does not."""
    with ended(start([sys.executable, "-c", PEEKING, *offset], directory)) as program:
        program.wait_until(lambda: "ready" in program.output, "its sockets")
        yield program


def offsets(program: Program) -> set[int]:
    """SO_PEEK_OFF of each of its sockets."""
    found = set()
    for number in program.output.partition("[")[2].partition("]")[0].split(","):
        with sockets.looked_into(program.pid, int(number)) as looked:
            found.add(looked.getsockopt(socket.SOL_SOCKET, sockets.SO_PEEK_OFF))
    return found


def test_a_program_that_runs_finds_what_it_would_find_while_its_sockets_are_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look, seen = sockets._peeked, set()

    def watched(looked: socket.socket, count: int, identify: sockets.Identify) -> sockets.Queue:
        seen.add(looked.getsockopt(socket.SOL_SOCKET, sockets.SO_PEEK_OFF))
        return look(looked, count, identify)

    with peeking(tmp_path) as program:
        with monkeypatch.context() as patch:
            patch.setattr(sockets, "_peeked", watched)
            glance(program.pid)
        assert seen == {-1}, "set while it runs"
        for _ in range(3):
            with protected(program) as session:
                snapshot = captured_at_last(session, CaptureOrder())
        queues = [queue for held in snapshot.resources if (queue := held.facts.get("queue"))]
        assert queues == [[b"firstsecondthird"], *3 * [[b"first", b"second", b"third"]]]
        assert offsets(program) == {-1}
        program.tell()
        expect_ok(program)


@pytest.mark.parametrize("own", [-1, 3], ids=["the kernel's", "its own"])
def test_an_offset_that_a_dead_keeper_has_left_is_put_back_by_the_next_one(own: int, tmp_path: Path) -> None:
    with peeking(tmp_path, str(own)) as program:
        keeper = os.fork()
        if not keeper:
            _die_in_the_middle(program)
        assert os.waitstatus_to_exitcode(os.waitpid(keeper, 0)[1]) == -signal.SIGKILL
        assert offsets(program) == {own, 0}
        with protected(program) as session:
            assert offsets(program) == {own}
            captured_at_last(session, CaptureOrder())
        assert offsets(program) == {own}


def _die_in_the_middle(program: Program) -> NoReturn:
    """Capture it, and be killed when the first of its sockets has been told to look behind the first message."""
    look = sockets._peeked

    def killed(looked: socket.socket, count: int, identify: sockets.Identify) -> sockets.Queue:
        if count > 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return look(looked, count, identify)

    sockets._peeked = killed
    with contextlib.suppress(BaseException), protected(program) as session:
        captured_at_last(session, CaptureOrder())
    os._exit(1)
