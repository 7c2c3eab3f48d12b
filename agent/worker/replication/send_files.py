"""Sends a program's files from the robot that runs it: asks the standby what it lacks and sends that once, before a snapshot.

A standby could not resume a snapshot that needs a file which it lacks, so the agent offers a snapshot only when all its files are
there. The agent does not ask again with each delta, only when the snapshot needs other files, and now and then.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import os
import stat
import time
from collections.abc import Awaitable, Callable
from typing import Final

from msgspec import Struct, field

from agent.errors import LaneError
from agent.system.threads import to_its_end
from agent.worker.replication.receive_files import is_in_place, is_plausible, named, size_told
from agent.worker.replication.transfer import Arriving, Shipper
from checkpoint.errors import CheckpointError
from checkpoint.snapshot.required_files import Need
from checkpoint.store.content_store import digest_of_descriptor
from checkpoint.store.contract import SnapshotStore
from failover.core.wire.messages import BELONGINGS_MAX, Belonging, Belongings, Bulk, Content, Lacking

ANSWER_S: Final = 60.0
"""How long a standby may take to look whether it has some files: it reads those that have the right size."""

ASKED_TIMES: Final = 4
"""In that time: an answer is lost where the standby has not noticed yet that this process is another one."""

SURE_S: Final = 60.0
"""For so long a standby that had all is believed to have it still: its operator may install another release."""

PATIENCE_S: Final = 100.0
"""How long one snapshot waits for its files, less than the rules give it; they go on coming, and the next one waits again."""

log = logging.getLogger("failover.belongings")

Reader = Callable[[str, Need], Awaitable[int]]
"""Opens a file of a component as the program has it; raises CheckpointError or AgentError."""


class _Sure(Struct):
    """The files of a component that a peer was found to have."""

    needs: tuple[Need, ...]
    until_s: float


class _Peer(Struct):
    """One at a time is sent to a peer.

    Attributes:
        sure: by component.
        under_way: by digest.
    """

    sure: dict[str, _Sure] = field(default_factory=dict)
    under_way: dict[bytes, asyncio.Task[None]] = field(default_factory=dict)
    turn: asyncio.Lock = field(default_factory=asyncio.Lock)


class Bringing:
    """All that leaves this robot. Lives in one loop."""

    def __init__(
        self,
        shipper: Shipper,
        say: Callable[[str, Bulk], bool],
        read: Reader,
        note: Callable[[str, str, str], None] = lambda component, peer, sentence: None,
    ) -> None:
        """
        Args:
            say: on the replication link; False: it is not connected.
            note: told (component, peer, sentence) how the files travel, for the status; "" when none does any more.
        """
        self._shipper = shipper
        self._say = say
        self._read = read
        self._note = note
        self._numbers = itertools.count(time.monotonic_ns())
        self._asked: dict[int, tuple[str, asyncio.Future[Lacking]]] = {}
        self._peers: dict[str, _Peer] = {}
        self._sums: dict[tuple[str, str], tuple[int, int, bytes]] = {}

    def on_their_way(self, component: str) -> tuple[Arriving, ...]:
        """How much of a component's files the peers have that lack some."""
        going = [(peer, *sums) for (owner, peer), sums in self._sums.items() if owner == component]
        return tuple(Arriving(peer, size - rest + self._part(peer, digest), size) for peer, size, rest, digest in going)

    def _part(self, peer: str, digest: bytes) -> int:
        return sum(one.arrived for one in self._shipper.on_their_way(digest) if one.peer == peer)

    async def bring(self, peer: str, component: str, files: tuple[Need, ...]) -> None:
        """Return once the peer has all of these.

        Raises:
            LaneError: it cannot have them, or not yet; transfers under way go on all the same.
        """
        known = self._peers.setdefault(peer, _Peer())
        sure = known.sure.get(component)
        if sure is not None and sure.needs == files and time.monotonic() < sure.until_s:
            return
        known.sure.pop(component, None)
        lacking = await self._lacking(peer, component, files)
        try:
            if lacking:
                await self._send_all(peer, known, component, lacking)
        finally:
            self._sums.pop((component, peer), None)
            self._note(component, peer, "")
        known.sure[component] = _Sure(files, time.monotonic() + SURE_S)

    async def close(self) -> None:
        """Give up the transfers under way."""
        tasks = [task for peer in self._peers.values() for task in peer.under_way.values()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    def heard(self, peer: str, message: Lacking) -> None:
        """A peer's answer; one that is not awaited is dropped."""
        asked = self._asked.get(message.number)
        if asked is not None and asked[0] == peer and not asked[1].done():
            asked[1].set_result(message)

    def lost(self, peer: str) -> None:
        """The connection is gone: another robot may come back by that name."""
        self._peers.setdefault(peer, _Peer()).sure.clear()
        for name, answer in self._asked.values():
            if name == peer and not answer.done():
                answer.set_exception(LaneError(f"the replication link to {peer} went down"))

    async def _lacking(self, peer: str, component: str, files: tuple[Need, ...]) -> dict[bytes, Need]:
        """Which of the files a peer will take, by digest."""
        by_digest = {need.digest: need for need in files}
        found: dict[bytes, Need] = {}
        told = [Belonging(need.path, need.size, need.digest, need.exact) for need in files]
        for part in (told[first : first + BELONGINGS_MAX] for first in range(0, len(told), BELONGINGS_MAX)):
            answer = await self._ask(peer, component, tuple(file for file in part if is_plausible(file)))
            if answer.reason:
                raise LaneError(answer.reason)
            found |= {digest: by_digest[digest] for digest in answer.digests if digest in by_digest}
        return found

    async def _ask(self, peer: str, component: str, files: tuple[Belonging, ...]) -> Lacking:
        number = next(self._numbers)
        answer: asyncio.Future[Lacking] = asyncio.get_running_loop().create_future()
        self._asked[number] = peer, answer
        try:
            for _ in range(ASKED_TIMES):
                if not self._say(peer, Belongings(number, component, files)):
                    raise LaneError(f"the replication link to {peer} is not connected")
                with contextlib.suppress(TimeoutError):
                    return await asyncio.wait_for(asyncio.shield(answer), ANSWER_S / ASKED_TIMES)
            raise LaneError(f"{peer} did not say within {ANSWER_S:.0f} s which files of {component} it lacks")
        finally:
            del self._asked[number]

    async def _send_all(self, peer: str, known: _Peer, component: str, lacking: dict[bytes, Need]) -> None:
        """Send each once, also where several wait for it; the smallest first, so that most is there soon."""
        until_s = time.monotonic() + PATIENCE_S
        waiting = sorted(lacking.values(), key=lambda need: need.size)
        size = rest = sum(need.size for need in waiting)
        log.info("%s lacks %s of the files of %s: %s", peer, size_told(rest), component, named_needs(waiting))
        for need in waiting:
            self._sums[component, peer] = size, rest, need.digest
            self._note(component, peer, f"protected from {peer} after {size_told(rest)} of program files have arrived there")
            task = known.under_way.get(need.digest)
            if task is None:
                task = known.under_way[need.digest] = asyncio.create_task(self._send(peer, known, component, need))
                task.add_done_callback(lambda done, digest=need.digest: _end(known, digest, done))  # type: ignore[misc]
            await self._arrival(peer, task, until_s, rest)
            rest -= need.size

    async def _arrival(self, peer: str, task: asyncio.Task[None], until_s: float, rest: int) -> None:
        """Wait for one; a task that gives up waiting does not give it up."""
        done, _ = await asyncio.wait((task,), timeout=max(until_s - time.monotonic(), 0))
        if not done:
            raise LaneError(f"{size_told(rest)} of its program files are still on their way to {peer}")
        if task.cancelled():
            raise LaneError(f"its program files do not go to {peer} any more")
        task.result()

    async def _send(self, peer: str, known: _Peer, component: str, need: Need) -> None:
        async with known.turn:
            try:
                descriptor = await self._read(component, need)
            except CheckpointError as error:
                raise LaneError(f"{need.path} cannot be brought to {peer}: {error}") from error
            try:
                await self._shipper.ship(peer, Content(0, need.size, need.digest), descriptor)
            except LaneError as error:
                raise LaneError(f"{need.path} ({size_told(need.size)}) was not brought to {peer}: {error}") from error
            except OSError as error:
                raise LaneError(f"{need.path} cannot be read here: {error.strerror}") from error
            finally:
                os.close(descriptor)


def _end(known: _Peer, digest: bytes, done: asyncio.Task[None]) -> None:
    known.under_way.pop(digest, None)
    if not done.cancelled():
        done.exception()  # noted: the tasks that waited have been told


def named_needs(needs: list[Need]) -> str:
    """A few of them, for a sentence."""
    return named(Belonging(need.path, need.size, need.digest) for need in needs)


class Sources:
    """Where this robot's own copy of a file is: brought here before, at its path, or only in the program that has it mapped."""

    def __init__(self, store: SnapshotStore, ask: Callable[[str, Need], Awaitable[int]]) -> None:
        """
        Args:
            ask: the component's keeper, for the descriptor of a file without a path any more, or that only the program may read.
        """
        self._store = store
        self._ask = ask

    async def open(self, component: str, need: Need) -> int:
        """A descriptor of the content, the caller's to close.

        Raises:
            CheckpointError, AgentError: it is not here (any more): it was changed in place, for one.
        """
        if self._store.contents.has(need.digest, need.size):
            return self._store.contents.open(need.digest)
        descriptor = await asyncio.to_thread(_open_if_same, need)
        return descriptor if descriptor is not None else await self._from_keeper(component, need)

    async def keep_what_goes(self, component: str, files: tuple[Need, ...]) -> None:
        """Keep by content the files that are not at their paths any more: the program was upgraded, or removed, while it runs.

        Raises:
            CheckpointError, AgentError, OSError: it cannot be had (any more), or kept.
        """
        gone = await asyncio.to_thread(lambda: [need for need in files if not is_in_place(need)])
        for need in gone:
            if not need.digest or self._store.contents.has(need.digest, need.size):
                continue
            descriptor = await self._from_keeper(component, need)
            try:
                await to_its_end(self._store.contents.put, descriptor, need.digest)
            finally:
                os.close(descriptor)
            log.info("%s: kept %s as the program has it; its path leads to it no more", component, need.path)

    async def _from_keeper(self, component: str, need: Need) -> int:
        descriptor = await self._ask(component, need)
        if await asyncio.to_thread(digest_of_descriptor, descriptor) == need.digest:
            return descriptor
        os.close(descriptor)
        raise LaneError(f"{need.path} was changed in place since the program began to use it: start the program again")


def _open_if_same(need: Need) -> int | None:
    """The file at the path, if it has the content."""
    try:
        descriptor = os.open(need.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError:
        return None
    try:
        about = os.fstat(descriptor)
        if stat.S_ISREG(about.st_mode) and about.st_size == need.size and digest_of_descriptor(descriptor) == need.digest:
            return os.dup(descriptor)
    except OSError:
        return None
    finally:
        os.close(descriptor)
    return None
