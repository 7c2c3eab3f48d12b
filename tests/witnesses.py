"""A witness that keeps sealed copies, and a robot's way to it: real replication links on the loopback, without their agents."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Coroutine, Iterator
from pathlib import Path
from typing import Any, TypeVar

from agent.errors import AgentError
from agent.worker.network.remote_orders import SEALED, Errands
from agent.worker.network.replication_link import Callbacks, Keys, LinkState, ReplicationLink, new_keys
from agent.worker.replication.sealed_copies import SealedCopies
from agent.worker.replication.send_sealed import Courier
from agent.worker.replication.transfer import Receiver, Shipper
from checkpoint.errors import CheckpointError
from failover.archive import signature
from failover.cli.demo.robots import free_ports
from failover.core.wire.messages import Bulk, Cancel, Chunk, Content, Credit, Errand, ErrandDone, Refuse, Taken
from failover.errors import ArchiveError, FailoverError

ROBOT = "robot1"
GATE = "gate"
SIZE_MAX = 1 << 30

T = TypeVar("T")


class Gate:
    """Both ends, in a loop of their own, and `failover.archive.witness.Witness` for the test.

    Attributes:
        spoil: given the bytes of each chunk on its way, returns those that arrive.
    """

    def __init__(self, directory: Path, key: bytes, size_max: int = SIZE_MAX) -> None:
        self.directory = directory / "sealed"
        self.spoil = lambda content: content
        self._size_max, self._public = size_max, signature.public_of(key)
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self._closing: list[Any] = []

    def call(self, work: Coroutine[Any, Any, T]) -> T:
        """Do something in the loop of both."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    async def begin(self) -> None:
        """Connect both."""
        self.copies = SealedCopies(self.directory, self._size_max, GATE, lambda: self._public)
        self.copies.load()
        ports = free_ports(2)
        where = {name: f"127.0.0.1:{port}" for name, port in zip((ROBOT, GATE), ports, strict=True)}
        pairs = {name: new_keys() for name in where}
        publics = {name: public for name, (public, _) in pairs.items()}
        stand = asyncio.Event()

        def changed(*_: object) -> None:
            ends = (self.robot.links.get(GATE), self.gate.links.get(ROBOT))
            if all(end is not None and end.state is LinkState.CONNECTED for end in ends):
                stand.set()

        def link(me: str, peer: str, hear: Any) -> ReplicationLink:
            return ReplicationLink(me, where[me], {peer: where[peer]}, Keys(*pairs[me], publics), Callbacks(hear, changed))

        self.robot, self.gate = link(ROBOT, GATE, self._hear_at_robot), link(GATE, ROBOT, self._hear_at_gate)
        self._receiver = Receiver(self.gate, self.directory, self.copies)
        self.copies.arriving = self._receiver.arriving
        self._answers = Errands(self.gate.say, lambda _: "", {}, {SEALED: self.copies.answer})
        self._shipper = Shipper(self.robot)
        self._errands = Errands(self.robot.say, lambda _: "", {})
        self.courier = Courier(self._errands, self._shipper, GATE)
        self.robot.open()
        self.gate.open()
        await stand.wait()

    def _hear_at_robot(self, peer: str, message: Bulk) -> None:
        match message:
            case ErrandDone():
                self._errands.done(peer, message)
            case Credit() | Taken() | Refuse():
                self._shipper.heard(peer, message)

    def _hear_at_gate(self, peer: str, message: Bulk) -> None:
        match message:
            case Errand():
                self._answers.received(peer, message)
            case Content():
                self._receiver.offered(peer, message)
            case Chunk(transfer, offset, content):
                self._receiver.chunk(peer, Chunk(transfer, offset, self.spoil(content)))
            case Cancel():
                self._receiver.cancelled(peer, message)

    def ask(self, arguments: dict[str, Any]) -> dict[str, Any]:
        """See `failover.archive.witness.Witness.ask`."""
        with told():
            return self.call(self.courier.ask(arguments))

    def ship(self, digest: bytes, size: int, descriptor: int) -> None:
        """See `failover.archive.witness.Witness.ship`."""
        with told():
            self.call(self.courier.ship(Content(0, size, digest), descriptor))

    def drop_transfers(self) -> None:
        """Have both ends give up what is on its way, as where the link is lost."""

        async def drop() -> None:
            self._receiver.lost(ROBOT)
            self._shipper.lost(GATE)

        self.call(drop())

    async def end(self) -> None:
        """Cut both off."""
        await self._answers.close()
        await self.robot.close()
        await self.gate.close()

    def close(self) -> None:
        """End the loop."""
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()


@contextlib.contextmanager
def told() -> Iterator[None]:
    """Say what went wrong as the archive's process does."""
    try:
        yield
    except (AgentError, CheckpointError, FailoverError) as error:
        raise ArchiveError(str(error)) from error


@contextlib.contextmanager
def keeping(directory: Path, key: bytes, size_max: int = SIZE_MAX) -> Iterator[Gate]:
    """A witness that keeps sealed copies for the holders of a key, connected."""
    gate = Gate(directory, key, size_max)
    try:
        gate.call(gate.begin())
        try:
            yield gate
        finally:
            gate.call(gate.end())
    finally:
        gate.close()
