"""A program that waits where the last look found it has nothing new to say; one that did anything in between is captured."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, Session
from checkpoint.engines.ptrace.capture import at_rest, memory, memory_result
from checkpoint.engines.ptrace.capture.process import CapturedProcess
from checkpoint.engines.ptrace.capture.session import PtraceSession
from checkpoint.engines.ptrace.capture.snapshot_builder import SnapshotBuilder
from checkpoint.errors import UnsupportedError
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.model import Position, Snapshot
from checkpoint.pages import page_set
from tests.checkpoint.round_trip import Program, captured_at_last, ended, protected, start, start_tracee

pytestmark = [pytest.mark.root, pytest.mark.write_protection]

WAITS = """
import ctypes, os, sys, threading
words, memory, never = open(sys.argv[1]), bytearray(1 << 20), threading.Event()
for _ in range(int(sys.argv[2])):
    threading.Thread(target=never.wait, daemon=True).start()
print("ready", flush=True)
for word in words:
    word = word.strip()
    if word == "write":
        memory[-1] += 1
    elif word == "many":
        for place in range(0, 20 * 4096, 4096):
            memory[place] += 1
    elif word == "thread":
        threading.Thread(target=never.wait, daemon=True).start()
    elif word == "fork" and not os.fork():
        ctypes.CDLL(None).prctl(1, 9)  # it ends with its parent
        print("born", flush=True)
        never.wait()
    print(word, flush=True)
"""
MANY = 20
"""Pages that "many" writes."""
PATIENCE_S = 60.0


class Waiting:
    """A program that waits for words, and its session; the positions that were captured are acknowledged at once."""

    def __init__(self, program: Program, session: Session, words: int) -> None:
        self.program = program
        self.session = session
        self._words = words
        self._sequence = 0

    def say(self, word: str) -> None:
        os.write(self._words, f"{word}\n".encode())
        self.program.wait_for_line("born" if word == "fork" else word)

    def captured(self, *, base: bool = False) -> Snapshot:
        self._sequence += 1
        snapshot = captured_at_last(self.session, CaptureOrder(base=base, sequence=self._sequence))
        self.session.acknowledge(snapshot.position)
        return snapshot

    def capture(self, *, base: bool = False) -> Position:
        return self.captured(base=base).position

    def until_at_rest(self) -> None:
        """Capture until it says that it is unchanged; a thread that has just printed takes its time to wait again."""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            position = self.capture()
            for _ in range(20):
                if (known := self.session.unchanged(0)) is not None:
                    assert known == position
                    return
                time.sleep(0.005)
            assert time.monotonic() < deadline, "it never rests"


@contextmanager
def waiting(directory: Path, threads: int = 0) -> Iterator[Waiting]:
    fifo = directory / "words"
    os.mkfifo(fifo)
    words = os.open(fifo, os.O_RDWR)
    try:
        with ended(start([sys.executable, "-c", WAITS, fifo, str(threads)], directory)) as program:
            program.wait_for_line("ready")
            with protected(program) as session:
                found = Waiting(program, session, words)
                found.capture(base=True)
                yield found
    finally:
        os.close(words)


@pytest.mark.parametrize("threads", [0, 5])
def test_a_program_that_waits_is_unchanged_until_it_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    monkeypatch.setattr("checkpoint.engines.ptrace.capture.session.REST_MAX_S", PATIENCE_S)
    with waiting(tmp_path, threads) as one:
        one.until_at_rest()
        assert one.session.unchanged(0) is not None, "and again, while nothing happens"
        assert one.session.unchanged(1) is None, "a newer epoch is told by a capture"
        one.say("write")
        assert one.session.unchanged(0) is None
        one.until_at_rest()


def test_pages_that_were_read_to_compare_them_are_not_read_again_unless_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("checkpoint.engines.ptrace.capture.session.REST_MAX_S", PATIENCE_S)
    for module in (at_rest, memory):
        monkeypatch.setattr(module, "REST_PAGES", 4096)  # an interpreter writes a hundred pages to print a word
    read: list[int] = []
    read_into = memory.MemoryCapture._read_into
    monkeypatch.setattr(memory.MemoryCapture, "_read_into", lambda *wanted: read.append(len(wanted[2])) or read_into(*wanted))
    with waiting(tmp_path) as one:
        for is_written_again in (False, True):
            one.until_at_rest()
            one.say("many")
            _until_compared(one)
            if is_written_again:
                one.say("many")
            read.clear()
            snapshot = one.captured()
            assert page_set.total_size(page_set.extents(snapshot.runs)) >= MANY * abi.PAGE_SIZE
            assert _differing_pages(one.program.pid, snapshot) <= 1, "but for where restartable sequences are noted"
            if not is_written_again:
                assert not read


def test_a_program_that_works_is_compared_less_often_and_one_that_comes_to_rest_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("checkpoint.engines.ptrace.capture.session.REST_MAX_S", PATIENCE_S)
    asked: list[int] = []
    with waiting(tmp_path) as one:
        with monkeypatch.context() as patched:
            patched.setattr(CapturedProcess, "has_rested", lambda _: bool(asked.append(ask)))
            for ask in range(1, 41):  # noqa: B007 - the lambda has it
                assert one.session.unchanged(0) is None
        assert asked == [1, 2, 3, 4, 6, 10, 18, 26, 34]
        assert one.session._differences < 10, "years of it take no more"  # type: ignore[attr-defined]
        one.until_at_rest()
        assert one.session.unchanged(0) is not None, "it is asked each time again"


def _until_compared(one: Waiting) -> None:
    """Ask until its pages, not its threads alone, were found to differ: a thread that has just printed takes its time to wait."""
    deadline = time.monotonic() + PATIENCE_S
    of_program = one.session._first.memory  # type: ignore[attr-defined]
    while of_program._begun is None:
        assert one.session.unchanged(0) is None
        assert time.monotonic() < deadline, "it never waits"


def _differing_pages(pid: int, snapshot: Snapshot) -> int:
    """How many of the pages that a snapshot tells are not those of a process that waits since."""
    runs = page_set.extents(snapshot.runs)
    now = memoryview(bytearray(page_set.total_size(runs)))
    Memory(pid).read_pages_into(runs, now)
    told = memoryview(snapshot.contents)
    places = range(0, len(now), abi.PAGE_SIZE)
    return sum(now[place : place + abi.PAGE_SIZE] != told[place : place + abi.PAGE_SIZE] for place in places)


def _until_stopped(one: Waiting) -> None:
    os.kill(one.program.pid, signal.SIGSTOP)
    while procfs.stat(one.program.pid).state != "T":
        time.sleep(0.001)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(lambda one: one.say("thread"), id="a thread"),
        pytest.param(lambda one: one.say("fork"), id="a child"),
        pytest.param(lambda one: one.say("nothing"), id="it ran and waits again"),
        pytest.param(_until_stopped, id="it was stopped"),
        pytest.param(lambda one: one.program.kill(), id="it was killed"),
    ],
)
def test_whatever_happens_to_it_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change: Callable[[Waiting], None]
) -> None:
    monkeypatch.setattr("checkpoint.engines.ptrace.capture.session.REST_MAX_S", PATIENCE_S)
    with waiting(tmp_path) as one:
        one.until_at_rest()
        change(one)
        assert one.session.unchanged(0) is None


def test_a_look_that_has_become_no_snapshot_is_nothing_to_compare_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("checkpoint.engines.ptrace.capture.session.REST_MAX_S", PATIENCE_S)
    with waiting(tmp_path) as one:
        one.until_at_rest()
        one.say("write")
        with monkeypatch.context() as patched:
            patched.setattr(SnapshotBuilder, "built", _refused)
            with pytest.raises(UnsupportedError):
                one.capture()
        time.sleep(0.05)
        assert one.session.unchanged(0) is None, "what it wrote is in no snapshot"


def _refused(*_: object) -> None:
    raise UnsupportedError("cannot capture: it has a socket", ("it has a socket",))


def test_a_child_that_waits_rests_with_its_parent_and_what_it_writes_is_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("checkpoint.engines.ptrace.capture.session.REST_MAX_S", PATIENCE_S)
    with waiting(tmp_path) as one:
        one.say("fork")
        one.until_at_rest()
        one.say("write")
        assert one.session.unchanged(0) is None


def test_a_look_is_believed_for_a_while_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("checkpoint.engines.ptrace.capture.session.REST_MAX_S", 0.0)
    with waiting(tmp_path) as one:
        one.capture()
        time.sleep(0.05)
        assert one.session.unchanged(0) is None
    assert at_rest.REST_MAX_S <= 2.0, "docs/limits.md says so"


class Told:
    """A program that writes pages by letters (tests/tracees/pages_by_word.c), and waits in the same read again."""

    def __init__(self, program: Program, words: int, answers: int) -> None:
        self.program = program
        self._words = words
        self._answers = answers

    def say(self, letters: str) -> None:
        for letter in letters:
            os.write(self._words, letter.encode())
            assert os.read(self._answers, 1) == b"x"
            while procfs.stat(self.program.pid).state != "S":
                time.sleep(0.001)


@pytest.mark.parametrize(
    ("before", "during", "after"),
    [
        pytest.param("m", "b", "d", id="a page comes between those that were copied"),
        pytest.param("mz", "l", "u", id="a page of zeros goes from between them"),
    ],
)
def test_a_page_is_compared_with_its_own_bytes(
    compiled: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str, during: str, after: str
) -> None:
    monkeypatch.setattr("checkpoint.engines.ptrace.capture.session.REST_MAX_S", PATIENCE_S)
    look, coming = PtraceSession._frozen_look, [during]

    def looked_at(self: PtraceSession, *arguments: object, **named: object) -> object:
        if is_delta and coming:
            told.say(coming.pop())
        return look(self, *arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(PtraceSession, "_frozen_look", looked_at)
    os.mkfifo(tmp_path / "words")
    os.mkfifo(tmp_path / "answers")
    answers = os.open(tmp_path / "answers", os.O_RDWR)
    words = os.open(tmp_path / "words", os.O_RDWR)
    is_delta = False
    try:
        tracee = start_tracee(compiled("pages_by_word"), tmp_path, "words", "answers")
        with ended(tracee) as program, protected(program) as session:
            told = Told(program, words, answers)
            one = Waiting(program, session, words)
            one.capture(base=True)
            told.say(before)
            is_delta = True
            position = one.capture()
            assert not coming, "it wrote after most was copied, and before it stood still"
            deadline = time.monotonic() + PATIENCE_S
            while session.unchanged(0) != position:
                assert time.monotonic() < deadline, "it never rests"
                time.sleep(0.005)
            told.say(after)
            assert session.unchanged(0) is None, "a page has the bytes of another one now"
    finally:
        os.close(words)
        os.close(answers)


def test_no_copy_that_is_compared_is_used_for_another_thing() -> None:
    assert at_rest.REST_PAGES * abi.PAGE_SIZE < memory_result.WITHIN_SIZE
