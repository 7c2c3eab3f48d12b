"""What a robot takes from the archive, with its process and a folder as the place: what is newer, whole, and not run here."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest

from agent import config as configuration
from agent.main_loop.messages import Told
from agent.worker.fetching import Arrived, Fetching
from checkpoint.keeper.messages import memfd_holding
from checkpoint.model import Snapshot
from checkpoint.snapshot import format
from checkpoint.store.store import open_store
from failover.archive import sealed
from failover.archive.archive import Archive
from failover.archive.objects import FolderObjects
from failover.config import team
from failover.config.team import Robot, Team
from failover.core.events import Event, Fetched, Looked
from failover.core.types import ComponentSpec, StatusView
from tests.checkpoint.snapshots import COMPONENT, history

pytest.importorskip("cryptography")

PATIENCE_S = 100.0
SPEC = ComponentSpec(COMPONENT)


class Member:
    """A robot's store, the archive beside it, and what the core would hear."""

    def __init__(self, directory: Path) -> None:
        robots = {f"robot{place}": Robot((f"127.0.0.1:74{place}0",), f"127.0.0.1:74{place}1") for place in (1, 2)}
        team.write(directory / "team", Team("lab", robots))
        sealed.new_key(directory / "team")
        for name in ("place", "state"):
            (directory / name).mkdir()
        path = directory / "agent.toml"
        path.write_text(
            f'robot = "robot1"\nteam_directory = "{directory}/team"\nstate_directory = "{directory}/state"\ninsecure = true\n'
            f'bring = false\nrule = "etcd"\nlease_ms = 1800\n[coordinator]\nendpoints = ["http://127.0.0.1:1"]\n'
            f'[store]\ns3 = "{directory}/place"\ns3_every_s = 1\n'
        )
        self.directory, self.events = directory, list[Event]()
        self.store = open_store(directory / "state" / "store")
        self.fetching = Fetching(configuration.load(path), self.store, self.told, self.events.append, self.kept)

    async def told(self) -> Told:
        return Told(1, 0, StatusView("robot1", 1, "etcd", "", True, (), ()))

    def kept(self, arrived: Arrived) -> None:
        raise AssertionError("no core accepts it here")

    def put(self, snapshot: Snapshot) -> str:
        """Another robot puts a copy; the object's name."""
        key = sealed.read_key(self.directory / "team")
        archive = Archive(FolderObjects(self.directory / "place"), key, "lab", self.directory, by_epoch=True)
        descriptor = memfd_holding(format.encode_bytes(snapshot), "snapshot")
        with os.fdopen(descriptor, "rb") as file:
            return archive.put(file, "robot2", msgspec.msgpack.encode(SPEC))[0]

    def fetched(self) -> list[int]:
        return [event.position.sequence for event in self.events if isinstance(event, Fetched)]

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not condition():
                await asyncio.sleep(0.02)


def run(tmp_path: Path, work: Callable[[Member], object]) -> None:
    async def both() -> None:
        member = Member(tmp_path)
        taking = asyncio.create_task(member.fetching.run())
        try:
            await work(member)  # type: ignore[misc]
        finally:
            taking.cancel()
            await asyncio.gather(taking, return_exceptions=True)
            member.store.close()

    asyncio.run(both())


def bases() -> list[Snapshot]:
    """Whole checkpoints of one component, each later than the one before."""
    first = history(1)[0]
    return [
        msgspec.structs.replace(first, position=msgspec.structs.replace(first.position, sequence=number)) for number in (1, 2, 3)
    ]


def test_the_newest_copy_comes_into_the_store_an_altered_one_is_named_and_a_rollback_is_told(tmp_path: Path) -> None:
    async def work(member: Member) -> None:
        first, second, third = bases()
        name = member.put(first)
        await member.until(lambda: member.fetched() == [1])
        assert member.store.newest(COMPONENT) == first.position
        assert any(isinstance(event, Looked) and event.behind == (COMPONENT,) for event in member.events)
        harmed = member.directory / "place" / member.put(third)
        content = bytearray(harmed.read_bytes())
        content[len(content) // 2] ^= 1
        harmed.write_bytes(content)
        await member.until(lambda: "was not taken" in " ".join(member.fetching.complaints()))
        assert member.store.newest(COMPONENT) == first.position, "nothing of an altered copy is used"
        harmed.unlink()
        member.put(second)
        await member.until(lambda: 2 in member.fetched())
        await member.until(lambda: "rolled back" in " ".join(member.fetching.complaints()))
        assert (member.directory / "place" / name).exists()
        assert member.store.newest(COMPONENT) == second.position

    run(tmp_path, work)
