"""Growth: descriptors and memory of every process of ours, over hours, with programs of ten kinds.

python -m benchmarks soak --for 2h --output benchmarks/soak      the default; --quick takes two minutes
python -m benchmarks.plots --record benchmarks/soak/results.json
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.costs import pss_mb
from benchmarks.figures import Figure, Findings
from benchmarks.running import BenchmarkError
from failover.cli.demo.robots import RobotMachine, Stage, means

SPAN_S: Final = 2 * 3_600.0
QUICK_SPAN_S: Final = 120.0
SAMPLES: Final = 240
"""Over the whole time, at most."""
PERIOD_S_MIN: Final = 5.0
"""Between two of them: to look takes some tenths of a second, too."""
SETTLED_SHARE: Final = 0.25
"""Of the time: memory that is loaded, laid and remembered for the first time does not count as growth."""
PATIENCE_S: Final = 300.0
POLL_S: Final = 0.2

MEMORY: Final = "memory (PSS)"
DESCRIPTORS: Final = "descriptors"
MEMORY_GROWTH: Final = "memory, growth an hour"
DESCRIPTOR_GROWTH: Final = "descriptors, growth an hour"
WHEN: Final = "minutes since all were protected"

PARTS: Final = {
    "agent.main": "main loop",
    "agent.worker.process": "worker",
    "agent.guard.server": "guards",
    "checkpoint keeper": "keeper",
}
"""By what stands in their command line."""
OTHER_KEEPERS: Final = "keepers that wait or have a ready copy"

SHELL: Final = "i=0; while :; do i=$((i+1)); x=$(echo $i | cat); echo $x; sleep 0.5; done"
AWK: Final = 'BEGIN { for (i = 0;; i++) { system("sleep 0.5"); a[i % 1000] = i; print i; fflush() } }'
THREADS: Final = """
import threading, time
def work(number):
    held, turn = {}, 0
    while True:
        turn += 1
        held[turn % 5000] = "x" * (turn % 300)
        time.sleep(0.1)
for number in range(6):
    threading.Thread(target=work, args=(number,)).start()
"""
NUMPY: Final = """
import time
import numpy
grid, turn = numpy.zeros(2_000_000), 0
while True:
    turn += 1
    grid[turn * 1000 % 1_900_000:][:20_000] = numpy.random.rand(20_000)
    time.sleep(0.05)
"""
KEPT: Final = """
import time
import failover
state = failover.resume("state", default={"turn": 0, "held": {}})
while True:
    state["turn"] += 1
    state["held"][state["turn"] % 2000] = "v" * (state["turn"] % 200)
    failover.commit()
    time.sleep(0.05)
"""
SERVER: Final = """
import os, socket, threading, time
listener = socket.create_server(("127.0.0.1", 0))
for number in range(3):
    if os.fork() == 0:
        while True:
            try:
                with socket.create_connection(listener.getsockname()) as end:
                    for turn in range(50):
                        end.sendall(b"%d" % turn)
                        if not end.recv(100):
                            break
                        time.sleep(0.05)
            except OSError:
                time.sleep(0.5)
def answer(end):
    with end:
        while told := end.recv(100):
            end.sendall(told)
while True:
    threading.Thread(target=answer, args=(listener.accept()[0],), daemon=True).start()
"""
HEAP: Final = """
import random, time
held = {number: str(number) * 5 for number in range(60_000)}
while True:
    for _ in range(200):
        held[random.randrange(60_000)] = str(random.random())
    time.sleep(0.05)
"""
WORKERS: Final = """
import os, time
while True:
    pids = []
    for number in range(3):
        if (pid := os.fork()) == 0:
            end = time.monotonic() + 2 + number
            while time.monotonic() < end:
                sum(range(1000))
                time.sleep(0.05)
            os._exit(0)
        pids.append(pid)
    for pid in pids:
        os.waitpid(pid, 0)
"""
WRITER: Final = """
import time
turn = 0
while True:
    turn += 1
    print(turn, "x" * 100, flush=True)
    time.sleep(0.02)
"""
TIMERS: Final = """
import asyncio, os
async def pass_on(first, last):
    while True:
        os.write(last, b"x")
        await asyncio.sleep(0.05)
async def main():
    ends = [os.pipe() for _ in range(5)]
    for first, _ in ends:
        asyncio.get_running_loop().add_reader(first, os.read, first, 100)
    await asyncio.gather(*(pass_on(*pair) for pair in ends))
asyncio.run(main())
"""

PYTHON: Final = ("/usr/bin/python3", "-S", "-c")
OUR_PYTHON: Final = (sys.executable, "-c")
PROGRAMS: Final[dict[str, tuple[str, ...]]] = {
    "shell": ("/bin/sh", "-c", SHELL),
    "awk": ("/usr/bin/awk", AWK),
    "threads": (*PYTHON, THREADS),
    "numpy": (*OUR_PYTHON, NUMPY),
    "kept": (*OUR_PYTHON, KEPT),
    "server": (*PYTHON, SERVER),
    "heap": (*PYTHON, HEAP),
    "workers": (*PYTHON, WORKERS),
    "writer": (*PYTHON, WRITER),
    "timers": (*PYTHON, TIMERS),
}


def soak(quick: bool, directory: Path, span_s: float | None = None) -> Findings:
    """All programs at once, for as long as is asked for."""
    return measured(span_s or (QUICK_SPAN_S if quick else SPAN_S), directory)


@dataclass
class Samples:
    """The samples, by process: for every sample a number, nan where there was none."""

    minutes: list[float] = field(default_factory=list)
    memory: dict[str, list[float]] = field(default_factory=dict)
    descriptors: dict[str, list[float]] = field(default_factory=dict)

    def add(self, minutes: float, seen: dict[str, tuple[float, float]]) -> None:
        """Take one sample in: megabytes and descriptors by whose they are."""
        for name in {*self.memory, *seen}:
            for lines, value in zip((self.memory, self.descriptors), seen.get(name, (np.nan, np.nan)), strict=True):
                lines.setdefault(name, [np.nan] * len(self.minutes)).append(value)
        self.minutes.append(minutes)


def measured(span_s: float, directory: Path) -> Findings:
    """Run, and look at every process now and then.

    Raises:
        BenchmarkError: not all programs were protected at the beginning, or at the end.
    """
    samples = Samples()
    with Stage(directory / "soak", means()) as stage:
        stage.directory.mkdir()
        stage.start()
        primary = stage.robots[0]
        for name, argv in PROGRAMS.items():
            with primary.control() as link:
                engine = "cooperative" if name == "kept" else "ptrace"
                link.ask("run", argv=list(argv), name=name, cwd="/", wait=False, engine=engine)
        _until_protected(primary)
        began = time.monotonic()
        count = max(1, min(SAMPLES, int(span_s / PERIOD_S_MIN)))
        for number in range(count + 1):
            time.sleep(max(0.0, began + span_s * number / count - time.monotonic()))
            seen = {name: figures for robot in stage.robots for name, figures in _looked_at(robot).items()}
            samples.add((time.monotonic() - began) / 60, seen)
        _until_protected(primary)  # again: it went on all the time
        snapshots = {_short(one): int(one["snapshots"]) for one in primary.status()["components"]}
    return Findings(
        "What grows over hours",
        f"Two robots with {len(PROGRAMS)} programs at the first one, {span_s / 60:.0f} min; all were protected at its end. "
        f"Of each process of ours its share of memory (PSS) and its descriptors, {len(samples.minutes)} times; a ready copy's "
        "own memory is not among it, for it is the program's. The growth is the slope of the straight line through the "
        f"samples after the first {SETTLED_SHARE:.0%} of the time. Snapshots were taken of "
        + ", ".join(f"{name}: {count:,}" for name, count in sorted(snapshots.items()))
        + ".",
        tuple(figures_of(samples)),
    )


def figures_of(samples: Samples) -> Iterator[Figure]:
    """Of each process that lasted: all that was seen, and how it grew."""
    for told, growth, unit, lines in (
        (MEMORY, MEMORY_GROWTH, "MB", samples.memory),
        (DESCRIPTORS, DESCRIPTOR_GROWTH, "", samples.descriptors),
    ):
        lasting = {name: values for name, values in sorted(lines.items()) if np.isfinite(values).mean() > 1 - SETTLED_SHARE}
        for name, values in lasting.items():
            yield Figure(told, name, unit, tuple(value for value in values if np.isfinite(value)))
        for name, values in lasting.items():
            yield Figure(growth, name, unit, (slope_an_hour(samples.minutes, values),))
    yield Figure(WHEN, "each sample", "min", tuple(samples.minutes))


def slope_an_hour(minutes: list[float], values: list[float]) -> float:
    """Of the straight line through what was seen after the first quarter of the time, by least squares."""
    when, seen = np.array(minutes), np.array(values)
    counts = np.isfinite(seen) & (when >= when[-1] * SETTLED_SHARE)
    return float(np.polyfit(when[counts], seen[counts], 1)[0] * 60) if counts.sum() > 1 else 0.0


def _until_protected(robot: RobotMachine) -> None:
    """Until each has been protected since this was asked; on a busy machine now this one lags, now that one."""
    deadline = time.monotonic() + PATIENCE_S
    wanted = set(PROGRAMS)
    while True:
        components = robot.status()["components"]
        wanted -= {_short(one) for one in components if one["protection"] == "protected"}
        if not wanted:
            return
        if time.monotonic() > deadline:
            late = {_short(one): (*one["reasons"], *one["notes"]) for one in components if _short(one) in wanted}
            told = "; ".join(f"{name}: {', '.join(late.get(name, ('it is not there',)))}" for name in sorted(wanted))
            raise BenchmarkError(f"not all came to be protected: {told}")
        time.sleep(POLL_S)


def _short(component: dict[str, Any]) -> str:
    return str(component["name"]).rpartition("/")[2]


def _looked_at(robot: RobotMachine) -> dict[str, tuple[float, float]]:
    """Megabytes and descriptors of each process of ours; those of a kind that come and go all day are told together."""
    followed = {one["pid"]: _short(one) for one in robot.status()["components"] if one["pid"]}
    found: dict[str, tuple[float, float]] = {}
    for pid in robot.processes():
        try:
            command = Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            part = next((part for sign, part in PARTS.items() if sign in command), None)
            if part is None:
                continue
            opened = _opened(pid)
            figures = pss_mb(pid), float(len(opened))
        except (OSError, StopIteration):
            continue  # it has just ended
        if part == "keeper":
            part = _kept_by(opened, followed)
        name = f"{robot.name}: {part}"
        before = found.get(name, (0.0, 0.0))
        found[name] = before[0] + figures[0], before[1] + figures[1]
    if found:
        found[f"{robot.name}: all"] = sum(one[0] for one in found.values()), sum(one[1] for one in found.values())
    return found


def _opened(pid: int) -> list[str]:
    """The targets of its descriptors; of one that is closed meanwhile: an empty text."""
    return [_target(f"/proc/{pid}/fd/{name}") for name in os.listdir(f"/proc/{pid}/fd")]


def _target(path: str) -> str:
    try:
        return os.readlink(path)
    except FileNotFoundError:
        return ""


def _kept_by(opened: list[str], followed: dict[int, str]) -> str:
    """Whose keeper has these open: it has files of its program's in /proc."""
    pids = {int(parts[2]) for path in opened if len(parts := path.split("/")) > 3 and parts[1] == "proc" and parts[2].isdigit()}
    names = [name for pid, name in followed.items() if pid in pids]
    return f"keeper of {names[0]}" if names else OTHER_KEEPERS
