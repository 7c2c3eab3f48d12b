"""A program to a file and back, by whole commands as a person types them: `failover capture` and `restore`, beside CRIU's."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from benchmarks import alternatives, engine, machine
from benchmarks.alternatives import Criu, call
from benchmarks.beside import fresh, images
from benchmarks.figures import OURS, Absent, Figure, Findings
from benchmarks.running import wait_until_gone
from checkpoint.keeper import messages
from checkpoint.linux.spawn import vessel
from checkpoint.linux.spawn.vessel import Born
from checkpoint.snapshot import format
from failover.cli.keeper_client import Keeper
from failover.cli.verbs import one_shot

SIZES_MB: Final = (100, 500)
COUNT: Final = 8
QUICK_COUNT: Final = 3
TO_FILE, BACK, SIZE = "to a file, the program is ended", "back from it, until it runs", "size of the file"

READY: Final = f"{OURS}, its keeper running"

Times = dict[str, list[float]]


def files(quick: bool, directory: Path) -> Findings:
    """One program after the other, ours and CRIU's in turns."""
    criu = Criu()
    figures: list[Figure] = []
    with images() as place:
        with fresh(place) as probe:
            reason = criu.why_absent(probe)
        makers: dict[str, Callable[[int, Path], Times]] = {OURS: _ours, READY: _ready}
        if not reason:
            makers[criu.name] = lambda pid, image: _theirs(criu, pid, image)
        for megabytes in SIZES_MB[: 1 if quick else None]:
            found: dict[tuple[str, str], list[float]] = {}
            for who, maker in list(makers.items()) * (QUICK_COUNT if quick else COUNT):
                for what, values in _once(maker, megabytes, directory, place).items():
                    found.setdefault((what, who), []).extend(values)
            figures += [
                Figure(what, f"{megabytes} MB", "MB" if what == SIZE else "ms", tuple(values), who)
                for (what, who), values in found.items()
            ]
    return Findings(
        "To a file and back, as commands",
        "`failover capture PID -o FILE` and `failover restore FILE`, from the start of the command to its end, beside "
        "`criu dump` and `criu restore`; files are in memory. Ours are encoded, and every byte is verified before it is used; "
        "the content, one page of chance again and again, compresses well. Ours contain the start of an interpreter and of two "
        "processes' modules, the command's and its keeper's; beside them the same orders to a keeper that runs already, as "
        "an agent's does.",
        tuple(sorted(figures, key=lambda figure: (TO_FILE, BACK, SIZE).index(figure.benchmark))),
        (Absent(criu.name, reason),) if reason else (),
    )


def _once(maker: Callable[[int, Path], Times], megabytes: int, directory: Path, place: Path) -> Times:
    machine.touch_memory(engine.ROOM * megabytes)
    with fresh(place) as image, engine.resident(megabytes, 40, directory) as pid:
        return maker(pid, image)


def _ours(pid: int, image: Path) -> Times:
    file = image / "snapshot"
    taken = _timed(lambda: _failover("capture", str(pid), "-o", str(file)))
    size = file.stat().st_blocks * 512 / 1e6
    os.waitpid(pid, 0)
    brought = _timed(lambda: _failover("restore", str(file)))
    _end_stranger(pid)
    return {TO_FILE: [taken], BACK: [brought], SIZE: [size]}


def _ready(pid: int, image: Path) -> Times:
    """The times of the commands' work, without their start."""
    file = image / "snapshot"
    with Keeper.spawn() as keeper:
        engine.wait_until_ready(keeper)
        taken = _timed(lambda: _to_file(keeper, pid, file))
    size = file.stat().st_blocks * 512 / 1e6
    with Keeper.spawn() as keeper:
        engine.wait_until_ready(keeper)
        born: list[Born] = []
        brought = _timed(lambda: born.append(_back(keeper, file)))
    vessel.discard(born[0])
    return {TO_FILE: [taken], BACK: [brought], SIZE: [size]}


def _to_file(keeper: Keeper, pid: int, file: Path) -> None:
    keeper.ask(messages.Protect(pid, "/benchmark"), messages.Protected)
    with open(file, "xb", buffering=0) as target:
        order = messages.Capture(base=True, generation=1, sequence=1, hold=True)
        keeper.ask(order, messages.Captured, (target.fileno(),))
        os.fsync(target.fileno())
    os.kill(pid, signal.SIGKILL)
    keeper.release()
    os.waitpid(pid, 0)


def _back(keeper: Keeper, file: Path) -> Born:
    descriptor = os.open(file, os.O_RDONLY | os.O_CLOEXEC)
    state = format.read_state(descriptor)
    born = vessel.spawn_vessel(one_shot.birth_of(state, 0, own_session=True))
    keeper.ask(messages.Restore(born.pid, state.component, follow=False), messages.Restored, (descriptor,))
    keeper.ask(messages.Resume(), messages.Resumed)
    keeper.release()
    os.close(descriptor)
    return born


def _theirs(criu: Criu, pid: int, image: Path) -> Times:
    taken = _timed(lambda: criu.dump_and_kill(pid, image))
    size = alternatives.size_of(image) / 1e6
    brought = _timed(lambda: criu.restore(image))
    os.kill(pid, signal.SIGKILL)
    os.waitpid(pid, 0)
    return {TO_FILE: [taken], BACK: [brought], SIZE: [size]}


def _failover(*words: str) -> None:
    call([sys.executable, "-m", "failover", *words])


def _end_stranger(pid: int) -> None:
    """End the program that was restored under its old PID: it is no child of ours."""
    os.kill(pid, signal.SIGKILL)
    wait_until_gone(pid)


def _timed(act: Callable[[], None]) -> float:
    """Milliseconds."""
    began = time.perf_counter()
    act()
    return (time.perf_counter() - began) * 1000
