"""Simulated robots with the page open: missed deadlines, processor time, memory, and what the page takes.

python -m benchmarks.simulated --minutes 10     80 robots in 4 labs, and a browser that shows one of them

The simulation registers with an agent on the loopback, whose page a browser has open: Debian's chromium, driven by playwright.
Nothing else should run meanwhile.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Final

import psutil

from benchmarks.costs import pss_mb
from benchmarks.figures import Figure, Findings, table
from benchmarks.main_loop import TeamStage
from benchmarks.running import BenchmarkError
from failover.drivers.here import DIRECTORY, ROBOT
from tests.e2e import pages

LABS: Final = 4
BROWSER_PATIENCE_MS: Final = 120_000
LOOK_S: Final = 5.0
SHOWN: Final = ("Simulated", "University", "Lab1", "Robotino1", "US")
"""Rows of the tree that the browser opens, one below the other."""

MISSED: Final = "missed deadlines"


def simulated(count: int, span_s: float, directory: Path) -> Findings:
    """Measure so many robots for so long."""
    drivers, board = directory / "drivers", directory / "board"
    drivers.mkdir(mode=0o700)
    environment = {DIRECTORY: str(drivers), ROBOT: "robot1"}
    with ExitStack() as stack:
        stage = stack.enter_context(TeamStage(directory / "robots", 2, ""))
        stage.start()
        served = stack.enter_context(pages.served(stage.robots[0], directory / "page", **environment))
        page = psutil.Process(served.process.pid)
        words = ("--robots", str(count), "--labs", str(LABS), "--for", f"{span_s:.0f}s", "--json", "--board", str(board))
        simulation = subprocess.Popen(
            [sys.executable, "-m", "failover", "simulate", *words],
            env={**os.environ, **environment},
            stdout=subprocess.PIPE,
            text=True,
        )
        stack.callback(simulation.kill)
        stack.enter_context(_watching(served.url))
        began, used, memory = time.monotonic(), _processor_s(page), 0.0
        while simulation.poll() is None:
            memory = max(memory, _memory_mb(page))
            time.sleep(LOOK_S)
        share = (_processor_s(page) - used) / (time.monotonic() - began) * 100
        assert simulation.stdout is not None
        said = _told(simulation.stdout.read(), simulation.returncode)
    case = f"{count} robots in {LABS} labs, {span_s:.0f} s"
    figures = [
        Figure("activations of controllers", case, "", (float(said["activations"]),)),
        Figure(MISSED, case, "", (float(said["missed"]),)),
        *(Figure(f"lateness, {part}", case, "ms", (float(ms),)) for part, ms in said["late_ms"].items()),
        Figure("processor time of the simulation", case, "cores", (float(said["cores"]),)),
        Figure("memory of the simulation", case, "MB", (float(said["memory_mb"]),)),
        Figure("processor time of the page", case, "% of a core", (share,)),
        Figure("memory of the page", case, "MB", (memory,)),
    ]
    story = "Each controller is due every 50 ms and is to end 50 ms later. A browser shows the sensors of one robot, live."
    return Findings("Simulated robots with the page open", story, tuple(figures))


def _told(said: str, status: int) -> dict[str, Any]:
    """What the simulation has counted."""
    try:
        return dict(json.loads(said))
    except ValueError as error:
        raise BenchmarkError(f"the simulation failed with status {status}, and said {said[-500:]!r}") from error


@contextmanager
def _watching(url: str) -> Iterator[None]:
    """A browser that shows the sensors of one simulated robot, live."""
    path = pages.browser()
    if not path:
        raise BenchmarkError("no browser can be driven here: install chromium, and what requirements-browser.txt lists")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=["--no-sandbox"], timeout=0)
        window = browser.new_page()
        window.set_default_timeout(BROWSER_PATIENCE_MS)
        window.goto(url)
        for step in SHOWN:
            row = window.get_by_role("treeitem", name=re.compile(f"^{step}(,|$)")).first
            row.wait_for()
            row.locator(".name").first.click()
        window.get_by_role("treeitem", name=re.compile(", simulated, live")).first.wait_for()
        yield
        browser.close()


def _family(process: psutil.Process) -> list[psutil.Process]:
    """The page and its processes.

    Raises:
        BenchmarkError: it has ended.
    """
    try:
        if process.status() != psutil.STATUS_ZOMBIE:
            return [process, *process.children(recursive=True)]
    except psutil.NoSuchProcess:
        pass
    raise BenchmarkError(f"the page (pid {process.pid}) has ended: without it there is nothing to measure")


def _memory_mb(process: psutil.Process) -> float:
    found = 0.0
    for one in _family(process):
        with suppress(OSError, StopIteration):  # it has ended meanwhile
            found += pss_mb(one.pid)
    return found


def _processor_s(process: psutil.Process) -> float:
    found = 0.0
    for one in _family(process):
        with suppress(psutil.NoSuchProcess):
            found += sum(one.cpu_times()[:2])
    return found


def main() -> int:
    """For as long as is asked for; fails where a deadline was missed."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.simulated", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=1.0, help="default 1")
    parser.add_argument("--robots", type=int, default=80, help="default 80")
    wanted = parser.parse_args()
    try:
        with tempfile.TemporaryDirectory(prefix="failover-benchmark-") as directory:
            found = simulated(wanted.robots, wanted.minutes * 60, Path(directory))
    except BenchmarkError as error:
        print(f"simulated: {error}", file=sys.stderr)
        return 2
    print(found.story, table(found.figures), sep="\n\n")
    return 1 if any(figure.benchmark == MISSED and figure.median for figure in found.figures) else 0


if __name__ == "__main__":
    sys.exit(main())
