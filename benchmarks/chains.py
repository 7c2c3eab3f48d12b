"""A base and its deltas: brought back, laid as a ready copy, and folded by a store; how long, and in how much memory."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks import engine, machine
from benchmarks.figures import Figure, Findings
from checkpoint.keeper import messages
from checkpoint.linux.spawn import vessel
from checkpoint.linux.spawn.vessel import Birth
from checkpoint.store.store import open_store
from failover.cli.keeper_client import Keeper

MEGABYTES = 500
DELTAS = 64
"""After so many a store folds a chain of a large program."""
RESTORED = 8
"""Files of it that are brought back."""
COUNT = 5
XOR_CACHE = 64 << 20


def chains(quick: bool, directory: Path) -> Findings:
    """One program's chain, kept in memory."""
    megabytes = 100 if quick else MEGABYTES
    pid, files = _chain(megabytes, directory)
    case, figures = f"{megabytes} MB", []
    few = files[:RESTORED]

    def restored(keeper: Keeper, born: int) -> None:
        keeper.ask(messages.Restore(born, "/benchmark", follow=False), messages.Restored, few)
        keeper.ask(messages.Resume(), messages.Resumed)

    def laid(keeper: Keeper, born: int) -> None:
        keeper.ask(messages.Lay(born, "/benchmark"), messages.Laid, few)

    for what, obey in (("restore", restored), ("laying of a ready copy", laid)):
        found = [_measured(obey, pid, megabytes) for _ in range(2 if quick else COUNT)]
        figures += [
            Figure(f"{what}, a base and {RESTORED - 1} deltas", case, "ms", tuple(ms for ms, _ in found)),
            Figure(f"… the most that its keeper held, besides {case}", case, "MB", tuple(mb for _, mb in found)),
        ]
    folds = [_folded_once(files, directory / f"store{turn}") for turn in range(2 if quick else COUNT)]
    figures += [
        Figure(f"fold, a base and {DELTAS} deltas, processor time", case, "ms", tuple(ms for ms, _ in folds)),
        Figure("… the most that its process held", case, "MB", tuple(mb for _, mb in folds)),
    ]
    for one in files:
        os.close(one)
    story = (
        "A program that writes 400 KB each 50 ms, its snapshots as they travel. A keeper that runs already restores the first "
        f"{RESTORED}, or lays a ready copy of them; a store folds all {DELTAS + 1} into one base, in a process of its own."
    )
    return Findings("Chains", story, tuple(figures))


def _chain(megabytes: int, directory: Path) -> tuple[int, tuple[int, ...]]:
    """The PID of a program that has been killed, and its snapshots: a base first."""
    files = []
    with engine.resident(megabytes, 400, directory) as pid, Keeper.spawn() as keeper:
        keeper.ask(messages.Protect(pid, "/benchmark"), messages.Protected)
        for sequence in range(1, DELTAS + 2):
            order = messages.Capture(base=sequence == 1, generation=1, sequence=sequence, xor_cache=XOR_CACHE)
            captured, (content,) = keeper.ask(order, messages.Captured)
            keeper.tell(messages.Acknowledge(captured.position))
            files.append(content)
            time.sleep(engine.PERIOD_S)
        os.kill(pid, signal.SIGKILL)
    return pid, tuple(files)


def _measured(obey: Callable[[Keeper, int], object], pid: int, megabytes: int) -> tuple[float, float]:
    """Milliseconds from a vessel's birth until orders about it are obeyed, and MB that the keeper held at most."""
    with Keeper.spawn() as keeper:
        engine.wait_until_ready(keeper)
        machine.touch_memory(engine.ROOM * megabytes)
        began = time.perf_counter()
        born = vessel.spawn_vessel(Birth(pid))
        obey(keeper, born.pid)
        found = (time.perf_counter() - began) * 1000, _peak_mb(keeper.pid)
    vessel.discard(born)
    return found


def _peak_mb(pid: int) -> float:
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024 / 1e6
    raise AssertionError("a process that lives has memory")


def _folded_once(files: tuple[int, ...], place: Path) -> tuple[float, float]:
    """Milliseconds of a processor, and MB that the process held at most."""
    command = [sys.executable, "-m", "benchmarks.chains", str(place), *map(str, files)]
    told = subprocess.run(command, pass_fds=files, check=True, capture_output=True, text=True).stdout.split()
    return float(told[0]), float(told[1])


def _fold(place: Path, files: tuple[int, ...]) -> None:
    """Keep them in a store, which is what another process has done, and fold them; print what that took."""
    store = open_store(place)
    try:
        position = [store.put(one, prove=False).position for one in files][-1]
        (component,) = store.components()
        began = time.process_time()
        store.fold(component, position)
        print((time.process_time() - began) * 1000, _peak_mb(os.getpid()))
    finally:
        store.close()


if __name__ == "__main__":
    _fold(Path(sys.argv[1]), tuple(map(int, sys.argv[2:])))
