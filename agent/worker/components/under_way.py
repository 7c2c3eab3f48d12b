"""Tells the core that an act is carried out still."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Callable
from typing import Final

from failover.core.events import Event, UnderWay

EVERY_S: Final = 5.0
"""Far less than `failover.core.types.Config.ship_ms`, after which the core gives up what it hears nothing of."""


@contextlib.asynccontextmanager
async def told(tell: Callable[[Event], None], event: UnderWay) -> AsyncIterator[None]:
    """Tell the event again and again for as long as the body lasts."""
    telling = asyncio.create_task(_tell(tell, event))
    try:
        yield
    finally:
        telling.cancel()


async def _tell(tell: Callable[[Event], None], event: UnderWay) -> None:
    while True:
        await asyncio.sleep(EVERY_S)
        tell(event)
