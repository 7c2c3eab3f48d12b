"""Tells the core that an act is carried out still."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable, Iterator
from typing import Final

from failover.core.events import Event, UnderWay

EVERY_S: Final = 5.0
"""Far less than `failover.core.types.Config.ship_ms`, after which the core gives up what it hears nothing of."""


@contextlib.contextmanager
def told(tell: Callable[[Event], None], event: UnderWay) -> Iterator[None]:
    """Tell the event again and again for as long as the body lasts."""
    with each(EVERY_S, lambda: tell(event)):
        yield


@contextlib.contextmanager
def each(period_s: float, act: Callable[[], object]) -> Iterator[None]:
    """Do something after each period for as long as the body lasts; most bodies are over before the first time."""
    loop = asyncio.get_running_loop()
    timer: asyncio.TimerHandle

    def again() -> None:
        nonlocal timer
        timer = loop.call_later(period_s, again)
        act()

    timer = loop.call_later(period_s, again)
    try:
        yield
    finally:
        timer.cancel()
