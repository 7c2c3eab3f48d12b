"""The facts of the machine that figures belong to, and whether anything else keeps it busy."""

from __future__ import annotations

import mmap
import os
import platform
import shutil
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

WATCHED_S: Final = 1.0
"""How long the machine is looked at before anything is measured."""

UNKNOWN: Final = "unknown"

BUSY_SHARE: Final = 0.05
"""Of all cores' time, used by others while we look: more than this moves the figures."""

STOLEN_SHARE: Final = 0.01
"""Of all cores' time, given to others by the host of a virtual machine: more than this is said beside the figures."""

SHARED_MEMORY: Final = Path("/dev/shm")
IMAGES_SIZE: Final = 4 << 30
"""Bytes of room that images of the largest program want, several at a time."""


@dataclass(frozen=True, slots=True)
class Ticks:
    """Time of all cores, in clock ticks: ``stolen`` was the host's, of a virtual machine, for others."""

    used: int
    stolen: int
    idle: int

    def __sub__(self, earlier: Ticks) -> Ticks:
        return Ticks(self.used - earlier.used, self.stolen - earlier.stolen, self.idle - earlier.idle)

    @property
    def whole(self) -> int:
        """All of it."""
        return self.used + self.stolen + self.idle

    @property
    def stolen_share(self) -> float:
        """Of all of it."""
        return self.stolen / max(self.whole, 1)


def ticks() -> Ticks:
    """Since boot. Source: proc_stat(5)."""
    user, nice, system, idle, waiting, interrupts, soft, stolen = map(
        int, Path("/proc/stat").read_text().splitlines()[0].split()[1:9]
    )
    return Ticks(user + nice + system + interrupts + soft, stolen, idle + waiting)


def facts(share: float) -> dict[str, str]:
    """The facts that a reader needs before comparing; ``share`` is the result of `busy_share`."""
    return {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "memory": _field("/proc/meminfo", "MemTotal"),
        "kernel": platform.release(),
        "python": platform.python_version(),
        "user": "root" if os.geteuid() == 0 else "ordinary",
        "commit": _commit(),
        "load average at the start": " ".join(f"{one:.2f}" for one in os.getloadavg()),
        "busy with something else at the start": f"{share:.0%} of its cores' time",
        "images were written to": f"{images_place()} ({_file_system(images_place())})",
    }


def busy_share() -> float:
    """The part of all cores' time that other programs used during the last `WATCHED_S`; we only wait."""
    before = ticks()
    time.sleep(WATCHED_S)
    passed = ticks() - before
    return (passed.used + passed.stolen) / max(passed.whole, 1)


def warning(share: float) -> str:
    """The warning when the machine is not quiet; "" when it is."""
    if share <= BUSY_SHARE:
        return ""
    return f"{share:.0%} of this machine's time goes to something else: the figures are worse than those of a quiet machine"


def touch_memory(megabytes: int) -> None:
    """Use so much memory and give it back, so that the kernel has it at hand for the next measurement.

    A virtual machine gets memory from its host when it is first written to, and gives back what lies idle for some seconds. That
    takes the host's time (2 ms a MB on one that we saw), and is no part of the measurement.
    """
    with mmap.mmap(-1, megabytes << 20, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS) as room:
        np.frombuffer(room, dtype=np.uint8)[:: mmap.PAGESIZE] = 1


def images_place() -> Path:
    """Where images go: a memory file system where there is room, so that a disk does not change the figures."""
    try:
        roomy = shutil.disk_usage(SHARED_MEMORY).free >= IMAGES_SIZE
    except OSError:
        roomy = False
    return SHARED_MEMORY if roomy else Path(os.environ.get("TMPDIR", "/tmp"))


def _field(path: str, name: str) -> str:
    for line in Path(path).read_text().splitlines():
        key, _, value = line.partition(":")
        if key.strip() == name:
            return value.strip()
    return UNKNOWN


def _file_system(path: Path) -> str:
    """The kind of file system that a path lies on: the deepest mount point above it."""
    mounts = [line.split()[1:3] for line in Path("/proc/self/mounts").read_text().splitlines()]
    above = [(len(point), kind) for point, kind in mounts if path.is_relative_to(point)]
    return max(above)[1] if above else UNKNOWN


def _processor() -> str:
    """By its name where the kernel tells it; an ARM's maker and part otherwise."""
    told = _field("/proc/cpuinfo", "model name")
    if told != UNKNOWN:
        return told
    maker, part = (_field("/proc/cpuinfo", field) for field in ("CPU implementer", "CPU part"))
    return f"{platform.machine()}, implementer {maker}, part {part}"


def _commit() -> str:
    """The commit that is measured; unknown where there is no checkout, or no git."""
    try:
        ran = subprocess.run(["git", "describe", "--always", "--dirty"], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return UNKNOWN
    return ran.stdout.strip() or UNKNOWN
