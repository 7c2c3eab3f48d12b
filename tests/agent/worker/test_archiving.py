"""The worker's part of an archive, with its process: which components, how often, which files, and what is said."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import subprocess
import tempfile
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from blake3 import blake3

from agent import config as configuration
from agent.archive.messages import KeepCheckpoint
from agent.archive.process import Archivist
from agent.errors import LaneError
from agent.system import clock
from agent.worker.archiving import Archiving
from agent.worker.network.remote_orders import Errands
from agent.worker.network.replication_link import new_keys
from agent.worker.replication.send_files import Reader
from agent.worker.replication.send_sealed import Courier
from agent.worker.replication.transfer import Shipper
from checkpoint.keeper.messages import memfd_holding
from checkpoint.model import Snapshot
from checkpoint.snapshot import format
from checkpoint.snapshot.required_files import Need
from checkpoint.store import chain
from checkpoint.store.chain_files import fold_to
from checkpoint.store.store import Store, open_store
from failover.archive import keys, sealed
from failover.archive.archive import Archive
from failover.archive.objects import FolderObjects
from failover.config import team
from failover.config.team import Robot, Role, Team
from failover.core.events import Archived, Event
from failover.core.wire.messages import Bulk, Chunk, Offer
from tests.checkpoint.snapshots import COMPONENT, history, page, pages_of, snapshot

pytest.importorskip("cryptography")

PATIENCE_S = 60.0
OTHER = "/lab/robot2/planner"


@dataclass
class Member:
    """A member with a store and an archive, but without an agent."""

    directory: Path
    store: Store
    archiving: Archiving
    running: set[str]
    events: list[Event] = field(default_factory=list)

    def archive(self) -> Archive:
        known = keys.read_keys(self.directory / "team", team.read(self.directory / "team"))
        return Archive(FolderObjects(self.directory / "place"), known, "lab", self.directory)

    def put(self, *made: Snapshot) -> None:
        for one in made:
            descriptor = memfd_holding(format.encode_bytes(one), "snapshot")
            self.store.put(descriptor)
            os.close(descriptor)

    def archived(self, component: str = COMPONENT) -> list[int]:
        """The numbers of the copies, the newest first."""
        return [copy.sequence for copy in self.archive().copies(component)]


class Nowhere:
    """A link that does not stand."""

    def say(self, peer: str, message: Bulk) -> bool:
        return False

    async def ship(self, peer: str, chunk: Chunk | Offer) -> None:
        raise LaneError(f"the replication link to {peer} is not connected")


async def nothing(component: str, need: Need) -> int:
    raise LaneError(f"{need.path} is not here any more")


@contextlib.contextmanager
def member(
    directory: Path, *lines: str, role: Role = "robot", bring: bool = False, opening: Reader = nothing
) -> Iterator[Member]:
    robots = {f"robot{place}": Robot((f"127.0.0.1:74{place}0",), f"127.0.0.1:74{place}1") for place in (1, 2, 3)}
    robots["robot1"] = replace(robots["robot1"], role=role)
    team.write(directory / "team", Team("lab", robots))
    keys.new_key(directory / "team")
    for name in ("place", "state"):
        (directory / name).mkdir()
    path = directory / "agent.toml"
    path.write_text(
        f'robot = "robot1"\nteam_directory = "{directory}/team"\nstate_directory = "{directory}/state"\ninsecure = true\n'
        f'bring = {str(bring).lower()}\n[store]\ns3 = "{directory}/place"\ns3_every_s = 1\n' + "\n".join(lines)
    )
    made = open_store(directory / "state" / "store")
    running: set[str] = set()
    events: list[Event] = []
    try:
        archiving = Archiving(configuration.load(path), made, lambda: running, opening, events.append)
        yield Member(directory, made, archiving, running, events)
    finally:
        made.close()


def run(member: Member, work: Callable[[], Awaitable[None]]) -> None:
    """Do some work while copies are made."""

    async def both() -> None:
        copying = asyncio.create_task(member.archiving.run())
        try:
            await work()
        finally:
            copying.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await copying

    asyncio.run(both())


async def until(condition: Callable[[], Any]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not condition():
            await asyncio.sleep(0.02)


def test_nothing_is_folded_or_sealed_while_no_copy_can_leave_for_its_witness(tmp_path: Path) -> None:
    with member(tmp_path) as one:
        one.put(snapshot({1: page("x")}))
        one.running.add(COMPONENT)
        courier = Courier(
            Errands(lambda *_: None, lambda _: "", {}), Shipper(Nowhere()), "gate", lambda: "wlan0 is the only link"
        )
        archiving = Archiving(one.archiving._settings, one.store, lambda: one.running, nothing, one.events.append, courier)
        one.archiving = archiving

        async def work() -> None:
            await until(lambda: "sealed copies wait: wlan0 is the only link" in "".join(archiving.complaints()))

        run(one, work)
        assert archiving._process._child is None, "the archive's process was not even started"


def test_a_robot_archives_what_runs_here_and_a_server_all_that_it_keeps(tmp_path: Path) -> None:
    for role, wanted in (("robot", [COMPONENT]), ("server", [COMPONENT, OTHER])):
        (tmp_path / role).mkdir()
        with member(tmp_path / role, role=role) as one:
            one.put(snapshot({1: page("x")}), snapshot({1: page("y")}, component=OTHER))
            one.running.add(COMPONENT)

            async def work(one: Member = one, wanted: list[str] = wanted) -> None:
                await until(lambda: not one.archiving.complaints() and len(one.archive().copies()) >= len(wanted))

            run(one, work)
            assert [copy.component for copy in one.archive().copies()] == wanted


def test_a_chain_becomes_one_checkpoint_and_older_copies_go(tmp_path: Path) -> None:
    made = history(5)
    with member(tmp_path, "s3_keep = 2") as one:
        one.put(*made[:3])
        one.running.add(COMPONENT)

        async def work() -> None:
            await until(lambda: one.archived() == [3])
            one.put(made[3])
            await until(lambda: one.archived() == [4, 3])
            one.put(made[4])
            await until(lambda: one.archived() == [5, 4])

        run(one, work)
        with (tmp_path / "fetched").open("w+b") as file:
            one.archive().fetch(one.archive().copies()[0], file)
            assert pages_of(format.decode(file)) == pages_of(chain.fold(made))
        assert one.events == []


def test_the_files_of_a_program_go_along_and_one_that_cannot_be_had_is_told(tmp_path: Path) -> None:
    content = os.urandom(100_000)
    asked: list[str] = []
    is_here = False

    async def opening(component: str, need: Need) -> int:
        asked.append(need.path)
        if not is_here:
            raise LaneError(f"{need.path} is not here any more")
        return memfd_holding(content, "file")

    with member(tmp_path, bring=True, opening=opening) as one:
        made = snapshot({1: page("x")})
        executable = type(made.process.executable)("/opt/mapper", size=len(content), digest=blake3(content).digest())
        state = msgspec.structs.replace(made, process=msgspec.structs.replace(made.process, executable=executable))
        state = msgspec.structs.replace(state, position=chain.position_of(state, 1, 1))
        one.put(state)
        one.running.add(COMPONENT)

        async def work() -> None:
            nonlocal is_here
            await until(lambda: any("/opt/mapper is not here any more" in said for said in one.archiving.complaints()))
            await until(lambda: one.archived() == [1])
            is_here = True
            await until(lambda: one.archived() == [1] and not one.archiving.complaints())
            count = len(asked)
            one.put(msgspec.structs.replace(state, position=chain.position_of(state, 1, 2)))
            await until(lambda: one.archived() == [2, 1])
            assert len(asked) == count, "its files are there"

        run(one, work)
        assert one.archive().holds_whole(executable.digest)
        assert [event.sentence.partition(":")[0] for event in one.events] == [  # type: ignore[union-attr]
            "its checkpoints reach the archive without files",
            "its checkpoints reach the archive again",
        ]


def test_when_a_member_goes_or_joins_all_is_sealed_anew_for_those_who_are_there(tmp_path: Path) -> None:
    content = os.urandom(100_000)

    async def opening(component: str, need: Need) -> int:
        return memfd_holding(content, "file")

    with member(tmp_path, bring=True, opening=opening) as one:
        before = team.read(tmp_path / "team")
        with_keys = {name: replace(robot, public_key=new_keys()[0]) for name, robot in before.robots.items() if name != "robot1"}
        robots = before.robots | with_keys
        team.write(tmp_path / "team", replace(before, robots=robots))
        made = snapshot({1: page("x")})
        executable = type(made.process.executable)("/opt/mapper", size=len(content), digest=blake3(content).digest())
        state = msgspec.structs.replace(made, process=msgspec.structs.replace(made.process, executable=executable))
        one.put(msgspec.structs.replace(state, position=chain.position_of(state, 1, 1)))
        one.running.add(COMPONENT)

        def sealed_for(*names: str) -> bool:
            """Whether the newest copy, and the file that the program needs, are for these alone."""
            stay = replace(before, robots={name: robots[name] for name in names})
            wanted = keys.ids_of(keys.read_keys(tmp_path / "team", stay).readers)
            newest = [tmp_path / "place" / copy.name for copy in one.archive().copies()[:1]]
            found = [*newest, *(tmp_path / "place").rglob("contents/*.sealed")]
            return len(found) == 2 and all(readers_of(path) == wanted for path in found)

        async def work() -> None:
            await until(lambda: sealed_for("robot1", "robot2", "robot3"))
            for names in (("robot1", "robot2"), ("robot1", "robot2", "robot3")):  # one goes, one joins
                team.write(tmp_path / "team", replace(before, robots={name: robots[name] for name in names}))
                await until(lambda names=names: sealed_for(*names) and one.archived() == [1])  # type: ignore[misc]

        run(one, work)
        assert one.archived() == [1] and one.archive().holds_whole(executable.digest)


def readers_of(path: Path) -> frozenset[bytes]:
    with contextlib.suppress(FileNotFoundError), path.open("rb") as file:  # it may be replaced meanwhile
        return sealed.readers_in(sealed.read_head(path.name, file))
    return frozenset()


def test_a_chain_is_folded_in_steps_where_its_deltas_are_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    together: list[int] = []

    def fold(file: Any, *sources: Any) -> None:
        together.append(len(sources))
        fold_to(file, *sources)

    monkeypatch.setattr("checkpoint.store.fold_rules.FOLDED_AT_ONCE_SIZE", 1)
    monkeypatch.setattr("checkpoint.store.chain_files.fold_to", fold)
    made = history(5)
    for number, one in enumerate(made):
        (tmp_path / f"{number}").write_bytes(format.encode_bytes(one))
    with member(tmp_path) as one, contextlib.ExitStack() as files:
        opened = [files.enter_context((tmp_path / f"{number}").open("rb")) for number in range(len(made))]
        archivist = Archivist(configuration.load(tmp_path / "agent.toml"))
        assert archivist.answer(KeepCheckpoint(COMPONENT), tuple(file.fileno() for file in opened)).refusal == ""
        assert sum(together) - len(together) == 4 and len(together) > 1, "each delta once, in several steps"
        with tempfile.TemporaryFile() as file:
            one.archive().fetch(one.archive().copies()[0], file)
            assert pages_of(format.decode(file)) == pages_of(chain.fold(made))
        assert archivist.answer(KeepCheckpoint(COMPONENT), (opened[0].fileno(),)).refusal == ""
        assert not opened[0].closed and os.fstat(opened[0].fileno())


def test_a_key_that_is_replaced_seals_all_anew(tmp_path: Path) -> None:
    with member(tmp_path) as one:
        one.put(history(1)[0])
        one.running.add(COMPONENT)

        async def work() -> None:
            await until(lambda: one.archived() == [1])
            (before,) = one.archive().copies()
            path = keys.key_path(tmp_path / "team")
            path.rename(path.with_suffix(".old"))
            keys.recovery_path(tmp_path / "team").unlink()
            keys.new_key(tmp_path / "team")
            await until(lambda: [copy.name > before.name for copy in one.archive().copies()] == [True])

        run(one, work)
        with tempfile.TemporaryFile() as file:
            one.archive().fetch(one.archive().copies()[0], file)


def test_a_process_that_hangs_is_told_and_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with member(tmp_path) as one:
        one.put(history(1)[0])
        one.running.add(COMPONENT)

        async def work() -> None:
            await until(lambda: (shelf := one.archiving._shelves.get(COMPONENT)) is not None and shelf.position is not None)
            child = one.archiving._process._child
            assert child is not None
            os.kill(child.pid, signal.SIGSTOP)
            monkeypatch.setattr("agent.worker.archive_process.PATIENCE_S", 0.5)
            one.put(history(2)[1])
            await until(lambda: any("s and was ended; see that" in said for said in one.archiving.complaints()))
            monkeypatch.setattr("agent.worker.archive_process.PATIENCE_S", 600.0)
            await until(lambda: one.archived() == [2, 1] and not one.archiving.complaints())
            assert child.returncode == -signal.SIGKILL and one.archiving._process._child is not child

        run(one, work)


def test_a_process_that_does_not_end_when_it_is_killed_is_told_and_no_second_one_is_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Stuck(subprocess.Popen[bytes]):
        def kill(self) -> None:
            """The kernel holds it."""

    started: list[Stuck] = []

    def start(*arguments: Any, **keywords: Any) -> Stuck:
        started.append(Stuck(["sleep", "1000"]))
        return started[-1]

    monkeypatch.setattr("agent.worker.archive_process.subprocess", SimpleNamespace(**vars(subprocess) | {"Popen": start}))
    monkeypatch.setattr("agent.worker.archive_process.END_S", 0.1)
    with member(tmp_path) as one:
        one.put(history(1)[0])
        one.running.add(COMPONENT)

        async def work() -> None:
            await until(lambda: any("was killed and does not end" in said for said in one.archiving.complaints()))

        try:
            run(one, work)
        finally:
            for process in started:
                process.send_signal(signal.SIGKILL)
                process.wait()
        assert len(started) == 1


def test_a_copy_that_has_gone_from_the_archive_is_put_again_and_the_core_hears_of_it(tmp_path: Path) -> None:
    with member(tmp_path) as robot:
        robot.put(*history(1))
        robot.running.add(COMPONENT)

        async def work() -> None:
            await until(lambda: robot.archived() and robot.archiving._shelves[COMPONENT].position)
            (copy,) = robot.archive().copies()
            robot.archiving.listed([copy], clock.now_ns())
            assert not robot.events, "it is there"
            (tmp_path / "place" / copy.name).unlink()
            begun_ns = robot.archiving._shelves[COMPONENT].put_ns
            robot.archiving.listed([], begun_ns)
            assert not robot.events, "the archive was asked before the copy was there"
            robot.archiving.listed(robot.archive().copies(), clock.now_ns())
            assert [event.position for event in robot.events if isinstance(event, Archived)] == [None]
            await until(robot.archived)

        run(robot, work)
