"""Transfers under credit: complete or without a trace, however the other side behaves."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import msgspec
import pytest
from blake3 import blake3

from agent.errors import LaneError
from agent.system import crash
from agent.worker.replication import send_snapshots, transfer
from agent.worker.replication.send_snapshots import Dispatch
from agent.worker.replication.transfer import BATCH_CHUNKS, Receiver, Refusal, Shipper, digest_of
from checkpoint.keeper.messages import memfd_holding
from checkpoint.model import Position
from checkpoint.snapshot import format
from checkpoint.store.disk import DiskFile
from checkpoint.store.store import open_store
from failover.core import acts
from failover.core.events import Event, ShipEnded
from failover.core.types import ComponentSpec
from failover.core.wire.codec import encode_bulk
from failover.core.wire.messages import CHUNK_SIZE_MAX, Bulk, Cancel, Chunk, Credit, Offer, Refuse, Taken
from tests.checkpoint.snapshots import PAGE, snapshot

SIZE = 5 * CHUNK_SIZE_MAX + 17
SMALL = 3_000
BOUND_S = 20.0


class Link:
    """A link whose other end is the test's function."""

    def __init__(self, deliver: Callable[[str, Bulk], None]) -> None:
        self.deliver = deliver
        self.connected = True
        self.said: list[Bulk] = []

    def say(self, peer: str, message: Bulk) -> bool:
        if self.connected:
            self.said.append(message)
            asyncio.get_running_loop().call_soon(self.deliver, peer, message)
        return self.connected

    async def ship(self, peer: str, chunk: Chunk | Offer) -> None:
        self.say(peer, chunk)


class Desk:
    """Takes everything that it admits."""

    def __init__(self, refusal: str = "") -> None:
        self.refusal = refusal
        self.taken: list[bytes] = []
        self.failed: list[str] = []

    def admits(self, peer: str, offer: Offer) -> None:
        if self.refusal:
            raise Refusal(self.refusal)

    async def take(self, peer: str, offer: Offer, descriptor: int) -> None:
        self.taken.append(os.pread(descriptor, offer.size, 0))

    def make_room(self, size: int) -> None:
        self.room = size

    def not_taken(self, peer: str, offer: Offer, why: str) -> None:
        self.failed.append(why)


class Two:
    """A shipper and a receiver, joined by two links; ``spoil`` changes, or drops, what the shipper says."""

    def __init__(self, directory: Path, desk: Desk, spoil: Callable[[Bulk], Bulk | None] = lambda message: message) -> None:
        self.desk = desk
        self.out = Link(self._arrive)
        self.back = Link(self._answer)
        self.shipper = Shipper(self.out)
        self.receiver = Receiver(self.back, directory, desk)
        self._spoil = spoil

    def _arrive(self, _peer: str, sent: Bulk) -> None:
        match self._spoil(sent):
            case Offer() as message:
                self.receiver.offered("robot1", message)
            case Chunk() as message:
                self.receiver.chunk("robot1", message)
            case Cancel() as message:
                self.receiver.cancelled("robot1", message)

    def _answer(self, _peer: str, message: Bulk) -> None:
        if isinstance(message, Credit | Taken | Refuse):
            self.shipper.heard("robot2", message)


@pytest.fixture
def content(tmp_path: Path) -> Path:
    path = tmp_path / "snapshot"
    path.write_bytes(os.urandom(SIZE))
    return path


@pytest.fixture
def little_patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer, "PATIENCE_S", 0.2)


async def ship(two: Two, path: Path, size: int = SIZE) -> None:
    with path.open("rb") as file:
        digest = digest_of(file.fileno(), size)
        offer = Offer(0, "/lab/a", 1, Position(1, 1, b""), None, size, digest, ComponentSpec("/lab/a"))
        await asyncio.wait_for(two.shipper.ship("robot2", offer, file.fileno()), BOUND_S)


async def until_sent(two: Two, shipping: asyncio.Task[None]) -> None:
    """Wait until all chunks are on their way."""
    while sum(isinstance(message, Chunk) for message in two.out.said) < 6:
        assert not shipping.done(), shipping.exception()
        await asyncio.sleep(0)


def run(body: Coroutine[Any, Any, None]) -> None:
    asyncio.run(body)


def left_in(directory: Path) -> list[str]:
    return [path.name for path in directory.iterdir() if path.name != "snapshot"]


def test_a_snapshot_arrives_whole(tmp_path: Path, content: Path) -> None:
    async def body() -> None:
        two = Two(tmp_path, Desk())
        await ship(two, content)
        while not two.desk.taken:
            await asyncio.sleep(0)
        assert two.desk.taken == [content.read_bytes()]

    run(body())


def test_how_much_of_it_the_receiver_has_by_its_own_word_is_known(tmp_path: Path) -> None:
    size, path = 3 * transfer.WINDOW + 17, tmp_path / "large"
    path.write_bytes(bytes(size))

    async def body() -> None:
        seen: list[int] = []

        def look(message: Bulk) -> Bulk:
            going = two.shipper.on_their_way("/lab/a")
            seen.extend(one.arrived for one in going)
            assert all((one.peer, one.size) == ("robot2", size) for one in going)
            return message

        two = Two(tmp_path, Desk(), look)
        await ship(two, path, size)
        assert seen == sorted(seen) and seen[0] == 0 and len(set(seen)) > 1 and transfer.WINDOW < max(seen) <= size
        assert two.shipper.on_their_way("/lab/a") == () == two.shipper.on_their_way("/lab/b")

    run(body())


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "snapshot"
    path.write_bytes(os.urandom(SMALL))
    return path


def test_a_small_snapshot_travels_with_its_offer(tmp_path: Path, small: Path) -> None:
    async def body() -> None:
        two = Two(tmp_path, Desk())
        await ship(two, small, SMALL)
        assert two.desk.taken == [small.read_bytes()]
        assert [type(message) for message in (*two.out.said, *two.back.said)] == [Offer, Taken]

    run(body())


@pytest.mark.parametrize(("pages", "threads"), [(1, 0), (64, 1)], ids=["small", "large"])
def test_a_small_file_is_examined_without_a_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, pages: int, threads: int
) -> None:
    made = snapshot({number: os.urandom(PAGE) for number in range(pages)})
    store, to_thread = open_store(tmp_path / "store"), asyncio.to_thread
    handed: list[str] = []
    told: list[Event] = []

    def handing(*call: Any) -> Coroutine[Any, Any, Any]:
        handed.append(call[0].__name__)
        return to_thread(*call)

    async def body() -> None:
        two, ended = Two(tmp_path, Desk()), asyncio.Event()
        dispatch = Dispatch(store, two.shipper, lambda event: told.append(event) or ended.set())
        monkeypatch.setattr(send_snapshots.asyncio, "to_thread", handing)
        dispatch.ship(acts.Ship(made.component, 1, made.position, None, "robot2", ComponentSpec(made.component)))
        await asyncio.wait_for(ended.wait(), BOUND_S)
        assert two.desk.taken == [store.chain_of(made.component)[-1].path.read_bytes()]

    try:
        descriptor = memfd_holding(format.encode_bytes(made), "snapshot")
        store.put(descriptor, prove=False)
        os.close(descriptor)
        run(body())
    finally:
        store.close()
    assert told == [ShipEnded(made.component, 1, made.position, "robot2", True, "")]
    assert handed.count("_examined") == threads


def test_a_receiver_of_an_older_release_gets_a_small_snapshot_as_a_chunk(tmp_path: Path, small: Path) -> None:
    def without_content(message: Bulk) -> Bulk:
        return msgspec.structs.replace(message, content=b"") if isinstance(message, Offer) else message

    async def body() -> None:
        two = Two(tmp_path, Desk(), without_content)
        await ship(two, small, SMALL)
        assert two.desk.taken == [small.read_bytes()]
        assert [type(message) for message in two.out.said] == [Offer, Chunk]

    run(body())


@pytest.mark.parametrize("size", [SMALL, CHUNK_SIZE_MAX - 1, CHUNK_SIZE_MAX, CHUNK_SIZE_MAX + 1])
def test_no_message_is_larger_than_a_chunk_by_more_than_its_head(tmp_path: Path, size: int) -> None:
    path = tmp_path / "snapshot"
    path.write_bytes(os.urandom(size))

    async def body() -> None:
        two = Two(tmp_path, Desk())
        await ship(two, path, size)
        assert two.desk.taken == [path.read_bytes()]
        assert max(len(encode_bulk(message)) for message in two.out.said) < CHUNK_SIZE_MAX + 100

    run(body())


@pytest.mark.parametrize("spoilt", [b"", b"\0"])
def test_a_small_snapshot_that_is_not_what_was_offered_leaves_nothing(tmp_path: Path, small: Path, spoilt: bytes) -> None:
    def spoil(message: Bulk) -> Bulk:
        if not isinstance(message, Offer):
            return message
        return msgspec.structs.replace(message, content=message.content[:-1] + spoilt)

    async def body() -> None:
        two = Two(tmp_path, Desk(), spoil)
        with pytest.raises(LaneError, match=r"sent .* bytes with an offer of|is not the promised digest"):
            await ship(two, small, SMALL)
        assert two.desk.taken == []
        assert left_in(tmp_path) == []

    small.write_bytes(os.urandom(SMALL - 1) + b"\1")
    run(body())


def test_the_signs_of_one_that_stores_a_small_snapshot_slowly_are_no_credit(
    tmp_path: Path, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transfer, "SIGN_S", 0.01)

    async def body() -> None:
        free = asyncio.Event()
        two = Two(tmp_path, Slow(free))
        shipping = asyncio.create_task(ship(two, small, SMALL))
        while len(two.back.said) < 3:
            await asyncio.sleep(0.01)
        free.set()
        await shipping
        assert [type(message) for message in two.out.said] == [Offer]

    run(body())


class Slow(Desk):
    """Takes its time to check and to store."""

    def __init__(self, free: asyncio.Event) -> None:
        super().__init__()
        self._free = free

    async def take(self, peer: str, offer: Offer, descriptor: int) -> None:
        await self._free.wait()
        await super().take(peer, offer, descriptor)


def test_a_snapshot_that_is_stored_slowly_is_waited_for_as_long_as_its_receiver_shows_that_it_is_at_it(
    tmp_path: Path, content: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transfer, "STORED_S", 1.0)
    monkeypatch.setattr(transfer, "SIGN_S", 0.05)

    async def body() -> None:
        free = asyncio.Event()
        two = Two(tmp_path, Slow(free))
        shipping = asyncio.create_task(ship(two, content))
        began = asyncio.get_running_loop().time()
        while asyncio.get_running_loop().time() < began + 2.0:
            assert not shipping.done(), "longer than its patience"
            await asyncio.sleep(0.05)
        assert not any(isinstance(message, Taken) for message in two.back.said), "it counts when it is stored, not before"
        free.set()
        await shipping
        assert two.desk.taken == [content.read_bytes()]

    run(body())


def test_a_receiver_that_shows_nothing_is_not_waited_for(tmp_path: Path, content: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer, "STORED_S", 0.2)
    monkeypatch.setattr(transfer, "SIGN_S", 10 * BOUND_S)

    async def body() -> None:
        two = Two(tmp_path, Slow(asyncio.Event()))
        with pytest.raises(LaneError, match="robot2 took nothing"):
            await ship(two, content)

    run(body())


def test_an_answer_that_went_with_its_connection_is_not_waited_for_as_for_a_slow_disk(
    tmp_path: Path, content: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def body() -> None:
        free = asyncio.Event()
        two = Two(tmp_path, Slow(free))
        shipping = asyncio.create_task(ship(two, content))
        await until_sent(two, shipping)
        monkeypatch.setattr(transfer, "PATIENCE_S", 0.2)
        two.back.connected = False
        free.set()
        while not two.desk.taken:
            await asyncio.sleep(0.01)
        two.back.connected = True
        two.shipper.answers_may_be_lost("robot2")
        with pytest.raises(LaneError, match="robot2 took nothing for 0 s"):
            await shipping

    run(body())


def test_a_receiver_that_connects_anew_and_is_still_at_it_is_waited_for(
    tmp_path: Path, content: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transfer, "SIGN_S", 0.02)

    async def body() -> None:
        free = asyncio.Event()
        two = Two(tmp_path, Slow(free))
        shipping = asyncio.create_task(ship(two, content))
        await until_sent(two, shipping)
        monkeypatch.setattr(transfer, "PATIENCE_S", 1.0)
        two.shipper.answers_may_be_lost("robot2")
        await asyncio.sleep(3 * transfer.PATIENCE_S)
        assert not shipping.done()
        free.set()
        await shipping

    run(body())


@pytest.mark.usefixtures("little_patience")
def test_never_more_chunks_are_under_way_than_there_is_credit_for(tmp_path: Path, content: Path) -> None:
    async def body() -> None:
        two = Two(tmp_path, Desk())
        two.shipper = Shipper(Link(lambda *_: None))
        task = asyncio.create_task(ship(two, content))
        with pytest.raises(LaneError, match="took nothing"):
            await task

    run(body())


def test_an_offer_that_cannot_leave_is_given_up_at_once(tmp_path: Path, content: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(transfer, "PATIENCE_S", 10 * BOUND_S)

    async def body() -> None:
        two = Two(tmp_path, Desk())
        two.out.connected = False
        with pytest.raises(LaneError, match="is not connected"):
            await ship(two, content)

    run(body())


@pytest.mark.usefixtures("little_patience")
@pytest.mark.parametrize("at", [0, 3])
def test_a_sender_that_falls_silent_leaves_nothing_and_is_told_why(tmp_path: Path, content: Path, at: int) -> None:
    def spoil(message: Bulk) -> Bulk | None:
        return None if isinstance(message, Chunk) and message.offset >= at * CHUNK_SIZE_MAX else message

    async def body() -> None:
        two = Two(tmp_path, Desk(), spoil)
        with pytest.raises(LaneError, match=r"silent|took nothing"):
            await ship(two, content)
        assert two.desk.taken == []

    run(body())
    assert left_in(tmp_path) == []


def test_one_flipped_bit_under_way_is_noticed(tmp_path: Path, content: Path) -> None:
    def spoil(message: Bulk) -> Bulk | None:
        if isinstance(message, Chunk) and message.offset == CHUNK_SIZE_MAX:
            return msgspec.structs.replace(message, content=b"\x00" + message.content[1:])
        return message

    changed = content.read_bytes()
    content.write_bytes(changed[:CHUNK_SIZE_MAX] + b"\x01" + changed[CHUNK_SIZE_MAX + 1 :])

    async def body() -> None:
        two = Two(tmp_path, Desk(), spoil)
        with pytest.raises(LaneError, match="digest"):
            await ship(two, content)
        assert two.desk.taken == []

    run(body())


def test_a_full_disk_is_said_by_name(tmp_path: Path, content: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(transfer, "_keep", full)

    async def body() -> None:
        two = Two(tmp_path, Desk())
        with pytest.raises(LaneError, match="No space left on device"):
            await ship(two, content)
        assert two.desk.taken == []
        assert two.desk.failed == ["cannot write it there: No space left on device"]

    run(body())


def test_what_the_desk_does_not_admit_does_not_travel(tmp_path: Path, content: Path) -> None:
    async def body() -> None:
        two = Two(tmp_path, Desk("epoch 1 is over"))
        with pytest.raises(LaneError, match="epoch 1 is over"):
            await ship(two, content)
        assert not any(isinstance(message, Chunk) for message in two.out.said)

    run(body())


@pytest.mark.parametrize("size", [0, -1, 1 << 60])
def test_an_absurd_size_is_refused_at_once(tmp_path: Path, size: int) -> None:
    async def body() -> None:
        two = Two(tmp_path, Desk())
        spec = ComponentSpec("/lab/a")
        two.receiver.offered("robot1", Offer(1, "/lab/a", 1, Position(1, 1, b""), None, size, b"", spec))
        assert isinstance(two.back.said[0], Refuse)

    run(body())


def test_chunks_that_have_come_meanwhile_are_written_at_once(
    tmp_path: Path, content: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A snapshot of gigabytes has ten thousand chunks, and each turn of a thread takes as long as to write one."""
    written: list[int] = []
    keep = transfer._keep

    def noted(file: DiskFile, contents: list[bytes], digest: blake3) -> None:
        written.append(len(contents))
        keep(file, contents, digest)

    monkeypatch.setattr(transfer, "_keep", noted)

    async def body() -> None:
        raw, desk = content.read_bytes(), Desk()
        two = Two(tmp_path, desk)
        offer = Offer(1, "/lab/a", 1, Position(1, 1, b""), None, SIZE, blake3(raw).digest(), ComponentSpec("/lab/a"))
        two.receiver.offered("robot1", offer)
        for offset in range(0, SIZE, CHUNK_SIZE_MAX):
            two.receiver.chunk("robot1", Chunk(1, offset, raw[offset : offset + CHUNK_SIZE_MAX]))
        async with asyncio.timeout(BOUND_S):
            while not desk.taken:
                await asyncio.sleep(0.01)
        assert desk.taken == [raw]

    run(body())
    assert written == [BATCH_CHUNKS, 2]


def test_a_chunk_without_credit_ends_its_transfer(tmp_path: Path) -> None:
    async def body() -> None:
        two = Two(tmp_path, Desk())
        spec = ComponentSpec("/lab/a")
        two.receiver.offered("robot1", Offer(1, "/lab/a", 1, Position(1, 1, b""), None, 1 << 30, b"", spec))
        for index in range(100):
            two.receiver.chunk("robot1", Chunk(1, index * CHUNK_SIZE_MAX, b"x"))
        assert any(isinstance(message, Refuse) and "credit" in message.reason for message in two.back.said)

    run(body())


def test_a_mistake_in_taking_a_snapshot_in_is_not_passed_over(
    tmp_path: Path, content: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Mistaken(Desk):
        async def take(self, peer: str, offer: Offer, descriptor: int) -> None:
            raise ZeroDivisionError

    ended: list[int] = []
    monkeypatch.setattr(os, "_exit", ended.append)

    async def body() -> None:
        two = Two(tmp_path, Mistaken())
        shipping = asyncio.create_task(ship(two, content))
        async with asyncio.timeout(BOUND_S):
            while not ended:
                await asyncio.sleep(0)
        shipping.cancel()

    run(body())
    assert ended == [crash.STATUS]
