"""The watchdog ends a process that owes an answer and does nothing, and none that works, waits for a disk, or owes nothing."""

from __future__ import annotations

import asyncio
import itertools
import os
import signal
import subprocess
from collections.abc import Callable, Iterable

import pytest

from agent.worker.components import stall_watchdog
from agent.worker.components.stall_watchdog import STEP_S, STEPS_MAX, Watchman
from failover.core.schedule.slack import LAG_NS_MAX

PATIENCE_S = 30.0
LOOKS = 3 * STEPS_MAX
STANDING = [("T", 7)] * LOOKS


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stall_watchdog, "STEP_S", 0.001)
    monkeypatch.setattr(stall_watchdog, "LATE_S", PATIENCE_S)


def is_ended(
    monkeypatch: pytest.MonkeyPatch, sights: Iterable[tuple[str, int]], owed: Callable[[], object] = lambda: "an answer"
) -> bool:
    """Whether a process is ended that looks like this, one look after the other."""
    rest = iter(sights)
    reasons: list[str] = []

    async def story() -> None:
        over = asyncio.Event()

        class Watching(Watchman):
            def end(self, why: str) -> None:
                reasons.append(why)
                over.set()

        def activity(_pid: int) -> tuple[str, int]:
            sight = next(rest, None)
            if sight is None:
                over.set()
            return sight or ("R", 0)

        monkeypatch.setattr(stall_watchdog, "activity", activity)
        watchman = Watching(os.getpid(), "the keeper", owed)
        watchman.awaits()
        await asyncio.wait_for(over.wait(), PATIENCE_S)
        watchman.close()

    asyncio.run(story())
    return bool(reasons)


def test_who_stands_still_and_owes_an_answer_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    assert is_ended(monkeypatch, STANDING)


def test_who_works_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not is_ended(monkeypatch, [("S", look // (STEPS_MAX - 1)) for look in range(LOOKS)])


def test_who_waits_for_a_disk_or_is_not_to_be_seen_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not is_ended(monkeypatch, [("D", 7)] * LOOKS)
    assert not is_ended(monkeypatch, [("", 0)] * LOOKS)


def test_who_is_kept_from_running_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not is_ended(monkeypatch, [("R", 7)] * LOOKS)


def test_who_answers_one_question_after_the_other_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    questions = itertools.count()
    assert not is_ended(monkeypatch, STANDING, lambda: next(questions))


def test_looks_that_come_late_prove_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stall_watchdog, "LATE_S", -1.0)
    assert not is_ended(monkeypatch, STANDING)


def test_a_process_that_was_stopped_is_really_ended() -> None:
    process = subprocess.Popen(["sleep", "1000"])
    try:
        process.send_signal(signal.SIGSTOP)

        async def story() -> None:
            Watchman(process.pid, "the guard", lambda: "an answer").awaits()
            await asyncio.to_thread(process.wait, PATIENCE_S)

        asyncio.run(story())
        assert process.returncode == -signal.SIGKILL
    finally:
        process.kill()
        process.wait()


def test_a_keeper_that_waits_for_a_window_answers_before_it_is_taken_for_one_that_hangs() -> None:
    """It sleeps meanwhile, and may use no tick of its processor."""
    assert 2 * LAG_NS_MAX < STEPS_MAX * STEP_S * 1e9
