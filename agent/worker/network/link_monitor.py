"""Watches for cables that are pulled and plugged and for addresses that come and go: the kernel reports them, without polling.

Where the kernel does not report them (no netlink socket can be opened), this module polls once a second.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Awaitable, Callable
from typing import Final

from agent.system import rtnetlink
from agent.system.crash import end_worker_on_mistake
from agent.worker.network.links import Links

SETTLE_S: Final = 0.05
"""Messages about one cable come in a burst; the last one counts."""

POLL_S: Final = 1.0

log = logging.getLogger("failover.links")


class Wires:
    """Refreshes `Links` and passes the changes on. Lives in the worker's loop."""

    def __init__(self, links: Links, changed: Callable[[list[str]], Awaitable[None]]) -> None:
        self._links = links
        self._changed = changed
        self._listener: socket.socket | None = None
        self._stirred = asyncio.Event()
        self._task: asyncio.Task[None] | None = None

    def watch(self) -> None:
        """Look once now, and again whenever something changes."""
        try:
            self._listener = rtnetlink.changes()
        except OSError as error:
            log.warning("the kernel does not report a pulled cable (%s); the agent asks it every %.0f s", error.strerror, POLL_S)
        if self._listener is not None:
            asyncio.get_running_loop().add_reader(self._listener.fileno(), self._stir)
        self._stirred.set()
        first = self._links.refresh()
        self._task = asyncio.create_task(self._follow(first))
        self._task.add_done_callback(end_worker_on_mistake)

    def close(self) -> None:
        """Look no longer."""
        if self._task is not None:
            self._task.cancel()
        if self._listener is not None:
            asyncio.get_running_loop().remove_reader(self._listener.fileno())
            self._listener.close()

    def _stir(self) -> None:
        assert self._listener is not None
        rtnetlink.drain(self._listener)
        self._stirred.set()

    async def _follow(self, first: list[str]) -> None:
        await self._changed(first)
        while True:
            if self._listener is not None:
                await self._stirred.wait()
                await asyncio.sleep(SETTLE_S)
                self._stirred.clear()
            else:
                await asyncio.sleep(POLL_S)
            sentences = self._links.refresh()
            if sentences:
                await self._changed(sentences)
