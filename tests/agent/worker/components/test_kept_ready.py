"""Processes kept ready at a standby end completely, also where no caller waits for the end any more."""

from __future__ import annotations

import asyncio
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from agent.worker.components import ready_copy
from agent.worker.components.process_pool import ProcessPool
from agent.worker.components.ready_copy import Ready, ReadyCopy
from agent.worker.components.statistics import Figures
from checkpoint.errors import RestoreError


class Slow:
    """A component whose end takes until it is allowed."""

    def __init__(self) -> None:
        self.began, self.allowed, self.is_undone = asyncio.Event(), asyncio.Event(), False

    async def undo(self) -> None:
        self.began.set()
        await self.allowed.wait()
        self.is_undone = True


def test_a_copy_that_is_being_ended_is_ended_whole_when_none_is_wanted_any_more(tmp_path: Path) -> None:
    async def story() -> None:
        around = SimpleNamespace(places=SimpleNamespace(process_pool=ProcessPool(tmp_path, "")))
        copy, component = ReadyCopy("/test/one", cast(Any, around), Figures()), Slow()
        copy._ready = Ready(cast(Any, component), cast(Any, None))
        copy._work = copy._task(copy._end("its chain has begun anew"))
        await component.began.wait()
        copy.drop()
        component.allowed.set()
        await copy.close()
        assert component.is_undone

    asyncio.run(story())


class Fickle(ReadyCopy):
    """A copy that can be laid, and not be brought on."""

    async def _lay(self, spec: Any) -> None:
        component = Slow()
        component.allowed.set()
        self._ready = Ready(cast(Any, component), cast(Any, None))
        self._news.set()

    async def _bring_on(self, position: Any = None) -> None:
        raise RestoreError("its processes have changed")

    async def _until_news(self) -> None:
        await self._news.wait()


@pytest.mark.parametrize(("steady_s", "pauses"), [(math.inf, [0.1, 1.0, 5.0, 30.0, 30.0]), (0.0, [0.1] * 5)])
def test_a_copy_that_is_laid_in_vain_is_laid_more_and_more_seldom_unless_it_has_stood_for_long(
    steady_s: float, pauses: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept: list[float] = []

    async def sleep(seconds: float) -> None:
        slept.append(seconds)
        if len(slept) == len(pauses):
            raise asyncio.CancelledError

    async def story() -> None:
        around = SimpleNamespace(places=SimpleNamespace(process_pool=ProcessPool(tmp_path, "")))
        copy = Fickle("/test/one", cast(Any, around), Figures())
        with pytest.raises(asyncio.CancelledError):
            await copy._follow(cast(Any, None), lambda ready, why: None)

    monkeypatch.setattr(ready_copy, "STEADY_S", steady_s)
    monkeypatch.setattr(ready_copy, "asyncio", SimpleNamespace(**{**vars(asyncio), "sleep": sleep}))
    asyncio.run(story())
    assert slept == pauses
