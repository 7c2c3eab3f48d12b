"""The cost of one more snapshot by the bytes written since the last one, and by all bytes, beside a full copy."""

from __future__ import annotations

import mmap
import os
import signal
import time
from pathlib import Path
from typing import Final

from benchmarks.engine import PERIOD_S, capture, resident
from benchmarks.figures import Figure, Findings
from checkpoint.keeper import messages
from checkpoint.linux.memory.remote_memory import Memory, ranges_of
from checkpoint.linux.procfs import procfs
from failover.cli.keeper_client import Keeper

SIZES_MB: Final = (10, 50, 200, 500)
WRITTEN_MB: Final = (0.0, 0.04, 0.1, 0.4, 1.0, 4.0, 10.0)
AT_MB: Final = 100
"""Resident, where it varies what is written."""
AT_KB: Final = 400
"""Written each `PERIOD_S`, where it varies how much is resident."""
COUNT: Final = 20
QUICK_COUNT: Final = 5

FULL: Final = "full copy"
SENT: Final = "sent for one more snapshot"
SENT_OF_ONE: Final = f"sent for one more snapshot of {AT_MB} MB"
STILL: Final = "stands still for one more snapshot"
STOP_S: Final = 10.0


def increments(quick: bool, directory: Path) -> Findings:
    """Deltas of programs of several sizes that write at several rates, and full copies of the same ones."""
    count = QUICK_COUNT if quick else COUNT
    figures: list[Figure] = []
    for written_mb in WRITTEN_MB[1::3] if quick else WRITTEN_MB:
        sent, _, base = _deltas(AT_MB, round(written_mb * 1000), count, directory)
        figures.append(Figure(SENT_OF_ONE, f"{written_mb:g} MB written since the last", "KB", sent))
    figures.append(Figure(SENT_OF_ONE, f"{written_mb:g} MB written since the last", "KB", (base,), FULL))
    for megabytes in SIZES_MB[:2] if quick else SIZES_MB:
        case = f"{megabytes} MB, {AT_KB} KB written since the last"
        sent, still, base = _deltas(megabytes, AT_KB, count, directory)
        figures += [Figure(SENT, case, "KB", sent), Figure(SENT, case, "KB", (base,), FULL)]
        figures += [Figure(STILL, case, "ms", still), Figure(STILL, case, "ms", _full_copies(megabytes, count, directory), FULL)]
    return Findings(
        "Increments",
        f"What one more snapshot sends, encoded, of {AT_MB} MB of which a part is written anew each {PERIOD_S * 1000:.0f} ms, by "
        "chance, so that nothing of it compresses; and of several sizes of which an equal part is. A full copy sends what the "
        "first snapshot did. It stands still as long as it takes to read all private memory of a stopped process into memory "
        "that is there, in one go (SIGSTOP, process_vm_readv(2), SIGCONT): less than any checkpointer does that knows no "
        "increments.",
        tuple(figures),
    )


def _deltas(megabytes: int, dirty_kb: int, count: int, directory: Path) -> tuple[tuple[float, ...], tuple[float, ...], float]:
    """Of deltas: KB sent, ms of freeze; and KB sent for the base."""
    sent, still = [], []
    with resident(megabytes, dirty_kb, directory, by_chance=True) as pid, Keeper.spawn() as keeper:
        keeper.ask(messages.Protect(pid, "/benchmark"), messages.Protected)
        base = capture(keeper, base=True, sequence=1).size
        capture(keeper, base=False, sequence=2)  # what the program wrote while the base was taken
        for sequence in range(3, count + 3):
            time.sleep(PERIOD_S)
            taken = capture(keeper, base=False, sequence=sequence)
            sent.append(taken.size / 1000)
            still.append(taken.told.freeze_us / 1000)
        keeper.ask(messages.Release(), messages.Released)
    return tuple(sent), tuple(still), base / 1000


def _full_copies(megabytes: int, count: int, directory: Path) -> tuple[float, ...]:
    """Milliseconds that the program stands still for each."""
    room = bytearray()
    with resident(megabytes, AT_KB, directory, by_chance=True) as pid:
        memory = Memory(pid)
        return tuple(_full_copy(pid, memory, room) for _ in range(count + 1))[1:]  # the first one makes the room


def _full_copy(pid: int, memory: Memory, room: bytearray) -> float:
    began = time.perf_counter()
    os.kill(pid, signal.SIGSTOP)
    _wait_until_stopped(pid)
    lines = procfs.parse_maps(procfs.read_text(pid, "maps"))
    private = [(line.start, line.size) for line in lines if line.protection & mmap.PROT_WRITE and not line.shared]
    room.extend(bytes(max(0, sum(size for _, size in private) - len(room))))
    memory.read_into(ranges_of(private), room)
    os.kill(pid, signal.SIGCONT)
    return (time.perf_counter() - began) * 1000


def _wait_until_stopped(pid: int) -> None:
    deadline = time.monotonic() + STOP_S
    while procfs.stat(pid).state != "T":
        if time.monotonic() > deadline:
            raise TimeoutError(f"pid {pid} does not stop")
