"""A signal that comes while a thread stands still for us ends the call that the thread stood in, as it would have without us."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from checkpoint.errors import ProcessGoneError
from checkpoint.linux.trace.threads import Threads
from tests.checkpoint.round_trip import (
    Program,
    calls_of,
    captured_and_killed,
    ended,
    expect_ok,
    protected,
    restored,
    start_tracee,
)

SUSPENDED = {"34", "130", "73", "133"}
"""pause(2), or ppoll(2) where there is none, and rt_sigsuspend(2): by x86-64's numbers, then by those of most others."""


@pytest.fixture(params=[("pause",), ()], ids=["pause", "sigsuspend"])
def waiting(compiled: Callable[..., Path], tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Program]:
    """A program that waits for SIGUSR1, and for ever if the handler has run before the wait begins."""
    with ended(start_tracee(compiled("sigsuspend"), tmp_path, *request.param)) as program:
        stands_in_its_call(program)
        yield program


def stands_in_its_call(program: Program) -> None:
    """Wait until it does."""
    program.wait_until(lambda: calls_of(program.pid) <= SUSPENDED, "its call")


@contextlib.contextmanager
def signalled_at_last(patched: pytest.MonkeyPatch) -> Iterator[None]:
    """In the body who is let go first is sent the signal just before, when it has been given all that it had."""
    thaw = Threads.thaw
    signalled: list[int] = []

    def signalled_first(threads: Threads) -> None:
        if not signalled:
            os.kill(threads.pid, signal.SIGUSR1)
            signalled.append(threads.pid)
        thaw(threads)

    with patched.context() as inside:
        inside.setattr(Threads, "thaw", signalled_first)
        yield


def test_a_signal_that_comes_during_a_look_ends_the_call(waiting: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    with contextlib.suppress(ProcessGoneError), signalled_at_last(monkeypatch), protected(waiting):
        pass  # it ends by then, or will never do so
    expect_told(waiting)


def test_a_signal_that_comes_before_a_restored_program_runs_ends_the_call(
    waiting: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    snapshot = captured_and_killed(waiting)
    with signalled_at_last(monkeypatch), ended(restored(snapshot, tmp_path)) as program:
        expect_told(program)


def expect_told(program: Program) -> None:
    """It has left the call by the signal, and misses nothing else."""
    program.tell()
    expect_ok(program)
