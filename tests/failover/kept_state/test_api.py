"""The API by which an application keeps its state: used as by its author, in other processes where they end or are killed."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import re
import signal
import subprocess
import sys
import textwrap
import threading
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import failover
from checkpoint.store.disk import Disk
from failover.errors import FitError, KeepError, SchemaError
from failover.kept_state.api import PROCESS
from failover.kept_state.period import Activations

ROOT = Path(__file__).parents[3]


@dataclass
class Mission:
    """A small state."""

    leg: int = 0
    found: list[str] = field(default_factory=list)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """States lie in a folder of the test's own, and none is kept when it ends."""
    monkeypatch.setenv("FAILOVER_STATE", str(tmp_path))
    monkeypatch.delenv("FAILOVER_COMPONENT", raising=False)
    yield tmp_path
    PROCESS.release()


def again() -> None:
    """What the end of the process does."""
    PROCESS.release()


def test_every_public_name_is_there() -> None:
    assert all(getattr(failover, name) is not None for name in failover.__all__)


# The plain form


def test_a_state_is_there_again_as_it_was_committed() -> None:
    mission = failover.resume("mission", default=Mission())
    assert failover.resumed() is None
    mission.leg = 3
    mission.found.append("a well")
    assert failover.commit() == 1
    mission.leg = 4
    again()
    mission = failover.resume("mission", default=Mission())
    assert mission == Mission(3, ["a well"])
    resumed = failover.resumed()
    assert resumed is not None
    assert (resumed.why, resumed.generation, resumed.epoch, failover.epoch()) == ("restarted", 2, 0, 0)
    assert 0 <= resumed.age_s < 60
    assert resumed.robot == os.uname().nodename


def test_nothing_is_committed_that_the_program_did_not_commit(folder: Path) -> None:
    failover.resume("mission", default=Mission()).leg = 9
    again()
    assert failover.resume("mission", default=Mission()).leg == 0


def test_waiting_for_a_commit_says_that_it_survives(folder: Path) -> None:
    mission = failover.resume("mission", default=Mission())
    failover.wait_committed(1)
    mission.leg = 1
    failover.commit()
    failover.wait_committed(30)
    assert len(list(folder.glob("mission.state/@*/*.base"))) == 1


def test_a_damaged_state_is_refused_and_never_taken_for_a_beginning(folder: Path) -> None:
    failover.resume("mission", default=Mission(leg=7))
    failover.commit()
    again()
    stored = next(folder.glob("mission.state/@*/*.base"))
    content = bytearray(stored.read_bytes())
    content[len(content) // 2] ^= 4
    stored.write_bytes(content)
    for _ in range(2):
        with pytest.raises(failover.TaskError, match=r"to begin anew, move .*mission.state away"):
            failover.resume("mission", default=Mission())
    assert stored.exists()


def test_a_disk_that_hangs_costs_age_and_not_a_single_step(monkeypatch: pytest.MonkeyPatch) -> None:
    hangs, goes_on = threading.Event(), threading.Event()
    honest = Disk.sync_file

    def hanging(self: Disk, descriptor: int) -> None:
        hangs.set()
        goes_on.wait(60)
        honest(self, descriptor)

    monkeypatch.setattr(Disk, "sync_file", hanging)
    mission = failover.resume("mission", default=Mission())
    try:
        failover.commit()
        assert hangs.wait(60)
        for leg in range(1000):
            mission.leg = leg
            failover.commit()
        with pytest.raises(failover.NotCommittedError):
            failover.wait_committed(0.01)
    finally:
        goes_on.set()
    failover.wait_committed(60)
    again()
    assert failover.resume("mission", default=Mission()).leg == 999


def test_waiting_for_a_commit_that_was_not_made_says_so() -> None:
    mission = failover.resume("mission", default=Mission())
    failover.commit()
    failover.wait_committed(30)
    assert PROCESS.task is not None
    readers = [PROCESS.task.state.open_reader() for _ in range(3)]
    with contextlib.ExitStack() as held:
        for bank, reader in enumerate(readers):
            held.enter_context(reader._held(bank))
        mission.leg = 1
        assert failover.commit() == 1
        with pytest.raises(failover.NotCommittedError, match="commit again"):
            failover.wait_committed(30)
    assert failover.commit() == 2
    failover.wait_committed(30)
    for reader in readers:
        reader.close()


def test_a_full_disk_costs_age_and_is_said(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mission = failover.resume("mission", default=Mission())
    failover.commit()
    failover.wait_committed(30)

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("checkpoint.store.disk.Disk.sync_file", full)
        mission.leg = 5
        failover.commit()
        with pytest.raises(failover.NotCommittedError, match="free some space"):
            failover.wait_committed(0.5)
    failover.wait_committed(30)
    again()
    assert failover.resume("mission", default=Mission()).leg == 5


def test_a_transaction_commits_at_its_end_and_not_in_the_middle() -> None:
    mission = failover.resume("mission", default=Mission())
    with failover.transaction(mission) as same:
        assert same is mission
        mission.leg = 1
        with pytest.raises(failover.TaskError, match="at its end"):
            failover.commit()
        mission.leg = 2
    with pytest.raises(ZeroDivisionError), failover.transaction(mission):
        mission.leg = 1 // 0
    mission.leg = 3
    again()
    assert failover.resume("mission", default=Mission()).leg == 2


@pytest.mark.parametrize("call", [failover.commit, failover.wait_committed, failover.resumed, failover.activations])
def test_without_a_state_every_call_says_how_to_begin(call: object) -> None:
    with pytest.raises(failover.TaskError, match=r"failover.resume\("):
        call()  # type: ignore[operator]


@pytest.mark.parametrize("default", [0, 1.5, "text", b"bytes", None, (1, 2)])
def test_a_state_that_never_changes_is_refused(default: object) -> None:
    with pytest.raises(failover.TaskError, match="never changes"):
        failover.resume("mission", default=default)


def test_a_second_state_in_one_process_is_refused_with_what_to_do() -> None:
    failover.resume("mission", default=Mission())
    with pytest.raises(failover.TaskError, match="one dataclass"):
        failover.resume("other", default=Mission())


@pytest.mark.parametrize("name", ["", "/", "..", "a\0b"])
def test_a_name_that_is_none_is_refused(name: str) -> None:
    with pytest.raises(failover.TaskError, match="choose a word"):
        failover.resume(name, default=Mission())


def test_two_names_that_share_a_folder_do_not_share_a_state() -> None:
    failover.resume("/lab/mapper", default=Mission()).leg = 1
    failover.commit()
    again()
    with pytest.raises(failover.TaskError, match=re.escape("/lab/mapper")):
        failover.resume("lab.mapper", default=Mission())


def test_whoever_starts_the_program_may_name_it(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setenv("FAILOVER_COMPONENT", "/lab/robot1/mission")
    failover.resume("mission", default=Mission())
    assert (folder / "lab.robot1.mission.state").is_dir()


def test_a_value_that_cannot_be_kept_is_named_and_the_last_commit_stands() -> None:
    mission = failover.resume("mission", default=Mission())
    mission.leg = 1
    failover.commit()
    mission.leg, mission.found = 2, [object()]  # type: ignore[list-item]
    with pytest.raises(KeepError, match="found"):
        failover.commit()
    again()
    assert failover.resume("mission", default=Mission()) == Mission(1)


def test_a_state_that_no_longer_fits_is_refused_by_field_and_not_lost() -> None:
    failover.resume("mission", default=Mission(leg=7))
    failover.commit()
    again()

    @dataclass
    class Changed:
        leg: list[int] = field(default_factory=list)

    with pytest.raises(FitError, match="leg"):
        failover.resume("mission", default=Changed())
    assert failover.resume("mission", default=Mission()).leg == 7


def test_a_field_that_was_added_has_its_default_and_that_is_noted() -> None:
    failover.resume("mission", default=Mission(leg=7))
    failover.commit()
    again()

    @dataclass
    class Grown(Mission):
        battery: float = 1.0

    grown = failover.resume("mission", default=Grown())
    assert (grown.leg, grown.battery) == (7, 1.0)
    resumed = failover.resumed()
    assert resumed is not None and any("battery" in note for note in resumed.notes)


@dataclass
class Maps:
    """A state of arrays that come, grow and go."""

    number: int = 0
    images: dict[str, NDArray[np.uint8]] = field(default_factory=dict)
    blob: bytes = b""


def test_arrays_that_come_grow_and_go_are_what_they_were() -> None:
    dice = np.random.default_rng(7)
    state = failover.resume("maps", default=Maps())
    for number in range(1, 40):
        state.number = number
        name = f"image {number % 5}"
        if number % 7 == 0:
            state.images.pop(name, None)
        else:
            state.images[name] = dice.integers(0, 255, int(dice.integers(1, 300_000)), dtype=np.uint8)
        for image in state.images.values():
            image[0] = number
        state.blob = bytes(number * 900)
        failover.commit()
        if number % 6 == 0:
            kept = {name: image.copy() for name, image in state.images.items()}
            again()
            state = failover.resume("maps", default=Maps())
            assert (state.number, state.blob) == (number, bytes(number * 900))
            assert state.images.keys() == kept.keys()
            assert all(np.array_equal(state.images[name], kept[name]) for name in kept)


def test_a_live_array_that_goes_and_comes_back_or_changes_places_is_what_it_was() -> None:
    state = failover.resume("maps", default=Maps(images={name: np.full(200_000, 7, dtype=np.uint8) for name in "ab"}))
    failover.commit()
    again()
    state = failover.resume("maps", default=Maps())  # now they lie in live memory
    failover.commit()
    absent = state.images.pop("a")
    failover.commit()
    state.images["a"] = absent
    failover.commit()
    state.images["b"][5] = 8
    state.images = {"a": state.images["b"], "b": state.images["a"]}
    failover.commit()
    again()
    state = failover.resume("maps", default=Maps())
    assert state.images["a"][5] == 8 and (np.delete(state.images["a"], 5) == 7).all()
    assert (state.images["b"] == 7).all()


def test_a_part_of_a_live_array_is_kept_as_that_part_whatever_its_size_was_before() -> None:
    state = failover.resume("maps", default=Maps(images={"a": np.ones(400_000, dtype=np.uint8)}))
    failover.commit()
    again()
    state = failover.resume("maps", default=Maps())
    whole = state.images["a"]
    for size in (400_000, 150_000, 300_000, 70_000):
        state.images["a"] = whole[:size]
        whole[size - 1 :: 4096] = size % 251
        failover.commit()
        expected = whole[:size].copy()
    again()
    state = failover.resume("maps", default=Maps())
    assert np.array_equal(state.images["a"], expected)


def test_when_all_addresses_were_used_a_new_lineage_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("failover.kept_state.state.MAX_PLACES", 6)
    state = failover.resume("maps", default=Maps(images={"fixed": np.ones(100_000, dtype=np.uint8)}))
    for number in range(20):
        state.images.pop(f"image {number - 1}", None)
        state.images[f"image {number}"] = np.full(9000, number, dtype=np.uint8)
        state.images["fixed"][number] = number
        assert failover.commit() == number + 1
        failover.wait_committed(30)
    again()
    images = failover.resume("maps", default=Maps()).images
    assert images.keys() == {"fixed", "image 19"}
    assert (images["image 19"] == 19).all() and images["fixed"][:21].tolist() == [*range(20), 1]


def test_more_arrays_than_a_segment_has_regions_are_refused_and_the_last_commit_stands() -> None:
    state = failover.resume("maps", default=Maps(number=1))
    failover.commit()
    state.images = {f"image {number}": np.ones(5000, dtype=np.uint8) for number in range(1100)}
    with pytest.raises(KeepError, match="more than 1023 arrays"):
        failover.commit()
    again()
    state = failover.resume("maps", default=Maps())
    assert state == Maps(number=1)
    state.images = {f"image {number}": np.ones(5000, dtype=np.uint8) for number in range(1100)}
    with pytest.raises(KeepError, match="more than 1023 arrays"):
        failover.commit()
    state.images = {"image 7": np.full(5000, 7, dtype=np.uint8)}
    failover.commit()
    again()
    assert (failover.resume("maps", default=Maps()).images["image 7"] == 7).all()


def test_a_forked_child_may_not_commit_the_state_of_its_parent() -> None:
    mission = failover.resume("mission", default=Mission())
    failover.commit()
    pid = os.fork()
    if pid == 0:
        try:
            mission.leg = 1
            failover.commit()
            os._exit(1)
        except failover.TaskError as error:
            os._exit(0 if "child" in str(error) else 2)
    assert os.waitpid(pid, 0)[1] == 0
    mission.leg = 2
    failover.commit()
    again()
    assert failover.resume("mission", default=Mission()).leg == 2


# Components


@failover.component(name="/lab/robot1/mapper")
class Mapper:
    """As in the documentation."""

    pose: Mission = failover.kept(default=Mission())
    grid: NDArray[np.uint8] = failover.kept(shape=(512, 512), dtype=np.uint8)
    rounds: int = failover.kept(default=0)

    def __init__(self) -> None:
        self.rounds = self.rounds  # may read what is kept
        self.driver = "open"
        self.resumed: failover.Resumed | None = None

    def on_resume(self, resumed: failover.Resumed) -> None:
        self.resumed = resumed

    def step(self) -> object:
        self.rounds += 1
        self.pose.leg += 2
        self.grid[self.rounds, :] = self.rounds
        return failover.FINISHED if self.rounds % 5 == 0 else None


def test_a_component_goes_on_where_it_was() -> None:
    first = failover.run(Mapper)
    assert first.resumed is None and first.rounds == 5
    second = failover.run(Mapper)
    assert second.resumed is not None and second.resumed.generation == 2
    assert (second.rounds, second.pose.leg, second.driver) == (10, 20, "open")
    assert [int(row[3]) for row in second.grid[:12]] == [*range(11), 0]


def test_a_component_made_by_hand_has_its_first_values_to_itself() -> None:
    one, other = Mapper(), Mapper()
    one.step()
    assert (one.rounds, one.pose.leg, int(one.grid[1, 0])) == (1, 2, 1)
    assert (other.rounds, other.pose.leg, int(other.grid[1, 0])) == (0, 0, 0)


def test_what_init_sets_is_a_beginning_and_does_not_undo_a_resume() -> None:
    @failover.component(name="counter")
    class Counter:
        count: int = failover.kept(default=0)

        def __init__(self) -> None:
            self.count = 100

        def step(self) -> object:
            self.count += 1
            return failover.FINISHED

    assert failover.run(Counter).count == 101
    assert failover.run(Counter).count == 102


def test_a_step_that_raises_is_not_committed() -> None:
    @failover.component(name="fragile")
    class Fragile:
        count: int = failover.kept(default=0)

        def step(self) -> object:
            self.count += 1
            if self.count == 3:
                raise ValueError("three")
            return None

    for _ in range(2):
        with pytest.raises(ValueError, match="three"):
            failover.run(Fragile)
    assert failover.resume("fragile", default={}) == {"count": 2}


def test_a_component_may_be_asynchronous() -> None:
    @failover.component(name="driver", every=0.001)
    class Driver:
        count: int = failover.kept(default=0)

        async def on_resume(self, resumed: failover.Resumed) -> None:
            await asyncio.sleep(0)
            self.count += 1000

        async def step(self) -> object:
            await asyncio.sleep(0)
            self.count += 1
            return failover.FINISHED if self.count % 10 == 0 else None

    assert failover.run(Driver).count == 10
    assert failover.run(Driver).count == 1020


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ({"step": lambda self: None}, "keeps nothing"),
        ({"count": failover.kept(default=0)}, "no step"),
    ],
)
def test_a_class_that_is_no_component_is_refused_with_what_it_lacks(body: dict[str, object], why: str) -> None:
    with pytest.raises(failover.TaskError, match=why):
        failover.component(type("Lacking", (), body))


@pytest.mark.parametrize("decorator", [failover.component, failover.resumable])
def test_a_name_that_is_not_said_to_be_one_is_refused_with_what_to_write(decorator: Callable[[str], object]) -> None:
    with pytest.raises(failover.TaskError, match=r"\(name='mapper'\)"):
        decorator("mapper")


def test_a_class_that_is_not_declared_is_not_run() -> None:
    class Plain:
        def step(self) -> None: ...

    with pytest.raises(failover.TaskError, match=r"@failover\.component"):
        failover.run(Plain)


def test_an_attribute_is_kept_in_one_way() -> None:
    with pytest.raises(SchemaError, match="say default="):
        failover.kept(default=1, factory=int)  # type: ignore[call-overload]


def test_late_steps_are_counted_and_delay_no_later_one() -> None:
    period = 100
    steps = Activations(period, 1000)
    assert steps.next_ns(1010) == 1100
    assert steps.next_ns(1110) == 1200
    assert steps.overruns == 0
    assert steps.next_ns(1450) == 1500
    assert steps.overruns == 2
    assert steps.next_ns(1510) == 1600
    assert steps.overruns == 2
    assert Activations(0, 0).next_ns(77) == 77


# Functions


def test_a_generator_goes_on_from_its_last_yield() -> None:
    @failover.resumable
    def survey(state: Mission) -> Iterator[None]:
        while state.leg < 10:
            state.leg += 1
            yield
            if state.leg == 4:
                state.found.append("never committed")
                raise ConnectionError

    with pytest.raises(ConnectionError):
        survey(Mission())
    assert survey(Mission(-5)) == Mission(10)


def test_a_function_may_commit_by_itself() -> None:
    @failover.resumable(name="count")
    def counted(state: Mission) -> None:
        state.leg += 1
        failover.commit()

    assert [counted(Mission()).leg for _ in range(3)] == [1, 2, 3]


def test_coroutines_and_asynchronous_generators_are_resumable() -> None:
    @failover.resumable(name="count")
    async def counted(state: Mission) -> None:
        await asyncio.sleep(0)
        state.leg += 1

    @failover.resumable(name="count")
    async def yielding(state: Mission) -> AsyncIterator[None]:
        state.leg += 10
        yield
        state.leg += 100

    assert asyncio.run(counted(Mission())).leg == 1
    assert asyncio.run(yielding(Mission())).leg == 111


# Processes


def program(folder: Path, text: str) -> Path:
    path = folder / "program.py"
    path.write_text(textwrap.dedent(text))
    return path


@contextmanager
def started(path: Path) -> Iterator[subprocess.Popen[str]]:
    pipe = subprocess.PIPE
    command = [sys.executable, "-W", "ignore:This process:DeprecationWarning", path]  # of a fork, from Python 3.12 on
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True, cwd=path.parent) as process:
        try:
            yield process
        finally:
            process.kill()


def snippet_of_the_readme() -> str:
    found = re.search(r"```python\n(import failover.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert found is not None, "README shows a program that keeps its state"
    return found[1]


def test_the_counter_of_the_readme_is_killed_and_goes_on(folder: Path) -> None:
    text = snippet_of_the_readme()
    assert len(text.splitlines()) == 5
    path = program(folder, text)
    runs: list[list[int]] = []
    for _ in range(2):
        with started(path) as process:
            assert process.stdout is not None
            lines = [int(process.stdout.readline()) for _ in range(5)]
            while not any(folder.glob("*.state/**/*.base")):  # the disk may be slow
                lines.append(int(process.stdout.readline()))
            process.kill()
            runs.append([*lines, *map(int, process.stdout)])
    assert runs[0][0] == 1
    assert runs[1][0] > 1, "it went on, it did not begin again"
    lines = [*runs[0], *runs[1]]
    steps = [later - earlier for earlier, later in itertools.pairwise(lines)]
    assert [step for step in steps if step > 1] == [], "no number is left out"
    assert sum(step < 1 for step in steps) <= 1, "only what was not committed is counted again"


def test_two_processes_do_not_keep_one_state(folder: Path) -> None:
    path = program(
        folder,
        """
        import failover, sys
        state = failover.resume("counter", default={"n": 0})
        print("kept", flush=True)
        sys.stdin.read()
        """,
    )
    with started(path) as process:
        assert process.stdout is not None and process.stdout.readline() == "kept\n"
        with pytest.raises(failover.StateTakenError, match="another process has it"):
            failover.resume("counter", default={"n": 0})
        process.communicate()
    failover.resume("counter", default={"n": 0})


def test_a_child_that_outlives_its_parent_does_not_keep_the_state_from_the_next_one(folder: Path) -> None:
    path = program(
        folder,
        """
        import failover, os, sys
        state = failover.resume("counter", default={"n": 0})
        state["n"] = 5
        failover.commit()
        failover.wait_committed(60)
        if os.fork() == 0:
            print("child", flush=True)
            sys.stdin.read()
            os._exit(0)
        sys.stdin.read()
        """,
    )
    with started(path) as process:
        assert process.stdout is not None and process.stdout.readline() == "child\n"
        process.kill()
        process.wait()
        assert failover.resume("counter", default={"n": 0}) == {"n": 5}


def test_a_child_may_keep_a_state_of_its_own(folder: Path) -> None:
    path = program(
        folder,
        """
        import failover, os, sys
        state = failover.resume("parent", default={"n": 0})
        failover.commit()
        if os.fork() == 0:
            state = failover.resume("child", default={"n": 0})
            state["n"] = 7
            failover.commit()
            sys.exit()
        os.wait()
        state["n"] = 5
        failover.commit()
        """,
    )
    with started(path) as process:
        assert process.communicate(timeout=60) == ("", "")
    assert failover.resume("parent", default={}) == {"n": 5}
    again()
    assert failover.resume("child", default={}) == {"n": 7}


def test_no_child_is_forked_while_the_first_write_builds_what_all_writes_need(folder: Path) -> None:
    """It would have half of it: modules half loaded, decoders half built, of which C code takes no notice."""
    path = program(
        folder,
        """
        import failover, os, sys, threading, time
        from checkpoint.snapshot import format

        begun, steps, read_outline = threading.Event(), [], format.read_outline

        def slow(descriptor):
            begun.set()
            time.sleep(0.3)
            steps.append("built")
            return read_outline(descriptor)

        format.read_outline = slow
        failover.resume("parent", default={"n": 0})
        failover.commit()
        begun.wait()
        child = os.fork()
        if child == 0:
            failover.resume("child", default={"n": 0})["n"] = len(steps)
            failover.commit()
            sys.exit()
        sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
        """,
    )
    with started(path) as process:
        assert process.communicate(timeout=60) == ("", "")
        assert process.returncode == 0
    assert failover.resume("child", default={}) == {"n": 1}


@pytest.mark.parametrize("way", ["def", "async def"])
def test_the_end_of_a_program_writes_its_last_commit_and_sigterm_ends_it_between_steps(folder: Path, way: str) -> None:
    path = program(
        folder,
        f"""
        import failover

        @failover.component(name="slow", every=3600)
        class Slow:
            count: int = failover.kept(default=0)
            {way} step(self) -> None:
                self.count += 1
                print("stepped", flush=True)

        failover.run(Slow)
        print("ended well", flush=True)
        """,
    )
    with started(path) as process:
        assert process.stdout is not None and process.stdout.readline() == "stepped\n"
        process.send_signal(signal.SIGTERM)
        rest, errors = process.communicate(timeout=60)
    assert (rest, process.returncode) == ("ended well\n", 0), errors
    assert failover.resume("slow", default={}) == {"count": 1}


def test_no_library_that_it_does_not_need_is_loaded_into_the_program(folder: Path) -> None:
    path = program(
        folder,
        """
        import failover, sys
        state = failover.resume("counter", default={"n": 0})
        for _ in failover.every(0):
            break
        print([name for name in sys.modules if name.split(".")[0] in ("ptrace", "zmq", "psutil", "rich", "asyncio")])
        """,
    )
    with started(path) as process:
        rest, errors = process.communicate(timeout=60)
    assert rest.strip() == "[]", errors


def test_a_user_who_checks_types_strictly_gets_no_any(folder: Path) -> None:
    path = program(
        folder,
        """
        from collections.abc import Iterator
        from dataclasses import dataclass
        import numpy as np
        from numpy.typing import NDArray
        import failover

        @dataclass
        class Mission:
            leg: int = 0

        state = failover.resume("mission", default=Mission())
        reveal_type(state)
        with failover.transaction(state) as same:
            reveal_type(same)

        @failover.component(name="mapper", every=0.1)
        class Mapper:
            pose: Mission = failover.kept(default=Mission())
            grid: NDArray[np.uint8] = failover.kept(shape=(512, 512), dtype=np.uint8)
            def on_resume(self, resumed: failover.Resumed) -> None: ...
            def step(self) -> None:
                reveal_type(self.pose)

        reveal_type(failover.run(Mapper))

        @failover.resumable
        def survey(state: Mission) -> Iterator[None]:
            yield

        @failover.resumable(name="drive")
        async def drive(state: Mission) -> None: ...

        reveal_type(survey(Mission()))
        reveal_type(drive)
        """,
    )
    command = [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", str(path)]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env={**os.environ, "MYPYPATH": str(ROOT)})
    revealed = re.findall(r'Revealed type is "(.*)"', ran.stdout)
    shown = [re.sub(r"\b[\w.]+\.(?=\w)", "", text) for text in revealed]
    assert "error" not in ran.stdout, ran.stdout
    assert shown[:6] == ["Mission", "Mission", "Mission", "Mapper", "Mission", "def (Mission) -> Coroutine[Any, Any, Mission]"], (
        shown
    )
