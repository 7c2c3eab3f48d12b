"""Takes checkpoints from the archive, of components whose primary this robot does not hear (`agent.core_config.fetches`).

Each ``s3_every_s``, and when the core orders a look, the archive's process lists the copies. What is newer than this robot's own
goes into its store, verified; the core hears of it, and decides (`failover.core.replication.archived`). Nothing waits for it.

Loaded when it is wanted: an agent that takes nothing does not carry it.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import os
import time
from collections.abc import Awaitable, Callable, Collection
from typing import Final

import msgspec
from msgspec import Struct

from agent.archive.messages import Fetch, FetchContent, ListCopies
from agent.config import Settings
from agent.errors import TROUBLE
from agent.main_loop.messages import Told
from agent.system import clock
from agent.system.threads import to_its_end
from agent.worker.archive_process import LEAST_RATE, ArchiveProcess, NotArchivedError
from agent.worker.replication.receive_files import is_in_place
from agent.worker.replication.send_sealed import Courier
from checkpoint.engine import COOPERATIVE
from checkpoint.errors import UNDECODABLE
from checkpoint.model import Position, Snapshot
from checkpoint.snapshot import format
from checkpoint.snapshot.required_files import needs
from checkpoint.snapshot.untrusted import NOT_UNDERSTOOD
from checkpoint.store.contract import SnapshotStore
from checkpoint.store.index import folder_name
from failover.archive.archive import Copy, Label
from failover.core.acts import Accept
from failover.core.events import Damaged, Event, Fetched, Looked, Noticed
from failover.core.types import ENDED, ComponentSpec, State, StatusView

ANSWER_S: Final = 30.0
"""For a list, and for a copy besides its bytes; the start of the process on a busy machine is in it."""

PAUSE_ROUNDS: Final = 10
"""Before a copy that was refused is tried again."""

TRIES_MAX: Final = 3
"""Copies of one component in one round: where the newest is harmed, the one before it may be newer than ours."""

_IDLE: Final = (State.ABSENT, State.STANDBY)

log = logging.getLogger("failover.archive")

Line = tuple[int, int]


DAMAGED: Final = (
    "{}: checkpoint {} is damaged on this robot's disk; it, or a later one, comes from the archive; see that the disk is sound"
)


class Arrived(Struct, frozen=True):
    """A checkpoint that the core has not accepted yet."""

    spec: ComponentSpec
    snapshot: Snapshot
    size: int


class Fetching:
    """What one robot takes from the archive. Lives in the worker's loop."""

    def __init__(
        self,
        settings: Settings,
        store: SnapshotStore,
        told: Callable[[], Awaitable[Told]],
        tell: Callable[[Event], None],
        kept: Callable[[Arrived], None],
        listed: Callable[[Collection[Copy], int], None] = lambda _copies, _begun_ns: None,
        courier: Courier | None = None,
    ) -> None:
        """
        Args:
            told: the core's view of the team.
            kept: called with a checkpoint once the core has accepted it.
            listed: called with what the archive had, and the instant at which it was asked.
            courier: the way to the witness that keeps the copies; None: they are elsewhere.
        """
        self._listed = listed
        self._settings, self._store = settings, store
        self._told, self._tell, self._kept = told, tell, kept
        self._process = ArchiveProcess(settings.path, courier)
        self._rounds = itertools.count()
        self._ordered = asyncio.Event()
        self._fetched: dict[str, Position] = {}
        self._seen: dict[str, tuple[int, Line]] = {}
        self._looked_for: set[str] = set()
        self._in_advance, self._gives_way = "", False
        self._absent: set[bytes] = set()
        self._refused: dict[str, int] = {}
        self._troubles: dict[str, str] = {}
        self._lost: dict[str, str] = {}
        self._damaged: dict[str, Position] = {}
        self._silent = ""
        self._answered_s = time.monotonic()
        self._arrived: dict[tuple[str, Position], Arrived] = {}
        self._given: set[str] = set()

    async def run(self) -> None:
        """Take copies until cancelled."""
        try:
            while True:
                number = next(self._rounds)
                if number == 0 or await self._is_wanted():
                    await self._round(number)
                else:
                    self._process.hang_up()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._ordered.wait(), self._settings.config.store.s3_every_s)
                self._ordered.clear()
        finally:
            self._process.close()

    async def _is_wanted(self) -> bool:
        """Whether to turn to the archive again: robots that share nothing else always do, others where a primary is silent."""
        if self._settings.config.rule == "etcd" or self._looked_for:
            return True
        with contextlib.suppress(*TROUBLE):
            if (view := (await self._told()).status) is not None:
                return not view.components or any(_takes(one.name, view) for one in view.components)
        return True

    def look(self, component: str) -> None:
        """The core orders a look, because it could take that component over: what is fetched in advance gives way to it."""
        self._looked_for.add(component)
        self._ordered.set()
        if self._in_advance not in ("", component):
            self._gives_way = True
            self._process.hang_up()

    def accepted(self, act: Accept) -> bool:
        """The core counts a checkpoint as held here; False if it did not come from the archive."""
        arrived = self._arrived.pop((act.component, act.position), None)
        self._given.discard(act.component)
        if arrived is not None:
            self._given.add(act.component)
            self._kept(arrived)
        return arrived is not None

    def gave(self, component: str) -> bool:
        """Whether the newest checkpoint of a component came from the archive: no silence of a robot says how old it is."""
        return component in self._given

    def complaints(self) -> list[str]:
        """For the status: why this robot does not have what the archive has."""
        if self._silent:
            since_s = time.monotonic() - self._answered_s
            return [f"the archive has not answered for {since_s:.0f} s: no checkpoints come from there: {self._silent}"]
        damaged = [DAMAGED.format(name, position.sequence) for name, position in self._damaged.items()]
        return [*damaged, *self._lost.values(), *self._troubles.values()]

    async def _round(self, number: int) -> None:
        looked_for, self._looked_for = self._looked_for, set()
        begun_ns = clock.now_ns()
        try:
            copies = (await self._process.ask(ListCopies(), limit_s=ANSWER_S)).copies
            view = (await self._told()).status
        except TROUBLE as error:
            if not self._silent:
                self._tell(Noticed("", f"the archive does not answer: {error}"))
            self._silent = str(error)
            self._looked_for |= looked_for
            with contextlib.suppress(*TROUBLE):
                self._look_for_damage((await self._told()).status)
            return
        if self._silent:
            self._tell(Noticed("", "the archive answers again"))
        self._silent, self._answered_s = "", time.monotonic()
        self._listed(copies, begun_ns)
        if view is None:
            return
        names = self._names(view)
        self._look_for_damage(view)
        wanted: dict[str, list[Copy]] = {}
        skipped = []
        for folder, group in itertools.groupby(copies, key=lambda copy: copy.folder):
            found = list(group)
            name = names.get(folder, found[0].component)
            self._look_for_a_rollback(name, found[0])
            if not _takes(name, view, is_looked_for=name in looked_for):
                self._fetched.pop(folder, None)
                skipped.append(name)
            elif newer := self._newer(name, found, view):
                wanted[name] = newer
        self._look_for_an_empty_archive({copy.folder for copy in copies}, names, view)
        self._tell(Looked(begun_ns, tuple(wanted), tuple(skipped)))
        for name in sorted(wanted, key=lambda one: (one not in looked_for, wanted[one][0].size)):
            self._in_advance = "" if name in looked_for else name
            await self._fetch(name, wanted[name], begun_ns, number)
            self._in_advance, self._gives_way = "", False
            if self._ordered.is_set():
                return  # the list is old: the next round begins at once, with what is looked for

    def _names(self, view: StatusView) -> dict[str, str]:
        """Folder of the archive → component: the name of a folder is cut where the component's is too long."""
        known = (*self._settings.config.components, *self._store.components(), *(one.name for one in view.components))
        return {folder_name(name): name for name in known}

    def _look_for_an_empty_archive(self, folders: set[str], names: dict[str, str], view: StatusView) -> None:
        """As `_look_for_a_rollback`, of components of which not even an older copy is there; those that ended may be removed."""
        lives = {one.name for one in view.components if one.state not in ENDED}
        for folder in self._seen.keys() - folders:
            if (name := names.get(folder, "")) in lives:
                self._lost[name] = f"{name}: the archive has lost all copies of it, or was rolled back to a time before them"

    def _look_for_a_rollback(self, name: str, newest: Copy) -> None:
        """An archive that has only older copies than it had is told of; what this robot holds is newer, and stays."""
        line = newest.epoch, (newest.generation, newest.sequence)
        had = self._seen.get(newest.folder, line)
        self._seen[newest.folder] = max(had, line)
        if line < had:
            self._lost[name] = (
                f"{name}: the archive has lost copies, or was rolled back: its newest is number {newest.sequence} of epoch "
                f"{newest.epoch}, and it had number {had[1][1]} of epoch {had[0]}; nothing older is taken from it"
            )
        else:
            self._lost.pop(name, None)

    def _look_for_damage(self, view: StatusView | None) -> None:
        """What the core counts as held here, and the store has found damaged, is not held: it may come again."""
        shown = {one.name: one for one in view.components} if view is not None else {}
        for name, one in shown.items():
            newest = one.positions[0] if one.positions else None
            is_awaited = view is not None and _takes(name, view)
            if name in self._damaged and (not is_awaited or (newest is not None and newest >= self._damaged[name])):
                del self._damaged[name]
            if is_awaited and newest is not None and newest not in self._store.positions(name):
                self._damaged[name] = newest
                self._tell(Damaged(name, one.epoch, newest))

    def _newer(self, name: str, found: list[Copy], view: StatusView) -> list[Copy]:
        """The copies that are newer than what the core counts as held here, and the store has; the newest first."""
        held, there = (
            (position for one in view.components if one.name == name for position in one.positions),
            self._store.positions(name),
        )
        had = self._fetched.get(found[0].folder)
        ours = max(((one.generation, one.sequence) for one in (*held, had) if one in there), default=(0, 0))
        return [copy for copy in found if (copy.generation, copy.sequence) > ours]

    async def _fetch(self, name: str, newer: list[Copy], begun_ns: int, number: int) -> None:
        """Take the newest copy that is whole; never raises. Where it is not the newest of all, the core looks again."""
        tried = [copy for copy in _spread(newer) if self._refused.get(copy.name, 0) <= number]
        for copy in tried[:TRIES_MAX]:
            try:
                await self._take(copy, begun_ns if copy is newer[0] else 0)
            except (*TROUBLE, *NOT_UNDERSTOOD) as error:  # who sealed it has the key, and still its word is its own
                if self._gives_way:
                    return
                if not isinstance(error, TROUBLE):
                    log.warning("%s is not understood", copy.name, exc_info=error)
                self._refused[copy.name] = number + PAUSE_ROUNDS
                if name not in self._troubles:
                    self._tell(Noticed(name, f"a copy in the archive was not taken: {error}"))
                self._troubles[name] = f"{name}: a copy in the archive was not taken, the checkpoint before it stays: {error}"
            else:
                if copy is newer[0]:
                    self._troubles.pop(name, None)
                    for one in newer:
                        self._refused.pop(one.name, None)
                return

    async def _take(self, copy: Copy, begun_ns: int) -> None:
        """Raises CheckpointError, AgentError, FailoverError, OSError."""
        await asyncio.to_thread(self._store.make_room, copy.size)
        descriptor = await asyncio.to_thread(self._store.unnamed)
        try:
            label = (await self._process.ask(Fetch(copy), (descriptor,), limit_s=ANSWER_S + copy.size / LEAST_RATE)).label
            spec = _spec(copy, label)
            header = format.read_header(descriptor)
            await self._bring(descriptor)
            snapshot = await to_its_end(self._store.put, descriptor)
        finally:
            os.close(descriptor)
        self._fetched[copy.folder] = header.position
        self._damaged.pop(header.component, None)
        self._arrived = {key: one for key, one in self._arrived.items() if key[0] != header.component}
        self._arrived[header.component, header.position] = Arrived(spec, snapshot, copy.size)
        age_ns = max(time.time_ns() - copy.stamp_ms * 1_000_000, 0)
        keeps_state = snapshot.engine == COOPERATIVE
        self._tell(Fetched(header.component, header.epoch, header.position, spec, begun_ns, age_ns, keeps_state))

    async def _bring(self, descriptor: int) -> None:
        """The files that the program needs and this robot lacks, as far as the archive has them; the status tells the rest."""
        if not self._settings.config.bring:
            return
        outline = await asyncio.to_thread(format.read_outline, descriptor)
        contents = self._store.contents
        opened = self._settings.component(outline.component).bring_data
        for need in needs(outline, opened=opened):
            if not need.digest or await asyncio.to_thread(is_in_place, need) or contents.hold(need.digest, need.size):
                continue
            file = await asyncio.to_thread(self._store.unnamed)
            try:
                await self._process.ask(FetchContent(need), (file,), limit_s=ANSWER_S + need.size / LEAST_RATE)
                await to_its_end(contents.put, file, need.digest)
            except TROUBLE as error:
                if need.digest not in self._absent:
                    log.warning("a file that a program needs did not come from the archive: %s", error)
                self._absent.add(need.digest)
            finally:
                os.close(file)


def _spread(copies: list[Copy]) -> list[Copy]:
    """The newest copy, then those that harm of it is the least likely to reach: its base, the newest of another base."""
    newest = copies[0]
    base = [copy for copy in copies[1:] if copy.name == newest.base]
    other = [copy for copy in copies if copy.base != newest.base][:1]
    return [newest, *base, *other, *(copy for copy in copies[1:] if copy not in (*base, *other))]


def _takes(name: str, view: StatusView, *, is_looked_for: bool = False) -> bool:
    """Whether this robot may have to run a component: it does not hear the primary, or the core looks for it to take it over."""
    known = next((one for one in view.components if one.name == name), None)
    if known is None:
        return True
    is_heard = any(peer.robot == known.primary and peer.state in ("alive", "suspect", "restarting") for peer in view.peers)
    return known.state in _IDLE and (is_looked_for or not is_heard)


def _spec(copy: Copy, label: Label | None) -> ComponentSpec:
    """Raises NotArchivedError."""
    try:
        if label is not None and label.spec:
            return msgspec.msgpack.decode(label.spec, type=ComponentSpec)
    except UNDECODABLE as error:
        raise NotArchivedError(f"{copy.name} has a specification that this version of failover cannot read: {error}") from error
    raise NotArchivedError(f"{copy.name} does not say how the program is started: it was archived before that was on record")
