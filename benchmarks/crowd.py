"""The time that one more thread, descriptor of each kind, and carried file adds to the freeze of a program."""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Final

from benchmarks.engine import PERIOD_S, capture
from benchmarks.figures import Figure
from benchmarks.running import running
from checkpoint.engine import NO_TERMS, Carry, Terms
from checkpoint.keeper import messages
from failover.cli.keeper_client import Keeper

KINDS: Final = ("thread", "file", "end of a pipe", "eventfd", "epoll", "unix socket", "UDP socket", "TCP socket")
"""In the order of `benchmarks.programs.crowded`."""
COUNTS: Final = (8, 64)
NAMES: Final = (500, 4_000)
DELTAS: Final = 20


def crowd(quick: bool, directory: Path) -> list[Figure]:
    """Freeze time with many of a kind, less that with none, by how many there are."""
    found = []
    for kind, name in enumerate(KINDS[: 2 if quick else None]):
        usual = statistics.median(_freezes_us(kind, 0, directory))
        for count in COUNTS:
            values = tuple((freeze - usual) / count for freeze in _freezes_us(kind, count, directory))
            found.append(Figure(f"one more {name}", f"of {count}", "µs", values))
    usual = statistics.median(_freezes_us(0, 0, directory))
    for count in NAMES[: 1 if quick else None]:
        folder = directory / f"carried-{count}"
        folder.mkdir()
        for number in range(count):
            (folder / str(number)).write_bytes(b"carried")
        values = tuple((freeze - usual) / count for freeze in _freezes_us(0, 0, directory, Terms(Carry((str(folder),)))))
        found.append(Figure("one more carried name", f"of {count}", "µs", values))
    return found


def _freezes_us(kind: int, count: int, directory: Path, terms: Terms = NO_TERMS) -> list[float]:
    """Of deltas, by the keeper's own account."""
    found: list[float] = []
    with running("crowded", kind, count, directory=directory) as program, Keeper.spawn() as keeper:
        keeper.ask(messages.Protect(program.pid, "/benchmark", terms=terms), messages.Protected)
        capture(keeper, base=True, sequence=1)
        for sequence in range(2, DELTAS + 2):
            time.sleep(PERIOD_S)
            captured = capture(keeper, base=False, sequence=sequence).told
            found.append(float(captured.freeze_us))
        keeper.ask(messages.Release(), messages.Released)
    return found
