"""failover.h under an agent: it speaks TASK.md, here with a guard of the test's own that knows the document's bytes alone."""

from __future__ import annotations

import array
import fcntl
import os
import secrets
import socket
import struct
import subprocess
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from checkpoint.engines.cooperative.session import open_segment
from checkpoint.segment.layout import ARRAY, PENDING, Committed, Layout, Region, address_of
from checkpoint.segment.writer import SegmentWriter, Source
from tests.include.programs import environment, program

pytestmark = pytest.mark.compiler

HELLO, KEEPS = struct.pack("<II", 1, 1), struct.pack("<II", 4, 1)
COUNTERS_SIZE, LARGE = 4096, 200_000
LIMIT_S = 20


def begin(pipes: tuple[int, int], why: int = 0, robot: str = "", generation: int = 0, age_ns: int = 0) -> bytes:
    return struct.pack(
        "<IIQQQIIQQ256s64s", 2, 1, 3, *pipes, why, 0, generation, age_ns, b"/lab/guarded", robot.encode()
    )  # fmt: skip


def refused(why: str) -> bytes:
    return struct.pack("<II504s", 3, 1, why.encode())


def safe(commit: int) -> bytes:
    return struct.pack("<IIQ", 5, 1, commit)


@dataclass
class Guarded:
    """The program, and the test's ends: of its socket, its pipes, its answers and the counters of its output."""

    process: subprocess.Popen[bytes]
    end: socket.socket
    answers: socket.socket
    counters: int
    pipes: tuple[int, int]

    def send(self, packet: bytes, *descriptors: int) -> None:
        socket.send_fds(self.end, [packet], list(descriptors))

    def begins(self) -> None:
        """Tell it to begin."""
        self.send(begin(self.pipes), self.counters)
        assert self.answer() == "open 0"
        assert self.answer() == "at 0, epoch 3, last byte 0"

    def asks(self, letter: str) -> str:
        assert self.process.stdin is not None
        self.process.stdin.write(letter.encode())
        self.process.stdin.flush()
        return self.answer()

    def answer(self) -> str:
        """One line of what it says on descriptor 3."""
        line = b""
        while not line.endswith(b"\n"):
            more = self.answers.recv(1)
            assert more, f"it ended after {line!r}"
            line += more
        return line.decode().strip()

    def empty(self) -> int:
        """Take what its standard output holds, and count it as a guard does."""
        assert self.process.stdout is not None
        waiting = array.array("i", [0])
        fcntl.ioctl(self.process.stdout, termios.FIONREAD, waiting)
        taken = os.read(self.process.stdout.fileno(), waiting[0]) if waiting[0] else b""
        (before,) = struct.unpack("<Q", os.pread(self.counters, 8, 8))
        os.pwrite(self.counters, struct.pack("<Q", before + len(taken)), 8)
        return len(taken)

    def committed(self) -> Committed:
        reader = open_segment(self.process.pid)
        try:
            found = reader.read()
        finally:
            reader.close()
        assert found is not None
        return found


@contextmanager
def listening() -> Iterator[tuple[socket.socket, str]]:
    """A guard's socket, and what it is called in the program's environment."""
    name = f"failover.{secrets.token_hex(8)}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        listener.settimeout(LIMIT_S)
        listener.bind(f"\0{name}")
        listener.listen()
        yield listener, f"@{name}"


@contextmanager
def program_with(task: str, folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], socket.socket]]:
    """The program, told of a guard; and the other end of its descriptor 3."""
    pipe = subprocess.PIPE
    ours, its = socket.socketpair()
    ours.settimeout(LIMIT_S)

    def third() -> None:
        os.dup2(its.fileno(), 3)

    path = program("guarded")
    with ours, subprocess.Popen(
        path, stdin=pipe, stdout=pipe, stderr=pipe, preexec_fn=third, pass_fds=(3,),
        env=environment(folder, FAILOVER_TASK=task),
    ) as process:  # fmt: skip
        its.close()
        try:
            yield process, ours
        finally:
            process.kill()


@pytest.fixture
def guarded(tmp_path: Path) -> Iterator[Guarded]:
    """A program that has said Hello."""
    counters = os.memfd_create("counters")
    os.ftruncate(counters, COUNTERS_SIZE)
    with listening() as (listener, task), program_with(task, tmp_path) as (process, answers):
        assert process.stdout is not None and process.stderr is not None
        end, _ = listener.accept()
        with end:
            end.settimeout(LIMIT_S)
            assert end.recv(600) == HELLO
            pipes = (os.fstat(process.stdout.fileno()).st_ino, os.fstat(process.stderr.fileno()).st_ino)
            yield Guarded(process, end, answers, counters, pipes)
    os.close(counters)
    assert not list(tmp_path.iterdir()), "there is no file beside a program that has a guard"


def handed(number: int, size: int = LARGE) -> SegmentWriter:
    """A segment as a guard hands one over, with the state of the program at that number."""
    sizes = {"number": 8, "large": size}
    regions = tuple(Region(name, ARRAY, address_of(place), sizes[name]) for place, name in enumerate(sizes))
    writer = SegmentWriter(Layout(regions, bytes(16)), number=number - 1)
    large = np.full(size, number, dtype=np.uint8)
    assert writer.commit([Source(number.to_bytes(8, "little")), Source(large)])
    return writer


def test_a_program_begins_keeps_and_hears_what_is_safe(guarded: Guarded) -> None:
    guarded.begins()
    assert guarded.asks("c") == "commit 1"
    assert guarded.end.recv(600) == KEEPS
    assert guarded.asks("c") == "commit 2"
    found = guarded.committed()
    assert (found.number, found.region(0)[0], found.outputs) == (2, 2, (4, 0)), "two lines, however they are buffered"
    assert guarded.empty() == 4
    assert guarded.asks("c") == "commit 3"
    assert guarded.committed().outputs == (6, 0)
    guarded.send(safe(2))
    assert "wait -110 commit 3 is not safe yet: the standby holds commit 2" in guarded.asks("W")
    guarded.send(safe(3))
    assert guarded.asks("w") == "wait 0"
    guarded.end.setblocking(False)
    with pytest.raises(BlockingIOError):
        guarded.end.recv(600)


def test_a_warm_program_waits_and_then_goes_on_from_what_it_is_handed(guarded: Guarded) -> None:
    guarded.end.setblocking(False)
    with pytest.raises(BlockingIOError):
        guarded.end.recv(600)
    writer = handed(41)
    packet = begin(guarded.pipes, why=2, robot="robot1", generation=7, age_ns=1_500_000_000)
    guarded.send(packet, guarded.counters, writer.descriptor)
    writer.close()
    assert guarded.answer() == "resumed robot1|taken over|epoch 3|generation 7|commit 41|1.500 s|"
    assert [guarded.answer(), guarded.answer()] == ["open 1", "at 41, epoch 3, last byte 41"]
    assert guarded.asks("c") == "commit 1", "its commits count anew, in a segment of its own"
    found = guarded.committed()
    assert found.region(0)[0] == 42
    assert found.region(1) == bytes([41]) * (LARGE - 1) + bytes([42])


def test_a_state_that_does_not_fit_is_refused_by_the_region(guarded: Guarded) -> None:
    writer = handed(5, LARGE + 1)
    guarded.send(begin(guarded.pipes, why=1, robot="robot1"), guarded.counters, writer.descriptor)
    writer.close()
    assert "cannot resume from the agent's checkpoint: region 'large' has 200001 bytes there" in guarded.answer()


def test_what_the_guard_refuses_is_said(guarded: Guarded) -> None:
    guarded.send(refused("pid 7 keeps the state of /lab/guarded already"))
    assert guarded.answer() == "open -13 cannot keep a state under the agent: pid 7 keeps the state of /lab/guarded already"


@pytest.mark.parametrize(
    "packet",
    [
        lambda pipes: begin(pipes)[:-1],
        lambda pipes: begin(pipes) + bytes(200),
        lambda pipes: begin(pipes, why=4),
        lambda pipes: begin(pipes, why=1),
        lambda pipes: begin(pipes).replace(struct.pack("<II", 2, 1), struct.pack("<II", 2, 9), 1),
        lambda pipes: safe(1),
        lambda pipes: b"\2",
    ],
    ids=["short", "long", "no reason", "without a state", "version", "another kind", "one byte"],
)
def test_what_the_document_does_not_know_is_refused(guarded: Guarded, packet: Callable[[tuple[int, int]], bytes]) -> None:
    guarded.send(packet(guarded.pipes), guarded.counters)
    assert guarded.answer().startswith("open -71 cannot keep a state under the agent: its guard ")


def test_a_guard_that_hangs_up_costs_what_is_safe_and_nothing_else(guarded: Guarded) -> None:
    guarded.begins()
    assert guarded.asks("c") == "commit 1"
    guarded.end.close()
    assert guarded.asks("c") == "commit 2"
    assert guarded.asks("w").startswith("wait -32 commit 2 is not safe: the guard of this program has gone")


def test_a_commit_waits_for_no_room_in_a_pipe_that_nobody_empties(guarded: Guarded) -> None:
    guarded.begins()
    assert guarded.asks("p") == "full"
    assert guarded.asks("c") == "commit 1"
    assert guarded.committed().outputs is PENDING
    assert "its output pipe is full" in guarded.asks("W")
    taken = guarded.empty()
    assert guarded.asks("c") == "commit 2"
    assert guarded.committed().outputs == (taken + len("held back1\n2\n"), 0)


def test_a_child_has_nothing_of_the_guard(guarded: Guarded) -> None:
    guarded.begins()
    assert guarded.asks("f") == "child -1 no variable"


@pytest.mark.parametrize("task", ["@failover.0123456789abcdef", "7", "@failover.0123", "@failover.0123456789abcdeg"])
def test_a_program_that_no_guard_listens_to_keeps_its_state_beside_it(task: str, tmp_path: Path) -> None:
    with program_with(task, tmp_path) as (process, answers):
        process.communicate(b"cw")
        said = b"".join(iter(lambda: answers.recv(600), b"")).decode()
    assert said == "open 0 \nat 0, epoch 0, last byte 0\ncommit 1 \nwait 0 \n"
    assert (tmp_path / "guarded.segment").exists()
