"""Copies before a freeze keep it within the operator's limit; a program too fast for that is captured all the same."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder, Terms
from checkpoint.engines.ptrace.capture import freeze_budget, memory
from checkpoint.engines.ptrace.capture.freeze_budget import FIRST_PAGE_NS, FIRST_REST_NS, FreezeBudget
from checkpoint.engines.ptrace.capture.memory import MemoryCapture, RunningCopy
from checkpoint.engines.ptrace.capture.process import CapturedProcess
from checkpoint.engines.ptrace.capture.session import PtraceSession
from checkpoint.engines.ptrace.capture.standstill import Standstill
from checkpoint.errors import CaptureError
from tests.checkpoint.engines.ptrace.capture.test_deltas import OBEDIENT
from tests.checkpoint.round_trip import ENGINE, Program, at_last, ended, protected, start

MS = 1_000_000
PAGE = 4096


def test_a_budget_learns_what_a_page_and_the_rest_take() -> None:
    budget = FreezeBudget(10 * MS)
    assert budget.page_count == (10 * MS - FIRST_REST_NS) // FIRST_PAGE_NS
    for _ in range(100):
        budget.note(freeze_ns=6 * MS, copy_ns=4 * MS, size=4000 * PAGE)
    assert 7_900 <= budget.page_count <= 8_000, "1 µs a page, 2 ms besides"
    for _ in range(100):
        budget.note(freeze_ns=2 * MS, copy_ns=MS, size=PAGE)
    assert 8_900 <= budget.page_count <= 9_000, "one page tells nothing of what many take"
    for _ in range(100):
        budget.note(freeze_ns=20 * MS, copy_ns=0, size=0)
    assert budget.page_count == 1, "no copying beforehand helps"


class Obedient:
    """A program that writes as many pages as it is told, and the session that follows it."""

    def __init__(self, program: Program, session: PtraceSession) -> None:
        self.program, self.session = program, session
        self._told = 0

    def write(self, count: int) -> None:
        """Have it write so many, and wait for it."""
        self._told += count
        directory = self.program.directory
        (directory / "next").write_text(str(self._told))
        (directory / "next").replace(directory / "orders")
        self.program.wait_for_line(str(self._told))


@contextmanager
def obedient(tmp_path: Path, budget_ns: int, overrun_ns: int = 1) -> Iterator[Obedient]:
    """Where nothing else is said, no freeze is given up because it takes long."""
    order = ProtectOrder("/test/tracee", terms=Terms(freeze_budget_ns=budget_ns, freeze_overrun_ns=overrun_ns))
    with ended(start([sys.executable, "-S", "-c", OBEDIENT, tmp_path, "0.001"], tmp_path)) as program:
        session = at_last(lambda: ENGINE.protect(program.pid, order))
        assert isinstance(session, PtraceSession)
        try:
            program.wait_for_line("ready")
            session.acknowledge(session.capture(CaptureOrder(base=True, sequence=1)).position)
            yield Obedient(program, session)
        finally:
            session.close()


@pytest.mark.root
def test_what_a_budget_has_room_for_is_copied_once(tmp_path: Path) -> None:
    with obedient(tmp_path, 1_000_000 * MS) as one:
        one.write(2000)
        snapshot = one.session.capture(CaptureOrder(base=False, sequence=2))
        one.program.kill()
    assert 2000 * PAGE <= len(snapshot.contents) <= one.session.frozen_size


@pytest.fixture
def all_looks_count(monkeypatch: pytest.MonkeyPatch) -> None:
    """No look is repeated. A look is, where the program wrote to a file's page before it was confirmed: busy machines decide."""
    confirm = MemoryCapture.confirm
    monkeypatch.setattr(MemoryCapture, "confirm", lambda self: confirm(self) or True)


def _followed_by_writes(monkeypatch: pytest.MonkeyPatch, one: Obedient, written: Callable[[int], int]) -> list[int]:
    """Have the program write after each pass; the passes' numbers."""
    catch_up, passes = MemoryCapture._catch_up, list[int]()

    def passing(self: MemoryCapture, copied: RunningCopy) -> None:
        catch_up(self, copied)
        passes.append(len(passes))
        if count := written(len(passes)):
            one.write(count)

    monkeypatch.setattr(MemoryCapture, "_catch_up", passing)
    return passes


@pytest.mark.root
def test_as_many_passes_are_made_as_catch_up_with_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """After each pass half as much is written: more passes than anybody would make who is given no budget."""
    with obedient(tmp_path, MS + 200 * FIRST_PAGE_NS) as one:
        monkeypatch.setattr(FreezeBudget, "page_count", 200)
        one.write(8000)
        passes = _followed_by_writes(monkeypatch, one, lambda turn: 7000 >> turn)
        snapshot = one.session.capture(CaptureOrder(base=False, sequence=2))
        one.program.kill()
    assert len(passes) > memory.PASS_LIMIT
    assert len(snapshot.contents) >= 8000 * PAGE
    own = 200  # pages of the interpreter's
    assert one.session.frozen_size <= (200 + own) * PAGE


@pytest.mark.root
def test_a_program_that_cannot_be_caught_up_with_is_captured_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with obedient(tmp_path, 1) as one:
        one.write(2000)
        passes = _followed_by_writes(monkeypatch, one, lambda _: 2000)
        one.session.capture(CaptureOrder(base=False, sequence=2))
        one.program.kill()
    assert memory.PASS_LIMIT < len(passes) < memory.BUDGET_PASS_LIMIT, "it was seen to be of no use"
    assert one.session.frozen_size >= 2000 * PAGE


@pytest.mark.root
@pytest.mark.usefixtures("all_looks_count")
def test_a_freeze_that_would_take_too_long_is_given_up_and_the_next_ones_copy_less(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where no budget is set: the program writes after the last pass, until it is let go a second time."""
    monkeypatch.setattr(freeze_budget, "LONG_COPY_NS", 2_000 * FIRST_PAGE_NS)
    given_up: list[int] = []
    freeze = Standstill.freeze

    def freezing(self: Standstill) -> int:
        given_up.append(len(given_up))
        if len(given_up) <= 2:
            one.write(8_000)
        return freeze(self)

    with obedient(tmp_path, 0) as one:
        monkeypatch.setattr(Standstill, "freeze", freezing)
        snapshot = one.session.capture(CaptureOrder(base=False, sequence=2))
        one.program.kill()
    assert len(given_up) == 3
    assert len(snapshot.contents) >= 8_000 * PAGE
    assert one.session.frozen_size < 2_000 * PAGE


@pytest.mark.root
@pytest.mark.usefixtures("all_looks_count")
def test_a_capture_that_takes_long_makes_no_pass_in_vain_and_ends_with_its_next_freeze(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On an overloaded robot: else a program that writes fast has no checkpoint for minutes."""
    monkeypatch.setattr(freeze_budget, "LONG_CAPTURE_NS", 0)
    monkeypatch.setattr(freeze_budget, "LONG_COPY_NS", 2_000 * FIRST_PAGE_NS)
    with obedient(tmp_path, 0) as one:
        one.write(8_000)
        passes = _followed_by_writes(monkeypatch, one, lambda _: 8_000)
        snapshot = one.session.capture(CaptureOrder(base=False, sequence=2))
        one.program.kill()
    assert len(passes) == 2, "the second one copied as much as the first"
    assert len(snapshot.contents) >= 8_000 * PAGE
    assert one.session.frozen_size >= 8_000 * PAGE


@pytest.mark.root
@pytest.mark.usefixtures("all_looks_count")
def test_no_capture_takes_longer_than_its_budget_but_by_the_rule_and_what_it_copied_is_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A program that writes as fast as it is copied: given up, told why and until when, and captured when that time has come."""
    hour_ns = 3_600_000_000_000
    with obedient(tmp_path, 10 * MS, hour_ns) as one:
        looks: list[int] = []
        monkeypatch.setattr(Standstill, "freeze", _writing_first(Standstill.freeze, one, looks))
        with pytest.raises(CaptureError, match=r"gave 4 freezes up .* freeze_budget_ms of 10; in 3\d{3} s one may take longer"):
            one.session.capture(CaptureOrder(base=False, sequence=2))
        assert len(looks) == 4
        one.session._budget._whole_ns -= hour_ns
        snapshot = one.session.capture(CaptureOrder(base=False, sequence=3))
        one.program.kill()
    assert len(looks) == 5, "it was taken at once"
    assert len(snapshot.contents) >= 8_192 * PAGE, "nothing is forgotten of what failed captures named"


def _writing_first(freeze: Callable[[Standstill], int], one: Obedient, looks: list[int]) -> Callable[[Standstill], int]:
    """Between the last pass and the freeze all 32 MB are written."""

    def freezing(self: Standstill) -> int:
        looks.append(len(looks))
        one.write(8_192)
        return freeze(self)

    return freezing


def test_what_a_capture_tells_is_the_longest_time_that_the_program_stood_still(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = 0
    confirm = MemoryCapture.confirm
    look = CapturedProcess.look

    def slow_at_first(self: CapturedProcess, *arguments: object, **named: object) -> object:
        nonlocal looks
        looks += 1
        time.sleep(0.2 if looks == 1 else 0)
        return look(self, *arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(CapturedProcess, "look", slow_at_first)
    monkeypatch.setattr(MemoryCapture, "confirm", lambda self: confirm(self) and looks > 1)
    with ended(start(["sleep", "600"], tmp_path)) as program, protected(program) as session:
        snapshot = session.capture(CaptureOrder(base=True, sequence=1))
        assert looks == 2, "the first look was not whole"
        assert snapshot.freeze_us >= 200_000
