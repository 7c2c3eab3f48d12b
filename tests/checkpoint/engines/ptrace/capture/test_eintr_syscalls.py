"""System calls that the kernel ends with EINTR at every stop: a program that is captured many times a second does not notice."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import itertools
import mmap
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import Registers
from checkpoint.engine import CaptureOrder
from checkpoint.engines.ptrace.capture import eintr_syscalls
from checkpoint.engines.ptrace.capture.eintr_syscalls import Wait, decide
from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.trace import remote_syscalls, syscall_batch
from checkpoint.linux.trace.syscall_batch import Batch
from checkpoint.linux.trace.syscall_desk import Desk, Guest
from checkpoint.linux.trace.tracee import Tracee
from tests.checkpoint.round_trip import (
    PATIENCE_S,
    Program,
    calls_of,
    captured_and_killed,
    captured_at_last,
    ended,
    expect_ok,
    protected,
    restored,
    start,
    start_tracee,
)

Compiled = Callable[..., Path]

TOGETHER = (
    ("epoll", "thread", "pwait2", "handlers"),
    ("inline", "sigtimedwait", "semtimedop", "ticks"),
    ("recv", "read", "accept", "send"),
    ("bytes", "edges"),
)
"""What is waited in. So few at a time that each is captured several times in one wait."""
WAIT = arch.SYSCALLS.get("epoll_wait", arch.SYSCALLS["epoll_pwait"])
"""What epoll_wait(3) calls by."""
ROUNDS = {"ticks": 50, "bytes": 120, "edges": 120, "handlers": 300}
"""Waits that a program has ended at least while it is captured: those that end soon, for much longer than their timeout."""
FEW_ROUNDS = 2
"""Of those that take 0.4 s each."""
PAUSE_S = 0.02
"""Between two rounds of captures: how often is part of what is tested, not something that is waited for."""


def rounds(program: Program) -> int:
    """How many waits have ended."""
    return program.output.count("round\n")


def has_done_enough(program: Program) -> bool:
    """Whether enough of its waits have ended."""
    return rounds(program) >= ROUNDS.get(program.directory.name, FEW_ROUNDS)


@contextlib.contextmanager
def waiting(compiled: Compiled, directory: Path, kinds: tuple[str, ...], *more: str) -> Iterator[list[Program]]:
    """One program for each kind of wait, all at once, because each takes its time."""
    with contextlib.ExitStack() as stack:
        found = []
        for kind in kinds:
            (directory / kind).mkdir()
            program = start_tracee(compiled("waits", "-O2", "-pthread"), directory / kind, kind, *more)
            found.append(stack.enter_context(ended(program)))
        yield found


def capture_until(programs: list[Program], enough: Callable[[Program], bool]) -> None:
    """Capture all of them, again and again, each in one session."""
    with contextlib.ExitStack() as stack:
        sessions = [stack.enter_context(protected(program)) for program in programs]
        sequence, deadline = 0, time.monotonic() + PATIENCE_S
        while late := [program.directory.name for program in programs if not enough(program)]:
            assert time.monotonic() < deadline, f"still waiting: {late}"
            sequence += 1
            for session in sessions:
                session.acknowledge(captured_at_last(session, CaptureOrder(sequence=sequence)).position)
            assert all(program.poll() is None for program in programs)
            time.sleep(PAUSE_S)


def expect_all_ok(programs: list[Program]) -> None:
    """Tell them to end, and show what each of them found to differ."""
    complaints = []
    for program in programs:
        program.tell()
    for program in programs:
        try:
            expect_ok(program)
        except AssertionError as error:
            complaints.append(f"{program.directory.name}: {error}")
    assert not complaints, "\n".join(complaints)


@pytest.mark.compiler
@pytest.mark.root
@pytest.mark.parametrize("kinds", TOGETHER, ids="-".join)
def test_waits_end_as_they_do_undisturbed_however_often_the_program_is_captured(
    compiled: Compiled, tmp_path: Path, kinds: tuple[str, ...]
) -> None:
    with waiting(compiled, tmp_path, kinds) as programs:
        capture_until(programs, has_done_enough)
        expect_all_ok(programs)


@pytest.mark.compiler
@pytest.mark.root
@pytest.mark.parametrize("way", ["nanosleep_no_rest", "clock_relative", "nanosleep", "futex"])
def test_a_relative_sleep_ends_however_often_the_program_is_captured(compiled: Compiled, tmp_path: Path, way: str) -> None:
    """If it began anew at each capture it would never end."""
    with ended(start_tracee(compiled("sleeps"), tmp_path, way)) as program:
        with contextlib.suppress(ProcessGoneError), protected(program) as session:
            deadline = time.monotonic() + PATIENCE_S
            for sequence in itertools.count(1):
                session.acknowledge(captured_at_last(session, CaptureOrder(sequence=sequence)).position)
                assert time.monotonic() < deadline, "it sleeps still"
        expect_ok(program)


@pytest.mark.compiler
@pytest.mark.root
def test_without_room_for_a_mark_a_wait_ends_with_eintr_only_when_its_time_is_over(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(eintr_syscalls, "has_room_for_marks", lambda: False)
    with waiting(compiled, tmp_path, ("epoll", "thread", "sigtimedwait", "recv"), "lenient") as programs:
        capture_until(programs, has_done_enough)
        expect_all_ok(programs)


@pytest.mark.compiler
@pytest.mark.root
def test_a_wait_goes_on_after_each_of_three_restores(compiled: Compiled, tmp_path: Path) -> None:
    kinds = ("epoll", "thread", "sigtimedwait", "send", "handlers")
    with waiting(compiled, tmp_path, kinds) as programs, contextlib.ExitStack() as stack:
        for _ in range(3):
            snapshots = [captured_and_killed(program) for program in programs]
            programs = [restored(snapshot, program.directory) for snapshot, program in zip(snapshots, programs, strict=True)]
            for program in programs:
                stack.enter_context(ended(program))
        expect_all_ok(programs)


@pytest.mark.compiler
@pytest.mark.root
def test_a_wait_that_a_keeper_had_made_again_ends_by_itself_when_that_is_killed(compiled: Compiled, tmp_path: Path) -> None:
    """Killed in the middle of a look it would leave EINTR, as its stop did: it is killed between two."""
    with waiting(compiled, tmp_path, ("epoll", "thread", "read")) as programs:
        for program in programs:
            keeper = os.fork()
            if not keeper:
                with contextlib.suppress(BaseException):
                    capture_and_rest(program)
                os._exit(1)
            try:
                program.wait_until((program.directory / "captured").exists, "its captures")
                before = rounds(program)
            finally:
                os.kill(keeper, signal.SIGKILL)
                _, status = os.waitpid(keeper, 0)
            assert os.waitstatus_to_exitcode(status) == -signal.SIGKILL
            program.wait_until(lambda: rounds(program) > before, "that its wait ends by itself")  # noqa: B023
        expect_all_ok(programs)


def capture_and_rest(program: Program) -> None:
    """Capture it several times while it waits, say so, and do nothing more with it."""
    with protected(program) as session:
        for sequence in range(1, 6):
            session.acknowledge(captured_at_last(session, CaptureOrder(sequence=sequence)).position)
        (program.directory / "captured").touch()
        while True:
            signal.pause()


@pytest.mark.compiler
@pytest.mark.root
@pytest.mark.parametrize("kind", ["epoll", "thread"])
def test_a_wait_that_went_on_while_its_keeper_was_late_does_not_end_with_eintr(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """The program has run on by itself, into the same call: it is stopped there once more."""
    wait_in_time = remote_syscalls._tables_when_done

    def wait_too_long(memory: Memory, desks: Sequence[Desk], end: int) -> list[bytes]:
        tables = wait_in_time(memory, desks, end)
        program.wait_until(lambda: waiting_in in calls_of(program.pid), "the wait to be made again")
        return tables

    waiting_in = str(WAIT)
    with waiting(compiled, tmp_path, (kind,)) as programs:
        (program,) = programs
        with protected(program) as session:
            program.wait_until(lambda: waiting_in in calls_of(program.pid), "the wait")
            monkeypatch.setattr(remote_syscalls, "_tables_when_done", wait_too_long)
            with pytest.raises(CaptureError, match="has run on while failover examined it"):
                session.capture(CaptureOrder(base=True, generation=1, sequence=1))
            monkeypatch.undo()
        program.wait_until(lambda: has_done_enough(program), "its waits")
        expect_all_ok(programs)


# --- The table of rules ------------------------------------------------------------------------------------------------

ASKED_NS = 1_000
BEGAN_NS = 50_000


def stopped(mark: int = 0, **changed: int) -> Registers:
    """Registers of a thread that a stop has found in an epoll_wait."""
    registers = dict.fromkeys(arch.REGISTER_NAMES, 7)
    found = {
        **registers,
        arch.RESULT: -errno.EINTR & (1 << 64) - 1,
        arch.CALL_NUMBER: arch.marked(WAIT, mark),
        **changed,
    }
    return arch.recalled(found, WAIT, mark << 32 | 7)


def decided(registers: Registers, before: Wait | None, now_ns: int) -> tuple[Registers, Wait | None]:
    """The rules, for an epoll_wait of `ASKED_NS`."""
    return decide(registers, before, ASKED_NS, 0, now_ns)


def first_seen() -> tuple[Registers, Wait]:
    """A call that is met by a capture for the first time."""
    again, wait = decided(stopped(), None, BEGAN_NS)
    assert wait is not None and wait.deadline_ns == BEGAN_NS + ASKED_NS
    return again, wait


def is_made_again(registers: Registers, mark: int, found: Registers | None = None) -> bool:
    """Whether the call is made again, with this mark."""
    wanted = arch.made_again(stopped() if found is None else found, mark)
    return arch.encode_registers(registers) == arch.encode_registers(wanted)


def test_a_call_that_is_seen_for_the_first_time_is_made_again_with_a_mark() -> None:
    again, wait = first_seen()
    assert 0 < wait.mark < arch.MARK_LIMIT
    assert is_made_again(again, wait.mark)


def test_a_marked_call_keeps_its_mark_until_its_time_is_over_and_times_out_then() -> None:
    _, wait = first_seen()
    registers, kept = decided(stopped(wait.mark), wait, wait.deadline_ns - 1)
    assert is_made_again(registers, wait.mark)
    assert kept is not None and (kept.mark, kept.deadline_ns) == (wait.mark, wait.deadline_ns)
    registers, left = decided(stopped(wait.mark), kept, wait.deadline_ns)
    assert (registers[arch.RESULT], registers[arch.CALL_NUMBER], left) == (0, arch.NO_CALL, None)
    assert registers[arch.INSTRUCTION_POINTER] == stopped()[arch.INSTRUCTION_POINTER]


@pytest.mark.parametrize(
    "found",
    [stopped(), stopped(mark=12345), stopped(**{arch.INSTRUCTION_POINTER: 8})],
    ids=["unmarked", "another mark", "elsewhere"],
)
def test_a_call_without_our_mark_begins_anew_whatever_the_time(found: Registers) -> None:
    _, wait = first_seen()
    registers, fresh = decided(found, wait, wait.deadline_ns + 1)
    assert fresh is not None and fresh.deadline_ns == wait.deadline_ns + 1 + ASKED_NS
    assert fresh.mark != wait.mark
    assert is_made_again(registers, fresh.mark, found)


def test_without_marks_a_call_that_may_be_another_one_never_times_out_by_us(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(eintr_syscalls, "has_room_for_marks", lambda: False)
    _, wait = first_seen()
    assert wait.mark == 0
    registers, kept = decided(stopped(), wait, BEGAN_NS + ASKED_NS // 2)
    assert is_made_again(registers, 0)
    assert kept is not None and kept.deadline_ns == wait.deadline_ns
    assert decided(stopped(), kept, wait.deadline_ns) == (stopped(), None)  # EINTR, once
    _, fresh = decided(stopped(), kept, BEGAN_NS + ASKED_NS // 2 + ASKED_NS)  # the kernel would have ended it by now
    assert fresh is not None and fresh.deadline_ns > wait.deadline_ns


EINTR_SEEN_BY_C = """
import ctypes, os, sys
libc = ctypes.CDLL(None, use_errno=True)
epoll, events = libc.epoll_create1(0), ctypes.create_string_buffer(64)
print("waits", flush=True)
while True:
    came = libc.epoll_wait(epoll, events, 1, 60_000)
    print(came, ctypes.get_errno(), flush=True)
"""


def test_a_wait_that_has_timed_out_at_a_stop_can_be_left_alone_with_its_result() -> None:
    """Any thread: should we die, the code at its desk gives it back what the call returns, a negative number."""
    memory, room = Memory(os.getpid()), mmap.mmap(-1, abi.PAGE_SIZE)
    address = ctypes.addressof(ctypes.c_char.from_buffer(room))
    desk = Desk(memory, address, address + syscall_batch.SMALL_DESK, syscall_batch.SMALL)
    registers = arch.encode_registers({**stopped(), arch.RESULT: -errno.EAGAIN, arch.CALL_NUMBER: arch.NO_CALL})
    head = desk.armed(Batch(desk.table, syscall_batch.SMALL), Guest(Tracee(os.getpid(), memory), registers, 0))
    assert (-errno.EAGAIN).to_bytes(8, "little", signed=True) in head


def test_python_makes_its_calls_again_itself_with_what_is_left_of_their_time(tmp_path: Path) -> None:
    """What the kernel said is seen below Python: it is not hidden from an interpreter that knows what to do about it."""
    program = start((sys.executable, "-c", EINTR_SEEN_BY_C), tmp_path)
    with ended(program):
        program.wait_for_line("waits")
        with protected(program) as session:
            session.capture(CaptureOrder())
            program.wait_for_line(f"-1 {errno.EINTR}")
