"""Leases and freezes overtake a component's waiting acts; a takeover that the process kept ready cannot carry out starts anew."""

from __future__ import annotations

import asyncio
import os
import threading
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from agent.config import ComponentConfig
from agent.errors import GuardError
from agent.system.clock import Laps
from agent.worker.components import prerequisites, resume
from agent.worker.components import supervisor as supervisor_module
from agent.worker.components.component import Component
from agent.worker.components.context import Surroundings
from agent.worker.components.keeper_client import Following
from agent.worker.components.run_records import Records
from agent.worker.components.supervisor import Supervisor
from agent.worker.components.warm_program import Standby
from agent.worker.control.verbs import Verbs
from checkpoint.errors import StoreError
from checkpoint.keeper.messages import memfd_holding
from checkpoint.model import Position
from checkpoint.snapshot import format
from checkpoint.store.store import open_store
from failover.core import acts, events
from tests.checkpoint.snapshots import COMPONENT, history

NAME = "/lab/robot1/mapper"
LATE_NS, NEWER_NS = 100, 200


class Told:
    """Stands for a guard whose clock shows `now_ns`: what it was told, and whether the program runs."""

    def __init__(self) -> None:
        self.lease_ns = 0
        self.now_ns = 0
        self.runs = False
        self.refused = 0
        self.pid = 1
        self.engine = "ptrace"
        self.keeper = Following(NAME, cast(Any, None))

    async def lease(self, until_ns: int) -> None:
        self.lease_ns = until_ns

    def output_pending(self) -> int:
        return 0

    async def freeze(self) -> None:
        self.runs = False

    async def capture(self, **_: object) -> None:
        raise GuardError("it stands still by now, and nothing more is asked here")

    async def thaw(self) -> None:
        if self.lease_ns <= self.now_ns:
            self.refused += 1
            raise GuardError("its lease is over")
        self.runs = True


class FullStore:
    """Stands for a store whose disk has no room for a file more."""

    def unnamed(self) -> int:
        raise StoreError("cannot make a file: No space left on device")


def carried_out(orders: Callable[[Supervisor, Told], Any], directory: Path) -> Told:
    """What the guard was told in the end."""
    guard = Told()

    async def run() -> None:
        none = cast(Any, None)
        store = cast(Any, FullStore())
        around = Surroundings(none, store, Records(directory), lambda _: None, none, none, lambda _: ComponentConfig())
        supervisor = Supervisor(NAME, around, cast(Component, guard), epoch=3)
        orders(supervisor, guard)
        supervisor.begin()
        await settled()
        guard.now_ns = LATE_NS + 1
        if guard.refused:
            supervisor.order(acts.SetLease(NAME, 3, NEWER_NS))
            await settled()
        for task in tuple(supervisor._tasks):
            task.cancel()

    asyncio.run(run())
    return guard


async def settled() -> None:
    """Everything that can go on has gone on."""
    for _ in range(20):
        await asyncio.sleep(0)


def test_a_thaw_that_waited_does_not_bring_its_older_lease_back(tmp_path: Path) -> None:
    def orders(supervisor: Supervisor, guard: Told) -> None:
        guard.now_ns = LATE_NS + 1
        supervisor.order(acts.Thaw(NAME, 3, LATE_NS))
        supervisor.order(acts.SetLease(NAME, 3, NEWER_NS))

    guard = carried_out(orders, tmp_path)
    assert (guard.runs, guard.lease_ns, guard.refused) == (True, NEWER_NS, 0)


def test_a_thaw_that_came_too_late_for_its_lease_comes_with_the_next(tmp_path: Path) -> None:
    def orders(supervisor: Supervisor, guard: Told) -> None:
        guard.now_ns = LATE_NS + 1
        supervisor.order(acts.Thaw(NAME, 3, LATE_NS))

    guard = carried_out(orders, tmp_path)
    assert (guard.runs, guard.lease_ns, guard.refused) == (True, NEWER_NS, 1)


def test_a_thaw_that_waited_does_not_undo_a_later_freeze(tmp_path: Path) -> None:
    def orders(supervisor: Supervisor, _: Told) -> None:
        supervisor.order(acts.Thaw(NAME, 3, LATE_NS))
        supervisor.order(acts.Freeze(NAME, 3))

    assert not carried_out(orders, tmp_path).runs


def test_a_lease_lets_nothing_run_whose_last_snapshot_before_a_handover_was_ordered(tmp_path: Path) -> None:
    def orders(supervisor: Supervisor, guard: Told) -> None:
        guard.now_ns = LATE_NS + 1
        supervisor.order(acts.Thaw(NAME, 3, LATE_NS))
        supervisor.order(acts.Capture(NAME, 3, False, 1, 1, hold=True))

    guard = carried_out(orders, tmp_path)
    assert (guard.runs, guard.lease_ns, guard.refused) == (False, NEWER_NS, 1)


class SlowStore:
    """Stands for a store that folds until it may go on."""

    def __init__(self) -> None:
        self.may_go_on = threading.Event()
        self.begun = threading.Semaphore(0)
        self.calls: list[object] = []

    def is_prune_due(self, _: str, oldest: Position) -> bool:
        return oldest.sequence > 0

    def prune(self, _: str, oldest: Position) -> None:
        self.calls.append(oldest.sequence)
        self.begun.release()
        self.may_go_on.wait()

    def set_aside(self, _: str, generations: tuple[int, ...]) -> None:
        self.calls.append(generations)


def test_nobody_waits_until_a_chain_is_folded_but_who_forgets_of_it(tmp_path: Path) -> None:
    store, guard, none = SlowStore(), Told(), cast(Any, None)

    async def run() -> None:
        around = Surroundings(none, cast(Any, store), Records(tmp_path), lambda _: None, none, none, lambda _: ComponentConfig())
        supervisor = Supervisor(NAME, around, cast(Component, guard), epoch=3)
        supervisor.begin()
        supervisor.order(acts.Prune(NAME, 3, Position(1, 1, b"")))
        await asyncio.to_thread(store.begun.acquire)
        for sequence in (2, 3):
            supervisor.order(acts.Prune(NAME, 3, Position(1, sequence, b"")))
        supervisor.order(acts.Thaw(NAME, 3, LATE_NS))
        supervisor.order(acts.Forget(NAME, 3, (2,)))
        await settled()
        assert guard.runs and store.calls == [1]
        store.may_go_on.set()
        await forgotten(store)
        for task in tuple(supervisor._tasks):
            task.cancel()

    asyncio.run(run())
    assert store.calls == [1, 3, (2,)], "the newest order contains those before it"


async def forgotten(store: SlowStore) -> None:
    while not {3, (2,)} <= set(store.calls):
        await asyncio.sleep(0.001)


def test_a_takeover_that_what_waited_cannot_carry_out_starts_the_program_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = cast(Any, None)
    waiting, anew = cast(Component, object()), cast(Component, object())
    tried: list[Component | None] = []

    async def brought_back(
        around: object, act: object, chain: object, outage_ns: int, laps: object, waits: Any = None
    ) -> Component:
        tried.append(waits)
        return waits or anew

    async def let_it_run(
        self: Supervisor, component: Component, epoch: int, outage_ns: int, laps: object
    ) -> tuple[Component, int]:
        if component is waiting:
            raise GuardError("the program has ended")
        return component, outage_ns

    monkeypatch.setattr(resume, "brought_back", brought_back)
    monkeypatch.setattr(Supervisor, "_let_it_run", let_it_run)
    monkeypatch.setattr(Standby, "take", lambda _: waiting)

    async def run() -> None:
        supervisor = Supervisor(
            NAME, Surroundings(nothing, nothing, Records(tmp_path), lambda _: None, nothing, nothing, nothing)
        )
        assert await supervisor._resumed(acts.Restore(NAME, 3, Position(1, 1, b"d"), None), [], 7, Laps()) == (anew, 7)
        assert tried == [waiting, None]

    asyncio.run(run())


def test_a_freeze_reaches_a_restored_program_while_its_snapshot_is_read_for_the_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing, guard = cast(Any, None), Told()
    guard.runs = True

    async def run() -> None:
        loop = asyncio.get_running_loop()
        store = cast(Any, SimpleNamespace(open_chain=lambda *_: [-1]))

        async def soon(*_: object) -> None:
            pass

        async def resumed(*_: object) -> tuple[Component, int]:
            return cast(Component, SimpleNamespace(let_go_ns=1, freeze=guard.freeze, pid=1, notes=())), 0

        around = Surroundings(nothing, store, Records(tmp_path), lambda _: None, nothing, soon, nothing)
        supervisor = Supervisor(NAME, around, epoch=3)

        def read(*_: object) -> None:
            order = acts.Freeze(NAME, 3)
            asyncio.run_coroutine_threadsafe(supervisor._at_once(order), loop).result()
            raise OSError("the rest is not of interest here")

        monkeypatch.setattr(Supervisor, "_stop", soon)
        monkeypatch.setattr(Supervisor, "_resumed", resumed)
        monkeypatch.setattr(Supervisor, "_notice", lambda *_: None)
        monkeypatch.setattr(Supervisor, "_watch_the_end", lambda _: None)
        monkeypatch.setattr(supervisor_module, "_resumed_from", read)
        monkeypatch.setattr("agent.worker.components.supervisor.clock.age_ns", lambda _: 0)
        monkeypatch.setattr(supervisor_module, "close_all", lambda _: None)
        monkeypatch.setattr(type(supervisor._occasions), "before_resume", soon)
        with pytest.raises(OSError, match="not of interest"):
            await supervisor._restore(acts.Restore(NAME, 3, Position(1, 1, b"d"), None))

    asyncio.run(run())
    assert not guard.runs


class Guarded:
    """Stands for a component whose guard answers late, or not at all."""

    pid = 1

    def __init__(self, trouble: GuardError | None = None) -> None:
        self.answers = asyncio.Event()
        self.trouble = trouble

    async def release(self) -> None:
        await self.answers.wait()
        if self.trouble is not None:
            raise self.trouble


def released(directory: Path, trouble: GuardError | None = None) -> Exception | None:
    """Have a component released as an operator orders it; what he is told, which is nothing before its guard has answered."""

    async def run() -> Exception | None:
        none = cast(Any, None)
        around = Surroundings(none, none, Records(directory), lambda _: None, none, none, lambda _: ComponentConfig())
        guard = Guarded(trouble)
        supervisor = Supervisor(NAME, around, cast(Component, guard), epoch=3)
        supervisor.begin()

        async def command(*_: object) -> acts.Answer:
            supervisor.order(acts.LetGo(NAME, 3))
            return acts.Answer(1, True, "it is protected no longer")

        async def known(name: str) -> str:
            return name

        verbs = Verbs.__new__(Verbs)
        verbs.__dict__.update(_worker=SimpleNamespace(supervisor=lambda _: supervisor), _command=command, _known=known)
        answer = asyncio.create_task(verbs.release({"name": NAME}, 0))
        await settled()
        assert not answer.done()
        guard.answers.set()
        (outcome,) = await asyncio.gather(answer, return_exceptions=True)
        for task in tuple(supervisor._tasks):
            task.cancel()
        return outcome if isinstance(outcome, Exception) else None

    return asyncio.run(run())


def test_a_release_is_answered_once_the_guard_has_been_told(tmp_path: Path) -> None:
    records = Records(tmp_path)
    records.note(NAME, 3)
    assert released(tmp_path) is None
    assert not records.epoch(NAME)


def test_a_release_that_the_guard_was_not_told_of_is_not_said_to_be_one(tmp_path: Path) -> None:
    told = released(tmp_path, GuardError("its guard is gone"))
    assert str(told) == f"cannot let {NAME} go: its guard is gone"


class Ending(Guarded):
    """Its program takes a while to end."""

    async def stop(self, _: int) -> None:
        await self.answers.wait()

    async def forget(self) -> None:
        pass

    def close(self) -> None:
        pass


def test_what_is_lacking_is_looked_at_once_the_copy_that_was_here_has_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a handover it holds its ports and names for a moment yet, which were told as another process's for half a minute."""
    nothing = cast(Any, None)

    async def run() -> None:
        guard = Ending()

        async def compared(*_: object) -> tuple[str, ...]:
            return () if guard.answers.is_set() else ("its port is another process's here",)

        async def keeper() -> Any:
            return SimpleNamespace(end=lambda: None)

        monkeypatch.setattr(prerequisites, "_compared", compared)
        process_pool = SimpleNamespace(keeper=keeper, relieve=lambda *_: None)
        places = cast(Any, SimpleNamespace(process_pool=process_pool))
        around = Surroundings(places, nothing, Records(tmp_path), lambda _: None, nothing, nothing, lambda _: ComponentConfig())
        supervisor = Supervisor(NAME, around, cast(Component, guard), epoch=3)
        supervisor.begin()
        supervisor.order(acts.Stop(NAME, 4))
        await settled()
        found = asyncio.create_task(prerequisites.look(around, [supervisor]))
        await settled()
        guard.answers.set()
        assert await found == {NAME: ()}
        for task in tuple(supervisor._tasks):
            task.cancel()

    asyncio.run(run())


def test_a_checkpoint_that_a_takeover_finds_damaged_is_offered_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The chain is read where the program would be made of it; then the store itself looks which file is harmed."""
    store, told, none = open_store(tmp_path / "store"), list[events.Event](), cast(Any, None)
    first, second = history(2)
    for one in (first, second):
        descriptor = memfd_holding(format.encode_bytes(one), "snapshot")
        store.put(descriptor)
        os.close(descriptor)
    path = store.chain_of(COMPONENT)[-1].path
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)

    async def soon(*_: object) -> int:
        return 0

    async def brought_back(_around: object, _act: object, chain: list[int], *_: object) -> Component:
        for descriptor in chain:
            format.decode(descriptor)
        raise AssertionError("it was read as if it were whole")

    monkeypatch.setattr(resume, "brought_back", brought_back)

    async def run() -> None:
        around = Surroundings(none, store, Records(tmp_path), told.append, soon, soon, lambda _: ComponentConfig())
        supervisor = Supervisor(COMPONENT, around, epoch=3)
        monkeypatch.setattr(type(supervisor._occasions), "before_resume", soon)
        supervisor.begin()
        supervisor.order(acts.Restore(COMPONENT, 3, second.position, None))
        while not told:
            await asyncio.sleep(0.001)
        for task in tuple(supervisor._tasks):
            task.cancel()

    asyncio.run(run())
    (event,) = told
    assert isinstance(event, events.ActFailed) and event.damaged == second.position
    assert store.positions(COMPONENT) == (first.position,)
    assert any(str(path) in notice for notice in store.notices)
    store.close()
