"""A warm program at its standby, with a real guard and a real keeper: it begins when it is told, and not a step before."""

from __future__ import annotations

import asyncio
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest
from msgspec.structs import replace

from agent.errors import GuardError
from agent.guard.messages import BeginTask
from agent.guard.program import GuardedProgram
from agent.system import clock
from agent.worker.components import launch, process_pool, warm_program
from agent.worker.components.component import Component
from agent.worker.components.launch import Program, RestoreOptions
from agent.worker.components.paths import Places, guard_sockets
from agent.worker.components.warm_program import Standby
from checkpoint.linux.spawn.vessel import Born
from checkpoint.segment.task_messages import TAKEN_OVER
from tests.agent.guards import PATIENCE_S, children, lives
from tests.agent.worker.components.test_component import Captures, live, output, piece_of, until
from tests.agent.worker.components.test_cooperative_component import (
    BEGIN,
    NAME,
    STEPS,
    gone_afterwards,
    next_of,
    program,
    started,
)

CHATTY = "print('imported', flush=True)\n" + STEPS
ENDS = "import sys\nprint('no map here', file=sys.stderr)\nsys.exit(3)\n"


@pytest.fixture(autouse=True)
def _no_spares(monkeypatch: pytest.MonkeyPatch) -> None:
    """No other guard waits in advance here."""
    monkeypatch.setattr(process_pool, "REFILL_S", 10 * PATIENCE_S)


class Waiting:
    """A standby, and what it told."""

    def __init__(self, places: Places) -> None:
        self.standby = Standby(NAME, places)
        self.told: list[tuple[bool, str]] = []

    def warm(self, wanted: Program, owner: int = 0) -> None:
        self.standby.warm(wanted, owner, lambda ready, why: self.told.append((ready, why)))

    async def ready(self) -> None:
        await until(lambda: (True, "") in self.told[-1:], f"it to wait; it told {self.told}")

    async def taken(self) -> Component:
        await self.ready()
        component = self.standby.take()
        assert component is not None
        return component


async def left_by(places: Places, script: str) -> tuple[Captures, int]:
    """A program that took some steps on another robot, and where its output stands in its newest snapshot."""
    async with gone_afterwards(await started(places, script)) as first:
        await until(lambda: output(first).count(b"\n") > 10, "some steps")
        captures = Captures(first)
        for _ in range(3):
            captured = await next_of(first, captures)
    return captures, piece_of(captured).offset + len(piece_of(captured).content)


async def prepared(places: Places, captures: Captures, waiting: Component) -> Component:
    elsewhere = replace(places, robot="robot2")
    return await launch.begin_again(
        NAME, program(STEPS), captures.chain, elsewhere, RestoreOptions(5, owner=0, epoch=4), TAKEN_OVER, waiting
    )


def test_a_program_that_waits_goes_on_exactly_after_what_its_last_snapshot_carries(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        captures, end = await left_by(places, CHATTY)
        waiting = Waiting(places)
        waiting.warm(program(CHATTY))
        component = await waiting.taken()
        pid = component.pid
        await (await prepared(places, captures, component)).resume()
        async with gone_afterwards(component):
            await until(lambda: len(output(component)) > end + 200, "it to go on")
            assert component.pid == pid, "the very process that waited"
            first, second, *_ = output(component)[end:].decode().splitlines()
            assert first == "imported", "what it wrote while it waited follows now"
            assert "robot='robot1', epoch=4, generation=1, why='taken over'" in second
            numbers = [int(line) for line in output(component).splitlines()[:-1] if line.isdigit()]
            assert numbers == list(range(len(numbers)))
        captures.close()

    live(tmp_path, story)


def test_a_program_that_is_lost_with_its_guard_while_it_waits_says_so_and_asks_for_no_installation(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        waiting = Waiting(places)
        waiting.warm(program(STEPS))
        await waiting.ready()
        for guard in children("agent.guard.server"):
            guard.kill()
        await until(lambda: not waiting.told[-1][0], "its loss to be told")
        assert waiting.told[-1][1] == f"the guard of {NAME} ended, and its program with it"
        await waiting.standby.close()

    live(tmp_path, story)


def test_a_program_that_waits_touches_no_log(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        captures, end = await left_by(places, CHATTY)
        log = next(places.logs.glob("*/stdout.log"))
        before = log.read_bytes()
        waiting = Waiting(places)
        waiting.warm(program(CHATTY))
        await waiting.ready()
        assert log.read_bytes() == before
        await waiting.standby.close()
        assert log.read_bytes() == before and len(before) >= end
        captures.close()

    live(tmp_path, story)


def test_a_program_whose_lease_is_over_takes_no_step(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        captures, end = await left_by(places, STEPS)
        waiting = Waiting(places)
        waiting.warm(program(STEPS))
        component = await prepared(places, captures, await waiting.taken())
        await component.lease(1)
        await component.resume()
        async with gone_afterwards(component):
            assert (await component.describe()).frozen_by == "lease"
            assert len(output(component)) == end
            await component.lease(clock.now_ns() + 10**12)
            await until(lambda: len(output(component)) > end, "it to go on under its new lease")
        captures.close()

    live(tmp_path, story)


def test_a_guard_has_the_lease_before_it_is_told_to_begin(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(places: Places) -> None:
        captures, _ = await left_by(places, STEPS)
        waiting = Waiting(places)
        waiting.warm(program(STEPS))
        component = await prepared(places, captures, await waiting.taken())
        asked: list[str] = []
        honest = component.ask_guard

        async def noted(request: Any, descriptors: tuple[int, ...] = ()) -> Any:
            asked.append(type(request).__name__)
            return await honest(request, descriptors)

        monkeypatch.setattr(component, "ask_guard", noted)
        await component.lease(clock.now_ns() + 10**12)
        await component.resume()
        async with gone_afterwards(component):
            assert asked[:2] == ["Lease", "BeginTask"]
        captures.close()

    live(tmp_path, story)


def test_a_program_whose_lease_is_over_is_frozen_before_it_hears_anything(tmp_path: Path) -> None:
    done: list[str] = []

    class Noting:
        """Stands for freezer, pump and task."""

        is_open, logs = False, None

        def __getattr__(self, name: str) -> Callable[..., None]:
            return lambda *_: done.append(name)

    nothing = cast(Any, Noting())
    program = GuardedProgram(NAME, Born(1, 1), nothing, str(tmp_path), nothing, committed=False, warm=True, task=nothing)
    program.set_lease(1)
    program.begin_task(BeginTask(4, None, (0, 0)), ())
    assert done == ["open", "freeze", "begin", "begin"]


def test_a_program_that_ends_before_it_is_ready_is_told_with_its_last_words_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(warm_program, "PAUSES_S", (0.01,))

    async def story(places: Places) -> None:
        waiting = Waiting(places)
        waiting.warm(program(ENDS))
        await until(lambda: len(waiting.told) >= 2, "two tries")
        assert waiting.told[0] == (False, "it ended with exit code 3 before it asked for its state; it said: no map here")
        assert waiting.standby.take() is None
        await waiting.standby.close()

    live(tmp_path, story)


def test_a_program_that_is_killed_while_it_waits_is_started_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_program, "PAUSES_S", (0.01,))

    async def story(places: Places) -> None:
        waiting = Waiting(places)
        waiting.warm(program(STEPS))
        await waiting.ready()
        first = waiting.standby._ready
        assert first is not None
        os.kill(first.pid, signal.SIGKILL)
        await until(lambda: len(waiting.told) >= 3, "the next one to wait")
        assert [is_ready for is_ready, _ in waiting.told] == [True, False, True]
        assert waiting.told[1][1].startswith("it was ended by signal 9 while it waited")  # and what it said last
        await waiting.standby.close()

    live(tmp_path, story)


def test_a_program_that_never_asks_for_its_state_is_ended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm_program, "READY_S", 0.1)

    async def story(places: Places) -> None:
        waiting = Waiting(places)
        waiting.warm(program("import time\ntime.sleep(1000)\n"))
        await until(lambda: waiting.told, "its verdict")
        assert "has not asked for its state" in waiting.told[0][1]
        await until(lambda: not guard_sockets(places), "its guard to end")
        await waiting.standby.close()

    live(tmp_path, story)


def test_a_program_that_is_not_here_is_told_by_name_with_what_to_do(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        waiting = Waiting(places)
        waiting.warm(replace(program(STEPS), argv=(b"/nowhere/mapper",)))
        await until(lambda: waiting.told, "its verdict")
        assert "cannot start /nowhere/mapper: No such file or directory" in waiting.told[0][1]
        assert "install it here" in waiting.told[0][1]
        await waiting.standby.close()

    live(tmp_path, story)


def test_a_program_does_not_wait_as_somebody_who_does_not_own_it(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        waiting = Waiting(places)
        waiting.warm(program(STEPS), owner=12345)
        await until(lambda: waiting.told, "its verdict")
        assert "not its owner, uid 12345" in waiting.told[0][1]
        await waiting.standby.close()

    live(tmp_path, story)


@pytest.mark.parametrize("end", [lambda one: one.cool(), lambda one: one.warm(program(BEGIN), 0, lambda *_: None)])
def test_what_waits_ends_when_it_is_wanted_no_longer(tmp_path: Path, end: Callable[[Standby], None]) -> None:
    async def story(places: Places) -> None:
        waiting = Waiting(places)
        waiting.warm(program(STEPS))
        await waiting.ready()
        component = waiting.standby._ready
        assert component is not None
        end(waiting.standby)
        await until(lambda: not lives(component.pid), "it to end")
        await waiting.standby.close()
        await until(lambda: not guard_sockets(places), "all guards to end")

    live(tmp_path, story)


def test_what_is_being_ended_ends_whole_when_nothing_is_wanted_any_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    began, allowed = asyncio.Event(), asyncio.Event()
    undo = Component.undo

    async def undone(component: Component) -> None:
        began.set()
        await allowed.wait()
        await undo(component)

    async def story(places: Places) -> None:
        monkeypatch.setattr(Component, "undo", undone)
        waiting = Waiting(places)
        waiting.warm(program(STEPS))
        await waiting.ready()
        assert waiting.standby._ready is not None
        os.kill(waiting.standby._ready.pid, signal.SIGKILL)
        await began.wait()
        waiting.standby.cool()
        allowed.set()
        await waiting.standby.close()
        await until(lambda: not guard_sockets(places), "the guard to end")

    live(tmp_path, story)


def test_what_waits_ends_with_its_agent(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        component = await launch.start_to_wait(NAME, program(STEPS), places, 0)
        await asyncio.wait_for(component.connected.wait(), PATIENCE_S)
        pid = component.pid
        component.close()  # as the end of a process does
        await until(lambda: not lives(pid) and not guard_sockets(places), "guard and program to end")

    live(tmp_path, story)


def test_a_program_that_died_after_it_was_taken_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        captures, _ = await left_by(places, STEPS)
        waiting = Waiting(places)
        waiting.warm(program(STEPS))
        component = await prepared(places, captures, await waiting.taken())
        os.kill(component.pid, signal.SIGKILL)
        await until(component.ended.done, "its end")
        with pytest.raises(GuardError, match="the program has ended"):
            await component.resume()
        await until(lambda: not guard_sockets(places), "the guard to end")
        captures.close()

    live(tmp_path, story)
