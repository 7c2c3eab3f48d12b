"""A component with a real guard and a real keeper, as in the worker process: captures, deaths, restores."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import os
import signal
import termios
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

import pytest
from msgspec.structs import replace

from agent.errors import GuardError, GuardLostError, KeeperLostError
from agent.guard.output_logs import OutputLogs
from agent.worker.components import launch, process_pool
from agent.worker.components.component import Captured, Component
from agent.worker.components.connection import Dialogue
from agent.worker.components.launch import Program, RestoreOptions
from agent.worker.components.paths import Places, guard_sockets
from agent.worker.components.process_pool import ProcessPool, connect
from checkpoint.engine import NO_TERMS
from checkpoint.errors import CaptureError, CheckpointError, FormatError, NothingCommittedError, ProcessGoneError, StoreError
from checkpoint.keeper.messages import LARGE_SIZE, close_all
from checkpoint.model import OutputPiece
from checkpoint.segment.output_counters import StreamCounts
from checkpoint.snapshot import format
from checkpoint.snapshot.credentials import Owner
from tests.agent.guards import PATIENCE_S, POLL_S, PYTHON, lives

NAME: Final = "/test/robot1/one"
LINES: Final = 100_000
CAPTURES: Final = 5
WRITE = (
    "import os, time\n"
    f"for i in range({LINES}):\n"
    "    print(i, flush=i % 5 == 0)\n"
    "    i % 500 or time.sleep(0.002)\n"
    f"    while i == {LINES - 10} and not os.path.exists('{{flag}}'): time.sleep(0.002)\n"
)
"""Writes, and does not come to the end before a file exists."""
COUNT = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.001)\n"
OBSTINATE = "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\nprint('ready', flush=True)\ntime.sleep(1000)\n"


@pytest.fixture(autouse=True)
def _no_spares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody waits in advance for a takeover here."""
    monkeypatch.setattr(process_pool, "REFILL_S", 10 * PATIENCE_S)


T = TypeVar("T")
Story = Callable[[Places], Coroutine[Any, Any, None]]


def live(directory: Path, story: Story) -> None:
    """Run a story in a loop of its own; every guard and keeper that waits is ended after it."""

    async def whole() -> None:
        pool = ProcessPool(directory / "guards", "")
        (directory / "guards").mkdir()
        places = Places(directory / "guards", directory / "logs", pool, robot="robot1")
        try:
            await asyncio.wait_for(story(places), 2 * PATIENCE_S)
        finally:
            await pool.close()

    asyncio.run(whole())


def program(script: str) -> Program:
    return Program((os.fsencode(PYTHON), b"-S", b"-c", os.fsencode(script)), (b"PATH=/usr/bin:/bin",), b"/")


@asynccontextmanager
async def started(places: Places, script: str) -> AsyncIterator[Component]:
    """A program that runs; whatever becomes of it, it is gone afterwards."""
    component = await launch.start(NAME, program(script), places)
    try:
        yield component
    finally:
        await ended(component)


async def ended(component: Component) -> None:
    """End it, if it has not, and its guard."""
    with contextlib.suppress(GuardError):
        await component.stop(signal.SIGKILL)
        await component.forget()


async def until(condition: Callable[[], bool], what: str) -> None:
    for _ in range(int(PATIENCE_S / POLL_S)):
        if condition():
            return
        await asyncio.sleep(POLL_S)
    raise AssertionError(f"waited {PATIENCE_S:.0f} s in vain for {what}")


async def at_last(act: Callable[[], Coroutine[Any, Any, T]]) -> T:
    """What an act answers that is made again while the machine is too busy for it: it says so, and harms nothing."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return await act()
        except (ProcessGoneError, NothingCommittedError):
            raise
        except CaptureError:
            if time.monotonic() > deadline:
                raise
            await asyncio.sleep(POLL_S)


async def forever(act: Callable[[], Coroutine[Any, Any, Any]]) -> None:
    """Again and again, until it raises."""
    while True:
        await act()


async def looked_for(path: Path, places: Places) -> None:
    """Connect to a guard and hang up."""
    (await launch.reconnect(path, places)).close()


def output(component: Component) -> bytes:
    """All that it wrote to its standard output."""
    return (component.logs.directory / "stdout.log").read_bytes()


async def more(component: Component) -> None:
    """Wait until it writes on."""
    before = len(output(component))
    await until(lambda: len(output(component)) > before, "more output")


def counted(content: bytes) -> None:
    """Whole lines, each number once and in order."""
    numbers = content[: content.rindex(b"\n")].split()
    assert numbers == [b"%d" % number for number in range(len(numbers))]


class Captures:
    """Captures one component over and over, and keeps the snapshots of its newest chain."""

    def __init__(self, component: Component) -> None:
        self._component = component
        self._sequence = 0
        self.chain: list[int] = []

    async def take(self, *, hold: bool = False) -> Captured:
        """One more, acknowledged; tried again, as the agent does it, where a busy machine has left it no instant for it."""
        self._sequence += 1
        captured = await at_last(
            lambda: self._component.capture(base=False, generation=1, sequence=self._sequence, epoch=1, hold=hold)
        )
        await self._component.acknowledge(captured.position)
        if captured.parent is None:
            self.close()
        self.chain.append(captured.snapshot)
        return captured

    def close(self) -> None:
        for descriptor in self.chain:
            os.close(descriptor)
        self.chain.clear()


def piece_of(captured: Captured) -> OutputPiece:
    """What a snapshot carries of standard output."""
    (piece,) = (piece for piece in format.read_outline(captured.snapshot).output if piece.stream == 1)
    return piece


# Output


def test_the_output_of_a_hundred_thousand_lines_is_whole_in_the_log_and_in_the_snapshots(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        flag = tmp_path / "flag"
        async with started(places, WRITE.format(flag=flag)) as component:
            captures, carried = Captures(component), bytearray()
            taken = 0
            while not component.ended.done():
                with contextlib.suppress(CheckpointError):  # it ended meanwhile
                    piece = piece_of(await captures.take())
                    assert piece.offset == len(carried), "each snapshot carries what was written since the one before"
                    carried += piece.content
                    taken += 1
                if taken == CAPTURES:
                    flag.touch()
            captures.close()
            assert await component.ended == 0
            written = output(component)
            assert written.split() == [b"%d" % number for number in range(LINES)]
            assert carried and written.startswith(carried)

    live(tmp_path, story)


def test_a_restored_program_goes_on_exactly_after_what_its_snapshot_carries(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with started(places, COUNT) as first:
            await more(first)
            captures = Captures(first)
            for _ in range(3):
                await captures.take()
            await more(first)  # a takeover takes this back
            await first.stop(signal.SIGKILL)
        second = await launch.restore(NAME, captures.chain, places, RestoreOptions())
        try:
            assert (await second.describe()).state == "vessel"
            await second.resume()
            await more(second)
            assert await second.protect() == (), "it is protected already"
            counted(output(second))
        finally:
            captures.close()
            await ended(second)

    live(tmp_path, story)


# The keeper's death


def test_a_keeper_that_dies_costs_a_base_and_nothing_else(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with started(places, COUNT) as component:
            captures = Captures(component)
            await captures.take()
            assert (await captures.take()).parent is not None
            keeper = component.keeper._link
            assert keeper is not None
            os.kill(keeper.pid, signal.SIGKILL)
            with pytest.raises(KeeperLostError):
                await forever(captures.take)
            assert (await captures.take()).parent is None
            await more(component)
            counted(output(component))
            captures.close()

    live(tmp_path, story)


def test_a_program_that_a_capture_holds_goes_on_when_it_is_thawed(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with started(places, COUNT) as component:
            await more(component)
            captures = Captures(component)
            piece = piece_of(await captures.take(hold=True))
            await component.describe()
            assert len(output(component)) <= piece.offset + len(piece.content), "it wrote nothing after the snapshot"
            await component.thaw()
            await more(component)
            counted(output(component))
            captures.close()

    live(tmp_path, story)


async def written(component: Component) -> bytes:
    """All that a program has written that stands still, also what its guard is still to take from the pipe."""
    counts = StreamCounts(component.streams[0], (component.streams[1], component.streams[2]))
    try:
        while counts.totals() != (len(output(component)), 0):
            await asyncio.sleep(POLL_S)
        return output(component)
    finally:
        counts.close()


@pytest.mark.parametrize("cgroup", ["", "/nonexistent"])
def test_a_program_that_its_lease_has_frozen_can_be_captured_when_it_is_held_for_that(tmp_path: Path, cgroup: str) -> None:
    async def story(places: Places) -> None:
        async with started(replace(places, cgroup=cgroup), COUNT) as component:
            await more(component)
            await component.lease(1)
            await component.freeze(exposed=True)
            standing = await written(component)
            captures = Captures(component)
            piece = piece_of(await captures.take(hold=True))
            assert piece.offset + len(piece.content) == len(standing)
            assert output(component) == standing, "it did not run for it"
            captures.close()

    live(tmp_path, story)


# The agent's death


def guard_socket(component: Component, places: Places) -> Path:
    """Where its guard listens."""
    return places.sockets / component._guard._whom.removeprefix("the guard at ")


def test_an_agent_that_comes_back_finds_its_component_by_the_socket(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        component = await launch.start(NAME, program(COUNT), places)
        component.close()  # all that an agent leaves when it is killed: closed sockets
        path = guard_socket(component, places)
        assert path in guard_sockets(places)
        again = await launch.reconnect(path, places)
        try:
            assert (again.name, again.pid) == (NAME, component.pid)
            captures = Captures(again)
            assert (await captures.take()).parent is None, "a new keeper begins with a base"
            await more(again)
            counted(output(again))
            captures.close()
        finally:
            await ended(again)

    live(tmp_path, story)


def test_an_agent_that_comes_back_too_late_is_told_how_it_ended(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        component = await launch.start(NAME, program("import os; os._exit(5)"), places)
        path = guard_socket(component, places)
        component.close()
        again = await launch.reconnect(path, places)
        assert await again.ended == 5 << 8
        await again.forget()
        with pytest.raises(GuardLostError, match="has gone"):
            await forever(lambda: looked_for(path, places))
        assert not path.exists()

    live(tmp_path, story)


def test_an_end_right_behind_the_guards_answer_is_heard(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    guards: list[Dialogue] = []
    monkeypatch.setattr(launch, "connect", lambda path: guards.append(connect(path)) or guards[0])

    async def story(places: Places) -> None:
        component = await launch.start(NAME, program("import time; time.sleep(3600)"), places)
        path = guard_socket(component, places)
        component.close()
        finding = asyncio.create_task(launch.reconnect(path, places))
        await asyncio.sleep(0)  # it asks; from here on the loop stands still
        told = bytes_waiting(guards[0], more_than=0)
        os.kill(component.pid, signal.SIGKILL)
        bytes_waiting(guards[0], more_than=told)
        again = await finding
        assert await again.ended == signal.SIGKILL
        await again.forget()

    live(tmp_path, story)


def bytes_waiting(guard: Dialogue, more_than: int) -> int:
    """Wait, without the loop, until more than so many bytes of a guard have come that are not read yet."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        count = int.from_bytes(fcntl.ioctl(guard._channel.fileno(), termios.FIONREAD, bytes(4)), "little")
        if count > more_than:
            return count
        time.sleep(POLL_S)
    raise AssertionError(f"no more than {more_than} bytes came")


def test_a_restore_that_nobody_resumes_leaves_nothing(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with started(places, COUNT) as first:
            captures = Captures(first)
            await captures.take()
        second = await launch.restore(NAME, captures.chain, places, RestoreOptions())
        pid, path = second.pid, guard_socket(second, places)
        second.close()
        await until(lambda: not lives(pid) and not path.exists(), "vessel and guard to end")
        captures.close()

    live(tmp_path, story)


# Errors


def test_a_restore_from_something_damaged_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with started(places, COUNT) as first:
            captures = Captures(first)
            captured = await captures.take()
        content = bytearray(os.pread(captured.snapshot, captured.size, 0))
        content[-100] ^= 1
        damaged = tmp_path / "damaged"
        damaged.write_bytes(content)
        with damaged.open("rb") as file, pytest.raises(FormatError):
            await launch.restore(NAME, [file.fileno()], places, RestoreOptions())
        captures.close()

    live(tmp_path, story)


def test_a_program_that_cannot_be_started_leaves_nothing(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        with pytest.raises(GuardError, match="cannot start /no/such: No such file"):
            await launch.start(NAME, Program((b"/no/such",), (), b"/"), places)

    live(tmp_path, story)


def test_a_program_whose_guard_is_killed_is_known_to_have_ended(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        component = await launch.start(NAME, program(COUNT), places)
        await more(component)
        pid = component.pid
        os.kill(guard_of(pid), signal.SIGKILL)
        with pytest.raises(GuardLostError, match="its program with it"):
            await component.ended
        await until(lambda: not lives(pid), "the program to end")
        component.close()

    live(tmp_path, story)


def guard_of(pid: int) -> int:
    """The parent of a process."""
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def test_a_program_that_does_not_heed_its_signal_is_killed_in_the_end(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with started(places, OBSTINATE) as component:
            await until(lambda: output(component) == b"ready\n", "the program to be ready")
            assert await component.stop(signal.SIGTERM, patience_s=0.1) == signal.SIGKILL

    live(tmp_path, story)


def test_a_program_that_was_released_runs_on_unprotected(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        component = await launch.start(NAME, program(COUNT), places)
        captures = Captures(component)
        await captures.take()
        captures.close()
        await component.release()
        pid, path = component.pid, guard_socket(component, places)
        await more(component)
        counted(output(component))
        assert not path.exists()
        os.kill(guard_of(pid), signal.SIGKILL)
        await until(lambda: not lives(pid), "it to end with its guard")

    live(tmp_path, story)


# Descriptors


def opened() -> list[str]:
    """What this process has open: log files, guards' and keepers' sockets, and whatever else."""
    found = []
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            found.append(os.readlink(entry).partition(":[")[0])
    return sorted(found)


async def closed_again(before: list[str]) -> None:
    """Wait until no more is open than before; a keeper that was let go may need a moment."""
    for _ in range(int(PATIENCE_S / POLL_S)):
        if (now := opened()) == before:
            return
        await asyncio.sleep(POLL_S)
    raise AssertionError(
        f"{len(now) - len(before)} descriptors more than before: {sorted((Counter(now) - Counter(before)).items())}"
    )


def test_a_ready_copy_that_is_laid_again_and_again_leaves_no_descriptor(tmp_path: Path) -> None:
    """A standby's agent lays one a minute, for months, of a program whose children come and go."""

    async def story(places: Places) -> None:
        async with started(places, COUNT) as first:
            captures = Captures(first)
            await captures.take()

            async def laid_and_ended() -> None:
                copy, _ = await launch.lay(
                    NAME, captures.chain, places, age_ns=0, owner=os.geteuid(), started=None, terms=NO_TERMS
                )
                await copy.undo()

            await laid_and_ended()  # what is opened once for all of them is open by now
            before = opened()
            for _ in range(3):
                await laid_and_ended()
            await closed_again(before)
            captures.close()

    live(tmp_path, story)


def test_a_program_that_has_ended_or_was_let_go_leaves_no_descriptor(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async def lived(*, let_go: bool) -> None:
            async with started(places, COUNT) as component:
                await component.protect()
                if let_go:
                    pid = component.pid
                    await component.release()
                    os.kill(pid, signal.SIGKILL)

        await lived(let_go=False)
        before = opened()
        for let_go in (False, True, False, True):
            await lived(let_go=let_go)
        await closed_again(before)

    live(tmp_path, story)


BIG: Final = f"import os, time; held = os.urandom({2 * LARGE_SIZE}); print('ready', flush=True); time.sleep(1000)"


def test_a_large_snapshot_goes_straight_into_a_file_of_the_store_and_a_small_one_into_memory(tmp_path: Path) -> None:
    """A base of gigabytes in a memory file takes as much memory again, and is written once more."""
    made: list[int] = []

    def unnamed() -> int:
        made.append(os.open(tmp_path, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600))
        return made[-1]

    def full() -> int:
        return os.open("/dev/full", os.O_RDWR | os.O_CLOEXEC)

    async def story(places: Places) -> None:
        async with started(places, BIG) as component:
            keeper, captures = component.keeper, Captures(component)
            while not component.logs.read(1, 0, committed=False).content:
                await asyncio.sleep(POLL_S)
            await keeper.lend(unnamed)
            large = await captures.take()
            assert (large.snapshot, keeper.spare) == (made[0], ())
            assert len(format.decode(large.snapshot).contents) > 2 * LARGE_SIZE
            await keeper.lend(unnamed)
            await keeper.lend(unnamed)
            small = await captures.take()
            assert format.decode(small.snapshot).parent == large.position
            assert keeper.spare == (made[1],) and not os.fstat(made[1]).st_size, "it waits for a large one"
            close_all(keeper.take_spare())
            await keeper.lend(full)
            with pytest.raises(StoreError, match=f"cannot write a snapshot of {NAME}: No space left on device; free some space"):
                await component.capture(base=True, generation=1, sequence=9, epoch=1)
            assert not keeper.spare, "it may hold a part of a snapshot"
            keeper.terms = replace(keeper.terms, owner=Owner(1000))
            await keeper.lend(unnamed)
            assert not keeper.spare, "that keeper has the rights of a user, who could write to what is stored"
            captures.close()

    live(tmp_path, story)


def test_a_program_with_a_small_base_has_no_file_made_for_each_capture(tmp_path: Path) -> None:
    threads: list[int] = []

    def unnamed() -> int:
        threads.append(threading.get_ident())
        return os.open(tmp_path, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)

    async def story(places: Places) -> None:
        async with started(places, COUNT) as component:
            keeper, captures = component.keeper, Captures(component)
            await keeper.lend(unnamed)
            assert keeper.spare, "no base is known yet"
            await captures.take()
            assert not keeper.spare, "a descriptor would stay open for each small component"
            await keeper.lend(unnamed)
            assert not keeper.spare
            captures.close()

    live(tmp_path, story)
    assert len(threads) == 1
    assert threads[0] != threading.get_ident(), "a slow disk would hold all components up"


BIG_TICKS: Final = (
    f"import os, time; held = os.urandom({2 * LARGE_SIZE}); print('ready', flush=True)\n"
    "while True: time.sleep(0.02); print('on', flush=True)"
)


def test_a_program_whose_last_capture_before_a_handover_fails_runs_on(tmp_path: Path) -> None:
    """The keeper has left it standing by then, and cannot write what it holds: the disk is full."""

    async def story(places: Places) -> None:
        async with started(places, BIG_TICKS) as component:
            log = component.logs.directory / "stdout.log"

            async def runs_on() -> None:
                before = log.stat().st_size
                await until(lambda: log.stat().st_size > before, "a line that it writes")

            await runs_on()
            await component.keeper.lend(lambda: os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))
            with pytest.raises(StoreError, match="cannot write a snapshot"):
                await component.capture(base=True, generation=1, sequence=9, epoch=1, hold=True)
            await runs_on()
            captures = Captures(component)
            await captures.take()
            await runs_on()
            captures.close()

    live(tmp_path, story)


def test_a_keeper_that_is_let_go_as_its_answer_comes_leaves_the_snapshot(tmp_path: Path) -> None:
    async def story(places: Places) -> None:
        async with started(places, BIG) as component:
            while not component.logs.read(1, 0, committed=False).content:
                await asyncio.sleep(POLL_S)
            await component.protect()
            link = component.keeper._link
            assert link is not None
            await component.keeper.lend(lambda: os.open(tmp_path, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600))
            link.dialogue.heard = lambda _: asyncio.get_running_loop().call_soon(component.keeper.drop) is None
            captured = await component.capture(base=True, generation=1, sequence=9, epoch=1)
            assert isinstance(captured, Captured)
            assert not component.keeper.is_there
            assert len(format.decode(captured.snapshot).contents) > 2 * LARGE_SIZE
            os.close(captured.snapshot)

    live(tmp_path, story)


def test_logs_that_were_closed_write_into_no_other_file(tmp_path: Path) -> None:
    """The number of a closed descriptor may be another file's by then."""
    logs = OutputLogs(tmp_path)
    logs.close()
    logs.close()
    with pytest.raises(OSError, match="Bad file descriptor"):
        logs.commit((1, 1))


@pytest.mark.parametrize(("error", "stays"), [(errno.ECONNREFUSED, False), (errno.EAGAIN, True), (errno.EMFILE, True)])
def test_only_a_socket_at_which_no_guard_listens_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: int, stays: bool
) -> None:
    def refuse(_path: Path) -> None:
        raise OSError(error, os.strerror(error))

    monkeypatch.setattr(launch, "connect", refuse)
    path = tmp_path / "guard"
    path.touch()
    nowhere: Any = None
    with pytest.raises(GuardLostError, match=os.strerror(error)):
        asyncio.run(launch.reconnect(path, nowhere))
    assert path.exists() is stays
