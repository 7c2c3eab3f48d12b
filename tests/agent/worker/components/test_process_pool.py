"""The process pool: which guards and keepers wait in advance, and when."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import psutil
import pytest

from agent.worker.components import process_pool
from agent.worker.components.process_pool import ProcessPool

PATIENCE_S = 60.0
POLL_S = 0.01


def live(directory: Path, story: Callable[[ProcessPool], Coroutine[Any, Any, None]]) -> None:
    async def whole() -> None:
        process_pool = ProcessPool(directory, "")
        try:
            await asyncio.wait_for(story(process_pool), PATIENCE_S)
        finally:
            await process_pool.close()

    asyncio.run(whole())


def waiting() -> dict[str, int]:
    """How many of our children are guards, and keepers."""
    found = {"agent.guard.server": 0, "keeper": 0}
    for child in psutil.Process().children():
        words = child.cmdline() if child.status() != psutil.STATUS_ZOMBIE else []
        for kind in found:
            found[kind] += kind in words
    return found


async def until(wanted: dict[str, int]) -> None:
    while waiting() != wanted:
        await asyncio.sleep(POLL_S)


def test_nobody_waits_where_there_is_no_component(tmp_path: Path) -> None:
    async def story(process_pool: ProcessPool) -> None:
        process_pool.expect(0)
        await asyncio.sleep(0.2)
        assert waiting() == {"agent.guard.server": 0, "keeper": 0}

    live(tmp_path, story)


def test_with_the_first_guard_that_is_given_a_keeper_is_born(tmp_path: Path) -> None:
    async def story(process_pool: ProcessPool) -> None:
        guard = await process_pool.guard()
        await until({"agent.guard.server": 1, "keeper": 1})
        process_pool.expect(0)
        await until({"agent.guard.server": 2, "keeper": 1})  # one more than the one that was given
        guard.close()

    live(tmp_path, story)


def test_what_has_a_ready_copy_needs_no_pair_besides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process_pool, "REFILL_S", 0.0)

    async def story(process_pool: ProcessPool) -> None:
        for name in ("one", "other"):
            process_pool.relieve(name, True)
        process_pool.expect(3)
        await until({"agent.guard.server": 1, "keeper": 1})
        process_pool.relieve("other", False)
        await until({"agent.guard.server": 2, "keeper": 2})

    live(tmp_path, story)


def test_a_pair_waits_for_each_component_that_may_be_taken_over(tmp_path: Path) -> None:
    async def story(process_pool: ProcessPool) -> None:
        process_pool.expect(2)
        await until({"agent.guard.server": 2, "keeper": 2})

    live(tmp_path, story)
