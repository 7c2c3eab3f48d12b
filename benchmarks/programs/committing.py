"""A control loop that keeps its state: each step computes for about half a millisecond, then commits.

``python3 committing.py CASE HOW STEPS PAUSE_US OUTPUT`` writes STEPS lines of two numbers to OUTPUT: nanoseconds that the
computing took, and the commit; then it sleeps for ever.

CASE: ``small``, a dataclass; ``big``, 1 MB changed inside an array of 100 MB; ``ordinary``, the same, the array handed over in
the default. HOW: ``kept`` as ever, beside a file or under an agent; ``memory``, only shared memory: no reader takes it.
"""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from failover.kept_state.api import Task, open_task
from failover.kept_state.state import KeptState
from failover.state import Field, Schema

BIG = 100 << 20
CHANGED = 1 << 20
WORK = 12_000
"""Rounds of a loop in Python: some half a millisecond."""
WARM_STEPS = 20
"""Not counted: each bank is filled once."""


@dataclass
class Mission:
    """A state as programs have them: some numbers, a name, a plan."""

    x: float = 0.0
    y: float = 0.0
    heading: float = 0.0
    leg: int = 0
    name: str = "survey"
    plan: list[int] = field(default_factory=lambda: list(range(8)))

    def step(self) -> None:
        """A little of it changes."""
        self.x += 1.5
        self.leg += 1


def small() -> tuple[Task, Callable[[], None]]:
    """A dataclass."""
    mission = Mission()
    return open_task("mission", lambda name: Schema.of(Mission, mission, name=name), lambda *_: mission), mission.step


def big(is_live: bool) -> tuple[Task, Callable[[], None]]:
    """An array, in live memory or where numpy has put it."""
    fields = {"turn": Field(int, default=0), "grid": Field(np.ndarray, shape=(BIG,), dtype="u1")}
    values: dict[str, Any] = {"turn": 0}

    def begin(state: KeptState) -> dict[str, Any]:
        values["grid"] = state.array("grid", (BIG,), np.dtype("u1")) if is_live else np.zeros(BIG, "u1")
        values["grid"][:] = 1
        return values

    def step() -> None:
        values["turn"] += 1
        place = values["turn"] * 7 % (BIG // CHANGED - 1) * CHANGED
        values["grid"][place : place + CHANGED] = values["turn"] % 250 + 1

    return open_task("map", lambda name: Schema.of_fields(fields, name=name), begin), step


def work() -> int:
    """Compute as a program does between two commits."""
    total = 0
    for number in range(WORK):
        total += number & 7
    return total


def main() -> None:
    """Measure, write, wait to be ended."""
    case, how, steps, pause_us, output = sys.argv[1:]
    task, step = small() if case == "small" else big(case == "big")
    commit: Callable[[], object] = task.commit if how == "kept" else lambda: task.state.commit(task.value)
    commit()
    if how == "kept":
        task.wait_committed(60)  # from now on a reader takes them
    lines = []
    for _ in range(int(steps) + WARM_STEPS):
        began = time.perf_counter_ns()
        work()
        step()
        computed = time.perf_counter_ns()
        commit()
        lines.append(f"{computed - began} {time.perf_counter_ns() - computed}\n")
        time.sleep(int(pause_us) / 1e6)
    aside = Path(output).with_suffix(".new")
    aside.write_text("".join(lines[WARM_STEPS:]))
    aside.rename(output)
    while True:
        time.sleep(1)
        task.commit()


if __name__ == "__main__":
    main()
