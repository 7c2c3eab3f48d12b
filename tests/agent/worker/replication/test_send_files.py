"""A program's files between two robots: missing ones are sent once; hostile or too large ones are refused by name."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import pytest
from blake3 import blake3

from agent.errors import LaneError
from agent.worker.replication import send_files, transfer
from agent.worker.replication.receive_files import Limits, Stock, is_plausible
from agent.worker.replication.send_files import Bringing, Sources
from agent.worker.replication.transfer import Receiver, Shipper
from checkpoint.snapshot.required_files import Need
from checkpoint.store.disk import Disk
from checkpoint.store.store import Store, open_store
from failover.core.wire.messages import Belonging, Belongings, Bulk, Cancel, Chunk, Content, Credit, Lacking, Refuse, Taken

NAME = "/lab/mapper"
BOUND_S = 20.0
ELSEWHERE = "/nowhere/on/this/machine"


class Link:
    """A link whose other end is the test's function; words overtake nothing."""

    def __init__(self, deliver: Callable[[Bulk], None]) -> None:
        self.deliver = deliver
        self.said: list[Bulk] = []

    def say(self, peer: str, message: Bulk) -> bool:
        self.said.append(message)
        asyncio.get_running_loop().call_soon(self.deliver, message)
        return True

    async def ship(self, peer: str, chunk: Chunk) -> None:
        self.say(peer, chunk)


ALLOWED = Limits()


class Two:
    """robot1, which has files, and robot2, which stands by; ``spoil`` changes what robot1 says."""

    def __init__(
        self,
        store: Store,
        directory: Path,
        limits: Limits = ALLOWED,
        spoil: Callable[[Bulk], Bulk] = lambda message: message,
        admits: Callable[[str, str], str] = lambda component, peer: "",
    ) -> None:
        self.out, self.back = Link(self._arrive), Link(self._answer)
        self.stock = Stock(store, limits, "robot2", admits)
        self.receiver = Receiver(self.back, directory, self.stock)
        self.shipper = Shipper(self.out)
        self.notes: list[str] = []
        self.bringing = Bringing(self.shipper, self.out.say, self._read, lambda *told: self.notes.append(told[2]))
        self.held: dict[bytes, bytes] = {}
        self._spoil = spoil
        self._tasks: set[asyncio.Task[None]] = set()

    def file(self, content: bytes, path: str = ELSEWHERE) -> Need:
        """One that robot1 has."""
        digest = blake3(content).digest()
        self.held[digest] = content
        return Need(path, len(content), digest)

    async def bring(self, *files: Need, component: str = NAME) -> None:
        await asyncio.wait_for(self.bringing.bring("robot2", component, files), BOUND_S)

    def sent(self, kind: type[Any]) -> list[Any]:
        return [message for message in self.out.said if isinstance(message, kind)]

    async def _read(self, component: str, need: Need) -> int:
        descriptor = os.memfd_create("content")
        os.write(descriptor, self.held[need.digest])
        return descriptor

    def _arrive(self, sent: Bulk) -> None:
        match self._spoil(sent):
            case Belongings() as asked:
                task = asyncio.create_task(self._compare(asked))
                self._tasks.add(task)
            case Content() as offer:
                self.receiver.offered("robot1", offer)
            case Chunk() as chunk:
                self.receiver.chunk("robot1", chunk)
            case Cancel() as cancel:
                self.receiver.cancelled("robot1", cancel)

    async def _compare(self, asked: Belongings) -> None:
        self.back.say("robot1", await self.stock.compare("robot1", asked))

    def _answer(self, message: Bulk) -> None:
        match message:
            case Lacking():
                self.bringing.heard("robot2", message)
            case Credit() | Taken() | Refuse():
                self.shipper.heard("robot2", message)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    store = open_store(tmp_path / "store")
    yield store
    store.close()


def run(body: Coroutine[Any, Any, None]) -> None:
    asyncio.run(body)


LARGE = bytes(range(256)) * 4096


def test_what_is_lacking_arrives_once_for_all_components_and_is_never_asked_about_again(store: Store, tmp_path: Path) -> None:
    async def body() -> None:
        two = Two(store, tmp_path)
        files = two.file(LARGE), two.file(b"small", ELSEWHERE + "2")
        await two.bring(*files)
        assert all(store.contents.path(need.digest).read_bytes() == two.held[need.digest] for need in files)
        assert len(two.sent(Content)) == 2
        assert two.notes[-1] == ""
        assert "after 1.0 MB of program files have arrived" in two.notes[1]
        await two.bring(*files, component="/lab/other")
        assert len(two.sent(Content)) == 2, "by content, whoever needs it"
        asked = len(two.sent(Belongings))
        await two.bring(*files)
        assert len(two.sent(Belongings)) == asked, "a delta asks nothing"

    run(body())


def test_two_components_that_wait_for_the_same_file_share_one_transfer(store: Store, tmp_path: Path) -> None:
    async def body() -> None:
        two = Two(store, tmp_path)
        need = two.file(LARGE)
        await asyncio.gather(two.bring(need), two.bring(need, component="/lab/other"))
        assert len(two.sent(Content)) == 1

    run(body())


def test_what_is_the_same_at_its_path_does_not_travel_but_to_a_server_which_runs_nothing(store: Store, tmp_path: Path) -> None:
    async def body() -> None:
        path = tmp_path / "library"
        path.write_bytes(LARGE)
        two = Two(store, tmp_path)
        await two.bring(two.file(LARGE, str(path)))
        assert not two.sent(Content)
        path.write_bytes(LARGE[::-1])
        await two.bring(two.file(LARGE, str(path)), component="/lab/other")
        assert len(two.sent(Content)) == 1, "as long, but of another content"
        server = Two(store, tmp_path, Limits(runs=False))
        await server.bring(server.file(LARGE[::-1], str(path)))
        assert len(server.sent(Content)) == 1

    run(body())


def test_what_is_over_the_limit_is_refused_by_name_before_a_byte_travels(store: Store, tmp_path: Path) -> None:
    async def body() -> None:
        two = Two(store, tmp_path, Limits(size_max=1_000_000))
        with pytest.raises(LaneError, match=r"robot2 lacks are 1\.0 MB \(/nowhere/on/this/machine.*over bring_size = 1\.0 MB"):
            await two.bring(two.file(LARGE), two.file(b"small", ELSEWHERE + "2"))
        assert not two.sent(Content)

    run(body())


def test_the_limit_holds_for_a_component_however_many_messages_name_its_files(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(send_files, "BELONGINGS_MAX", 1)

    async def body() -> None:
        two = Two(store, tmp_path, Limits(size_max=1_500_000))
        files = two.file(LARGE), two.file(LARGE[::-1], ELSEWHERE + "2")
        with pytest.raises(LaneError, match="over bring_size"):
            await two.bring(*files)
        await two.bring(files[0], component="/lab/other")

    run(body())


def test_what_was_answered_for_stays_until_the_snapshot_that_relies_on_it_is_here(store: Store, tmp_path: Path) -> None:
    async def body() -> None:
        two = Two(store, tmp_path)
        need = two.file(LARGE)
        await two.bring(need)
        os.utime(store.contents.path(need.digest), (1, 1))
        await two.bring(need, component="/lab/other")
        assert store.collect_contents() == 0
        os.utime(store.contents.path(need.digest), (1, 1))
        assert store.collect_contents() == len(LARGE)

    run(body())


def test_a_robot_that_takes_no_files_says_which_it_lacks(store: Store, tmp_path: Path) -> None:
    async def body() -> None:
        two = Two(store, tmp_path, Limits(bring=False))
        with pytest.raises(LaneError, match=f"lacks {ELSEWHERE} .*bring = true"):
            await two.bring(two.file(b"content"))

    run(body())


def test_a_file_that_could_not_be_digested_must_be_there(store: Store, tmp_path: Path) -> None:
    async def body() -> None:
        path = tmp_path / "huge"
        path.write_bytes(b"huge")
        two = Two(store, tmp_path)
        await two.bring(Need(str(path), 4, b""))
        with pytest.raises(LaneError, match=f"lacks {ELSEWHERE} .*too large, or not readable"):
            await two.bring(Need(ELSEWHERE, 4, b""))

    run(body())


@pytest.mark.parametrize(
    "file",
    [
        Belonging("relative", 1, bytes(32)),
        Belonging("/etc/../etc/shadow", 1, bytes(32)),
        Belonging("/a\0b", 1, bytes(32)),
        Belonging("/" + "a" * 5000, 1, bytes(32)),
        Belonging("/a", -1, bytes(32)),
        Belonging("/a", 1, bytes(31)),
        Belonging("/a", 1, b"../../../../etc/cron.d/xxxxxxxxxx"),
    ],
)
def test_a_file_that_could_not_be_one_is_refused_and_nothing_of_it_is_looked_at(
    store: Store, tmp_path: Path, file: Belonging
) -> None:
    async def body() -> None:
        answer = await Two(store, tmp_path).stock.compare("robot1", Belongings(1, NAME, (file,)))
        assert answer.digests == ()
        assert "no file that could be brought" in answer.reason

    assert not is_plausible(file)
    run(body())


def test_a_link_is_followed_to_its_content_and_nothing_but_a_regular_file_is_read(store: Store, tmp_path: Path) -> None:
    async def body() -> None:
        two = Two(store, tmp_path)
        fifo = tmp_path / "fifo"
        os.mkfifo(fifo)
        need = two.file(b"", str(fifo))
        await two.bring(need)
        assert store.contents.has(need.digest, 0), "an empty file of that content came; nobody waited for the pipe's writer"

    run(body())


def test_nothing_is_taken_that_was_not_asked_for(store: Store, tmp_path: Path) -> None:
    async def body() -> None:
        two = Two(store, tmp_path)
        need = two.file(LARGE)
        with pytest.raises(LaneError, match="has not asked for that file"):
            await two.shipper.ship("robot2", Content(0, need.size, need.digest), await two._read(NAME, need))
        await two.bring(need)
        with pytest.raises(LaneError, match="has not asked for that file"):
            await two.shipper.ship("robot2", Content(0, 1 << 30, need.digest), -1)

    run(body())


def test_a_file_of_another_content_than_promised_leaves_no_trace(store: Store, tmp_path: Path) -> None:
    def spoil(sent: Bulk) -> Bulk:
        return Chunk(sent.transfer, sent.offset, b"x" * len(sent.content)) if isinstance(sent, Chunk) else sent

    async def body() -> None:
        two = Two(store, tmp_path, spoil=spoil)
        need = two.file(LARGE)
        with pytest.raises(LaneError, match=f"{ELSEWHERE} .*not the promised digest"):
            await two.bring(need)
        assert not store.contents.path(need.digest).exists()

    run(body())


def test_who_is_not_admitted_is_told_nothing_of_what_is_here(store: Store, tmp_path: Path) -> None:
    async def body() -> None:
        two = Two(
            store, tmp_path, admits=lambda component, peer: f"this robot does not take snapshots of {component} from {peer}"
        )
        with pytest.raises(LaneError, match="does not take snapshots of /lab/mapper from robot1"):
            await two.bring(two.file(b"content"))

    run(body())


class FullDisk(Disk):
    """One that takes no more files."""

    def rename(self, old: Path, new: Path) -> None:
        raise OSError(28, "No space left on device")


def test_a_full_disk_refuses_by_name(tmp_path: Path) -> None:
    async def body() -> None:
        store = open_store(tmp_path / "store", FullDisk())
        two = Two(store, tmp_path)
        need = two.file(LARGE)
        with pytest.raises(
            LaneError, match=rf"{ELSEWHERE} \(1\.0 MB\) was not brought to robot2: .*No space left on device; free some"
        ):
            await two.bring(need)
        assert not list((tmp_path / "store" / "contents").iterdir())
        store.close()

    run(body())


def test_files_give_way_to_snapshots_and_arrive_all_the_same(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A snapshot that is under way for ever delays each chunk, and no more."""
    waits: list[float] = []

    async def body() -> None:
        two = Two(store, tmp_path)
        need = two.file(LARGE)
        sleep = asyncio.sleep

        async def noted(delay_s: float) -> None:
            if delay_s < transfer.GIVE_WAY_S:
                waits.append(delay_s)
            await sleep(delay_s)

        monkeypatch.setattr(transfer.asyncio, "sleep", noted)
        await two.bring(need)
        assert not waits
        two.shipper._outgoing[-1] = transfer._Outgoing("robot3", transfer.SNAPSHOT, "/lab/b", 1 << 20)
        await two.bring(two.file(LARGE[::-1], ELSEWHERE + "2"))
        assert waits

    run(body())


def test_a_file_that_was_changed_in_place_is_named(store: Store, tmp_path: Path) -> None:
    """Nobody has the old content any more: also the program has the new one."""
    path = tmp_path / "library"
    path.write_bytes(b"another content")

    async def ask(component: str, need: Need) -> int:
        return os.open(need.path, os.O_RDONLY)

    async def body() -> None:
        need = Need(str(path), 11, blake3(b"the content").digest())
        with pytest.raises(LaneError, match=f"{path} was changed in place"):
            await Sources(store, ask).open(NAME, need)

    run(body())


def test_a_link_that_goes_down_ends_the_asking_and_what_was_sure(store: Store, tmp_path: Path) -> None:
    async def body() -> None:
        two = Two(store, tmp_path)
        need = two.file(b"content")
        await two.bring(need)
        two.bringing.lost("robot2")
        asked = len(two.sent(Belongings))
        await two.bring(need)
        assert len(two.sent(Belongings)) == asked + 1
        two.out.deliver = lambda message: None
        waiting = asyncio.create_task(two.bring(need, component="/lab/other"))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        two.bringing.lost("robot2")
        with pytest.raises(LaneError, match="went down"):
            await waiting

    assert send_files.ANSWER_S > BOUND_S, "or the test would not see the difference"
    run(body())


def test_a_question_whose_answer_was_lost_is_asked_again(store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process that asks is another one by now, and the standby answered the one before it."""
    monkeypatch.setattr(send_files, "ANSWER_S", BOUND_S / 10)

    async def body() -> None:
        two = Two(store, tmp_path)
        need, answer = two.file(b"content"), two.back.deliver
        two.back.deliver = lambda message: setattr(two.back, "deliver", answer)
        await two.bring(need)
        assert len(two.sent(Belongings)) == 2
        assert store.contents.path(need.digest).read_bytes() == b"content"

    run(body())
