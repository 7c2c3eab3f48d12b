"""The message that a driver carries out now: what it sends to other drivers meanwhile goes on with that message's hops."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final

from failover.core.messaging.envelope import Hop

_HOPS: Final[ContextVar[tuple[Hop, ...]]] = ContextVar("failover_hops", default=())


@contextmanager
def carrying_out(hops: tuple[Hop, ...]) -> Iterator[None]:
    """In the body a message with these hops is carried out, by this thread. The last hop is of this process."""
    token = _HOPS.set(hops)
    try:
        yield
    finally:
        _HOPS.reset(token)


def hops_so_far() -> tuple[Hop, ...]:
    """Of the message that this thread carries out; (): it carries out none."""
    return _HOPS.get()
