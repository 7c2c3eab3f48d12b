"""Sockets: what a restore says of them, and which process they say they belong to."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from checkpoint.engine import RestoreOptions
from checkpoint.errors import CaptureError
from checkpoint.linux.net import inet_diag, sock_diag
from checkpoint.linux.procfs import procfs
from checkpoint.linux.spawn.vessel import Birth, discard, spawn_vessel
from checkpoint.model import Snapshot
from checkpoint.resources.survey import gather, with_contents
from tests.checkpoint.round_trip import ENGINE, Program, captured_and_killed, ended, expect_ok, start_tracee

pytestmark = [pytest.mark.compiler, pytest.mark.root]

NLMSG_DONE = 3

Compiled = Callable[..., Path]


def restored_with_notes(state: Snapshot, directory: Path) -> tuple[Program, tuple[str, ...]]:
    """Bring a base back and let it run; and what the restore says of it."""
    streams = [
        os.open(os.devnull, os.O_RDONLY),
        *(os.open(directory / name, os.O_WRONLY | os.O_APPEND) for name in ("out", "err")),
    ]
    born = spawn_vessel(Birth(inner_pid=state.process.pid, stdio=(streams[0], streams[1], streams[2])))
    for stream in streams:
        os.close(stream)
    try:
        program = ENGINE.restore(born.pid, state, RestoreOptions(0))
        program.resume()
    except BaseException:
        discard(born)
        raise
    return Program(born, directory), tuple(program.notes)


@pytest.mark.parametrize("case", ["accepted_stream_4", "accepted_stream_6"])
def test_options_that_a_stream_shows_but_cannot_be_given_are_not_noted_as_lost(
    case: str, compiled: Compiled, tmp_path: Path
) -> None:
    with ended(start_tracee(compiled("internet_sockets", "-O2"), tmp_path, case)) as tracee:
        snapshot = captured_and_killed(tracee)
    tracee, notes = restored_with_notes(snapshot, tmp_path)
    with ended(tracee):
        assert notes == ()
        tracee.tell()
        expect_ok(tracee)


def test_a_list_that_the_kernel_does_not_have_is_asked_for_once() -> None:
    """It would look for a module each time, while the program stands still."""
    unassigned = socket.AF_INET, 200
    for _ in range(2):
        assert inet_diag.shut_down(*unassigned) == {}
        assert unassigned in inet_diag._WITHOUT


def answers_in_turn(monkeypatch: pytest.MonkeyPatch, lists: list[tuple[bytes, int]]) -> None:
    """Have the kernel answer questions with lists of one entry each, of this content and with these flags."""
    done = sock_diag.HEADER.pack(sock_diag.HEADER.size + 4, NLMSG_DONE, 2, 1, 0) + bytes(4)

    def opened() -> socket.socket:
        ours, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        content, flags = lists.pop(0)
        size = sock_diag.HEADER.size + len(content)
        other.send(sock_diag.HEADER.pack(size, sock_diag.SOCK_DIAG_BY_FAMILY, 2 | flags, 1, 0) + content)
        other.send(done)
        others.append(other)
        return ours

    others: list[socket.socket] = []
    monkeypatch.setattr(sock_diag, "opened", opened)


def test_a_list_that_was_interrupted_is_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    answers_in_turn(monkeypatch, [(b"torn", sock_diag.NLM_F_DUMP_INTR), (b"torn", sock_diag.NLM_F_DUMP_INTR), (b"good", 0)])
    assert list(sock_diag.listed(b"")) == [b"good"]


def test_a_list_that_is_interrupted_each_time_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    answers_in_turn(monkeypatch, [(b"torn", sock_diag.NLM_F_DUMP_INTR)] * sock_diag.TRIES)
    with pytest.raises(CaptureError, match="changed 5 times while it was read"):
        inet_diag.shut_down(socket.AF_INET, socket.IPPROTO_UDP)


def test_the_kernels_lists_are_read_once_however_many_sockets_there_are(monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []

    def counted(pid: int, name: str) -> str:
        read.append(name)
        return read_text(pid, name)

    read_text = procfs.read_text
    monkeypatch.setattr(procfs, "read_text", counted)
    with contextlib.ExitStack() as stack:
        ours = [
            stack.enter_context(socket.socket(*form))
            for form in ((socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP), (socket.AF_NETLINK, socket.SOCK_RAW, 0))
            for _ in range(5)
        ]
        for one in ours[:5]:
            one.connect(("127.0.0.1", 0))
        seen = with_contents(gather(os.getpid()), None)
        facts = {held.first.number: held.observed for held in seen}
        assert all(facts[one.fileno()]["peer"] == ["127.0.0.1", 0] for one in ours[:5])
        assert all(facts[one.fileno()]["port"] == 0 for one in ours[5:])
    assert read.count("net/raw") == 1
    assert read.count("net/netlink") == 1
