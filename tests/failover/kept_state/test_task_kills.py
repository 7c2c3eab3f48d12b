"""A program that keeps its state is killed, or its power is cut, at any instant: it resumes from a commit, and no old one."""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import select
import signal
import struct
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from checkpoint.engines.cooperative.session import CooperativeSession, regions_of
from failover.kept_state.api import Task, open_task
from failover.kept_state.file_store import StateFile, folder_of
from failover.kept_state.state import KeptState
from failover.state import Schema
from tests.checkpoint.store.test_store_power import CuttingDisk, PowerCutError, laid_out

KILLS = int(os.environ.get("FAILOVER_TASK_KILLS", "200"))
SEED = int(os.environ.get("FAILOVER_SEED", str(random.randrange(1 << 32))))
SIZE = 96 << 10
"""Bytes of the array: enough that it lies in live memory, and is written as deltas."""
REPORT = struct.Struct("<cQ")


@dataclass
class Voyage:
    """A state that tells whether it is one commit: everything in it says the same number."""

    number: int = 0
    trail: list[int] = field(default_factory=lambda: [0] * 20)
    grid: NDArray[np.uint64] = field(default_factory=lambda: np.zeros(SIZE // 8, dtype=np.uint64))

    def sail(self) -> None:
        """Become the state of the next number."""
        self.number += 1
        self.trail[self.number % 20] = self.number
        self.grid[self.number % 24 * 512] = self.number
        self.grid[-1] = self.number

    def check(self) -> int:
        """Its number; fails unless it is just that state."""
        expected = Voyage()
        expected.number = max(self.number - 30, 0)
        while expected.number < self.number:
            expected.sail()
        assert self.grid[-1] == self.number
        for place in range(24):
            marks = range(self.number, max(self.number - 24, 0), -1)
            assert self.grid[place * 512] == next((mark for mark in marks if mark % 24 == place), 0)
        assert self.trail == expected.trail
        return self.number


def schema_of(name: str) -> Schema:
    return Schema.of(Voyage, Voyage(), name=name)


def opened(folder: Path) -> Task:
    return open_task("voyage", schema_of, lambda _: Voyage(), folder)


def sail_until_killed(folder: Path, reports: int) -> None:
    """Resume, say from where; then commit without end, and say what was waited for."""
    task = opened(folder)
    voyage: Voyage = task.value
    os.write(reports, REPORT.pack(b"r", voyage.check()))
    while True:
        voyage.sail()
        task.commit()
        if voyage.number % 7 == 0:
            task.wait_committed(30)
            os.write(reports, REPORT.pack(b"w", voyage.number))


def child_sailing(folder: Path) -> tuple[int, int]:
    """A process that sails until it is killed, and the pipe of its reports."""
    ours, theirs = os.pipe()
    pid = os.fork()
    if pid:
        os.close(theirs)
        return pid, ours
    try:
        sail_until_killed(folder, theirs)
    except BaseException as error:  # noqa: BLE001 - it must not run on as a second pytest
        os.write(2, f"the child failed: {error!r}\n".encode())
    finally:
        os._exit(1)


def test_killed_again_and_again_it_resumes_from_a_commit_no_older_than_the_last_one_waited_for(tmp_path: Path) -> None:
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    safe, furthest = 0, 0
    for _ in range(KILLS):
        pid, reports = child_sailing(tmp_path)
        assert select.select([reports], [], [], 60)[0], "the child resumes"
        time.sleep(dice.random() * 0.03)  # not a wait for anything: the instant of the kill
        os.kill(pid, signal.SIGKILL)
        assert os.waitpid(pid, 0)[1] == signal.SIGKILL
        said = REPORT.iter_unpack(read_all(reports))
        kind, resumed_at = next(said)
        assert kind == b"r"
        assert resumed_at >= safe, f"commit {safe} was said to be safe, seed {SEED}"
        safe = max([resumed_at, *(number for _, number in said)])
        furthest = max(furthest, safe)
    assert furthest > KILLS // 4, "the voyage must go on between kills, or this test shows nothing"


def read_all(descriptor: int) -> bytes:
    with open(descriptor, "rb") as file:
        content = file.read()
    return content[: len(content) // REPORT.size * REPORT.size]


# --- Power cuts ----------------------------------------------------------------------------------------------------------


def a_life_cut_short(root: Path, cut_at: int) -> tuple[CuttingDisk, int] | None:
    """Commits, each written before the next; what was written at the cut, or None when it came to its end."""
    disk = CuttingDisk(cut_at)
    disk.now[root.parent] = disk.safe[root.parent] = None
    voyage, safe = Voyage(), 0
    with contextlib.ExitStack() as after_death:  # what the kernel gives back of a process that dies
        try:
            file = StateFile(root, "voyage", disk)
            after_death.callback(file.close)
            state = KeptState(schema_of("voyage"))
            after_death.callback(state.live.close)
            session: CooperativeSession | None = None
            for _ in range(5):
                voyage.sail()
                state.commit(voyage)
                session = session or after_death.enter_context(
                    contextlib.closing(CooperativeSession(state.open_reader(), os.getpid(), "voyage"))
                )
                file.write(session)
                safe = voyage.number
                file.tidy()
        except PowerCutError:
            return disk, safe
    return None


@pytest.mark.timeout(240)
def test_power_may_be_cut_at_any_write_of_the_state_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("failover.kept_state.file_store.SMALL_PAGES", 1)  # deltas, so that folding is cut, too
    monkeypatch.setattr("failover.kept_state.file_store.TIDY_S", 0.0)
    monkeypatch.setattr("checkpoint.store.fold_rules.CHEAP_DELTA_COUNT", 2)
    resumed = KeptState(schema_of("voyage"))
    for cut_at in itertools.count():
        old = tmp_path / f"old{cut_at}"
        old.mkdir()
        cut = a_life_cut_short(folder_of("voyage", old), cut_at)
        if cut is None:
            break
        disk, safe = cut
        for names_written, content_written in itertools.product(("all", "half", "none"), repeat=2):
            new = tmp_path / f"new{cut_at}-{names_written}-{content_written}"
            new.mkdir()
            laid_out(disk.left(names_written, content_written), old, new)
            file = StateFile(folder_of("voyage", new), "voyage")
            snapshot = file.load()
            file.close()
            where = f"cut before change {cut_at}, names {names_written}, content {content_written}"
            if snapshot is None:
                assert safe == 0, where
                continue
            decoded = resumed.decode({region.name: content for region, content in regions_of(snapshot)})
            assert decoded.value.check() >= safe, where
    assert cut_at > 30
