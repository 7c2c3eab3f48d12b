"""A standby that holds the state of a program, and whose store was damaged, or filled by an attacker.

The harm is done while the standby's agent is away and the other robot is lost, by the project's own writer where no checksum must
find it. Then the agent comes back and must take over: it says what is wrong, and runs nothing.
FAILOVER_HOSTILE=all tries everything; otherwise one of each kind.
"""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import pytest
from msgspec.structs import replace

from checkpoint.engines.cooperative.session import KIND
from checkpoint.keeper.messages import memfd_holding
from checkpoint.model import Snapshot
from checkpoint.pages.page_set import PageTable
from checkpoint.segment.layout import PAGE
from checkpoint.snapshot import format
from checkpoint.store.chain import position_of
from checkpoint.store.store import open_store
from failover.core.transitions.exits import TRIES_MAX
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_cooperative import protected
from tests.robot_processes import naming, parts

NAME: Final = "/demo/robot1/count"
SHOWN: Final = None if os.environ.get("FAILOVER_HOSTILE") == "all" else 1
"""How many of each kind are tried."""
Change = Callable[[Snapshot], Snapshot]


@dataclass(frozen=True, slots=True)
class Left:
    """A standby whose agent is away, and whose primary is gone.

    Attributes:
        state: everything that it holds, as it was.
    """

    robot: RobotMachine
    state: Path

    @contextmanager
    def back_from(self, harm: Callable[[Path], None]) -> Iterator[RobotMachine]:
        """Do harm to the store, let the agent come back, and end it in order afterwards."""
        state = self.robot.directory / "state"
        shutil.rmtree(state)
        shutil.copytree(self.state, state)
        harm(state / "store")
        robots.start_agent(self.robot)
        robots.until(lambda: robots.answers(self.robot), "the agent to be back")
        yield self.robot
        stop(self.robot)


def stop(robot: RobotMachine) -> None:
    robots.stop_agent(robot)
    robots.until(lambda: not parts(robot, "main_loop") and not parts(robot, "worker"), "the agent to be gone")


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Left]:
    folder = tmp_path_factory.mktemp("hostile")
    with robots.two_robots(folder, own_network=False) as (first, second):
        protected(first, second, folder)
        robots.keep_on(second)
        stop(second)
        first.cut_power()
        kept = folder / "kept"
        shutil.copytree(second.directory / "state", kept)
        yield Left(second, kept)


def proved(changed: Snapshot) -> Snapshot:
    """With the sums that go with it: no reader can tell that it was not captured so."""
    page_sum = PageTable.empty(PAGE).apply((), changed.runs, changed.contents, changed.vmas).page_sum
    changed = replace(changed, page_sum=page_sum)
    return replace(changed, position=position_of(changed, changed.position.generation, changed.position.sequence))


def with_regions(regions: Any) -> Change:
    """What its pages are said to be."""

    def changed(state: Snapshot) -> Snapshot:
        resources = tuple(
            replace(held, facts={**held.facts, "regions": regions}) if held.kind == KIND else held for held in state.resources
        )
        return replace(state, resources=resources)

    return changed


def with_state(written: bytes) -> Change:
    """Its first page, which begins with how many bytes the encoded state has."""

    def changed(state: Snapshot) -> Snapshot:
        return replace(state, contents=memoryview(written.ljust(PAGE, b"\0") + bytes(state.contents)[PAGE:]))

    return changed


def sized(encoded: bytes) -> bytes:
    return len(encoded).to_bytes(8, "little") + encoded


REFUSED: Final = "did not take its state"
"""What a robot's journal says of each program that ended so."""

OWNED: Final = Path("/tmp/failover-owned")
"""Would be there if a content were executed."""


REFUSED_BY_ITS_ROBOT: Final = {
    "a region of 2^62 bytes": (with_regions([[0, 1 << 62]]), "do not fill the pages"),
    "regions that are no list": (with_regions("all of it"), "does not describe its pages"),
    "a region less": (with_regions([]), "does not describe its pages"),
}
REFUSED_BY_THE_PROGRAM: Final = {
    "a pickle": (with_state(sized(b"cposix\nsystem\n(S'touch %s'\ntR." % str(OWNED).encode())), "StateFormatError"),
    "a length of 2^64": (with_state(b"\xff" * 8), "the stored state is cut off"),
    "no length at all": (with_state(b""), "the stored state is cut off"),
    "lists in lists": (with_state(sized(b"\x91" * 3000 + b"\xc0")), "StateFormatError"),
    "a giant list": (with_state(sized(b"\xdd\xff\xff\xff\xff")), "StateFormatError"),
}


def store_of(robot: RobotMachine) -> Path:
    return robot.directory / "state" / "store"


def rewrite(root: Path, change: Change) -> None:
    """Put a changed snapshot in the place of everything that is held of the program."""
    store = open_store(root)
    try:
        changed = proved(change(store.load(NAME)))
        store.drop(NAME)
        descriptor = memfd_holding(format.encode_bytes(changed), "hostile")
        try:
            store.put(descriptor)
        finally:
            os.close(descriptor)
    finally:
        store.close()


def damage(root: Path) -> None:
    """Turn over some bytes in the middle of every file."""
    for path in (*root.rglob("*.base"), *root.rglob("*.delta")):
        content = bytearray(path.read_bytes())
        middle = len(content) // 2
        content[middle : middle + 8] = bytes(255 - byte for byte in content[middle : middle + 8])
        path.write_bytes(content)


def cut_off(root: Path) -> None:
    """Leave half of every file."""
    for path in (*root.rglob("*.base"), *root.rglob("*.delta")):
        os.truncate(path, path.stat().st_size // 2)


def programs(robot: RobotMachine) -> list[int]:
    """Processes of the program."""
    return naming(robot, "counter.py")


@pytest.mark.parametrize("harm", [damage, cut_off][:SHOWN])
def test_a_damaged_state_is_refused_and_nothing_runs(left: Left, harm: Callable[[Path], None]) -> None:
    with left.back_from(harm) as robot:
        assert "it is not used" in robots.failover(robot, "status").stdout
        expect_nothing(robot)


@pytest.mark.skipif(SHOWN is not None, reason="only with FAILOVER_HOSTILE=all")
def test_the_same_way_an_unharmed_state_is_taken_over(left: Left) -> None:
    with left.back_from(lambda root: rewrite(root, lambda state: state)) as robot:
        robots.until(lambda: programs(robot), "the program to run")
        os.kill(programs(robot)[0], signal.SIGTERM)


@pytest.mark.parametrize("what", [*REFUSED_BY_ITS_ROBOT][:SHOWN])
def test_a_hostile_state_is_refused_and_nothing_runs(left: Left, what: str) -> None:
    change, reason = REFUSED_BY_ITS_ROBOT[what]
    with left.back_from(lambda root: rewrite(root, change)) as robot:
        robots.until(lambda: reason in robots.failover(robot, "status").stdout, "the reason to be shown")
        expect_nothing(robot)


@pytest.mark.parametrize("what", [*REFUSED_BY_THE_PROGRAM][:SHOWN])
def test_a_hostile_content_is_refused_by_the_program(left: Left, what: str) -> None:
    """To its robot a state is bytes. The program ends before its first step and says why, at each try; what is stored stays."""
    change, reason = REFUSED_BY_THE_PROGRAM[what]
    before = left.robot.log.read_text().count(REFUSED)
    with left.back_from(lambda root: rewrite(root, change)) as robot:
        robots.until(lambda: robot.log.read_text().count(REFUSED) - before >= TRIES_MAX, "the last try to fail")
        robots.until(lambda: reason in robots.failover(robot, "status").stdout, "the reason to be shown")
        expect_nothing(robot)


def expect_nothing(robot: RobotMachine) -> None:
    """No program runs, nothing of the hostile content did, and it lies there for whoever wants to look at it."""
    assert not programs(robot)
    assert not OWNED.exists()
    assert [path for path in store_of(robot).rglob("*") if path.suffix in (".base", ".delta")]
