"""What is kept ready at a standby ends whole, also where nobody waits for that any more."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from agent.figures import Figures
from agent.nursery import Nursery
from agent.ready_copy import Ready, ReadyCopy


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
        around = SimpleNamespace(places=SimpleNamespace(nursery=Nursery(tmp_path, "")))
        copy, component = ReadyCopy("/test/one", cast(Any, around), Figures()), Slow()
        copy._ready = Ready(cast(Any, component), cast(Any, None))
        copy._work = copy._task(copy._end("its chain has begun anew"))
        await component.began.wait()
        copy.drop()
        component.allowed.set()
        await copy.close()
        assert component.is_undone

    asyncio.run(story())
