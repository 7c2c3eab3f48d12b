"""Captures that race with a program's own acts: nothing is lost, no thread is left stopped, no descriptor is left open.

``FAILOVER_TEST_RACES=10000`` for the long version: so many captures of each kind, some ten minutes each.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder, Session
from checkpoint.errors import CaptureError, ProbeError, ProcessGoneError, UnsupportedError
from checkpoint.model import Snapshot
from tests.checkpoint.linux.trace.test_threads import open_descriptors, states, tracers
from tests.checkpoint.round_trip import (
    ENGINE,
    PATIENCE_S,
    Program,
    ended,
    expect_ok,
    protected,
    restored,
    start_tracee,
    transported,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root, pytest.mark.timeout(3600)]

Compiled = Callable[..., Path]
Outcome = TypeVar("Outcome")

RACES = int(os.environ.get("FAILOVER_TEST_RACES", "30"))
KILLED_ONE_IN = 10
"""Captures for each program that is killed while it is captured: starting one takes as long as some captures."""


def expect_unharmed(tracee: Program, descriptors: int) -> None:
    """It runs, nobody traces it, and it has no descriptor that it did not have."""
    assert tracers(tracee.pid) == {"0"}
    assert "t" not in states(tracee.pid)
    assert len(os.listdir(f"/proc/{tracee.pid}/fd")) == descriptors
    tracee.tell()
    expect_ok(tracee)


def at_last(act: Callable[[], Outcome]) -> Outcome:
    """Try until it is not refused: there are children now and then, and a busy machine leaves us no processor in time."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return act()
        except ProcessGoneError:
            raise
        except (CaptureError, UnsupportedError):
            if time.monotonic() > deadline:
                raise


@contextlib.contextmanager
def protected_at_last(tracee: Program) -> Iterator[Session]:
    """As `protected`, where that may be refused."""
    session = at_last(lambda: ENGINE.protect(tracee.pid, ProtectOrder("/test/tracee")))
    try:
        yield session
    finally:
        session.close()


def captured_often(session: Session, count: int) -> Snapshot:
    """So many captures, refused ones included; a whole one at last."""
    found = 0
    for sequence in range(1, count + 1):
        with contextlib.suppress(CaptureError, UnsupportedError):
            session.acknowledge(session.capture(CaptureOrder(sequence=sequence)).position)
            found += 1
    print(f"{found} of {count} captures")
    return transported(at_last(lambda: session.capture(CaptureOrder(base=True, sequence=count + 1))))


@pytest.mark.parametrize("kind", ["mappings", "signals", "forks"])
def test_captures_that_race_with_it_lose_nothing(kind: str, compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("races", "-O2", "-pthread"), tmp_path, kind)) as tracee:
        ours, its = open_descriptors(), len(os.listdir(f"/proc/{tracee.pid}/fd"))
        with protected_at_last(tracee) as session:
            whole = captured_often(session, RACES)
        assert open_descriptors() == ours
        expect_unharmed(tracee, its)
    (tmp_path / "go").unlink()
    with ended(restored(whole, tmp_path)) as tracee:
        tracee.tell()
        expect_ok(tracee)


def test_captures_that_race_with_the_execution_of_another_program_harm_nobody(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("races", "-O2", "-pthread"), tmp_path, "execs")) as tracee:
        ours, its = open_descriptors(), len(os.listdir(f"/proc/{tracee.pid}/fd"))
        found = executed = sequence = 0
        deadline = time.monotonic() + PATIENCE_S
        while sequence < RACES or not (found and executed):
            assert sequence < RACES or time.monotonic() < deadline, f"{found} captures, {executed} executions"
            try:
                with protected(tracee) as session:
                    while sequence < RACES or not executed:
                        sequence += 1
                        session.acknowledge(session.capture(CaptureOrder(sequence=sequence)).position)
                        found += 1
            except (ProcessGoneError, CaptureError, UnsupportedError, ProbeError) as error:
                executed += isinstance(error, ProcessGoneError)
                assert tracee.poll() is None, f"it has ended: {tracee.status}\n{tracee.output}"
        print(f"{found} of {sequence} captures, {executed} of a program that had become another")
        assert open_descriptors() == ours
        expect_unharmed(tracee, its)


def capture_until_it_ends(tracee: Program, after_ms: int) -> None:
    """Capture it in one session; somebody else kills it meanwhile."""
    with protected_at_last(tracee) as session:
        at_last(lambda: session.capture(CaptureOrder()))
        killer = os.posix_spawn("/bin/sh", ["sh", "-c", f"sleep 0.{after_ms:03}; kill -KILL {tracee.pid}"], {})
        try:
            for sequence in itertools.count(2):
                with contextlib.suppress(UnsupportedError):
                    at_last(functools.partial(session.capture, CaptureOrder(sequence=sequence)))
        finally:
            os.waitpid(killer, 0)


def test_captures_of_a_program_that_is_killed_end_with_a_word(compiled: Compiled, tmp_path: Path) -> None:
    for attempt in range(max(RACES // KILLED_ONE_IN, 1)):
        directory = tmp_path / str(attempt)
        directory.mkdir()
        ours = open_descriptors()
        with ended(start_tracee(compiled("races", "-O2", "-pthread"), directory, "mappings")) as tracee:
            with pytest.raises(ProcessGoneError):
                capture_until_it_ends(tracee, attempt % 20)
            tracee.wait_until(lambda: tracee.poll() is not None, "its end")
        assert open_descriptors() == ours
