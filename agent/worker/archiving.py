"""Has copies of checkpoints made in the archive (``[store] s3``): which, how often, and what the status says of those that lack.

The work is done by a process of its own (`agent.archive.process`); here nothing is read, folded, sealed or sent. No capture, no
acknowledgement and no takeover waits for it. A robot archives the components that run here, a server all that it keeps.

Loaded when it is wanted: an agent without an archive does not carry it.
"""

from __future__ import annotations

import asyncio
import logging
import os
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Collection
from typing import Final

from msgspec import Struct, field

from agent.archive.messages import Done, KeepCheckpoint, KeepContent, Look, Request
from agent.config import Settings
from agent.errors import TROUBLE, AgentError
from agent.worker.components.connection import Dialogue
from agent.worker.components.snapshots import newest_of
from checkpoint.keeper.messages import close_all, pair
from checkpoint.model import Position
from checkpoint.snapshot import format
from checkpoint.snapshot.required_files import Need, needs
from checkpoint.store.contract import SnapshotStore
from failover.core.events import Event, Noticed

BEHIND_ROUNDS: Final = 3
"""A copy that is older than so many rounds is told of, also while one is under way."""

SAID_MAX: Final = 3
"""Components that the status names; of more it says how many."""

log = logging.getLogger("failover.archive")

Opening = Callable[[str, Need], Awaitable[int]]
"""Opens a file that a component needs; raises CheckpointError or AgentError."""


class NotArchivedError(AgentError):
    """A copy could not be made; says why."""


class _Shelf(Struct):
    """One component's copies.

    Attributes:
        position: of the newest copy; None: none was made by this worker.
        since_s: when that was made, or the component was first seen here; monotonic.
        trouble: why the last try failed; "" if it did not.
    """

    since_s: float
    position: Position | None = None
    trouble: str = ""
    has: set[bytes] = field(default_factory=set)
    """Digests of the files that it needs and that were found in the archive."""


class Archiving:
    """The copies of one member. Lives in the worker's loop."""

    def __init__(
        self,
        settings: Settings,
        store: SnapshotStore,
        running: Callable[[], Collection[str]],
        open_need: Opening,
        tell: Callable[[Event], None],
    ) -> None:
        """
        Args:
            running: the components that run here.
        """
        self._settings, self._config = settings, settings.config.store
        self._store, self._running, self._open_need, self._tell = store, running, open_need, tell
        self._shelves: dict[str, _Shelf] = {}
        self._child: subprocess.Popen[bytes] | None = None
        self._dialogue: Dialogue | None = None

    async def run(self) -> None:
        """Make copies until cancelled."""
        try:
            while True:
                for name in self._wanted():
                    await self._copy(name)
                await asyncio.sleep(self._config.s3_every_s)
        finally:
            self._end_child()

    def complaints(self) -> list[str]:
        """For the status: what is not in the archive as it should be."""
        now_s, every_s = time.monotonic(), self._config.s3_every_s
        behind = []
        for name in self._wanted():
            shelf = self._shelves.setdefault(name, _Shelf(now_s))
            age_s = now_s - shelf.since_s
            if self._is_current(name, shelf) or not (shelf.trouble or age_s > BEHIND_ROUNDS * every_s):
                continue
            since = f"its newest copy is {age_s:.0f} s old" if shelf.position else f"it has had no copy for {age_s:.0f} s"
            why = shelf.trouble or "a copy is on its way"
            behind.append(
                f"ARCHIVE BEHIND: {name}: {since}: {why}; it is protected by its standby as before; next try within {every_s} s"
            )
        more = len(behind) - SAID_MAX
        return behind[:SAID_MAX] + ([f"ARCHIVE BEHIND: {more} more components"] if more > 0 else [])

    def _wanted(self) -> list[str]:
        held = self._store.components()
        return [name for name in held if self._settings.me.role == "server" or name in self._running()]

    def _is_current(self, name: str, shelf: _Shelf) -> bool:
        return shelf.position is not None and shelf.position == self._store.newest(name)

    async def _copy(self, name: str) -> None:
        """Make one copy of a component, unless it is as it was; never raises."""
        shelf = self._shelves.setdefault(name, _Shelf(time.monotonic()))
        if self._is_current(name, shelf):
            return
        try:
            if self._settings.config.bring:
                await self._copy_files(name, shelf)
            begun_s = time.monotonic()
            chain = tuple(await asyncio.to_thread(self._store.open_chain, name))
            try:
                position = format.read_header(chain[-1]).position
                done = await self._ask(KeepCheckpoint(name), chain)
            finally:
                close_all(chain)
        except TROUBLE as error:
            self._fail(name, shelf, str(error))
            return
        if shelf.trouble:
            self._tell(Noticed(name, "its checkpoints reach the archive again"))
        shelf.position, shelf.since_s, shelf.trouble = position, begun_s, ""
        log.debug("%s is in the archive: %s, %d bytes", name, done.name, done.size)

    async def _copy_files(self, name: str, shelf: _Shelf) -> None:
        """The files that its program needs, each once.

        Raises:
            CheckpointError, AgentError, OSError: one of them is not here, or does not arrive.
        """
        outline = await asyncio.to_thread(newest_of, self._store, name)
        brings_data = self._settings.component(name).bring_data
        wanted = {need.digest: need for need in needs(outline, opened=brings_data)} if outline is not None else {}
        unknown = tuple(digest for digest in wanted if digest and digest not in shelf.has)
        if not unknown:
            return
        lacking = (await self._ask(Look(unknown))).lacking
        for digest in lacking:
            descriptor = await self._open_need(name, wanted[digest])
            try:
                await self._ask(KeepContent(digest), (descriptor,))
            finally:
                os.close(descriptor)
        shelf.has.update(unknown)

    def _fail(self, name: str, shelf: _Shelf, trouble: str) -> None:
        if not shelf.trouble:
            log.warning("%s does not reach the archive: %s", name, trouble)
            self._tell(Noticed(name, f"its checkpoints do not reach the archive: {trouble}"))
        shelf.trouble = trouble

    async def _ask(self, request: Request, descriptors: tuple[int, ...] = ()) -> Done:
        """Have the process do something.

        Raises:
            AgentError: it cannot be done, or the process ended.
        """
        answer, more = await self._opened().ask(request, descriptors)
        close_all(more)
        if not isinstance(answer, Done) or answer.refusal:
            raise NotArchivedError(answer.refusal)
        return answer

    def _opened(self) -> Dialogue:
        """The conversation with the process, which is started if there is none."""
        if self._dialogue is not None and self._dialogue.open:
            return self._dialogue
        self._end_child()
        ours, theirs = pair()
        with theirs:
            command = [sys.executable, "-P", "-m", "agent.archive.process", str(self._settings.path), str(theirs.fileno())]
            self._child = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL, process_group=0)
        self._dialogue = Dialogue(ours, Done, NotArchivedError, "the archive's process")
        return self._dialogue

    def _end_child(self) -> None:
        if self._dialogue is not None:
            self._dialogue.close()
        if self._child is not None:
            self._child.kill()
            self._child.wait()
        self._dialogue = self._child = None
