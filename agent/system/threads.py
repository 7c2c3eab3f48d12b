"""Work in a thread that must have ended before its caller goes on, even where the caller is cancelled."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


async def to_its_end(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Run a function in a thread, as `asyncio.to_thread` does; a cancellation waits until the function has returned.

    For functions that write by a descriptor which the caller closes afterwards: under a thread that still runs, the number would
    become that of another file.
    """
    work = asyncio.ensure_future(asyncio.to_thread(function, *args, **kwargs))
    try:
        return await asyncio.shield(work)
    except asyncio.CancelledError:
        while not work.done():
            with contextlib.suppress(BaseException):
                await asyncio.shield(work)
        raise
