"""The message that a driver carries out now: what it sends to other drivers meanwhile goes on with that message's hops.

These tell where a message was, and refuse nothing: two drivers may post to each other for ever.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

from failover.core.messaging.envelope import HOPS_MAX, Hop

CARRIED_MAX: Final = HOPS_MAX // 2
"""Hops that another message begins with; behind more it begins a new way. The others are left to who passes a message on."""

_HOPS: Final[ContextVar[list[tuple[Hop, ...]] | None]] = ContextVar("failover_hops", default=None)
"""Emptied when the message is carried out: asyncio's tasks that it has begun have this list, and live on."""


@contextmanager
def carrying_out(hops: tuple[Hop, ...]) -> Iterator[None]:
    """In the body a message with these hops is carried out, by this thread. The last hop is of this process."""
    carried = [hops]
    token = _HOPS.set(carried)
    try:
        yield
    finally:
        _HOPS.reset(token)
        carried.clear()


def hops_so_far() -> tuple[Hop, ...]:
    """Of the message that is carried out here, for one that is sent meanwhile; (): that one begins a new way."""
    carried = _HOPS.get()
    try:
        hops = carried[0] if carried else ()
    except IndexError:  # another thread has just ended it
        return ()
    return hops if len(hops) <= CARRIED_MAX else ()
