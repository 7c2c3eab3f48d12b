"""The cost of a put and a get of an item of the board for a program in C, beside bare copies of shared memory."""

from __future__ import annotations

import os
import secrets
import shutil
import subprocess
from pathlib import Path
from typing import Final

from benchmarks.figures import OURS, Figure, Findings
from benchmarks.running import BenchmarkError
from failover.boards import boottime, directory
from failover.boards.board import board
from failover.core.board.banks import put_carefully
from failover.core.board.items import Item
from failover.core.board.layout import RUN, Wanted

HERE: Final = Path(__file__).parent
SOURCE: Final = HERE / "programs" / "board_calls.c"
SIZES: Final = (379, 4096)
"""Bytes of a value: CAMBADA's frame, and the most of a shared item."""
CALLS: Final = 20_000
BATCHES: Final = 200

CASES: Final = {
    "put": ("put", OURS),
    "put: memcpy": ("put", "memcpy into shared memory"),
    "put: like RTDB": ("put", "memcpy into one of two banks, and gettimeofday (as RTDB)"),
    "get": ("get", OURS),
    "get: memcpy": ("get", "memcpy out of shared memory"),
    "get: like RTDB": ("get", "memcpy out of one of two banks, and gettimeofday (as RTDB)"),
    "get of a robot by its name": ("get of another robot", OURS),
    "clock_gettime": ("the clock alone", OURS),
}
"""The program's measurements: case, and maker."""


def board_in_c(quick: bool, directory_: Path) -> Findings:
    """Put and get from C."""
    compiler = shutil.which("gcc") or shutil.which("cc")
    if compiler is None:
        raise BenchmarkError("there is no C compiler")
    made = directory_ / "board_calls"
    command = [compiler, "-O2", "-std=gnu11", f"-I{HERE.parent / 'include'}", "-pthread", "-o", str(made), str(SOURCE)]
    subprocess.run(command, check=True)
    figures = [figure for size in SIZES for figure in _measured(made, size, 20 if quick else BATCHES)]
    return Findings(
        "Board, in C",
        "One call of `fb_put` and of `fb_get` (failover_board.h), each the mean of 20,000 in a row; the value of a put is "
        "marked, stamped and published, that of a get examined and its age computed. Beside it a bare copy, and what CAMBADA's "
        "RTDB does for a put and a get: two banks and a time stamp without a check.",
        tuple(figures),
    )


def _measured(program: Path, size: int, batches: int) -> list[Figure]:
    place = Path(f"/dev/shm/failover-benchmark{secrets.token_hex(4)}-robot1")
    try:
        with board(place) as opened:
            opened.add(Item("value", size=size))
            peer = directory.make_peer(place, "robot2", rank=1, state=RUN)
            with peer.changing():
                peer.add(Wanted(0, "value", size))
            record = peer.record("value")
            assert record is not None
            put_carefully(peer.place(record), 1, bytes(size), boottime.now_ns(0))
            words = [str(program), str(size), str(batches), str(CALLS)]
            environment = {**os.environ, directory.VARIABLE: str(place)}
            told = subprocess.run(words, env=environment, capture_output=True, text=True, check=False)
    finally:
        shutil.rmtree(place, ignore_errors=True)
    if told.returncode != 0:
        raise BenchmarkError(f"board_calls: {told.stderr.strip()}")
    values: dict[str, list[float]] = {name: [] for name in CASES}
    for line in told.stdout.splitlines():
        name, ns = line.split("\t")
        values[name].append(float(ns))
    return [Figure(case, f"{size} B", "ns", tuple(values[name]), who) for name, (case, who) in CASES.items()]
