"""A program of several processes, back from its snapshot and from its ready copy: until all of its processes run."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from benchmarks import engine, machine
from benchmarks.figures import Figure, Findings
from benchmarks.running import running
from checkpoint.keeper import messages
from checkpoint.linux.spawn import vessel
from checkpoint.linux.spawn.vessel import Birth
from failover.cli.keeper_client import Keeper


def families(quick: bool, directory: Path) -> Findings:
    """The same sizes as for one process."""
    found = []
    for megabytes in engine.SIZES_MB[: 2 if quick else None]:
        found += _of(megabytes, 3 if quick else 8, directory)
    return Findings(
        "Several processes",
        "Four processes that have so much memory between them, and share one megabyte: from the snapshot in memory, and from the "
        "order to a standby that has a ready copy of them, to the last one's being let go.",
        tuple(found),
    )


def _of(megabytes: int, count: int, directory: Path) -> list[Figure]:
    with running("family", megabytes, 40, directory=directory) as program, Keeper.spawn() as keeper:
        keeper.ask(messages.Protect(program.pid, "/benchmark"), messages.Protected)
        _, (content,) = keeper.ask(messages.Capture(base=True, generation=1, sequence=1, hold=True), messages.Captured)
        os.kill(program.pid, signal.SIGKILL)
    whole = tuple(_back_once(content, program.pid, megabytes, from_copy=False) for _ in range(count))
    ready = tuple(_back_once(content, program.pid, megabytes, from_copy=True) for _ in range(count))
    os.close(content)
    case = f"{megabytes} MB"
    return [Figure("restore of four", case, "ms", whole), Figure("takeover of four from a ready copy", case, "ms", ready)]


def _back_once(content: int, pid: int, megabytes: int, *, from_copy: bool) -> float:
    """Milliseconds from the order to the last one's being let go."""
    with Keeper.spawn() as keeper:
        keeper.ask(messages.Probe(os.getpid()), messages.Probed)  # a standby's keeper runs already
        machine.touch_memory(engine.ROOM * megabytes)
        began_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
        born = vessel.spawn_vessel(Birth(pid, isolate=True))
        order = messages.Restore(born.pid, "/benchmark")
        try:
            if from_copy:
                laid, _ = keeper.ask(messages.Lay(born.pid, "/benchmark"), messages.Laid, (content,))
                began_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME)
                keeper.ask(messages.Finish(order, laid.position), messages.Restored)
            else:
                keeper.ask(order, messages.Restored, (content,))
            resumed, _ = keeper.ask(messages.Resume(), messages.Resumed)
            return (resumed.let_go_ns - began_ns) / 1e6
        finally:
            keeper.ask(messages.Release(), messages.Released)
            vessel.discard(born)
