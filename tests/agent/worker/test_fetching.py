"""What a robot takes from the archive, with its process and a folder as the place: what is newer, whole, and not run here."""

from __future__ import annotations

import asyncio
import os
import random
import signal
from collections.abc import Awaitable, Callable
from pathlib import Path

import msgspec
import pytest

from agent import config as configuration
from agent.archive.messages import Done, Fetch, Request
from agent.main_loop.messages import Told
from agent.worker import fetching
from agent.worker.fetching import Arrived, Fetching
from checkpoint.keeper.messages import memfd_holding
from checkpoint.model import Snapshot
from checkpoint.snapshot import format
from checkpoint.store.chain import position_of
from checkpoint.store.store import open_store
from failover.archive import keys
from failover.archive.archive import Archive, Last
from failover.archive.objects import FolderObjects
from failover.config import team
from failover.config.team import Robot, Team
from failover.core.events import Damaged, Event, Fetched, Looked
from failover.core.types import ComponentSpec, ComponentView, PeerView, Protection, State, StatusView
from tests.checkpoint.snapshots import COMPONENT, PAGE, history, snapshot

pytest.importorskip("cryptography")

PATIENCE_S = 100.0
SPEC = ComponentSpec(COMPONENT)


ETCD = 'rule = "etcd"\nlease_ms = 1800\n[coordinator]\nendpoints = ["http://127.0.0.1:1"]\n'


class Member:
    """A robot's store, the archive beside it, and what the core would hear."""

    def __init__(self, directory: Path, bring: bool = False, components: str = "", rule: str = ETCD) -> None:
        robots = {f"robot{place}": Robot((f"127.0.0.1:74{place}0",), f"127.0.0.1:74{place}1") for place in (1, 2)}
        team.write(directory / "team", Team("lab", robots))
        keys.new_key(directory / "team")
        for name in ("place", "state"):
            (directory / name).mkdir()
        path = directory / "agent.toml"
        path.write_text(
            f'robot = "robot1"\nteam_directory = "{directory}/team"\nstate_directory = "{directory}/state"\ninsecure = true\n'
            f'bring = {str(bring).lower()}\n{rule}[store]\ns3 = "{directory}/place"\ns3_every_s = 1\n'
            f"resume = {str(rule != ETCD).lower()}\n{components}"
        )
        self.directory, self.events = directory, list[Event]()
        self.seen: tuple[ComponentView, ...] = ()
        self.peers: tuple[PeerView, ...] = ()
        self.asked = 0
        self.store = open_store(directory / "state" / "store")
        self.fetching = Fetching(configuration.load(path), self.store, self.told, self.events.append, self.kept)

    async def told(self) -> Told:
        self.asked += 1
        return Told(1, 0, StatusView("robot1", 1, "etcd", "", True, self.peers, self.seen))

    def kept(self, arrived: Arrived) -> None:
        raise AssertionError("no core accepts it here")

    def put(self, snapshot: Snapshot, last: dict[str, Last] | None = None) -> str:
        """Another robot puts a copy; the object's name. ``last``: what it remembers, so that a delta may follow."""
        known = keys.read_keys(self.directory / "team", team.read(self.directory / "team"))
        archive = Archive(FolderObjects(self.directory / "place"), known, "lab", self.directory, by_epoch=True, last=last)
        descriptor = memfd_holding(format.encode_bytes(snapshot), "snapshot")
        with os.fdopen(descriptor, "rb") as file:
            return archive.put(file, "robot2", msgspec.msgpack.encode(SPEC))[0]

    def fetched(self) -> list[int]:
        return [event.position.sequence for event in self.events if isinstance(event, Fetched)]

    async def until(self, condition: Callable[[], object]) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while not condition():
                await asyncio.sleep(0.02)


def run(tmp_path: Path, work: Callable[[Member], object], bring: bool = False, components: str = "", rule: str = ETCD) -> None:
    async def both() -> None:
        member = Member(tmp_path, bring, components, rule)
        taking = asyncio.create_task(member.fetching.run())
        try:
            await work(member)  # type: ignore[misc]
        finally:
            taking.cancel()
            await asyncio.gather(taking, return_exceptions=True)
            member.store.close()

    asyncio.run(both())


def bases(count: int = 3, component: str = COMPONENT) -> list[Snapshot]:
    """Whole checkpoints of one component, each later than the one before."""
    first = msgspec.structs.replace(history(1)[0], component=component)
    return [msgspec.structs.replace(first, position=position_of(first, 1, number)) for number in range(1, count + 1)]


def harm(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_the_newest_copy_comes_into_the_store_an_altered_one_is_named_and_a_rollback_is_told(tmp_path: Path) -> None:
    async def work(member: Member) -> None:
        first, second, third = bases()
        name = member.put(first)
        await member.until(lambda: member.fetched() == [1])
        assert member.store.newest(COMPONENT) == first.position
        assert any(isinstance(event, Looked) and event.behind == (COMPONENT,) for event in member.events)
        harmed = member.directory / "place" / member.put(third)
        harm(harmed)
        await member.until(lambda: "was not taken" in " ".join(member.fetching.complaints()))
        assert member.store.newest(COMPONENT) == first.position, "nothing of an altered copy is used"
        harmed.unlink()
        member.put(second)
        await member.until(lambda: 2 in member.fetched())
        await member.until(lambda: "rolled back" in " ".join(member.fetching.complaints()))
        assert (member.directory / "place" / name).exists()
        assert member.store.newest(COMPONENT) == second.position

    run(tmp_path, work)


def test_where_members_vote_the_archive_is_asked_once_and_then_only_while_a_primary_is_silent(tmp_path: Path) -> None:
    async def work(member: Member) -> None:
        member.seen = (ComponentView(COMPONENT, State.STANDBY, 1, "robot2", "", Protection.NONE, -1, 0, (), ""),)
        member.peers = (PeerView("robot2", "alive", 1, 0, hears_us=True, load=0),)
        member.put(bases()[0])
        await member.until(lambda: member.asked >= 4)
        assert member.fetching._process._dialogue is None, "no process waits for the next question"
        assert not member.fetched()
        member.peers = (PeerView("robot2", "dead", 1, 0, hears_us=False, load=0),)
        await member.until(lambda: member.fetched() == [1])

    run(tmp_path, work, rule='rule = "majority"\n')


def test_a_copy_that_is_not_the_newest_does_not_say_that_this_robot_has_all_that_the_archive_had(tmp_path: Path) -> None:
    """Three newer ones do not open: the fourth is taken all the same, and the core waits as for an archive that is silent."""

    async def work(member: Member) -> None:
        first, *newer = bases(4)
        for one in newer:
            harm(member.directory / "place" / member.put(one))
        member.put(first)
        await member.until(lambda: member.fetched() == [1])
        (event,) = (event for event in member.events if isinstance(event, Fetched))
        assert event.begun_ns == 0
        looks = len(member.events)
        await member.until(lambda: any(isinstance(event, Looked) for event in member.events[looks:]))
        assert all(event.behind == (COMPONENT,) for event in member.events if isinstance(event, Looked))

    run(tmp_path, work)


def test_a_success_of_one_component_does_not_have_the_harmed_copy_of_another_tried_again(tmp_path: Path) -> None:
    other = "/lab/robot1/planner"

    async def work(member: Member) -> None:
        harm(member.directory / "place" / member.put(bases(1)[0]))
        await member.until(member.fetching.complaints)
        refused = dict(member.fetching._refused)
        member.put(bases(1, other)[0])
        await member.until(lambda: member.fetched() == [1])
        assert member.fetching._refused == refused

    run(tmp_path, work)


def test_where_the_chain_of_the_newest_copy_is_harmed_the_copies_of_which_most_are_whole_are_tried(tmp_path: Path) -> None:
    some = random.Random(1)
    state = {number: some.randbytes(PAGE) for number in range(100)}
    made = []
    for sequence in range(1, 9):
        state[sequence] = some.randbytes(PAGE)
        made.append(snapshot(state, sequence=sequence))

    async def work(member: Member) -> None:
        last: dict[str, Last] = {}
        names = [member.put(one, last) for one in made[:2]]
        last.clear()
        names += [member.put(one, last) for one in made[2:]]
        assert [".delta~" in name for name in names] == [False, True, False, True, True, True, True, True]
        place = member.directory / "place"
        whole = (place / names[3]).read_bytes()
        (place / names[3]).write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
        taking = asyncio.create_task(member.fetching.run())
        await member.until(lambda: member.fetched() == [3])
        assert sum(isinstance(event, Looked) for event in member.events) == 1, "in the first round"
        assert names[7] in " ".join(member.fetching.complaints()) or names[3] in " ".join(member.fetching.complaints())
        taking.cancel()
        await asyncio.gather(taking, return_exceptions=True)

    with_no_round(tmp_path, work)


def with_no_round(tmp_path: Path, work: Callable[[Member], Awaitable[None]]) -> None:
    """Do some work before anything is fetched."""

    async def both() -> None:
        member = Member(tmp_path)
        try:
            await work(member)
        finally:
            member.store.close()

    asyncio.run(both())


def test_a_component_whose_name_is_too_long_for_an_object_is_told_of_by_its_whole_name(tmp_path: Path) -> None:
    name = "/lab/robot1/" + "\u5730\u56fe" * 8

    async def work(member: Member) -> None:
        harm(member.directory / "place" / member.put(bases(1, name)[0]))
        await member.until(lambda: any(isinstance(event, Looked) and event.behind for event in member.events))
        assert all(event.behind in ((), (name,)) for event in member.events if isinstance(event, Looked))

    run(tmp_path, work, components=f'[components."{name}"]\nbring_data = false\n')


def test_what_is_fetched_in_advance_gives_way_to_what_the_core_looks_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The archive's process stands still in the middle of the one copy."""
    other = "/lab/robot1/planner"

    async def work(member: Member) -> None:
        process, stopped = member.fetching._process, list[int]()
        ask = process.ask

        async def stopping(request: Request, descriptors: tuple[int, ...] = (), limit_s: float = 0.0) -> Done:
            if isinstance(request, Fetch) and not stopped:
                assert process._child is not None
                stopped.append(process._child.pid)
                os.kill(stopped[0], signal.SIGSTOP)
            return await ask(request, descriptors, limit_s)

        monkeypatch.setattr(process, "ask", stopping)
        member.put(bases(1)[0])
        await member.until(lambda: stopped)
        member.put(bases(2, other)[1])
        member.fetching.look(other)
        await member.until(lambda: len(member.fetched()) == 2)
        assert member.fetched() == [2, 1]
        assert not member.fetching.complaints()

    run(tmp_path, work)


def test_a_copy_that_is_not_understood_is_refused_by_name_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def misread(*_: object, **__: object) -> None:
        raise KeyError("executable")

    monkeypatch.setattr(fetching, "needs", misread)

    async def work(member: Member) -> None:
        member.put(bases(1)[0])
        await member.until(member.fetching.complaints)
        monkeypatch.undo()
        member.put(bases(2)[1])
        await member.until(lambda: member.fetched() == [2])

    run(tmp_path, work, bring=True)


def test_what_the_core_does_not_count_as_held_is_taken_again_and_an_emptied_archive_is_told(tmp_path: Path) -> None:
    async def work(member: Member) -> None:
        (first,) = bases(1)
        descriptor = memfd_holding(format.encode_bytes(first), "snapshot")
        member.store.put(descriptor)
        os.close(descriptor)
        name = member.put(first)
        await member.until(lambda: member.fetched() == [1])
        member.seen = (ComponentView(COMPONENT, State.STANDBY, 1, "robot2", "", Protection.NONE, -1, 0, (first.position,), ""),)
        (member.directory / "place" / name).unlink()
        await member.until(lambda: "lost all copies" in " ".join(member.fetching.complaints()))

    run(tmp_path, work)


def the_file(member: Member) -> Path:
    (entry,) = member.store.chain_of(COMPONENT)
    return entry.path


def test_a_checkpoint_that_is_damaged_on_this_robots_disk_is_fetched_again_and_said_to_be_damaged_meanwhile(
    tmp_path: Path,
) -> None:
    """The archive gives nothing for a while; then the same copy comes once more, and is read whole."""

    async def work(member: Member) -> None:
        (first,) = bases(1)
        name = member.put(first)
        await member.until(lambda: member.fetched() == [1])
        member.seen = (ComponentView(COMPONENT, State.STANDBY, 1, "robot2", "", Protection.NONE, -1, 0, (first.position,), ""),)
        away = (member.directory / "place" / name).rename(member.directory / "away")
        harm(the_file(member))
        member.store.check(COMPONENT, first.position)
        await member.until(lambda: "damaged on this robot's disk" in " ".join(member.fetching.complaints()))
        assert Damaged(COMPONENT, 1, first.position) in member.events
        assert member.store.newest(COMPONENT) is None
        away.rename(member.directory / "place" / name)
        await member.until(lambda: member.fetched() == [1, 1])
        assert not any("damaged" in one for one in member.fetching.complaints())
        (member.directory / "place").rename(member.directory / "gone")
        await member.until(lambda: "has not answered" in " ".join(member.fetching.complaints()))
        told = member.events.count(Damaged(COMPONENT, 1, first.position))
        harm(the_file(member))
        member.store.check(COMPONENT, first.position)
        await member.until(lambda: member.events.count(Damaged(COMPONENT, 1, first.position)) > told)
        assert COMPONENT in member.fetching._damaged
        member.seen = (msgspec.structs.replace(member.seen[0], state=State.PRIMARY),)
        (member.directory / "gone").rename(member.directory / "place")
        await member.until(lambda: not member.fetching.complaints())
        member.seen = (msgspec.structs.replace(member.seen[0], state=State.STANDBY),)
        await member.until(lambda: member.fetched() == [1, 1, 1])
        assert format.verify(the_file(member)).position == first.position

    run(tmp_path, work)


def test_a_checkpoint_that_was_damaged_while_the_agent_was_off_is_fetched_again(tmp_path: Path) -> None:
    async def work(member: Member) -> None:
        (first,) = bases(1)
        member.put(first)
        await member.until(lambda: member.fetched() == [1])
        harm(the_file(member))
        path = the_file(member)
        member.store.close()
        member.store = open_store(member.directory / "state" / "store")
        assert any("it is not used" in notice for notice in member.store.notices)
        assert member.store.newest(COMPONENT) is None
        again = Fetching(member.fetching._settings, member.store, member.told, member.events.append, member.kept)
        taking = asyncio.create_task(again.run())
        try:
            await member.until(lambda: member.fetched() == [1, 1])
        finally:
            taking.cancel()
            await asyncio.gather(taking, return_exceptions=True)
        assert format.verify(path).position == first.position

    run(tmp_path, work)
