"""Snapshots across the bulk lane: transfers under credit, out of a memory file here, into an unnamed file there.

Nothing here knows what a snapshot is. A transfer ends in one of two ways: the receiver has every byte, or nothing of it is kept
on either side and both say why.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, Protocol

from agent.errors import LaneError
from agent.lane_messages import CHUNK_SIZE, CREDIT_CHUNKS, Cancel, Chunk, Credit, Message, Offer, Refuse

PATIENCE_S: Final = 5.0
"""A transfer in which the other side does nothing for so long is given up; the next snapshot begins afresh."""

SIZE_LIMIT: Final = 1 << 38
"""Bytes that a snapshot may claim to have: 256 GiB. The disk decides earlier."""

INCOMING_LIMIT: Final = 64
"""Transfers that one peer may have open here: one a component is all that it needs."""

BITS_A_BYTE: Final = 8


class Lane(Protocol):
    """What of `agent.transport.BulkLane` is needed here."""

    def say(self, peer: str, message: Message) -> None: ...
    async def ship(self, peer: str, chunk: Chunk, content: bytes) -> None: ...


@dataclass(slots=True)
class _Outgoing:
    peer: str
    below: int = 0
    refused: str = ""
    moved: asyncio.Event = field(default_factory=asyncio.Event)


class Shipper:
    """The transfers that leave this robot."""

    def __init__(self, lane: Lane, bytes_a_second: float = 0.0) -> None:
        """
        Args:
            bytes_a_second: cap on all transfers together; 0 for none.
        """
        self._lane = lane
        self._pace = Pace(bytes_a_second)
        self._numbers = itertools.count(time.monotonic_ns())
        self._outgoing: dict[int, _Outgoing] = {}

    async def ship(self, peer: str, offer: Offer, descriptor: int) -> None:
        """Send ``offer.size`` bytes of a file to a peer; returns when the last one has left.

        Args:
            offer: its transfer number is chosen here.
            descriptor: stays the caller's.

        Raises:
            LaneError: the connection went down, the peer refused, or it was silent for `PATIENCE_S`.
        """
        number = next(self._numbers)
        transfer = self._outgoing[number] = _Outgoing(peer)
        try:
            self._lane.say(peer, Offer(number, *offer_fields(offer)))
            for index in range(chunk_count(offer.size)):
                await self._credit(transfer, index)
                content = os.pread(descriptor, CHUNK_SIZE, index * CHUNK_SIZE)
                await self._pace.wait(len(content))
                await self._lane.ship(peer, Chunk(number, index), content)
        except (LaneError, asyncio.CancelledError):
            self._lane.say(peer, Cancel(number))
            raise
        finally:
            del self._outgoing[number]

    def heard(self, peer: str, message: Credit | Refuse) -> None:
        """Take the receiver's answer in; one for a transfer that has ended, or of another peer, is dropped."""
        transfer = self._outgoing.get(message.transfer)
        if transfer is None or transfer.peer != peer:
            return
        if isinstance(message, Credit):
            transfer.below = max(transfer.below, message.below)
        else:
            transfer.refused = message.why or "no reason given"
        transfer.moved.set()

    async def _credit(self, transfer: _Outgoing, index: int) -> None:
        while not transfer.refused and index >= transfer.below:
            transfer.moved.clear()
            try:
                await asyncio.wait_for(transfer.moved.wait(), PATIENCE_S)
            except TimeoutError:
                raise LaneError(f"{transfer.peer} took nothing for {PATIENCE_S:.0f} s in the middle of a snapshot") from None
        if transfer.refused:
            raise LaneError(f"{transfer.peer} refused the snapshot: {transfer.refused}")


class Pace:
    """A cap on a flow: whoever is ahead of it waits."""

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


Deliver = Callable[[str, Offer, int], Awaitable[str]]
"""Called with (peer, offer, descriptor of the whole file); returns "" or why the snapshot is not wanted."""


@dataclass(slots=True)
class _Incoming:
    peer: str
    offer: Offer
    chunks: asyncio.Queue[tuple[int, bytes]]
    task: asyncio.Task[None] | None = None


class Receiver:
    """The transfers that come in. Bytes are written by a thread, chunk by chunk; credit is given as they are written."""

    def __init__(self, lane: Lane, directory: Path, deliver: Deliver) -> None:
        """
        Args:
            directory: on the store's file system, for the unnamed files.
        """
        self._lane = lane
        self._directory = directory
        self._deliver = deliver
        self._incoming: dict[tuple[str, int], _Incoming] = {}

    def offered(self, peer: str, offer: Offer) -> None:
        """Begin to receive; an older transfer of the same component is dropped."""
        for key, older in list(self._incoming.items()):
            if key[0] == peer and older.offer.component == offer.component:
                self._drop(key)
        if not 0 < offer.size <= SIZE_LIMIT:
            self._lane.say(peer, Refuse(offer.transfer, f"a size of {offer.size} bytes is outside the limits"))
        elif sum(1 for key in self._incoming if key[0] == peer) >= INCOMING_LIMIT:
            self._lane.say(peer, Refuse(offer.transfer, f"{INCOMING_LIMIT} snapshots of {peer} are under way already"))
        else:
            key = (peer, offer.transfer)
            transfer = self._incoming[key] = _Incoming(peer, offer, asyncio.Queue(CREDIT_CHUNKS))
            transfer.task = asyncio.create_task(self._receive(key, transfer))

    def chunk(self, peer: str, chunk: Chunk, content: bytes) -> None:
        """Take one chunk in; one without credit ends its transfer."""
        transfer = self._incoming.get((peer, chunk.transfer))
        if transfer is None:
            return
        try:
            transfer.chunks.put_nowait((chunk.index, content))
        except asyncio.QueueFull:
            self._drop((peer, chunk.transfer))
            self._lane.say(peer, Refuse(chunk.transfer, "a chunk came without credit"))

    def cancelled(self, peer: str, message: Cancel) -> None:
        """The sender gave up."""
        self._drop((peer, message.transfer))

    def lost(self, peer: str) -> None:
        """The peer is gone: whatever it had begun leaves no trace."""
        for key in [key for key in self._incoming if key[0] == peer]:
            self._drop(key)

    def _drop(self, key: tuple[str, int]) -> None:
        transfer = self._incoming.pop(key, None)
        if transfer is not None and transfer.task is not None:
            transfer.task.cancel()

    async def _receive(self, key: tuple[str, int], transfer: _Incoming) -> None:
        try:
            descriptor = os.open(self._directory, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
        except OSError as error:
            self._lane.say(transfer.peer, Refuse(transfer.offer.transfer, f"cannot write there: {error.strerror}"))
            self._incoming.pop(key, None)
            return
        try:
            await self._fill(transfer, descriptor)
            why = await self._deliver(transfer.peer, transfer.offer, descriptor)
        except (OSError, LaneError) as error:
            why = (error.strerror or str(error)) if isinstance(error, OSError) else str(error)
        finally:
            os.close(descriptor)
            self._incoming.pop(key, None)
        if why:
            self._lane.say(transfer.peer, Refuse(transfer.offer.transfer, why))

    async def _fill(self, transfer: _Incoming, descriptor: int) -> None:
        offer = transfer.offer
        count = chunk_count(offer.size)
        self._lane.say(transfer.peer, Credit(offer.transfer, CREDIT_CHUNKS))
        for expected in range(count):
            try:
                index, content = await asyncio.wait_for(transfer.chunks.get(), PATIENCE_S)
            except TimeoutError:
                raise LaneError(f"{transfer.peer} was silent for {PATIENCE_S:.0f} s in the middle of a snapshot") from None
            if index != expected or len(content) != min(CHUNK_SIZE, offer.size - index * CHUNK_SIZE):
                raise LaneError(f"chunk {index} of {len(content)} bytes came where {expected} of {count} was due")
            await asyncio.to_thread(os.pwrite, descriptor, content, index * CHUNK_SIZE)
            self._lane.say(transfer.peer, Credit(offer.transfer, expected + 1 + CREDIT_CHUNKS))


def chunk_count(size: int) -> int:
    """Chunks that ``size`` bytes make."""
    return -(-size // CHUNK_SIZE)


def offer_fields(offer: Offer) -> tuple[str, int, int, int, int]:
    """Everything but the transfer number."""
    return offer.component, offer.epoch, offer.generation, offer.sequence, offer.size
