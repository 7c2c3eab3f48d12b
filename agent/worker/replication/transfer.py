"""Transfers of snapshots and program files over the replication link: under credit, from a file here into an unnamed one there.

Nothing here knows what a snapshot is. Files give way to snapshots, so that bringing a program's files delays no checkpoint. A
transfer ends in one of two ways: the receiver has every byte, or neither side keeps anything of it and both say why.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final, Protocol, TypeVar

from blake3 import blake3
from msgspec import Struct, field
from msgspec.structs import replace

from agent.errors import LaneError
from agent.system.crash import end_worker_on_mistake
from agent.system.threads import to_its_end
from agent.worker.components import under_way
from checkpoint.errors import StoreError
from checkpoint.store.disk import Disk, DiskFile
from failover.core.wire.codec import encode_bulk
from failover.core.wire.messages import (
    CHUNK_SIZE_MAX,
    SNAPSHOT_SIZE_MAX,
    WINDOW_CHUNKS,
    Bulk,
    Cancel,
    Chunk,
    Content,
    Credit,
    Offer,
    Refuse,
    Taken,
)

PATIENCE_S: Final = 5.0
"""A transfer in which the other side does nothing for so long is given up; the next snapshot begins afresh."""

WINDOW: Final = WINDOW_CHUNKS * CHUNK_SIZE_MAX
"""Bytes under way without credit for more: keeps a 1 Gbit/s link with 10 ms of delay busy."""

STORED_S: Final = 60.0
"""How long the sender of all bytes waits for the word that they are durable, or for a sign that the receiver is still at it."""

SIGN_S: Final = 1.0
"""Between two such signs: a busy robot checks and stores a snapshot of 2 GB for minutes."""

GIVE_WAY_S: Final = 0.02
"""How long a chunk of a file waits for snapshots at most: they have the link to themselves, and a file arrives all the same."""

BATCH_CHUNKS: Final = WINDOW_CHUNKS // 2
"""Chunks that are written at once, where so many have come: credit for the others is out meanwhile."""

INCOMING_LIMIT: Final = 64
"""Transfers that one peer may have open here: one a component is all that it needs."""


class Link(Protocol):
    """The part of `agent.worker.network.replication_link.ReplicationLink` that is needed here."""

    def say(self, peer: str, message: Bulk) -> bool: ...
    async def ship(self, peer: str, chunk: Chunk | Offer) -> None: ...


SNAPSHOT: Final = "snapshot"
FILE: Final = "file"

log = logging.getLogger("failover.lane")


Offered = Offer | Content


class _Outgoing(Struct):
    """One transfer that leaves, as far as it has been taken. ``doubted``: what its receiver said last may be lost.

    Attributes:
        subject: the component whose snapshot it is, or the digest of a file; size: in bytes.
    """

    peer: str
    what: str
    subject: str | bytes
    size: int
    until: int = 0
    sent: bool = False
    taken: bool = False
    doubted: bool = False
    refused: str = ""
    moved: asyncio.Event = field(default_factory=asyncio.Event)


class Arriving(Struct, frozen=True):
    """What is on its way to a peer, in bytes. ``arrived``: of ``size``."""

    peer: str
    arrived: int
    size: int


class Shipper:
    """The transfers that leave this robot."""

    def __init__(self, link: Link, bytes_a_second: float = 0.0) -> None:
        """
        Args:
            bytes_a_second: cap on all transfers together; 0 for none.
        """
        self._link = link
        self._pace = Pace(bytes_a_second)
        self._numbers = itertools.count(time.monotonic_ns())
        self._outgoing: dict[int, _Outgoing] = {}

    async def ship(self, peer: str, offer: Offered, descriptor: int) -> None:
        """Send ``offer.size`` bytes of a file to a peer; returns when the peer has all of them.

        Args:
            offer: its transfer number is chosen here.
            descriptor: stays the caller's.

        Raises:
            LaneError: the connection went down, the peer refused, or it was silent for `PATIENCE_S`.
        """
        number = next(self._numbers)
        what, subject = (SNAPSHOT, offer.component) if isinstance(offer, Offer) else (FILE, offer.digest)
        transfer = self._outgoing[number] = _Outgoing(peer, what, subject, offer.size)
        try:
            if not await self._offered_whole(peer, transfer, replace(offer, transfer=number), descriptor):
                return
            for offset in range(0, offer.size, CHUNK_SIZE_MAX):
                size = min(CHUNK_SIZE_MAX, offer.size - offset)
                await self._until(transfer, lambda end=offset + size: transfer.until >= end)  # type: ignore[misc]
                if isinstance(offer, Content):
                    await self._give_way()
                await self._pace.wait(size)
                await self._link.ship(peer, Chunk(number, offset, os.pread(descriptor, size, offset)))
            transfer.sent = True
            await self._until(transfer, lambda: transfer.taken, STORED_S)
        except (LaneError, asyncio.CancelledError):
            self._link.say(peer, Cancel(number))
            raise
        finally:
            del self._outgoing[number]

    async def _offered_whole(self, peer: str, transfer: _Outgoing, offer: Offered, descriptor: int) -> bool:
        """Offer it, a small snapshot with all of its bytes; whether they are still to be sent, in chunks.

        Raises:
            LaneError: as `ship`.
        """
        if not isinstance(offer, Offer) or offer.size + len(encode_bulk(offer)) > CHUNK_SIZE_MAX:
            if not self._link.say(peer, offer):
                raise LaneError(f"the replication link to {peer} is not connected")
            return True
        await self._pace.wait(offer.size)
        await self._link.ship(peer, replace(offer, content=os.pread(descriptor, offer.size, 0)))
        transfer.sent = True
        await self._until(transfer, lambda: transfer.taken or transfer.until >= offer.size, STORED_S)
        return not transfer.taken

    def heard(self, peer: str, message: Credit | Taken | Refuse) -> None:
        """Take the receiver's answer in; one for a transfer that has ended, or of another peer, is dropped."""
        transfer = self._outgoing.get(message.transfer)
        if transfer is None or transfer.peer != peer:
            return
        match message:
            case Credit():
                transfer.until = max(transfer.until, message.until)
            case Taken():
                transfer.taken = True
            case Refuse():
                transfer.refused = message.reason or "no reason given"
        transfer.doubted = False
        transfer.moved.set()

    def on_their_way(self, subject: str | bytes) -> tuple[Arriving, ...]:
        """How much of a component's snapshots, or of a file, the peers have by their own word."""
        going = (one for one in self._outgoing.values() if one.subject == subject)
        return tuple(Arriving(one.peer, min(max(one.until - WINDOW, 0), one.size), one.size) for one in going)

    def answers_may_be_lost(self, peer: str) -> None:
        """The peer has connected anew: its last words may be lost. While it is at a transfer, it says so each second."""
        for transfer in self._outgoing.values():
            if transfer.peer == peer:
                transfer.doubted = True
                transfer.moved.set()

    async def _give_way(self) -> None:
        """Let the bytes of snapshots go first, as long as a file may wait."""
        until = time.monotonic() + GIVE_WAY_S
        while any(one.what is SNAPSHOT and not one.sent for one in self._outgoing.values()) and time.monotonic() < until:
            await asyncio.sleep(GIVE_WAY_S / 10)

    def lost(self, peer: str) -> None:
        """The connection to the peer is gone, and with it every transfer on it."""
        for transfer in self._outgoing.values():
            if transfer.peer == peer:
                transfer.refused = "the connection was lost"
                transfer.moved.set()

    async def _until(self, transfer: _Outgoing, reached: Callable[[], bool], patience_s: float | None = None) -> None:
        longest_s = PATIENCE_S if patience_s is None else patience_s
        while not transfer.refused and not reached():
            transfer.moved.clear()
            patience_s = min(PATIENCE_S, longest_s) if transfer.doubted else longest_s
            try:
                async with asyncio.timeout(patience_s):  # wait_for loses a cancellation that comes with the event
                    await transfer.moved.wait()
            except TimeoutError:
                raise LaneError(
                    f"{transfer.peer} took nothing for {patience_s:.0f} s in the middle of a {transfer.what}"
                ) from None
        if transfer.refused:
            raise LaneError(f"{transfer.peer} refused the {transfer.what}: {transfer.refused}")


class Pace:
    """A cap on a flow: a sender that is ahead of it waits."""

    def __init__(self, bytes_a_second: float) -> None:
        self._rate = bytes_a_second
        self._free_at = 0.0

    async def wait(self, size: int) -> None:
        """Return when ``size`` more bytes may go."""
        if not self._rate:
            return
        now = time.monotonic()
        self._free_at = max(self._free_at, now) + size / self._rate
        await asyncio.sleep(self._free_at - now)


class Refusal(Exception):
    """A snapshot that is not wanted; ``needs_base``: only a base would help."""

    def __init__(self, reason: str, *, needs_base: bool = False) -> None:
        super().__init__(reason)
        self.needs_base = needs_base


Kind = TypeVar("Kind", Offer, Content, contravariant=True)
"""The kinds of offers: each has a receiver of its own."""


class Desk(Protocol[Kind]):
    """Decides about offers that come in."""

    def admits(self, peer: str, offer: Kind) -> None:
        """Raises `Refusal` when it is not wanted from this peer."""

    async def take(self, peer: str, offer: Kind, descriptor: int) -> None:
        """All bytes are in the file and their digest is right. The descriptor is closed afterwards.

        Raises:
            StoreError: the disk does not take a content; its sender is told.
        """

    def make_room(self, size: int) -> None:
        """So many bytes are about to be written. Called in a thread."""

    def not_taken(self, peer: str, offer: Kind, why: str) -> None:
        """They could not be written."""


class _Incoming(Struct):
    """One transfer that comes in, and the task that writes it.

    Attributes:
        content: all of it, where it came with the offer; ``credit`` is for what comes in chunks.
        descriptor: of the unnamed file that it is written to; -1: there is none yet.
        digest: of what is written.
    """

    offer: Offered
    chunks: asyncio.Queue[Chunk]
    credit: int = WINDOW
    task: asyncio.Task[None] | None = None
    content: bytes = b""
    descriptor: int = -1
    digest: blake3 = field(default_factory=blake3)


class Receiver:
    """The transfers that come in to one desk.

    Bytes are written by a thread, chunk by chunk; credit is given as they are written.
    """

    def __init__(self, link: Link, directory: Path, desk: Desk[Any]) -> None:
        """
        Args:
            directory: on the store's file system, for the unnamed files.
        """
        self._link = link
        self._directory = directory
        self._desk = desk
        self._incoming: dict[tuple[str, int], _Incoming] = {}

    def offered(self, peer: str, offer: Offered) -> None:
        """Begin to receive; an older transfer of the same component, or the same content, is dropped."""
        for key, older in list(self._incoming.items()):
            if key == (peer, offer.transfer) or (key[0] == peer and _of(older.offer) == _of(offer)):
                self._drop(key)
        try:
            self._check(peer, offer)
        except Refusal as refusal:
            self._link.say(peer, Refuse(offer.transfer, str(refusal), refusal.needs_base))
            return
        transfer = self._incoming[peer, offer.transfer] = _Incoming(offer, asyncio.Queue(WINDOW_CHUNKS))
        if isinstance(offer, Offer) and offer.content:
            transfer.offer, transfer.content, transfer.credit = replace(offer, content=b""), offer.content, 0
        transfer.task = asyncio.create_task(self._receive(peer, transfer))
        transfer.task.add_done_callback(end_worker_on_mistake)

    def chunk(self, peer: str, chunk: Chunk) -> None:
        """Take one chunk in; one without credit ends its transfer."""
        transfer = self._incoming.get((peer, chunk.transfer))
        if transfer is None:
            return
        try:
            transfer.chunks.put_nowait(chunk)
        except asyncio.QueueFull:
            self._drop((peer, chunk.transfer))
            self._link.say(peer, Refuse(chunk.transfer, "a chunk came without credit"))

    def cancelled(self, peer: str, message: Cancel) -> None:
        """The sender gave up."""
        self._drop((peer, message.transfer))

    def arriving(self) -> int:
        """Bytes of all transfers under way, whole. From any thread."""
        return sum(transfer.offer.size for transfer in list(self._incoming.values()))

    def lost(self, peer: str) -> None:
        """The peer is gone: its unfinished transfers leave no trace."""
        for key in [key for key in self._incoming if key[0] == peer]:
            self._drop(key)

    def _check(self, peer: str, offer: Offered) -> None:
        least = 1 if isinstance(offer, Offer) else 0
        if not least <= offer.size <= SNAPSHOT_SIZE_MAX:
            raise Refusal(f"a size of {offer.size} bytes is outside the limits")
        if sum(1 for key in self._incoming if key[0] == peer) >= INCOMING_LIMIT:
            raise Refusal(f"{INCOMING_LIMIT} transfers of {peer} are under way already")
        self._desk.admits(peer, offer)

    def _drop(self, key: tuple[str, int]) -> None:
        transfer = self._incoming.pop(key, None)
        if transfer is not None and transfer.task is not None:
            transfer.task.cancel()

    async def _receive(self, peer: str, transfer: _Incoming) -> None:
        """Fill an unnamed file, so that no failure leaves half a file, and hand it over."""
        offer = transfer.offer
        try:
            with under_way.each(SIGN_S, lambda: self._link.say(peer, Credit(offer.transfer, transfer.credit))):
                await to_its_end(self._begin, transfer)
                if transfer.credit:
                    await self._fill(peer, transfer)
                self._require_whole(peer, transfer)
                if isinstance(offer, Offer):
                    self._incoming.pop((peer, offer.transfer), None)  # a newer offer does not end a whole one
                await self._desk.take(peer, offer, transfer.descriptor)
                self._link.say(peer, Taken(offer.transfer))
        except OSError as error:
            why = f"cannot write it there: {error.strerror}"
            log.warning("gave up %s from %s: %s", _named(offer), peer, why)
            self._link.say(peer, Refuse(offer.transfer, why))
            self._desk.not_taken(peer, offer, why)
        except (LaneError, StoreError) as error:
            log.warning("gave up %s: %s", _named(offer), error)
            self._link.say(peer, Refuse(offer.transfer, str(error)))
        finally:
            self._incoming.pop((peer, offer.transfer), None)
            if transfer.descriptor >= 0:
                os.close(transfer.descriptor)

    def _begin(self, transfer: _Incoming) -> None:
        """Have an unnamed file, with the content that came with the offer."""
        self._desk.make_room(transfer.offer.size)
        transfer.descriptor = os.open(self._directory, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
        if transfer.content:
            _keep(DiskFile(Disk(), transfer.descriptor), [transfer.content], transfer.digest)

    def _require_whole(self, peer: str, transfer: _Incoming) -> None:
        """See that it is what was offered.

        Raises:
            LaneError: it is not.
        """
        size, content = transfer.offer.size, transfer.content
        if content and len(content) != size:
            raise LaneError(f"{peer} sent {len(content)} bytes with an offer of {size}")
        if transfer.digest.digest() != transfer.offer.digest:
            raise LaneError(f"{peer} sent {size} bytes whose digest is not the promised digest")

    async def _fill(self, peer: str, transfer: _Incoming) -> None:
        """Write what comes in chunks."""
        offer, end = transfer.offer, 0
        what = SNAPSHOT if isinstance(offer, Offer) else FILE
        file = DiskFile(Disk(), transfer.descriptor)
        self._link.say(peer, Credit(offer.transfer, transfer.credit))
        while end < offer.size:
            try:
                async with asyncio.timeout(PATIENCE_S):
                    batch = [await transfer.chunks.get()]
            except TimeoutError:
                raise LaneError(f"{peer} was silent for {PATIENCE_S:.0f} s in the middle of a {what}") from None
            while len(batch) < BATCH_CHUNKS and not transfer.chunks.empty():
                batch.append(transfer.chunks.get_nowait())
            for chunk in batch:
                size = len(chunk.content)
                if chunk.offset != end or size != min(CHUNK_SIZE_MAX, offer.size - end):
                    raise LaneError(f"{peer} sent {size} bytes at {chunk.offset} where {end} of {offer.size} was due")
                end += size
            await to_its_end(_keep, file, [chunk.content for chunk in batch], transfer.digest)
            transfer.credit = end + WINDOW
            self._link.say(peer, Credit(offer.transfer, transfer.credit))


def _of(offer: Offered) -> str | bytes:
    """The key of an offer: a newer offer with the same key takes its place."""
    return offer.component if isinstance(offer, Offer) else offer.digest


def _named(offer: Offered) -> str:
    if isinstance(offer, Offer):
        return f"snapshot {offer.position.sequence} of {offer.component}"
    return f"a file of {offer.size} bytes ({offer.digest.hex()[:16]}…)"


def _keep(file: DiskFile, contents: Sequence[bytes], digest: blake3) -> None:
    for content in contents:
        file.write(content)
        digest.update(content)


def digest_of(descriptor: int, size: int) -> bytes:
    """The blake3 digest of a file's first ``size`` bytes, for an `Offer`."""
    digest = blake3()
    for offset in range(0, size, CHUNK_SIZE_MAX):
        digest.update(os.pread(descriptor, min(CHUNK_SIZE_MAX, size - offset), offset))
    return digest.digest()
