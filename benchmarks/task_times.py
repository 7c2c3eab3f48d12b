"""How late activations of a task begin, beside a bare loop of clock_nanosleep: in Python and in C, at normal
priority and SCHED_FIFO.
"""

from __future__ import annotations

import os
import secrets
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from benchmarks.figures import OURS, Absent, Figure, Findings, percentile
from benchmarks.running import BenchmarkError
from failover.boards import directory

HERE: Final = Path(__file__).parent
PERIOD_NS: Final = 10_000_000
COUNT: Final = 3_000
ROUNDS: Final = 3
"""The loops take turns, so that load beside them hits all alike."""
PRIORITY: Final = 50
BARE: Final = "clock_nanosleep in a bare loop"
EARLY_S: Final = 0.0002
EARLY: Final = f"{OURS}, early={EARLY_S}"
ON_TIME: Final = f"{OURS}, early=0"
"""Of Python alone. Without ``early`` a task, one in C as well, learns how early to wake."""


def task_times(quick: bool, directory_: Path) -> Findings:
    """Lateness of a task and of a bare loop."""
    programs = {"Python": [sys.executable, str(HERE / "programs" / "task_times.py")]}
    absent = []
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        absent.append(Absent("C", "there is no C compiler"))
    else:
        made = directory_ / "task_times"
        source = HERE / "programs" / "task_times.c"
        subprocess.run([compiler, "-O2", f"-I{HERE.parent / 'include'}", "-pthread", "-o", str(made), str(source)], check=True)
        programs["C"] = [str(made)]
    classes = {"normal priority": ()}
    if may_be_fifo():
        classes[f"SCHED_FIFO {PRIORITY}"] = ("chrt", "-f", str(PRIORITY))  # type: ignore[assignment]
    else:
        absent.append(Absent("SCHED_FIFO", "this user, or this control group, may not have it"))
    count, place = (100 if quick else COUNT // ROUNDS), f"/dev/shm/failover-benchmark{secrets.token_hex(4)}-robot1"
    late: dict[tuple[str, str, str], list[int]] = {}
    processor: dict[tuple[str, str], list[int]] = {}
    for turn in range(1 if quick else ROUNDS):
        for language, command in programs.items():
            for priority, before in classes.items():
                early = ((EARLY, f"early{turn}", str(EARLY_S)), (ON_TIME, f"at{turn}", "0")) if language == "Python" else ()
                for who, name, *more in ((OURS, f"task{turn}"), (BARE, "-"), *early):
                    found, took_ns = _measured([*before, *command, name, str(PERIOD_NS), str(count), *more], place)
                    late.setdefault((f"{language}, {priority}", who, language), []).extend(found)
                    processor.setdefault((f"{language}, {priority}", who), []).extend(took_ns)
    figures = [
        Figure(case, f"p{share * 100:g}", "µs", (percentile(values, share) / 1000,), who)
        for (case, who, _), values in late.items()
        for share in (0.5, 0.99)
    ]
    figures += [
        Figure(case, "processor, an activation", "µs", (sum(found) / len(found) / 1000,), who)
        for (case, who), found in processor.items()
        if found
    ]
    return Findings(
        "Tasks at their times",
        f"From the instant at which an activation is due to that at which the program has it, each {PERIOD_NS // 1_000_000} ms. "
        "The bare loop does nothing but clock_nanosleep with an absolute time, and read the clock.",
        tuple(figures),
        tuple(absent),
    )


def may_be_fifo() -> bool:
    """Whether this user may have SCHED_FIFO here."""
    return (
        shutil.which("chrt") is not None
        and subprocess.run(["chrt", "-f", str(PRIORITY), "true"], capture_output=True, check=False).returncode == 0
    )


def _measured(command: Sequence[str], place: str) -> tuple[list[int], list[int]]:
    """Lateness of each activation; where the program tells it, what each took of a processor."""
    environment = {**os.environ, directory.VARIABLE: place, "PYTHONPATH": str(HERE.parent)}
    told = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if told.returncode != 0:
        raise BenchmarkError(f"task_times: {told.stderr.strip()}")
    words = told.stdout.split()
    return [int(word) for word in words if word[0] != "#"], [int(word[1:]) for word in words if word[0] == "#"]
