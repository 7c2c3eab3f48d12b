"""False alarms: both robots live, the processors are asked for twice what they have, and snapshots fill the cable.

python -m benchmarks.overload --minutes 60     for as long as that; the suite takes a minute
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

from benchmarks.cuts import BEAT_MS, DEAD, LEASE_MS
from benchmarks.figures import Absent, Figure, Findings
from benchmarks.figures import table as table_of
from benchmarks.load import busy
from benchmarks.running import BenchmarkError
from failover.cli.demo.robots import Pace, RobotMachine, Stage, means, run

SPAN_S: Final = 60.0
QUICK_SPAN_S: Final = 15.0
PATIENCE_S: Final = 90.0
POLL_S: Final = 0.05

PROGRAMS: Final = 3
"""At once: while one waits for its acknowledgement, another fills the cable."""
WRITING: Final = """
import os, time
held = bytearray(2_000_000)
while True:
    held[:] = os.urandom(len(held))
    time.sleep(0.05)
"""
"""Writes 2 MB anew each 50 ms, which no compression makes less."""

TASKS_A_PROCESSOR: Final = 2
RATES: Final = ("100mbit", "1gbit")
BURST: Final = "128kb"
QUEUE_MS: Final = 10
"""Of the token bucket at each end of the cable."""

LEASE_OVER: Final = "freezes it"

TAKEOVERS: Final = "false takeovers"
TAKEN_FOR_DEAD: Final = "robots falsely taken for dead"


PACES: Final = (Pace(20, 200), Pace(BEAT_MS, LEASE_MS))
"""The defaults, and the quickest detector of `benchmarks.cuts`."""


def overload(quick: bool, directory: Path) -> Findings:
    """Each pace and rate for a minute."""
    return measured(QUICK_SPAN_S if quick else SPAN_S, PACES, RATES[:1] if quick else RATES, directory)


def measured(span_s: float, paces: tuple[Pace, ...], rates: tuple[str, ...], directory: Path) -> Findings:
    """Count what goes wrong in so many seconds of each case."""
    title = "False alarms under overload"
    if not means().own_network or shutil.which("tc") is None:
        return Findings(title, "Not measured.", (), (Absent("the cable", "it takes root, networks of its own, and tc"),))
    figures: list[Figure] = []
    for number, (pace, rate) in enumerate((pace, rate) for pace in paces for rate in rates):
        figures += _case(span_s, pace, rate, directory / f"overload-{number}")
    return Findings(
        title,
        f"Two robots that live, {span_s:.0f} s a case; {TASKS_A_PROCESSOR} tasks that calculate for each processor, and "
        f"{PROGRAMS} programs that write 2 MB of noise each 50 ms, over a cable held to the rate by tc-tbf ({QUEUE_MS} ms of "
        "queue), which beats share with it. A robot taken for dead, or a takeover, is a false one.",
        tuple(figures),
    )


def _case(span_s: float, pace: Pace, rate: str, directory: Path) -> list[Figure]:
    with ExitStack() as stack:
        stage = stack.enter_context(Stage(directory, means(), pace=pace))
        stage.directory.mkdir()
        stage.start()
        primary, standby = stage.robots
        with primary.control() as link:
            argv = [sys.executable, "-S", "-c", WRITING]
            for name in range(PROGRAMS):
                link.ask("run", argv=argv, name=f"writing{name}", cwd="/", wait=False, engine="ptrace")
        _until_protected(primary)
        for robot in stage.robots:
            limits = ("tbf", "rate", rate, "burst", BURST, "latency", f"{QUEUE_MS}ms")
            run(["nsenter", "--net", f"--target={robot.process.pid}", "tc", "qdisc", "add", "dev", "wire", "root", *limits])
        stack.enter_context(busy(TASKS_A_PROCESSOR * (os.cpu_count() or 1)))
        began, sent = time.time(), _sent(primary)
        time.sleep(span_s)
        story, beats, moved = _story(stage.robots, began), standby.status()["beats"], _sent(primary) - sent
    case = f"beats of {pace.beat_ms} ms, a lease of {pace.lease_ms} ms, {rate}"
    counts = {
        TAKEOVERS: sum(" claims epoch " in did for did in story),
        TAKEN_FOR_DEAD: sum(DEAD in did for did in story),
        "times that the primary stood still": sum(LEASE_OVER in did for did in story),
    }
    return [
        *(Figure(what, case, "", (float(count),)) for what, count in counts.items()),
        Figure("longest silence between two beats", case, "ms", (beats["gap_us_max"] / 1e3,)),
        Figure("longest lateness of the standby's own loop", case, "ms", (beats["late_us_max"] / 1e3,)),
        Figure("over the cable", case, "MB/s", (moved / span_s / 1e6,)),
    ]


def _until_protected(primary: RobotMachine) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        if sum(one["protection"] == "protected" for one in primary.status()["components"]) == PROGRAMS:
            return
        time.sleep(POLL_S)
    raise BenchmarkError(f"{primary.name} found no standby in {PATIENCE_S:.0f} s: {primary.last_words()}")


def _sent(robot: RobotMachine) -> int:
    """Bytes that have left by its cable."""
    return sum(int(link["bytes_out"] or 0) for link in robot.status()["links"])


def _story(both: list[RobotMachine], began: float) -> list[str]:
    """The decisions of both since then."""
    found: list[dict[str, Any]] = []
    for robot in both:
        with robot.control() as link:
            found += link.ask("why", robot=robot.name)["story"]
    return [str(line["did"]) for line in found if float(line["at"]) >= began]


def alarms(figures: Iterable[Figure]) -> int:
    """How many false ones there were."""
    return round(sum(figure.median for figure in figures if figure.benchmark in (TAKEOVERS, TAKEN_FOR_DEAD)))


def main() -> int:
    """For as long as is asked for; fails where there was a false alarm."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.overload", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=1.0, help="of each case; default 1")
    parser.add_argument("--rate", choices=RATES, default=RATES[0], help=f"of the cable; default {RATES[0]}")
    wanted = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="failover-benchmark-") as directory:
        found = measured(wanted.minutes * 60, PACES, (wanted.rate,), Path(directory))
    print(found.story, table_of(found.figures), sep="\n\n")
    return 0 if found.figures and not alarms(found.figures) else 1


if __name__ == "__main__":
    sys.exit(main())
