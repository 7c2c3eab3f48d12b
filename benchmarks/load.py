"""Beside busy loops: how long programs stand still, how old their checkpoints are, and how long a takeover takes."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from benchmarks.engine import PERIOD_S, capture
from benchmarks.figures import Figure, Findings
from benchmarks.outage import COUNTING, Story, outages
from benchmarks.running import PROGRAMS, BenchmarkError, running
from checkpoint.engine import Terms
from checkpoint.errors import CheckpointError
from checkpoint.keeper import messages
from failover.cli.demo.robots import RobotMachine, Stage, means
from failover.cli.keeper_client import Keeper

LOADS: Final = (0, 2, 8)
"""Loops that calculate, beside what is measured."""
BUSY: Final = "while True: pass"

FROZEN: Final[dict[str, tuple[Any, ...]]] = {
    "100 MB, 400 KB written each 50 ms": ("resident", 100, 400),
    "200 threads": ("crowded", 0, 200),
    "1,000 files open": ("crowded", 1, 1_000),
    "a shell loop with constant children": ("shell",),
    "300 MB written a second": ("writing", 300),
    "300 MB written a second, a budget of 100 ms": ("writing", 300),
}
"""The program and its arguments, by case."""
BUDGETS_MS: Final = {"300 MB written a second, a budget of 100 ms": 100}
"""`freeze_budget_ms`: a freeze beyond it is given up, and after `freeze_overrun_s` one may take longer."""
OVERRUN_S: Final = 20
DELTAS: Final = 200
QUICK_DELTAS: Final = 40
DELTAS_S: Final = 60.0
"""A case ends then, whatever it has: beside eight loops a delta of the program that writes 300 MB/s takes seconds."""

KEPT: Final = {
    **{
        case: FROZEN[case]
        for case in ("100 MB, 400 KB written each 50 ms", "a shell loop with constant children", "300 MB written a second")
    },
    "2 GB that do not compress, 4 MB written each 50 ms": ("resident", 2_000, 4_000, 1),
}
"""Programs whose checkpoints' age is measured, with two agents."""
SPAN_S: Final = 30.0
QUICK_SPAN_S: Final = 10.0
POLL_S: Final = 0.05
PATIENCE_S: Final = 300.0
CUTS: Final = 5


def load(quick: bool, directory: Path, loads: tuple[int, ...] = LOADS) -> Findings:
    """Each case without a load, and with each."""
    figures: list[Figure] = []
    for case, (program, *arguments) in FROZEN.items():
        for count in loads:
            figures += _freezes(case, program, arguments, count, QUICK_DELTAS if quick else DELTAS, directory)
    for case in KEPT:
        for count in loads:
            figures += _ages(case, count, QUICK_SPAN_S if quick else SPAN_S, directory)
    for count in loads:
        with busy(count):
            argv = ("/usr/bin/python3", "-S", "-c", COUNTING)
            story = Story(_beside("1 program", count), argv, 1, 1 if quick else CUTS)
            figures.append(outages(story, directory))
    return Findings(
        "Beside busy loops",
        f"The same programs alone and beside {' and '.join(map(str, loads[1:]))} loops that calculate without a pause. "
        "*Freeze*: of deltas, twenty a second, by the keeper alone. *Age*: of the newest checkpoint that the other robot holds, "
        f"looked at each {POLL_S * 1e3:.0f} ms; two robots on this machine with all their processes, defaults. "
        "*First checkpoint*: of the program with all its memory, since it was started. *Power cut*: see Outage.",
        tuple(figures),
    )


def _beside(case: str, count: int) -> str:
    return f"{case}, {count} busy loops" if count else f"{case}, quiet"


def _freezes(case: str, program: str, arguments: list[int], count: int, deltas: int, directory: Path) -> Iterator[Figure]:
    freezes: list[float] = []
    given_up = 0
    with running(program, *arguments, directory=directory) as measured, busy(count), Keeper.spawn() as keeper:
        budget_ms = BUDGETS_MS.get(case, 0)
        terms = Terms(freeze_budget_ns=budget_ms * 1_000_000, freeze_overrun_ns=OVERRUN_S * 1_000_000_000)
        keeper.ask(messages.Protect(measured.pid, "/benchmark", terms=terms), messages.Protected)
        base, until = True, time.monotonic() + DELTAS_S
        for sequence in range(1, deltas + 2):
            if time.monotonic() > until:
                break
            time.sleep(PERIOD_S)
            try:
                taken = capture(keeper, base=base, sequence=sequence)
            except CheckpointError:
                given_up += 1
                continue
            if not base:
                freezes.append(taken.told.freeze_us / 1e3)
            base = False
        keeper.ask(messages.Release(), messages.Released)
    if freezes:
        yield Figure("freeze of a delta", _beside(case, count), "ms", tuple(freezes))
    yield Figure("captures that came to nothing", _beside(case, count), "", (float(given_up),))
    if budget_ms:
        beyond = sum(freeze_ms > budget_ms for freeze_ms in freezes)
        yield Figure("freezes beyond the budget", _beside(case, count), "", (float(beyond),))


def _ages(case: str, count: int, span_s: float, directory: Path) -> Iterator[Figure]:
    program, *arguments = KEPT[case]
    argv = ["/usr/bin/python3", str(PROGRAMS / f"{program}.py"), *map(str, arguments)]
    with Stage(directory / f"age-{program}-{arguments[:1]}-{count}", means()) as stage, busy(count):
        stage.directory.mkdir()
        stage.start()
        primary, standby = stage.robots
        began = time.monotonic()
        with primary.control() as link:
            link.ask("run", argv=argv, name="measured", cwd="/", wait=False, engine="ptrace")
        _until_held(standby)
        first_s = time.monotonic() - began
        ages = list(_looked_at(primary, span_s))
    yield Figure("first checkpoint at the other robot", _beside(case, count), "s", (first_s,))
    yield Figure("age of the newest checkpoint", _beside(case, count), "s", tuple(ages))


def _until_held(standby: RobotMachine) -> None:
    """Until it holds a checkpoint of the program with all its memory, which it has made before it says "ready"."""
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if any(b"ready" in log.read_bytes() for log in (standby.directory / "state" / "logs").glob("*/stdout.log")):
            return
        time.sleep(POLL_S)
    raise BenchmarkError(f"no checkpoint in {PATIENCE_S:.0f} s: {standby.last_words()}")


def _looked_at(robot: RobotMachine, span_s: float) -> Iterator[float]:
    until = time.monotonic() + span_s
    while time.monotonic() < until:
        for one in robot.status()["components"]:
            if one["lag_ms"] is not None:
                yield one["lag_ms"] / 1e3
        time.sleep(POLL_S)


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Beside so many loops."""
    tasks = [subprocess.Popen([sys.executable, "-S", "-c", BUSY]) for _ in range(count)]
    try:
        yield
    finally:
        for task in tasks:
            task.kill()
        for task in tasks:
            task.wait()
