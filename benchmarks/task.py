"""The cost of a commit for a program that keeps its own state, beside other ways of writing: in one run, for the ratios.

The others are on the disk when they return; a commit of ours is in shared memory and on its way. `and wait` is the fair one
to compare for a program that needs to know; the first line is for one that must not be late.
"""

from __future__ import annotations

import importlib
import os
import pickle
import shelve
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.figures import OURS, Figure, Findings
from benchmarks.loop import loop
from failover.kept_state.api import Task, open_task
from failover.kept_state.state import KeptState
from failover.state import Field, Schema

BIG = 100 << 20
CHANGED = 1 << 20
PAUSE_S = 0.002
"""Between two steps of a program. What runs after a pause runs with cold caches, several times slower, ours like the others."""


@dataclass
class Mission:
    """A state as programs have them: some numbers, a name, a plan."""

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    leg: int = 0
    name: str = "survey"
    plan: list[int] = field(default_factory=lambda: list(range(8)))


Case = tuple[str, Callable[[], object]]


def task(quick: bool, directory: Path) -> Findings:
    """A small dataclass; 1 MB changed inside an array of 100 MB."""
    figures = _measured("a small dataclass", _small(directory), _sail, 100 if quick else 400)
    figures += _measured("1 MB changed of 100 MB", _big(directory), _paint, 6 if quick else 15)
    figures += loop(quick, directory)
    return Findings(
        "Commit",
        "What a commit costs a Python program that keeps its own state, as the program sees it. Ours is in shared memory when it "
        "returns and on its way to the disk; the others are on the disk, as ours is after wait_committed. Then the same in a "
        "loop that computes for about half a millisecond before each commit and pauses for 2 ms after it: with the thread that "
        "writes the file beside it, with no reader, and at a robot whose agent takes its commits to another one.",
        tuple(figures),
    )


_mission = Mission()
_grid: dict[str, Any] = {}


def _sail() -> None:
    _mission.x += 1.5
    _mission.leg += 1


def _paint() -> None:
    turn = _grid["turn"] = _grid["turn"] + 1
    place = turn * 7 % (BIG // CHANGED - 1) * CHANGED
    _grid["grid"][place : place + CHANGED] = turn % 250 + 1


def _small(directory: Path) -> Iterator[Case]:
    kept = open_task("mission", lambda name: Schema.of(Mission, _mission, name=name), lambda *_: _mission, directory)
    yield from _ours(kept)
    yield from _others(directory / "small", lambda: _mission)


def _big(directory: Path) -> Iterator[Case]:
    fields = {"turn": Field(int, default=0), "grid": Field(np.ndarray, shape=(BIG,), dtype="u1")}

    def begin(state: KeptState) -> dict[str, Any]:
        _grid.update(turn=0, grid=state.array("grid", (BIG,), np.dtype("u1")))
        return _grid

    kept = open_task("map", lambda name: Schema.of_fields(fields, name=name), begin, directory)
    _grid["grid"][:] = 1
    for _ in range(4):  # each bank is filled once
        kept.commit()
        kept.wait_committed(60)
        _grid["turn"] += 1
    yield from _ours(kept)
    yield from _others(directory / "big", lambda: _grid)


def _ours(kept: Task) -> Iterator[Case]:
    """A commit; one that is waited for. Closed when the next case is asked for."""

    def commit_and_wait() -> None:
        kept.commit()
        kept.wait_committed(60)

    kept.commit()
    kept.wait_committed(60)
    yield OURS, kept.commit
    yield "failover, and wait_committed", commit_and_wait
    kept.close()


def _others(directory: Path, value: Callable[[], Any]) -> Iterator[Case]:
    directory.mkdir()
    yield "pickle, fsync, rename", lambda: _write_aside(directory / "pickled", pickle.dumps(value(), protocol=5))
    with shelve.open(str(directory / "shelf")) as shelf:
        yield "shelve, sync", lambda: _replace_entry(shelf, value())
    with closing(sqlite3.connect(directory / "rows")) as rows:
        rows.execute("CREATE TABLE states (name TEXT PRIMARY KEY, state BLOB)")
        yield "sqlite3 of a pickle", lambda: _replace_row(rows, pickle.dumps(value(), protocol=5))
    joblib = importlib.import_module("joblib")  # untyped
    yield "joblib, fsync, rename", lambda: _dump_aside(joblib, directory / "jobs", value())


def _write_aside(path: Path, content: bytes) -> None:
    with open(path.with_suffix(".new"), "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    path.with_suffix(".new").rename(path)


def _dump_aside(joblib: Any, path: Path, value: object) -> None:
    with open(path.with_suffix(".new"), "wb") as file:
        joblib.dump(value, file)
        file.flush()
        os.fsync(file.fileno())
    path.with_suffix(".new").rename(path)


def _replace_entry(shelf: shelve.Shelf[Any], value: Any) -> None:
    shelf["state"] = value
    shelf.sync()


def _replace_row(rows: sqlite3.Connection, content: bytes) -> None:
    with rows:
        rows.execute("INSERT OR REPLACE INTO states VALUES ('state', ?)", (content,))


def _measured(benchmark: str, cases: Iterator[Case], step: Callable[[], None], count: int) -> list[Figure]:
    """Each case in its turn, with pauses and without."""
    figures = []
    for name, act in cases:
        for pause_s in (PAUSE_S, 0.0):
            values = []
            for _ in range(count):
                step()
                began = time.perf_counter()
                act()
                values.append((time.perf_counter() - began) * 1e6)
                time.sleep(pause_s)
            case = f"{benchmark}, {f'each {pause_s * 1e3:.0f} ms' if pause_s else 'without pause'}"
            figures.append(Figure("time of a commit", case, "µs", tuple(values), name))
    return figures
