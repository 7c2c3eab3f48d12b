"""`failover.every`: a loop whose turns are committed, at their times."""

from __future__ import annotations

import asyncio
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import failover
from failover.kept_state.api import PROCESS

PERIOD_S = 0.001


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """States lie in a folder of the test's own, and none is kept when it ends."""
    monkeypatch.setenv("FAILOVER_STATE", str(tmp_path))
    monkeypatch.delenv("FAILOVER_COMPONENT", raising=False)
    yield tmp_path
    PROCESS.release()


def counted_again() -> int:
    """What is stored, read as the next process would."""
    PROCESS.release()
    return failover.resume("counter", default={"n": 0})["n"]


def test_each_turn_that_is_done_is_committed_and_one_that_is_left_is_not() -> None:
    state = failover.resume("counter", default={"n": 0})
    turns = []
    for turn in failover.every(PERIOD_S):
        turns.append(turn)
        state["n"] += 1
        if state["n"] == 4:
            break
    assert turns == [0, 1, 2, 3]
    assert failover.activations().steps == 3
    assert counted_again() == 3


def test_a_turn_that_raises_is_not_committed() -> None:
    state = failover.resume("counter", default={"n": 0})

    def count() -> None:
        for _ in failover.every(0):
            state["n"] += 1
            if state["n"] == 3:
                raise RuntimeError

    with pytest.raises(RuntimeError):
        count()
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL, "the loop gives back what it took"
    assert counted_again() == 2


def test_in_an_asyncio_loop_others_run_between_the_turns() -> None:
    ticks = 0

    async def tick() -> None:
        nonlocal ticks
        while True:
            ticks += 1
            await asyncio.sleep(0)

    async def count() -> None:
        other = asyncio.create_task(tick())
        state = failover.resume("counter", default={"n": 0})
        async for turn in failover.every(PERIOD_S):
            state["n"] += 1
            if turn == 3:
                break
        other.cancel()

    asyncio.run(count())
    assert ticks > 3
    assert counted_again() == 3


@pytest.mark.parametrize("period", [-0.1, float("nan"), float("inf")])
def test_what_is_no_period_is_refused(period: float) -> None:
    failover.resume("counter", default={"n": 0})
    with pytest.raises(failover.TaskError, match="is no period: say how many seconds"):
        failover.every(period)


def test_a_loop_without_a_state_is_refused_before_its_first_turn() -> None:
    with pytest.raises(failover.TaskError, match=r"begin with failover\.resume"):
        failover.every(PERIOD_S)


@pytest.mark.parametrize("way", ["for", "async for"])
def test_sigterm_ends_the_loop_after_the_turn_under_way(way: str, folder: Path) -> None:
    path = folder / "program.py"
    path.write_text(f"""
import asyncio, failover
async def count():
    state = failover.resume("counter", default={{"n": 0}})
    {way} _ in failover.every(3600):
        state["n"] += 1
        print("turn", flush=True)
    print("ended well", flush=True)
asyncio.run(count())
""")
    with subprocess.Popen([sys.executable, path], cwd=folder, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "turn\n"
            process.send_signal(signal.SIGTERM)
            assert process.communicate(timeout=60) == ("ended well\n", None)
        finally:
            process.kill()
    assert process.returncode == 0
    assert counted_again() == 1
