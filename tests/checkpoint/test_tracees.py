"""Everything that a restore must preserve, one tiny program for each: see ``tests/tracees``.

Every tracee is captured, runs on for a moment, is killed, restored, and told to look: it prints what differs. A few are
also checked after a capture alone: a captured program must never notice.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from _pytest.mark import ParameterSet

from tests.checkpoint.round_trip import (
    Program,
    captured,
    captured_and_killed,
    copied,
    ended,
    expect_ok,
    restored,
    start_tracee,
    straight,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]

BY_FILE, BY_SIGNAL, BY_ITSELF = "file", "signal", "itself"


@dataclass(frozen=True)
class Case:
    """One tracee with its arguments.

    Attributes:
        told: how it learns that it is to look: a file, SIGUSR1, or by itself when a time is over.
    """

    program: str
    arguments: tuple[str, ...] = ()
    told: str = BY_FILE

    def __str__(self) -> str:
        return "-".join((self.program, *self.arguments))

    def tell(self, tracee: Program) -> None:
        """Tell a running tracee to look."""
        if self.told == BY_FILE:
            tracee.tell()
        elif self.told == BY_SIGNAL:
            os.kill(tracee.pid, signal.SIGUSR1)


def cases(program: str, names: str = "", told: str = BY_FILE) -> list[Case]:
    """One case for each name, or the one without arguments."""
    return [Case(program, (name,), told) for name in names.split()] if names else [Case(program, (), told)]


MEMORY = [
    *cases("mappings"),
    *cases("file_private"),
    *cases("file_shared"),
    *cases("shared_anonymous"),
    *cases("advice"),
    *cases("heap"),
    *cases("stack"),
    *cases("guard_pages"),
    *cases("guard_pages", "advised"),
    *cases("bss"),
    *cases("sparse"),
    *cases("many_mappings"),
    *cases("deleted_mapping"),
]

OF_X86 = [
    *cases("registers", told=BY_SIGNAL),
    *cases("avx", told=BY_SIGNAL),
    *cases("avx512", told=BY_SIGNAL),
    *cases("rseq_loop", told=BY_SIGNAL),
    *cases("segments"),
    *cases("single_steps"),
]
OF_AARCH64 = [
    *cases("registers_aarch64", told=BY_SIGNAL),
    *cases("rseq_loop", told=BY_SIGNAL),
    *cases("scalable", "0 16", told=BY_SIGNAL),
    Case("scalable", ("0", "threads"), BY_SIGNAL),
]
OF_PROCESSOR = {"aarch64": OF_AARCH64}
"""What is written in instructions of one processor; `OF_X86` for those that have none of their own."""
REGISTERS = [
    *OF_PROCESSOR.get(os.uname().machine, OF_X86),
    *cases("thread_addresses"),
    *cases("tight_loop", "60"),
]

SIGNALS = [
    *cases("signal_actions"),
    *cases("signal_pending"),
    *cases("altstack"),
    *cases("sigsuspend", told=BY_SIGNAL),
    *cases("sigsuspend", "pause", told=BY_SIGNAL),
    *cases("sigwait", told=BY_SIGNAL),
    *cases("sigwait", "timed", told=BY_ITSELF),
]

TIME = [
    *cases("interval_timers"),
    *cases("timer_left"),
    *cases("posix_timers"),
    *cases("timer_overrun"),
    *cases("clocks"),
]

REALTIME, MONOTONIC, PROCESS_CPU, THREAD_CPU, BOOTTIME, TAI = 0, 1, 2, 3, 7, 11
TIMERS = [
    *(
        Case("time_kinds", ("timer", str(clock), how))
        for clock in (REALTIME, MONOTONIC, PROCESS_CPU, THREAD_CPU, BOOTTIME, TAI)
        for how in ("relative", "absolute")
    ),
    *(
        Case("time_kinds", ("descriptor", str(clock), how))
        for clock in (REALTIME, MONOTONIC, BOOTTIME)
        for how in ("relative", "absolute")
    ),
]

SLEEPS = cases(
    "sleeps",
    "nanosleep nanosleep_no_rest clock_relative clock_boottime absolute_monotonic absolute_realtime poll poll_file ppoll "
    "select pselect futex futex_bitset futex_realtime",
    told=BY_ITSELF,
)

PORTRAITS = cases(
    "portrait",
    "plain name umask nice limits personality dumpable parent_death_signal subreaper huge_pages_off "
    "huge_pages_advised timer_slack affinity "
    "batch idle realtime io_priority io_priority_best no_tsc mdwe memory_merge store_bypass mce_kill membarrier directory oom "
    "coredump_filter login arguments user setuid groups effective fsuid capabilities securebits keep_caps no_new_privs",
)

FILES = cases(
    "files",
    "read_offset write_offset append odd_flags shared_offset holes deleted deleted_read_only devices directory path_only "
    "beyond_end odd_name owner_signal owner_thread asynchronous "
    "directory_at_its_end deleted_sparse deleted_with_a_link deleted_directory "
    "deleted_working_directory deleted_device deleted_place deleted_link mapped_memory",
)

THREADS = [
    *cases("threads"),
    *cases("threads", "many"),
    *cases("blocked"),
    *cases("thread_rights"),
    *cases("thread_tables"),
    *cases("deadlines", "deadline slice"),
]

PRESERVED = [*MEMORY, *REGISTERS, *SIGNALS, *TIME, *PORTRAITS, *FILES, *THREADS]

NOT_YET = {
    "timer_overrun": "the kernel does not tell how often a timer went off while its signal was pending",
}
"""What a restore does not preserve so far, and why."""


def expected(found: list[Case], not_yet: dict[str, str]) -> list[ParameterSet]:
    """Cases as parameters: those that are known not to work must fail."""
    reasons = [(case, not_yet.get(str(case))) for case in found]
    marks = [[pytest.mark.xfail(reason=reason, strict=True)] if reason else [] for _, reason in reasons]
    return [pytest.param(case, id=str(case), marks=mark) for (case, _), mark in zip(reasons, marks, strict=True)]


Way = Callable[[Program, Path], Program]


@pytest.mark.sampled(2)
@pytest.mark.parametrize("way", [copied, straight])
@pytest.mark.parametrize("case", expected(PRESERVED, NOT_YET))
def test_a_restored_program_finds_everything_as_it_was(case: Case, way: Way, compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled(case.program, "-O2"), tmp_path, *case.arguments)
    with ended(tracee):
        again = way(tracee, tmp_path)
    with ended(again) as tracee:
        case.tell(tracee)
        expect_ok(tracee)


LOOKED_AT = [*REGISTERS, *SIGNALS, *TIME, *cases("portrait", "plain"), *THREADS]


@pytest.mark.parametrize("case", LOOKED_AT, ids=str)
def test_a_captured_program_notices_nothing(case: Case, compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled(case.program, "-O2"), tmp_path, *case.arguments)) as tracee:
        for _ in range(3):
            captured(tracee)
        case.tell(tracee)
        expect_ok(tracee)


def test_blocking_calls_end_only_when_their_time_is_over(compiled: Compiled, tmp_path: Path) -> None:
    """All at once, because each takes its time: captured, killed and brought back while they wait."""
    program = compiled("sleeps", "-O2")
    back = {}
    for case in SLEEPS:
        directory = tmp_path / case.arguments[0]
        directory.mkdir()
        tracee = start_tracee(program, directory, *case.arguments)
        back[case] = restored(captured_and_killed(tracee), directory)
    complaints = [f"{case}: {found}" for case, tracee in back.items() if (found := _complaint(tracee))]
    assert not complaints, "\n".join(complaints)


def test_timers_of_every_clock_go_off_when_they_are_due(compiled: Compiled, tmp_path: Path) -> None:
    """All at once, because each takes its time: captured, killed and brought back while they run."""
    program = compiled("time_kinds", "-O2")
    back = {}
    for case in TIMERS:
        directory = tmp_path / str(case)
        directory.mkdir()
        tracee = start_tracee(program, directory, *case.arguments)
        back[case] = restored(captured_and_killed(tracee), directory)
        back[case].tell()
    complaints = [f"{case}: {found}" for case, tracee in back.items() if (found := _complaint(tracee))]
    assert not complaints, "\n".join(complaints)


def test_blocking_calls_do_not_notice_a_capture(compiled: Compiled, tmp_path: Path) -> None:
    program = compiled("sleeps", "-O2")
    waiting = {}
    for case in SLEEPS:
        directory = tmp_path / case.arguments[0]
        directory.mkdir()
        waiting[case] = start_tracee(program, directory, *case.arguments)
        captured(waiting[case])
    complaints = [f"{case}: {found}" for case, tracee in waiting.items() if (found := _complaint(tracee))]
    assert not complaints, "\n".join(complaints)


def _complaint(tracee: Program) -> str:
    try:
        expect_ok(tracee)
    except AssertionError as error:
        return str(error).splitlines()[0] + " " + " ".join(tracee.output.split("\n"))
    finally:
        tracee.kill()
    return ""


@pytest.mark.parametrize(
    "case",
    [*cases("heap"), *cases("signal_pending"), *cases("portrait", "limits"), *cases("files", "deleted"), *cases("threads")],
    ids=str,
)
def test_three_restores_in_a_row_lose_nothing(case: Case, compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled(case.program, "-O2"), tmp_path, *case.arguments)
    for _ in range(3):
        with ended(tracee):
            snapshot = captured_and_killed(tracee)
        tracee = restored(snapshot, tmp_path)
    with ended(tracee):
        case.tell(tracee)
        expect_ok(tracee)


@pytest.mark.parametrize("case", [*cases("mappings"), *cases("files", "append"), *cases("posix_timers")], ids=str)
def test_a_new_pid_is_no_loss_to_a_program_that_does_not_hold_its_own(case: Case, compiled: Compiled, tmp_path: Path) -> None:
    tracee = start_tracee(compiled(case.program, "-O2"), tmp_path, *case.arguments)
    with ended(tracee):
        snapshot = captured_and_killed(tracee)
    with ended(restored(snapshot, tmp_path, keep_pid=False)) as tracee:
        assert tracee.pid != snapshot.process.pid
        case.tell(tracee)
        expect_ok(tracee)


def test_the_pid_is_kept_where_it_is_free(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("heap", "-O2"), tmp_path)) as tracee:
        snapshot = captured_and_killed(tracee)
    with ended(restored(snapshot, tmp_path)) as back:
        assert back.pid == tracee.pid == snapshot.process.pid
        back.tell()
        expect_ok(back)
