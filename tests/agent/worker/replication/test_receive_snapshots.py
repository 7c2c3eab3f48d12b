"""Incoming snapshots, and the instant from which a robot writes the component's output itself."""

from __future__ import annotations

import asyncio
import threading
from pathlib import Path
from typing import Any, cast

import pytest
from msgspec.structs import replace

from agent.guard.output_logs import LOG_NAMES, OutputLogs, logs_of
from agent.worker.components.paths import Places, log_directory
from agent.worker.replication.receive_snapshots import Deposit
from checkpoint.errors import StoreError
from checkpoint.model import Position, Snapshot
from checkpoint.snapshot.format import encode_bytes
from checkpoint.store.index import folder_name
from checkpoint.store.store import open_store
from failover.core.acts import Accept, Admit, Discard, Show
from failover.core.events import StoreFailed
from failover.core.types import ComponentSpec
from failover.core.wire.messages import Offer
from tests.checkpoint.snapshots import COMPONENT, history

NAME = "/lab/mapper"


class ProcessPool:
    """Starts nothing."""

    def expect(self, count: int) -> None:
        """Not here."""


class Storing(Deposit):
    """Its disk takes as long as the test wants, and then refuses."""

    def __init__(self, directory: Path) -> None:
        none = cast(Any, None)
        super().__init__(none, Places(directory, directory, cast(Any, ProcessPool())), lambda _: None, none)
        self.begun, self.may_end, self.stored = threading.Event(), threading.Event(), 0

    def _put(self, offer: Offer, descriptor: int) -> Any:
        self.begun.set()
        assert self.may_end.wait(60)
        self.stored += 1
        raise StoreError("the disk is full")


def test_whoever_takes_over_waits_for_the_snapshot_that_is_being_stored_and_for_no_other(tmp_path: Path) -> None:
    """Storing one ends with its output in the log, which is the new copy's from then on."""

    async def run() -> None:
        deposit = Storing(tmp_path)
        offer = Offer(1, NAME, 1, Position(64, 1, b"d"), None, 1, b"", ComponentSpec(NAME))
        deposit.admit(Admit(NAME, 1, "robot1"))
        taken = [asyncio.create_task(deposit.take("robot1", offer, -1)) for _ in range(2)]
        await asyncio.to_thread(deposit.begun.wait, 60)
        deposit.admit(Admit(NAME, 2, ""))
        settled = asyncio.create_task(deposit.settled(NAME))
        await asyncio.sleep(0)
        assert not settled.done()
        deposit.may_end.set()
        await settled
        await asyncio.gather(*taken)
        assert deposit.stored == 1, "the second had not begun, and is refused"

    asyncio.run(run())


def test_whose_snapshots_they_were_is_known_after_the_claim_that_ends_their_admission(tmp_path: Path) -> None:
    """So that an outage is counted from the last word of that robot."""
    deposit = Storing(tmp_path)
    assert deposit.last_sender(NAME) == ""
    deposit.admit(Admit(NAME, 1, "robot1"))
    deposit.admit(Admit(NAME, 2, ""))
    assert deposit.last_sender(NAME) == "robot1"


def test_a_snapshot_whose_facts_are_no_facts_is_refused_by_name(tmp_path: Path) -> None:
    """From a peer that may send it; the worker goes on."""
    told: list[Any] = []

    class Reading(Deposit):
        def _put(self, offer: Offer, descriptor: int) -> Any:
            return {}["flags"]

    async def run() -> None:
        none = cast(Any, None)
        deposit = Reading(none, Places(tmp_path, tmp_path, cast(Any, ProcessPool())), told.append, none)
        deposit.admit(Admit(NAME, 1, "robot1"))
        await deposit.take("robot1", Offer(1, NAME, 1, Position(64, 1, b"d"), None, 1, b"", ComponentSpec(NAME)), -1)

    asyncio.run(run())
    (failed,) = told
    assert isinstance(failed, StoreFailed)
    assert failed.sender == "robot1"
    assert f"cannot keep a snapshot of {NAME} from robot1: its snapshot says something" in failed.message


class Standing:
    """A standby's deposit over a real store, and what the core would hear of it."""

    def __init__(self, directory: Path) -> None:
        self.told: list[Any] = []
        self.accepted: list[int] = []
        self.store = open_store(directory / "store")
        self._directory = directory
        self._places = Places(directory, directory / "logs", cast(Any, ProcessPool()))
        self.deposit = Deposit(self.store, self._places, self.told.append, self._accept)
        self.deposit.admit(Admit(COMPONENT, 1, "robot1"))

    def _accept(self, offer: Offer, snapshot: Snapshot) -> None:
        self.accepted.append(snapshot.position.sequence)

    async def take(self, made: Snapshot) -> None:
        """It arrives from the primary."""
        path = self._directory / "arrived"
        path.write_bytes(encode_bytes(made))
        offer = Offer(1, COMPONENT, 1, made.position, made.parent, path.stat().st_size, b"", ComponentSpec(COMPONENT))
        with path.open("rb") as file:
            await self.deposit.take("robot1", offer, file.fileno())

    def log(self, stream: int) -> Path:
        """The file of a stream."""
        return log_directory(COMPONENT, self._places) / LOG_NAMES[stream]

    def seen(self) -> bytes:
        """What a reader of its output sees here."""
        logs = OutputLogs(log_directory(COMPONENT, self._places))
        try:
            return logs.read(1, 0).content
        finally:
            logs.close()


def test_readers_see_what_counts_as_acknowledged_and_not_what_is_merely_stored(tmp_path: Path) -> None:
    first, second, third = history(3)

    async def story() -> None:
        standing = Standing(tmp_path)
        for made in (first, second, third):
            await standing.take(made)
        assert [event.position.sequence for event in standing.told] == [1, 2, 3], "the core hears of each"
        assert standing.seen() == b"", "the core has said nothing yet"
        assert standing.accepted == []
        for made in (first, second):
            standing.deposit.accept(Accept(COMPONENT, 1, made.position))
        assert standing.accepted == [1, 2]
        assert standing.seen() == b""
        await standing.deposit.show(Show(COMPONENT, 1, first.position))
        assert standing.seen() == b"ready\n"
        await standing.deposit.show(Show(COMPONENT, 1, second.position))
        assert standing.seen() == b"ready\nline 2\n"

    asyncio.run(story())


def told_again(made: Snapshot, sequence: int, parent: Snapshot) -> Snapshot:
    """A snapshot of the same state, whose program has written nothing since."""
    ends = (replace(piece, offset=piece.offset + len(piece.content), content=b"") for piece in made.output)
    position = replace(made.position, sequence=sequence)
    return replace(made, position=position, parent=parent.position, runs=(), cleared=(), contents=b"", output=tuple(ends))


@pytest.mark.parametrize("is_taken_over_between", [True, False])
def test_logs_are_left_alone_where_nothing_was_written_unless_another_process_may_have(
    tmp_path: Path, is_taken_over_between: bool
) -> None:
    first, second = history(2)
    silent = told_again(first, 2, first)
    loud = replace(silent, position=replace(silent.position, sequence=3), parent=silent.position, output=second.output)

    async def story() -> None:
        standing = Standing(tmp_path)

        async def show(made: Snapshot) -> None:
            await standing.take(made)
            standing.deposit.accept(Accept(COMPONENT, 1, made.position))
            await standing.deposit.show(Show(COMPONENT, 1, made.position))

        await show(first)
        if is_taken_over_between:
            await standing.deposit.settled(COMPONENT)
        with standing.log(1).open("ab") as log:
            log.write(b"its guard here")
        await show(silent)
        is_left_alone = standing.log(1).read_bytes() == b"ready\nits guard here"
        assert is_left_alone is not is_taken_over_between
        await show(loud)
        assert standing.seen() == b"ready\nline 2\n"

    asyncio.run(story())


@pytest.mark.parametrize("begins_anew", [True, False])
def test_a_takeover_reads_nothing_where_nothing_was_written_and_the_logs_where_a_base_came(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begins_anew: bool
) -> None:
    """A base may be of another component that has this name now: its logs are looked at."""
    (first,) = history(1)
    silent = told_again(first, 2, first)
    if begins_anew:
        silent = replace(first, position=replace(first.position, sequence=64), output=silent.output)

    async def story() -> None:
        standing = Standing(tmp_path)
        for made in (first, silent):
            await standing.take(made)
            standing.deposit.accept(Accept(COMPONENT, 1, made.position))
            if made is silent:
                with standing.log(1).open("ab") as log:
                    log.write(b"another's")
            await standing.deposit.show(Show(COMPONENT, 1, made.position))
        is_looked_at = standing.log(1).read_bytes() == b"ready\n"
        assert is_looked_at is begins_anew
        opened, really = list[Position](), standing.store.open_chain
        monkeypatch.setattr(standing.store, "open_chain", lambda *asked: opened.append(asked[-1]) or really(*asked))
        for expected in ([], [silent.position]):  # a guard may have written since the first one
            await standing.deposit.settled(COMPONENT, silent.position)
            assert opened == expected

    asyncio.run(story())


def test_a_snapshot_that_the_core_does_not_accept_leaves_nothing(tmp_path: Path) -> None:
    """The robot had claimed the component while it was being stored: it goes on from the one before."""
    first, second = history(2)

    async def story() -> None:
        standing = Standing(tmp_path)
        await standing.take(first)
        standing.deposit.accept(Accept(COMPONENT, 1, first.position))
        await standing.deposit.show(Show(COMPONENT, 1, first.position))
        await standing.take(second)
        await standing.deposit.discard(Discard(COMPONENT, 1, second.position))
        assert standing.store.positions(COMPONENT) == (first.position,)
        assert standing.seen() == b"ready\n"
        assert standing.accepted == [1]

    asyncio.run(story())


def test_a_position_that_others_continue_is_not_forgotten(tmp_path: Path) -> None:
    first, second = history(2)

    async def story() -> None:
        standing = Standing(tmp_path)
        await standing.take(first)
        await standing.take(second)
        await standing.deposit.discard(Discard(COMPONENT, 1, first.position))
        assert standing.store.positions(COMPONENT) == (first.position, second.position)

    asyncio.run(story())


def test_after_a_restart_only_what_the_newest_snapshot_continues_is_shown_until_the_core_says_more(tmp_path: Path) -> None:
    made = history(3)

    async def story() -> None:
        standing = Standing(tmp_path)
        for one in made:
            await standing.take(one)
        standing.store.close()
        again = Standing(tmp_path)
        again.deposit.mend_logs(())
        assert again.seen() == b"ready\nline 2\n"
        await again.deposit.show(Show(COMPONENT, 1, made[-1].position))
        assert again.seen() == b"ready\nline 2\nline 3\n"

    asyncio.run(story())


def test_a_component_of_another_user_takes_nothing_over_from_its_namesake(tmp_path: Path) -> None:
    first, _ = history(2)

    async def story() -> None:
        standing = Standing(tmp_path)
        place = tmp_path / "logs" / folder_name(COMPONENT)
        theirs = logs_of(place, 7002)
        theirs.write(1, 0, b"a secret, and longer than what comes now\n")
        theirs.close()
        await standing.take(replace(first, output=()))
        standing.deposit.accept(Accept(COMPONENT, 1, standing.told[0].position))
        await standing.deposit.show(Show(COMPONENT, 1, standing.told[0].position))
        ours = OutputLogs(place)
        assert ours.owner == 0
        assert ours.totals() == (0, 0)
        ours.close()

    asyncio.run(story())


def test_who_goes_on_from_a_position_has_its_output_though_it_was_not_shown(tmp_path: Path) -> None:
    """A voters' standby may be elected before its primary could say that the newest position counts."""
    made = history(3)

    async def story(directory: Path, restarts: bool) -> None:
        directory.mkdir()
        standing = Standing(directory)
        for one in made:
            await standing.take(one)
            standing.deposit.accept(Accept(COMPONENT, 1, one.position))
        await standing.deposit.show(Show(COMPONENT, 1, made[0].position))
        if restarts:
            standing.store.close()
            standing = Standing(directory)
        assert standing.seen() == b"ready\n"
        await standing.deposit.settled(COMPONENT, made[-1].position)
        assert standing.seen() == b"ready\nline 2\nline 3\n"

    for restarts in (False, True):
        asyncio.run(story(tmp_path / str(restarts), restarts))


def test_output_after_a_restart_has_no_gap_where_the_snapshot_before_was_never_shown(tmp_path: Path) -> None:
    first, second, third = history(3)

    async def story() -> None:
        standing = Standing(tmp_path)
        for one in (first, second):
            await standing.take(one)
        standing.store.close()
        again = Standing(tmp_path)
        await again.take(third)
        again.deposit.accept(Accept(COMPONENT, 1, third.position))
        await again.deposit.show(Show(COMPONENT, 1, third.position))
        assert again.seen() == b"ready\nline 2\nline 3\n"

    asyncio.run(story())


def test_who_goes_on_from_what_was_shown_last_does_not_read_the_chain_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a takeover takes longer with each snapshot of its chain."""
    made = history(3)

    async def story() -> None:
        standing = Standing(tmp_path)
        for one in made:
            await standing.take(one)
            standing.deposit.accept(Accept(COMPONENT, 1, one.position))
            await standing.deposit.show(Show(COMPONENT, 1, one.position))
        opened: list[Position] = []
        monkeypatch.setattr(standing.store, "open_chain", lambda *asked: opened.append(asked[-1]) or [])
        await standing.deposit.settled(COMPONENT, made[-1].position)
        assert standing.seen() == b"ready\nline 2\nline 3\n" and not opened

    asyncio.run(story())


def test_a_namesake_with_the_same_position_has_its_own_output(tmp_path: Path) -> None:
    (first,) = history(1)

    async def story() -> None:
        standing = Standing(tmp_path)
        await standing.take(first)
        standing.deposit.accept(Accept(COMPONENT, 1, first.position))
        await standing.deposit.show(Show(COMPONENT, 1, first.position))
        for stream in (tmp_path / "logs" / folder_name(COMPONENT)).iterdir():  # it was released
            stream.unlink()
        standing.store.drop(COMPONENT)
        await standing.take(first)
        standing.deposit.accept(Accept(COMPONENT, 1, first.position))
        await standing.deposit.settled(COMPONENT, first.position)
        assert standing.seen() == b"ready\n"

    asyncio.run(story())
