"""A control loop that commits: what it costs the loop that a file, or agents, take its commits meanwhile."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Final

from benchmarks.figures import OURS, Figure
from benchmarks.running import POLL_S, PROGRAMS, BenchmarkError
from failover.cli.demo.robots import Stage, means

CASES: Final = {
    "small": "a small dataclass",
    "big": "1 MB changed of 100 MB",
    "ordinary": "1 MB changed of 100 MB, an array in the default",
}
QUICK_CASES: Final = ("small",)
STEPS: Final = 1000
QUICK_STEPS: Final = 200
PAUSE_US: Final = 2000
"""Between two steps."""
PATIENCE_S: Final = 120.0

Started = Callable[[list[str], Path], AbstractContextManager[None]]


def loop(quick: bool, directory: Path) -> list[Figure]:
    """Each state in a loop that computes, commits and pauses; three times, by who takes its commits meanwhile."""
    steps = QUICK_STEPS if quick else STEPS
    found: list[Figure] = []
    for case in QUICK_CASES if quick else CASES:
        found += _measured(case, OURS, "kept", steps, directory / f"{case}-file", _alone)
        found += _measured(case, "failover, nobody takes it", "memory", steps, directory / f"{case}-memory", _alone)
        found += _measured(case, "failover, with two agents", "kept", steps, directory / f"{case}-agents", _with_agents)
    return found


@contextmanager
def _alone(command: list[str], folder: Path) -> Iterator[None]:
    """By itself: its file lies in the folder."""
    environment = os.environ | {"FAILOVER_STATE": str(folder)}
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, cwd=folder, env=environment, start_new_session=True)
    try:
        yield
    finally:
        process.kill()
        process.wait()


@contextmanager
def _with_agents(command: list[str], folder: Path) -> Iterator[None]:
    """Run by one of two robots, its commits kept by the other."""
    with Stage(folder / "robots", means()) as stage:
        stage.directory.mkdir()
        stage.start()
        with stage.robots[0].control() as link:
            link.ask("run", argv=command, name="loop", cwd=str(folder), wait=False, engine="cooperative")
        yield


def _measured(case: str, who: str, how: str, steps: int, folder: Path, started: Started) -> list[Figure]:
    folder.mkdir()
    output = folder / "times"
    command = [sys.executable, str(PROGRAMS / "committing.py"), case, how, str(steps), str(PAUSE_US), str(output)]
    with started(command, folder):
        deadline = time.monotonic() + PATIENCE_S
        while not output.exists():
            if time.monotonic() > deadline:
                raise BenchmarkError(f"a loop that commits ({case}, {who}) did not come to its end in {PATIENCE_S:.0f} s")
            time.sleep(POLL_S)
    rows = [tuple(map(int, line.split())) for line in output.read_text().splitlines()]
    name = f"{CASES[case]}, in a loop"
    return [
        Figure("time of a commit", name, "µs", tuple(committed / 1e3 for _, committed in rows), who),
        Figure("computing, and changing the state", name, "µs", tuple(computed / 1e3 for computed, _ in rows), who),
    ]
