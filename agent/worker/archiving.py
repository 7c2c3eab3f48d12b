"""Has copies of checkpoints made in the archive (``[store] s3``): which, how often, and what the status says of those that lack.

The work is done by a process of its own (`agent.archive.process`); here nothing is read, folded, sealed or sent. No capture, no
acknowledgement and no takeover waits for it. A robot archives the components that run here, a server all that it keeps.

Loaded when it is wanted: an agent without an archive does not carry it.
"""

from __future__ import annotations

import asyncio
import logging
import os
import time
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Final

from msgspec import Struct, field

from agent.archive.messages import KeepCheckpoint, KeepContent, Look
from agent.config import Settings
from agent.core_config import fetches
from agent.errors import TROUBLE
from agent.system import clock
from agent.worker.archive_process import ArchiveProcess
from agent.worker.components.snapshots import newest_of
from agent.worker.replication.send_files import Reader
from agent.worker.replication.send_sealed import Courier
from checkpoint.keeper.messages import close_all
from checkpoint.model import Position
from checkpoint.snapshot import format
from checkpoint.snapshot.required_files import needs
from checkpoint.store.contract import SnapshotStore
from checkpoint.store.index import folder_name
from failover.archive.archive import Copy
from failover.archive.keys import key_path
from failover.config.team import TEAM_FILE
from failover.core.events import Archived, Event, Noticed

BEHIND_ROUNDS: Final = 3
"""A copy that is older than so many rounds is told of, also while one is under way."""

SAID_MAX: Final = 3
"""Components that the status names; of more it says how many."""

REFUSED_MAX: Final = 3
"""Files of one component that the archive may refuse in one round; then its checkpoint has its turn."""

log = logging.getLogger("failover.archive")


class _Shelf(Struct):
    """One component's copies.

    Attributes:
        position: of the newest copy; None: none was made by this worker for these readers.
        epoch: of that one; put_ns: when it was there, by the boot clock.
        since_s: when that was made, or the component was first seen here; monotonic.
        trouble: why the last try failed, wholly or for a file that it needs; "" if it did not.
        is_stale: the newest copy was sealed for other members than there are now; ``due_s``: since then.
    """

    since_s: float
    position: Position | None = None
    epoch: int = 0
    put_ns: int = 0
    trouble: str = ""
    is_stale: bool = False
    due_s: float = 0.0
    has: set[bytes] = field(default_factory=set)
    """Digests of the files that it needs and that were found in the archive."""


class Archiving:
    """The copies of one member. Lives in the worker's loop."""

    def __init__(
        self,
        settings: Settings,
        store: SnapshotStore,
        running: Callable[[], Collection[str]],
        open_need: Reader,
        tell: Callable[[Event], None],
        courier: Courier | None = None,
    ) -> None:
        """
        Args:
            running: the components that run here.
            courier: brings what is for the witness that keeps the copies; None: they go elsewhere.
        """
        self._courier = courier
        self._settings, self._config = settings, settings.config.store
        self._store, self._running, self._open_need, self._tell = store, running, open_need, tell
        self._shelves: dict[str, _Shelf] = {}
        self._process = ArchiveProcess(settings.path, courier)
        self._busy_with = ""
        self._sealed_by: tuple[tuple[int, int] | None, ...] = ()

    async def run(self) -> None:
        """Make copies until cancelled."""
        try:
            while True:
                await self._look_at_keys()
                for name in self._wanted():
                    self._busy_with = name
                    await self._copy(name)
                self._busy_with = ""
                await asyncio.sleep(self._config.s3_every_s)
        finally:
            self._process.close()

    async def _look_at_keys(self) -> None:
        """With another archive key, or for other members, all copies are made again: not all could open those of before."""
        directory = Path(self._settings.config.team_directory)
        found = await asyncio.to_thread(_signs_of, key_path(directory), directory / TEAM_FILE)
        if self._sealed_by and found != self._sealed_by:
            for shelf in self._shelves.values():
                shelf.is_stale, shelf.due_s, shelf.has = True, time.monotonic(), set()
                if found[:1] != self._sealed_by[:1]:
                    shelf.position = None
        self._sealed_by = found

    def listed(self, copies: Collection[Copy], begun_ns: int) -> None:
        """What the archive had from that instant on: a copy that has gone, and was followed by no later one, is put again."""
        newest: dict[str, tuple[int, int]] = {}
        for copy in copies:
            newest[copy.folder] = max(newest.get(copy.folder, (0, 0)), (copy.generation, copy.sequence))
        for name, shelf in self._shelves.items():
            if shelf.position is None or shelf.put_ns >= begun_ns:
                continue
            if newest.get(folder_name(name), (0, 0)) < (shelf.position.generation, shelf.position.sequence):
                shelf.position, shelf.has = None, set()
                self._tell(Archived(name, shelf.epoch, None, begun_ns))
                self._tell(Noticed(name, "its newest copy is in the archive no more: it is put again"))

    def complaints(self) -> list[str]:
        """For the status: what is not in the archive as it should be."""
        now_s, every_s = time.monotonic(), self._config.s3_every_s
        behind = []
        for name in self._wanted():
            shelf = self._shelves.setdefault(name, _Shelf(now_s))
            age_s = now_s - shelf.since_s
            is_late = now_s - max(shelf.since_s, shelf.due_s) > BEHIND_ROUNDS * every_s and not self._is_current(name, shelf)
            if not (shelf.trouble or is_late):
                continue
            since = f"its newest copy is {age_s:.0f} s old" if shelf.position else f"it has had no copy for {age_s:.0f} s"
            is_waiting = self._busy_with not in ("", name)
            why = shelf.trouble or (f"it waits behind {self._busy_with}" if is_waiting else "a copy is on its way")
            is_standby = fetches(self._settings) and self._settings.config.rule == "etcd"
            alone = "a robot that does not hear this one would resume from that copy" if is_standby else ""
            stays = alone or "a standby, if it has one, protects it as before"
            behind.append(f"ARCHIVE BEHIND: {name}: {since}: {why}; {stays}; next try within {every_s} s")
        more = len(behind) - SAID_MAX
        return behind[:SAID_MAX] + ([f"ARCHIVE BEHIND: {more} more components"] if more > 0 else [])

    def sealed(self, component: str) -> dict[str, object] | None:
        """For the status: the newest copy of a component at the witness; None: this worker has made none there."""
        shelf = self._shelves.get(component)
        if not self._config.witness or shelf is None or shelf.position is None:
            return None
        return {"at": self._config.witness, "age_s": time.monotonic() - shelf.since_s, "copies": None, "size": None}

    def _wanted(self) -> list[str]:
        held = self._store.components()
        if self._settings.me.role == "server":
            return list(held)
        running = self._running()
        return [name for name in held if name in running]

    def _is_current(self, name: str, shelf: _Shelf) -> bool:
        return not shelf.is_stale and shelf.position is not None and shelf.position == self._store.newest(name)

    async def _copy(self, name: str) -> None:
        """Make one copy of a component, unless it is as it was; never raises."""
        shelf = self._shelves.setdefault(name, _Shelf(time.monotonic()))
        if self._is_current(name, shelf) and not shelf.trouble:
            return
        try:
            if self._courier is not None:
                self._courier.check_way()
            is_new = shelf.position != self._store.newest(
                name
            )  # else it goes last: robots that can open the former one wait for nothing
            if fetches(self._settings) and is_new:
                await self._copy_checkpoint(name, shelf)
            lacking = await self._copy_files(name, shelf) if self._settings.config.bring else []
            if not self._is_current(name, shelf):
                await self._copy_checkpoint(name, shelf)
        except TROUBLE as error:
            self._fail(name, shelf, "its checkpoints do not reach the archive", str(error))
            return
        if lacking:
            one = lacking[0] + (f", and {len(lacking) - 1} more" if len(lacking) > 1 else "")
            self._fail(
                name, shelf, "its checkpoints reach the archive without files", f"a file that it needs is not there: {one}"
            )
            return
        if shelf.trouble:
            self._tell(Noticed(name, "its checkpoints reach the archive again"))
        shelf.trouble = ""

    async def _copy_checkpoint(self, name: str, shelf: _Shelf) -> None:
        """Raises CheckpointError, AgentError, OSError."""
        begun_s, begun_ns = time.monotonic(), clock.now_ns()
        chain = tuple(await asyncio.to_thread(self._store.open_chain, name))
        try:
            header = format.read_header(chain[-1])
            done = await self._process.ask(KeepCheckpoint(name), chain)
        finally:
            close_all(chain)
        shelf.position, shelf.since_s, shelf.is_stale = header.position, begun_s, False
        shelf.epoch, shelf.put_ns = header.epoch, clock.now_ns()
        if fetches(self._settings):
            self._tell(Archived(name, header.epoch, header.position, begun_ns))
        log.debug("%s is in the archive: %s, %d bytes", name, done.name, done.size)

    async def _copy_files(self, name: str, shelf: _Shelf) -> list[str]:
        """The files that its program needs, each once; why those that lack are not there.

        Raises:
            CheckpointError, AgentError, OSError: the archive does not answer, or the checkpoint cannot be read.
        """
        outline = await asyncio.to_thread(newest_of, self._store, name)
        brings_data = self._settings.component(name).bring_data
        wanted = {need.digest: need for need in needs(outline, opened=brings_data)} if outline is not None else {}
        unknown = tuple(digest for digest in wanted if digest and digest not in shelf.has)
        if not unknown:
            return []
        lacking = (await self._process.ask(Look(unknown))).lacking
        shelf.has.update(set(unknown) - set(lacking))
        troubles: list[str] = []
        refused = 0
        for digest in lacking:
            try:
                descriptor = await self._open_need(name, wanted[digest])
            except TROUBLE as error:
                troubles.append(str(error))
                continue
            try:
                await self._process.ask(KeepContent(digest), (descriptor,))
                shelf.has.add(digest)
            except TROUBLE as error:
                troubles.append(f"{wanted[digest].path}: {error}")
                refused += 1
            finally:
                os.close(descriptor)
            if refused == REFUSED_MAX:
                break
        return troubles

    def _fail(self, name: str, shelf: _Shelf, what: str, trouble: str) -> None:
        if not shelf.trouble:
            log.warning("%s: %s: %s", name, what, trouble)
            self._tell(Noticed(name, f"{what}: {trouble}"))
        shelf.trouble = trouble


def _signs_of(*paths: Path) -> tuple[tuple[int, int] | None, ...]:
    """What changes when one of the files is replaced or written; None for one that is not there."""
    signs: list[tuple[int, int] | None] = []
    for path in paths:
        try:
            about = path.stat()
            signs.append((about.st_ino, about.st_mtime_ns))
        except OSError:
            signs.append(None)
    return tuple(signs)
