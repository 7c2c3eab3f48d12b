"""A program that keeps its state, with a real guard and a real keeper: captures of its commits, and its resume from them."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shlex
import signal
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Final

import msgspec
import pytest
from msgspec.structs import replace

from agent.errors import GuardError
from agent.guard.messages import CommitKept, CommitSafe, Describe, Described
from agent.worker.components import launch, process_pool
from agent.worker.components.component import Captured, Component
from agent.worker.components.launch import Program, RestoreOptions
from agent.worker.components.paths import Places, guard_sockets
from checkpoint.engine import COOPERATIVE
from checkpoint.errors import CaptureError, MismatchError, NothingCommittedError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.spawn.inherited_limits import Inheritance
from checkpoint.segment.task_messages import TAKEN_OVER
from tests.agent.guards import PATIENCE_S
from tests.agent.worker.components.test_component import Captures, at_last, live, output, piece_of, until

NAME: Final = "/test/robot1/one"
BEGIN = """
import sys, time
import failover
from failover.kept_state.api import resumed
state = failover.resume("state", default={"step": 0})
"""
PRINTS = BEGIN + "print('before')\nfailover.commit()\nprint('after', flush=True)\ntime.sleep(1000)\n"
WAITS = (
    BEGIN
    + "failover.commit()\nprint('committed', flush=True)\nfailover.wait_committed()\n"
    + "print('safe', flush=True)\ntime.sleep(1000)\n"
)
STEPS = (
    BEGIN
    + "print(resumed(), flush=True)\nwhile True:\n    print(state['step'])\n    state['step'] += 1\n    failover.commit()\n"
    + "    time.sleep(0.001)\n"
)
FILLS = (
    BEGIN
    + """
import os, pathlib
def until(name):
    while not pathlib.Path(name).exists():
        time.sleep(0.002)
def commit():
    state["step"] += 1
    began = time.perf_counter()
    failover.commit()
    return time.perf_counter() - began
commit(); print("begun", flush=True)
until("FLAGS/stopped")
pipe = os.open("/proc/self/fd/1", os.O_WRONLY | os.O_NONBLOCK)
filled = 0
try:
    while True:
        filled += os.write(pipe, b"." * 1023 + b"\\n")
except BlockingIOError:
    print("printed before the commits", state["step"])  # it stays in Python's buffer
pathlib.Path("FLAGS/filled").write_text(str(filled))
pathlib.Path("FLAGS/took").write_text(" ".join(str(commit()) for _ in range(500)))
until("FLAGS/goes-on")
commit(); print("printed after it", flush=True)
time.sleep(1000)
"""
)
SILENT = "import time\nprint('here', flush=True)\ntime.sleep(1000)\n"


@pytest.fixture(autouse=True)
def _no_spares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody waits in advance for a takeover here."""
    monkeypatch.setattr(process_pool, "REFILL_S", 10 * PATIENCE_S)


def program(script: str) -> Program:
    environment = (b"PATH=/usr/bin:/bin", b"PYTHONPATH=" + os.fsencode(Path(__file__).parents[4]))
    return Program((os.fsencode(sys.executable), b"-c", os.fsencode(script)), environment, b"/", engine=COOPERATIVE)


@asynccontextmanager
async def gone_afterwards(component: Component) -> AsyncIterator[Component]:
    try:
        yield component
    finally:
        with contextlib.suppress(GuardError):
            await component.stop(signal.SIGKILL)
            await component.forget()


async def started(places: Places, script: str) -> Component:
    return await launch.start(NAME, program(script), places, 3)


async def again(places: Places, captures: Captures, script: str) -> Component:
    return await launch.begin_again(
        NAME, program(script), captures.chain, places, RestoreOptions(5, owner=0, epoch=4), TAKEN_OVER
    )


async def held(component: Component) -> Captured:
    return await at_last(lambda: component.capture(base=True, generation=1, sequence=99, epoch=3, hold=True))


def test_a_snapshot_carries_the_output_as_it_stood_at_the_commit_and_freezes_nobody(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with gone_afterwards(await started(places, PRINTS)) as component:
            await until(lambda: output(component) == b"before\nafter\n", "both lines")
            await until(lambda: component.keeps, "the agent to hear of its commit")
            captures = Captures(component)
            captured = await captures.take()
            assert piece_of(captured).content == b"before\n", "flushed by the commit, and not a byte beyond"
            assert captured.freeze_us == 0
            captures.close()

    live(tmp_path, story)


def test_a_program_that_has_committed_nothing_is_told_so(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with gone_afterwards(await started(places, SILENT)) as component:
            await until(lambda: output(component) == b"here\n", "its output")
            with pytest.raises(NothingCommittedError, match="has not said yet that it keeps a state"):
                await Captures(component).take()

    live(tmp_path, story)


def test_the_first_commit_is_told_at_once_and_captured(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        script = BEGIN + "print('begun', flush=True)\nwhile not pathlib.Path('FLAG').exists(): time.sleep(0.002)\n"
        script = "import pathlib\n" + script.replace("FLAG", str(tmp_path / "go")) + "failover.commit()\ntime.sleep(1000)\n"
        async with gone_afterwards(await started(places, script)) as component:
            told = asyncio.Event()
            component.committed = told.set
            await until(lambda: output(component) == b"begun\n" and component.task_pid, "the agent to hear that it keeps a state")
            captures = Captures(component)
            with pytest.raises(NothingCommittedError, match="has committed nothing yet"):
                await captures.take()
            assert not told.is_set()
            (tmp_path / "go").touch()
            await asyncio.wait_for(told.wait(), PATIENCE_S)
            assert (await captures.take()).parent is None
            captures.close()

    live(tmp_path, story)


def test_a_child_of_what_was_started_may_keep_the_state(tmp_path: Path) -> None:
    """A shell that does not exec, as launchers do: also its end is that of the component."""

    async def story(places: Places) -> None:
        command = shlex.join([sys.executable, "-c", STEPS]) + "; true"
        wrapped = replace(program(STEPS), argv=(b"sh", b"-c", os.fsencode(command)))
        async with gone_afterwards(await launch.start(NAME, wrapped, places, 3)) as component:
            await until(lambda: output(component).count(b"\n") > 10, "some steps")
            await until(lambda: component.keeps, "the agent to hear of its commit")
            assert component.task_pid not in (0, component.pid)
            await captures_go_on(component)
            os.close((await held(component)).snapshot)
            assert procfs.status(component.task_pid).state in "ST"
            before = len(output(component))
            assert len(output(component)) == before
            await component.thaw()
            await until(lambda: len(output(component)) > before, "it to go on")
            os.kill(component.task_pid, signal.SIGTERM)
            assert await component.ended == 0

    live(tmp_path, story)


def test_a_commit_is_safe_for_its_program_when_it_was_acknowledged_and_not_before(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with gone_afterwards(await started(places, WAITS)) as component:
            await until(lambda: output(component) == b"committed\n", "the commit")
            await until(lambda: component.keeps, "the agent to hear of its commit")
            captured = await at_last(lambda: component.capture(base=True, generation=1, sequence=1, epoch=3))
            os.close(captured.snapshot)
            assert output(component) == b"committed\n"
            await component.acknowledge(captured.position)
            await until(lambda: output(component) == b"committed\nsafe\n", "the program to hear of it")

    live(tmp_path, story)


@pytest.mark.parametrize("hears", [True, False], ids=["a guard of today", "a guard from before the upgrade"])
def test_only_a_guard_that_knows_the_message_is_told_that_this_robot_keeps_a_commit(
    hears: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A guard that does not know it hangs up, which looks like the end of its program."""

    async def story(places: Places) -> None:
        first = await started(places, STEPS)
        await until(lambda: first.keeps, "the agent to hear of its commit")
        first.close()
        async with gone_afterwards(await launch.reconnect(guard_sockets(places)[0], places)) as component:
            if not hears:
                described, streams = await component.ask_guard(Describe())
                said = msgspec.to_builtins(described)
                del said["hears_kept"]
                component.take(msgspec.convert(said, Described), streams)
            told: list[object] = []
            with monkeypatch.context() as patched:
                patched.setattr(component._guard, "tell", told.append)
                for sequence, is_safe in ((1, True), (2, False)):
                    capture = partial(component.capture, base=True, generation=1, sequence=sequence, epoch=3)
                    captured = await at_last(capture)
                    os.close(captured.snapshot)
                    await component.acknowledge(captured.position, is_safe=is_safe)
            commits = [type(one) for one in told if isinstance(one, CommitSafe | CommitKept)]
            assert commits == [CommitSafe, *[CommitKept] * hears]

    live(tmp_path, story)


def test_a_guard_that_stands_still_holds_up_no_commit_and_costs_no_output(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        script = FILLS.replace("FLAGS", str(tmp_path))
        first = await launch.start(NAME, replace(program(script), isolate=False), places, 3)
        async with gone_afterwards(first):
            await until(lambda: output(first) == b"begun\n", "its first commit")
            await until(lambda: first.keeps, "the agent to hear of its commit")
            captures = Captures(first)
            base = await captures.take()
            guard = procfs.status(first.pid).ppid
            os.kill(guard, signal.SIGSTOP)
            try:
                (tmp_path / "stopped").touch()
                await until((tmp_path / "took").exists, "five hundred commits whose output nobody takes")
                while_stopped = await first.capture(base=False, generation=1, sequence=50, epoch=1)
                os.close(while_stopped.snapshot)
                assert while_stopped.dirty_bytes == 0, "commits that cannot tell their output are passed over"
                with pytest.raises(CaptureError, match="had no room in the pipe"):
                    await first.capture(base=True, generation=1, sequence=51, epoch=1)
            finally:
                os.kill(guard, signal.SIGCONT)
            filled = int((tmp_path / "filled").read_text())
            await until(lambda: len(output(first)) >= len(b"begun\n") + filled, "the guard to make room for the next commit")
            (tmp_path / "goes-on").touch()
            await until(lambda: output(first).endswith(b"printed after it\n"), "the guard to take it all")
            captured = await captures.take()
            assert captured.parent == base.position
            carried = piece_of(captured)
            assert carried.content.endswith(b".\nprinted before the commits 1\n"), "all that was printed before, nothing after"
            assert output(first)[: carried.offset + len(carried.content)].endswith(carried.content)
        captures.close()

    live(tmp_path, story)


def test_a_program_goes_on_exactly_after_what_its_last_snapshot_carries(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with gone_afterwards(await started(places, STEPS)) as first:
            await until(lambda: output(first).count(b"\n") > 10, "some steps")
            await until(lambda: first.keeps, "the agent to hear of its commit")
            captures = Captures(first)
            for _ in range(5):
                captured = await next_of(first, captures)
        end = piece_of(captured).offset + len(piece_of(captured).content)
        second = await again(replace(places, robot="robot2"), captures, STEPS)
        await second.resume()
        async with gone_afterwards(second):
            await until(lambda: len(output(second)) > end + 200, "it to go on")
            await until(lambda: second.keeps, "the agent to hear of its commit")
            told = output(second)[end:].splitlines()[0].decode()
            assert "robot='robot1', epoch=4, generation=1, why='taken over'" in told
            numbers = [int(line) for line in output(second).splitlines()[:-1] if line.isdigit()]
            assert numbers == list(range(len(numbers)))
            await captures_go_on(second)
        captures.close()

    live(tmp_path, story)


async def next_of(component: Component, captures: Captures) -> Captured:
    """A snapshot after another commit of a program that takes steps."""
    await until(lambda: component.keeps, "the agent to hear of its commit")
    before = output(component).count(b"\n")
    await until(lambda: output(component).count(b"\n") > before + 2, "another commit")
    return await captures.take()


async def captures_go_on(component: Component) -> None:
    """The program that was started again is protected as it was before."""
    captures = Captures(component)
    await until(lambda: component.keeps, "the agent to hear of its commit")
    assert (await captures.take()).parent is None
    assert (await next_of(component, captures)).parent is not None
    captures.close()


def test_a_program_that_is_held_stands_still_until_it_is_thawed(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with gone_afterwards(await started(places, STEPS)) as component:
            await until(lambda: output(component).count(b"\n") > 10, "some steps")
            await until(lambda: component.keeps, "the agent to hear of its commit")
            os.close((await held(component)).snapshot)
            assert (await component.describe()).state == "frozen"
            await component.thaw()
            before = len(output(component))
            await until(lambda: len(output(component)) > before, "it to go on")

    live(tmp_path, story)


def test_a_program_that_cannot_be_held_for_its_capture_is_let_go(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with gone_afterwards(await started(places, SILENT)) as component:
            await until(lambda: output(component) == b"here\n", "its output")
            with pytest.raises(CaptureError):
                await held(component)
            assert (await component.describe()).state == "running"

    live(tmp_path, story)


def test_an_agent_that_comes_back_goes_on_with_the_same_engine(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        first = await started(places, STEPS)
        await until(lambda: output(first).count(b"\n") > 10, "some steps")
        await until(lambda: first.keeps, "the agent to hear of its commit")
        first.close()
        async with gone_afterwards(await launch.reconnect(guard_sockets(places)[0], places)) as found:
            assert found.engine == COOPERATIVE
            await captures_go_on(found)

    live(tmp_path, story)


async def left_behind(places: Places) -> Captures:
    """One snapshot of a program that has made some steps, and is gone."""
    async with gone_afterwards(await started(places, STEPS)) as first:
        await until(lambda: output(first).count(b"\n") > 10, "some steps")
        await until(lambda: first.keeps, "the agent to hear of its commit")
        captures = Captures(first)
        await captures.take()
    return captures


def test_what_was_prepared_and_never_resumed_leaves_nothing(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        captures = await left_behind(places)
        (await again(places, captures, STEPS)).close()
        await until(lambda: not guard_sockets(places), "the guard to end")
        captures.close()

    live(tmp_path, story)


def test_a_program_that_is_not_here_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        captures = await left_behind(places)
        missing = replace(program(STEPS), argv=(b"/nowhere/mapper",))
        second = await launch.begin_again(NAME, missing, captures.chain, places, RestoreOptions(owner=0, epoch=4), TAKEN_OVER)
        with pytest.raises(GuardError, match="cannot start /nowhere/mapper: No such file or directory"):
            await second.resume()
        await until(lambda: not guard_sockets(places), "the guard to end")
        captures.close()

    live(tmp_path, story)


def test_a_chain_is_not_started_as_somebody_who_does_not_own_it(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        captures = await left_behind(places)
        with pytest.raises(MismatchError, match="not its owner, uid 12345"):
            await launch.begin_again(
                NAME, program(STEPS), captures.chain, places, RestoreOptions(owner=12345, epoch=4), TAKEN_OVER
            )
        captures.close()

    live(tmp_path, story)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: whose rights are less is the question")
def test_a_chain_with_more_rights_than_its_owners_lays_nothing_down_and_starts_nothing(tmp_path: Path) -> None:
    """Root ran it; it comes back as an ordinary user's program, and its files would be laid down with root's rights."""

    async def story(places: Places) -> None:
        captures = await left_behind(places)
        theirs = replace(program(STEPS), inheritance=Inheritance(12345, 12345))
        with pytest.raises(MismatchError, match="other rights than those of its owner, uid 12345"):
            await launch.begin_again(NAME, theirs, captures.chain, places, RestoreOptions(owner=12345, epoch=4), TAKEN_OVER)
        assert not guard_sockets(places)
        captures.close()

    live(tmp_path, story)
