"""The program's end of the task socket: what its guard may say, what it may not, and the case without a guard."""

from __future__ import annotations

import array
import contextlib
import os
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from checkpoint.segment.task_messages import (
    TAKEN_OVER,
    VARIABLE,
    Begin,
    Hello,
    Keeps,
    Origin,
    Refused,
    Safe,
    encode,
    from_program,
)
from failover.errors import NotCommittedError, TaskError
from failover.kept_state.agent_link import Guarded, guarded

BEGIN = encode(Begin("/lab/heater", 3, (1, 2)))
RESUMED = encode(Begin("/lab/heater", 4, (1, 2), Origin("robot1", 129, TAKEN_OVER, 5)))

Guard = Callable[[socket.socket], None]


@contextlib.contextmanager
def listening(guard: Guard, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A guard that hears one program, and hangs up when it has said its say."""
    name = f"failover.{secrets.token_hex(8)}"
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind("\0" + name)
    listener.listen(1)
    listener.settimeout(30)

    def serve() -> None:
        program, _ = listener.accept()
        with program:
            program.settimeout(30)
            guard(program)

    thread = threading.Thread(target=serve)
    thread.start()
    monkeypatch.setenv(VARIABLE, "@" + name)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # nobody came
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as last:
                last.connect("\0" + name)
        thread.join(30)
        listener.close()


def says(*contents: bytes, descriptors: int = 0) -> Guard:
    """Answer the first packet with these; the first of them carries empty files."""

    def guard(program: socket.socket) -> None:
        assert from_program(program.recv(1024)) == Hello()
        for index, content in enumerate(contents):
            files = [os.memfd_create("empty") for _ in range(descriptors if index == 0 else 0)]
            ancillary = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", files))] if files else []
            with contextlib.suppress(BrokenPipeError):
                program.sendmsg([content], ancillary)
            for file in files:
                os.close(file)

    return guard


def opened() -> Guarded:
    found = guarded()
    assert found is not None
    return found


def test_a_program_without_a_guard_keeps_its_state_itself(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    assert guarded() is None
    for odd in ("", "7", "@failover.", "@failover.0123456789ABCDEF", "@another.0123456789abcdef", "@failover.0123456789abcdef\n"):
        monkeypatch.setenv(VARIABLE, odd)
        assert guarded() is None
    assert not caplog.records
    monkeypatch.setenv(VARIABLE, "@failover.0123456789abcdef")
    assert guarded() is None
    assert "no guard listens" in caplog.text and VARIABLE not in os.environ


def test_a_program_is_told_why_its_guard_will_not_have_it(monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        listening(says(encode(Refused("pid 7 keeps its state already"))), monkeypatch),
        pytest.raises(TaskError, match="under the agent: pid 7 keeps"),
    ):
        guarded()


@pytest.mark.parametrize("is_late", [False, True])
def test_a_guard_that_hung_up_before_it_read_everything_is_heard_all_the_same(is_late: bool) -> None:
    """Before the program says anything, or in the instant after."""
    first, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)

    def hang_up() -> None:
        theirs.send(encode(Refused("another keeps it")))
        theirs.close()

    class Ours(socket.socket):
        def send(self, content: Any, flags: int = 0) -> int:
            sent = super().send(content, flags)
            hang_up()
            return sent

    with Ours(fileno=first.detach()) as ours:
        if not is_late:
            ours.send(b"unread")
        with pytest.raises(TaskError, match="another keeps it"):
            Guarded(ours)


@pytest.mark.parametrize(
    ("contents", "descriptors", "sentence"),
    [
        ((), 0, "has gone"),
        ((b"\x02\0\0\0",), 0, "a packet of 4 bytes"),
        ((encode(Safe(7)),), 0, "says something else"),
        ((BEGIN,), 0, "says something else"),
        ((BEGIN,), 2, "says something else"),
        ((RESUMED,), 1, "says something else"),
        ((BEGIN + b"\0",), 1, "kind 2 has 376 bytes"),
    ],
)
def test_a_guard_that_makes_no_sense_is_refused_and_leaves_nothing_open(
    monkeypatch: pytest.MonkeyPatch, contents: tuple[bytes, ...], descriptors: int, sentence: str
) -> None:
    before = sorted(os.listdir("/proc/self/fd"))
    with listening(says(*contents, descriptors=descriptors), monkeypatch), pytest.raises(TaskError, match=sentence):
        guarded()
    assert sorted(os.listdir("/proc/self/fd")) == before


@settings(max_examples=60, deadline=None)
@given(st.binary(min_size=1, max_size=600))
def test_whatever_comes_instead_of_a_beginning_is_a_task_error(content: bytes) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        theirs.send(content)
        with pytest.raises(TaskError):
            Guarded(ours)


def test_a_commit_is_told_once_a_segment_and_is_safe_when_the_guard_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[bytes] = []

    def guard(program: socket.socket) -> None:
        says(BEGIN, descriptors=1)(program)
        heard.append(program.recv(1024))
        program.send(encode(Safe(2)))
        heard.append(program.recv(1024))

    with listening(guard, monkeypatch):
        found = opened()
        for segment in (1, 1, 1, 2):
            found.notice(segment)
        found.wait(2, 30)
        with pytest.raises(NotCommittedError, match="has gone"):
            found.wait(3, 30)
        found.notice(3)  # to nobody: no trouble
        found.close()
    assert heard == [encode(Keeps())] * 2


def test_a_forked_child_does_not_hold_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    ended = threading.Event()

    def guard(program: socket.socket) -> None:
        says(BEGIN, descriptors=1)(program)
        assert program.recv(1024) == b"", "it hung up"
        ended.set()

    with listening(guard, monkeypatch):
        found = opened()
        hold, release = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(release)
            os.read(hold, 1)
            os._exit(0)
        found.close()
        try:
            assert ended.wait(20), "the parent's end is the end, though its child lives"
        finally:
            os.close(release)
            os.close(hold)
            os.waitpid(child, 0)
