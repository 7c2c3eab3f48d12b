"""A ready copy equals the program: built from a base, updated by deltas while the program runs, and resumed when it has ended."""

from __future__ import annotations

import os
import random
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from checkpoint.engine import COPY_CLOCKS_AHEAD_NS, CaptureOrder, Copy, RestoreOptions, Session
from checkpoint.engines.ptrace.facts import memory_limits
from checkpoint.engines.ptrace.restore import memory
from checkpoint.engines.ptrace.standby_copy import lay, single
from checkpoint.engines.ptrace.standby_copy.single import ReadyCopy
from checkpoint.errors import CaptureError, ChainError, FormatError, RestoreError, UnsupportedError
from checkpoint.keeper import messages
from checkpoint.linux.spawn.vessel import Birth, Born, discard, spawn_vessel
from checkpoint.model import Snapshot
from checkpoint.snapshot import format
from tests.checkpoint.engines.ptrace.capture.test_deltas import MORE_ROUNDS, NAP_US, WAYS, _captured, _nap, _rounds, _undisturbed
from tests.checkpoint.keeper.test_keeper_death import Keeper
from tests.checkpoint.round_trip import (
    Program,
    _stdio,
    at_last,
    captured,
    ended,
    protected,
    start_tracee,
    transported,
)

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]
DELTAS = 8
COVERED = [ways for ways in WAYS if ways not in ("huge_pages", "a_mapped_file_that_is_deleted", "everything")]
"""The others have something, some of the time, for which there is no ready copy."""


@dataclass(slots=True)
class Standby:
    """A vessel and the copy in it."""

    born: Born
    copy: ReadyCopy
    directory: Path

    def becomes_the_program(self) -> Program:
        """It runs from here on."""
        self.copy.finish(RestoreOptions(age_ns(self.copy.state))).resume()
        return Program(self.born, self.directory)


def age_ns(snapshot: Snapshot) -> int:
    return max(time.time_ns() - snapshot.clocks.realtime_ns, 0)


def vessel_for(base: Snapshot, directory: Path) -> Born:
    """Where a copy can be laid: it writes to the program's own files."""
    isolate = base.process.isolated
    counted_ns, elapsed_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME), age_ns(base) + COPY_CLOCKS_AHEAD_NS
    with _stdio(directory) as stdio:
        return spawn_vessel(
            Birth(base.process.pid, isolate, base.clocks if isolate else None, elapsed_ns, stdio, counted_ns=counted_ns)
        )


@contextmanager
def laid(base: Snapshot, directory: Path) -> Iterator[Standby]:
    """A copy of a base, ended with the body unless it became the program."""
    born = vessel_for(base, directory)
    try:
        yield Standby(born, lay.lay(born.pid, base, RestoreOptions()), directory)
    finally:
        discard(born)


def base_of(session: Session) -> Snapshot:
    base = transported(at_last(lambda: _captured(session, CaptureOrder(base=True, sequence=1))))
    session.acknowledge(base.position)
    return base


def deltas_of(session: Session, dice: random.Random, count: int) -> Iterator[Snapshot]:
    """Each one is acknowledged as soon as it has been used."""
    for sequence in range(2, count + 2):
        _nap(dice)
        order = CaptureOrder(base=False, sequence=sequence)
        delta = transported(at_last(lambda: _captured(session, order)))  # noqa: B023
        yield delta
        session.acknowledge(delta.position)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("ways", COVERED)
def test_a_copy_that_follows_the_deltas_is_the_program(ways: str, compiled: Compiled, tmp_path: Path) -> None:
    program, dice = compiled("mutator", "-O2"), random.Random(1)
    with ended(start_tracee(program, tmp_path, WAYS[ways], "1", "1000000", NAP_US, isolate=True)) as tracee:
        tracee.wait_for_output(len("ready\n"))
        with protected(tracee) as session:
            base = base_of(session)
            with laid(base, tmp_path) as standby:
                for delta in deltas_of(session, dice, DELTAS):
                    standby.copy.advance(delta)
                    standby.copy.require_clocks(age_ns(delta))
                    assert standby.copy.position == delta.position
                tracee.kill()
                back = standby.becomes_the_program()
                known = _rounds(back)
                back.wait_until(lambda: _rounds(back) > known + MORE_ROUNDS, f"{MORE_ROUNDS} more rounds")
                back.tell()
                status = back.finish()
    lines = back.output.splitlines()
    assert (status, lines[-1]) == (0, "ok"), lines[-20:]
    quiet = tmp_path / "quiet"
    quiet.mkdir()
    assert lines == _undisturbed(program, quiet, WAYS[ways], 1, len(lines) - 2)


def test_a_delta_that_breaks_off_halfway_leaves_a_torn_copy_of_which_nothing_is_made(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ended(start_tracee(compiled("mutator", "-O2"), tmp_path, "wp", "1", "1000000", NAP_US, isolate=True)) as tracee:
        with protected(tracee) as session:
            base = base_of(session)
            with laid(base, tmp_path) as standby:
                first, second = deltas_of(session, random.Random(2), 2)

                def breaks(*_: object) -> None:
                    raise CaptureError("the disk of the page cache has gone")

                with monkeypatch.context() as patched:
                    patched.setattr(memory, "fill", breaks)
                    with pytest.raises(CaptureError):
                        standby.copy.advance(first)
                assert standby.copy.torn
                assert standby.copy.position == base.position, "it never claims what it has not"
                for use in (lambda: standby.copy.advance(second), lambda: standby.copy.finish(RestoreOptions())):
                    with pytest.raises(RestoreError, match="torn"):
                        use()


def takes_whole_continuing_deltas_only(copy: Copy, session: Session) -> None:
    """Two deltas that come in the wrong order, then in halves, then as they should."""
    first, second = deltas_of(session, random.Random(3), 2)
    with pytest.raises(ChainError):
        copy.advance(second)
    whole = format.encode_bytes(first)
    with pytest.raises(FormatError):
        copy.advance(format.decode(whole[: len(whole) // 2]))
    assert not copy.torn
    copy.advance(first)
    copy.advance(second)


def test_what_does_not_continue_a_copy_or_has_not_come_whole_changes_nothing(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("mutator", "-O2"), tmp_path, "wp", "1", "1000000", NAP_US, isolate=True)) as tracee:
        with protected(tracee) as session:
            base = base_of(session)
            with laid(base, tmp_path) as standby:
                takes_whole_continuing_deltas_only(standby.copy, session)
                tracee.kill()
                back = standby.becomes_the_program()
                back.tell()
                assert (back.finish(), back.output.splitlines()[-1]) == (0, "ok")


def test_a_keeper_that_is_killed_takes_its_copy_along(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("mutator", "-O2"), tmp_path, "wp", "1", "1000000", NAP_US, isolate=True)) as tracee:
        with protected(tracee) as session:
            base = base_of(session)
    born = vessel_for(base, tmp_path)
    keeper = Keeper()
    try:
        with tempfile.TemporaryFile() as file:
            file.write(format.encode_bytes(base))
            file.flush()
            answer, _ = keeper.ask(messages.Lay(born.pid, base.component, age_ns(base)), (file.fileno(),))
        assert isinstance(answer, messages.Laid), answer
        assert answer.position == base.position
        assert answer.size > 1_000_000
        keeper.process.kill()
        keeper.process.wait()
        _, status = os.waitpid(born.pid, 0)
        assert os.WTERMSIG(status) == signal.SIGKILL
    finally:
        keeper.process.kill()
        keeper.process.wait()
        discard(born)


def test_a_program_with_a_shared_file_can_have_none_and_is_told_why(compiled: Compiled, tmp_path: Path) -> None:
    with ended(start_tracee(compiled("file_shared", "-O2"), tmp_path, isolate=True)) as tracee:
        base = captured(tracee)
        born = vessel_for(base, tmp_path)
        try:
            with pytest.raises(UnsupportedError, match=r"maps .* shared"):
                lay.lay(born.pid, base, RestoreOptions())
        finally:
            discard(born)


def test_none_is_laid_that_takes_more_than_half_of_what_is_free(
    compiled: Compiled, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ended(start_tracee(compiled("heap", "-O2"), tmp_path, isolate=True)) as tracee:
        base = captured(tracee)
        held = sum(run.size for run in base.runs)
        born = vessel_for(base, tmp_path)
        try:
            monkeypatch.setattr(memory_limits, "free", lambda: 2 * held - 1)
            with pytest.raises(UnsupportedError, match="more than half of the"):
                lay.lay(born.pid, base, RestoreOptions())
            monkeypatch.setattr(memory_limits, "free", lambda: 2 * held)
            assert lay.lay(born.pid, base, RestoreOptions()).position == base.position
        finally:
            discard(born)


def test_a_kernel_without_time_namespaces_has_one_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(single, "TIME_NAMESPACE", "/proc/self/ns/none")
    copy = object.__new__(ReadyCopy)
    monkeypatch.setattr(copy, "_tracee", SimpleNamespace(pid=os.getpid()), raising=False)
    assert copy._clocks_ahead_ns(0) is None
