"""The cost of protection: of the program's work at 1, 10 and 50 snapshots a second, of processor, network and memory."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from benchmarks import interference
from benchmarks.figures import OURS, Figure, Findings
from benchmarks.interference import NAME, NO_COPY, ON_LOOPBACK, UNPROTECTED, WINDOW_S
from benchmarks.running import PROGRAMS, BenchmarkError, Running, running
from failover.cli.demo.robots import RobotMachine, Stage, means

RATES: Final = (1, 10, 50)
"""Snapshots a second."""
QUICK_RATES: Final = (10,)
RESIDENT_MB: Final = 100
DIRTY_KB: Final = 200
"""Written each 50 ms: 4 MB/s."""
TURNS: Final = 4

SMALL: Final = "small"
SMALL_DIRTY_KB: Final = 100
SMALL_PERIOD_MS: Final = 100
SMALL_S: Final = 20.0
QUICK_SMALL_S: Final = 5.0
STANDBYS_SNAPSHOTS: Final = 20
"""That the standby has before it counts: the first ones are larger, and its copy is laid meanwhile."""

CELLS: Final = 60_000
CHANGES: Final = 300
"""Of the map's cells, and how many are replaced each 50 ms."""
SNAPSHOTS: Final = 40
QUICK_SNAPSHOTS: Final = 8
WHOLE: Final = "failover, without differences"
MANY: Final = 8
MANY_RESIDENT_MB: Final = 10
MANY_SNAPSHOTS: Final = 20
"""Of each, before its keeper counts: what a keeper shares grows less as it is used."""
IDLE_S: Final = 60.0
QUICK_IDLE_S: Final = 3.0

TICKS_A_SECOND: Final = os.sysconf("SC_CLK_TCK")
PARTS: Final = {
    "agent.main": "main loop",
    "agent.worker.process": "worker",
    "agent.guard.server": "guard",
    "checkpoint keeper": "keeper",
}
"""By what stands in their command line."""


def costs(quick: bool, directory: Path) -> Findings:
    """All of it, on robots of their own each."""
    figures: list[Figure] = []
    for number in QUICK_RATES if quick else RATES:
        figures += _of_work(number, 1 if quick else TURNS, directory / f"work-{number}")
    figures += _of_small_deltas(1 if quick else TURNS, QUICK_SMALL_S if quick else SMALL_S, directory / "small")
    for who, settings in ((OURS, ""), (WHOLE, 'xor_cache = ""\n')):
        figures.append(_on_the_wire(who, settings, QUICK_SNAPSHOTS if quick else SNAPSHOTS, directory / f"wire-{len(settings)}"))
    figures += _of_many(2 if quick else MANY, directory / "many")
    figures += _idle(QUICK_IDLE_S if quick else IDLE_S, directory / "idle")
    return Findings(
        "What protection takes",
        f"The work of a Python program with {RESIDENT_MB} MB resident that writes 4 MB/s, protected and released in turns, "
        f"{WINDOW_S:g} s each, by snapshots a second, on a machine that plays both robots, without a ready copy; processor time "
        "of the processes of the robot that runs it. Bytes of a delta's file, which is what travels, per byte of its pages: of a "
        f"Python program with {CELLS:,} objects in a dictionary, {CHANGES} of them replaced each 50 ms. Of small deltas "
        f"({SMALL_DIRTY_KB} KB in {RESIDENT_MB} MB, each {SMALL_PERIOD_MS} ms; the standby keeps a ready copy, where robots can "
        "have PIDs of their own): processor time of every process of both robots by delta, beats included. Memory of what "
        f"protects {MANY} programs of {MANY_RESIDENT_MB} MB, by robot, what waits in advance included. What an agent takes that "
        "protects nothing (beats each 20 ms).",
        tuple(figures),
    )


def _of_work(number: int, turns: int, directory: Path) -> list[Figure]:
    """At so many snapshots a second."""
    directory.mkdir()
    settings = f"snapshot_period_ms = {1000 // number}\n{NO_COPY}"
    case = f"{number} snapshots a second"
    protected: list[float] = []
    released: list[float] = []
    made: list[float] = []
    taken: dict[str, list[float]] = {}
    with (
        Stage(directory / "robots", ON_LOOPBACK, settings) as stage,
        running("working", RESIDENT_MB, DIRTY_KB, directory=directory) as program,
    ):
        stage.directory.mkdir()
        stage.start()
        for _ in range(turns):
            released.append(interference.rate(program))
            work, snapshots, shares = _protected(stage.robots[0], program)
            protected.append(work)
            made.append(snapshots)
            for part, share in shares.items():
                taken.setdefault(part, []).append(share)
    return [
        Figure("work done a second", case, "steps", tuple(protected)),
        Figure("work done a second", case, "steps", tuple(released), UNPROTECTED),
        Figure("snapshots made a second", case, "", tuple(made)),
        *(Figure(f"processor time of the {part}", case, "% of a core", tuple(values)) for part, values in taken.items()),
    ]


def _protected(robot: RobotMachine, program: Running) -> tuple[float, float, dict[str, float]]:
    """Steps and snapshots a second, and percents of a core by part, while it is protected."""
    with robot.control() as link:
        link.ask("protect", pid=program.pid, name=NAME)
    interference.until_protected(robot)
    parts = parts_of(robot)
    began, snapshots, before = time.monotonic(), _snapshots(robot), _processor_s(parts)
    work = interference.rate(program)
    after, more, span = _processor_s(parts), _snapshots(robot) - snapshots, time.monotonic() - began
    with robot.control() as link:
        link.ask("release", name=NAME)
    return work, more / span, {part: (after[part] - before[part]) / span * 100 for part in after}


def _snapshots(robot: RobotMachine, name: str = NAME) -> int:
    return sum(int(one["snapshots"] or 0) for one in robot.status()["components"] if one["name"] == name)


def _of_small_deltas(turns: int, span_s: float, directory: Path) -> list[Figure]:
    """Milliseconds of processor time that a delta takes of each process of both robots."""
    directory.mkdir()
    argv = ["/usr/bin/python3", str(PROGRAMS / "resident.py"), str(RESIDENT_MB), str(SMALL_DIRTY_KB)]
    taken: dict[str, list[float]] = {}
    with Stage(directory / "robots", means(), f"snapshot_period_ms = {SMALL_PERIOD_MS}\n") as stage:
        stage.directory.mkdir()
        stage.start()
        with stage.robots[0].control() as link:
            link.ask("run", argv=argv, name=SMALL, cwd="/", wait=False)
        name = f"/demo/{stage.robots[0].name}/{SMALL}"
        _await_snapshots(stage, name, STANDBYS_SNAPSHOTS)
        time.sleep(interference.SETTLED_S)
        for _ in range(turns):
            for part, ms in _by_delta(stage, name, span_s).items():
                taken.setdefault(part, []).append(ms)
    return [Figure("processor time of a small delta", part, "ms", tuple(values)) for part, values in taken.items()]


def _await_snapshots(stage: Stage, name: str, count: int) -> None:
    """Until the standby has so many of it."""
    deadline = time.monotonic() + interference.PATIENCE_S
    while _snapshots(stage.robots[1], name) < count:
        if time.monotonic() > deadline:
            raise BenchmarkError(f"{name} was not protected in time: {stage.robots[0].last_words()}")
        time.sleep(interference.POLL_S)


def _by_delta(stage: Stage, name: str, span_s: float) -> dict[str, float]:
    """Of each process, and of each robot as a whole."""
    parts = [(who, parts_of(robot)) for who, robot in zip(("primary", "standby"), stage.robots, strict=True)]
    count, before = _snapshots(stage.robots[0], name), [_processor_s(of_robot) for _, of_robot in parts]
    time.sleep(span_s)
    count, after = _snapshots(stage.robots[0], name) - count, [_processor_s(of_robot) for _, of_robot in parts]
    found: dict[str, float] = {}
    for (who, of_robot), earlier, later in zip(parts, before, after, strict=True):
        spent = {part: (later[part] - earlier[part]) * 1000 / count for part in of_robot}
        found |= {f"{who}, all": sum(spent.values())} | {f"{who}, {part}": ms for part, ms in spent.items()}
    return found


def _on_the_wire(who: str, settings: str, count: int, directory: Path) -> Figure:
    """Of so many deltas in a row what their files take, by byte of their pages."""
    directory.mkdir()
    seen: dict[int, float] = {}
    with (
        Stage(directory / "robots", ON_LOOPBACK, settings) as stage,
        running("heap", CELLS, CHANGES, directory=directory) as program,
    ):
        stage.directory.mkdir()
        stage.start()
        primary = stage.robots[0]
        with primary.control() as link:
            link.ask("protect", pid=program.pid, name=NAME)
        interference.until_protected(primary)

        def note(one: dict[str, object]) -> bool:
            sequence, size, pages = one["sequence"], one["snapshot_size"], one["dirty_bytes"]
            assert isinstance(sequence, int)
            assert isinstance(size, int)
            assert isinstance(pages, int)
            seen[sequence] = size / max(pages, 1)
            return len(seen) >= count

        interference.until(primary, note)
    return Figure("bytes on the wire per byte written", "a Python heap", "", tuple(seen.values()), who)


def _of_many(count: int, directory: Path) -> list[Figure]:
    """Memory (PSS) of every part, with so many programs on one robot and their ready copies on the other."""
    directory.mkdir()
    argv = ["/usr/bin/python3", str(PROGRAMS / "resident.py"), str(MANY_RESIDENT_MB), str(SMALL_DIRTY_KB)]
    with Stage(directory / "robots", means()) as stage:
        stage.directory.mkdir()
        stage.start()
        names = [f"{SMALL}{number}" for number in range(count)]
        for name in names:
            with stage.robots[0].control() as link:
                link.ask("run", argv=argv, name=name, cwd="/", wait=False)
        for name in names:
            _await_snapshots(stage, f"/demo/{stage.robots[0].name}/{name}", MANY_SNAPSHOTS)
        return [
            Figure(f"memory that protects {count} programs", f"{who}, {part}", "MB", (sum(map(pss_mb, pids)),))
            for who, robot in zip(("primary", "standby"), stage.robots, strict=True)
            for part, pids in parts_of(robot).items()
        ]


def _idle(span_s: float, directory: Path) -> list[Figure]:
    """Memory (PSS) and processor time of an agent that protects nothing."""
    directory.mkdir()
    with Stage(directory / "robots", ON_LOOPBACK) as stage:
        stage.directory.mkdir()
        stage.start()
        time.sleep(span_s / 5)  # what it prepares is ready
        parts = parts_of(stage.robots[0])
        before = _processor_s(parts)
        time.sleep(span_s)
        after = _processor_s(parts)
        memory = {part: sum(map(pss_mb, pids)) for part, pids in parts.items()}
    of_agent = [part for part in parts if part in ("main loop", "worker")]
    return [
        Figure("memory of an idle agent", "main loop and worker", "MB", (sum(memory[part] for part in of_agent),)),
        *(Figure("memory of an idle agent", part, "MB", (size,)) for part, size in memory.items()),
        Figure(
            "processor time of an idle agent",
            "main loop and worker",
            "% of a core",
            (sum(after[part] - before[part] for part in of_agent) / span_s * 100,),
        ),
    ]


def parts_of(robot: RobotMachine) -> dict[str, list[int]]:
    """The processes of an agent, by what they are."""
    found: dict[str, list[int]] = {}
    for pid in robot.processes():
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):  # it has just ended
            command = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
            for part in (part for sign, part in PARTS.items() if sign in command):
                found.setdefault(part, []).append(pid)
    return found


def _processor_s(parts: dict[str, list[int]]) -> dict[str, float]:
    """Seconds of processor time that each part has used."""
    return {part: sum(map(used_s, pids)) for part, pids in parts.items()}


def used_s(pid: int) -> float:
    """Seconds of processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_A_SECOND


def pss_mb(pid: int) -> float:
    """Its share of memory (PSS), megabytes."""
    return _kb("Pss:", Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()) / 1000


def _kb(name: str, lines: Iterable[str]) -> int:
    return next(int(line.split()[1]) for line in lines if line.startswith(name))
