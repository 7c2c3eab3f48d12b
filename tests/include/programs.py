"""Programs in C that include failover.h: made once a session, and their state at each step."""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

from checkpoint.segment.layout import Committed
from checkpoint.segment.reader import SegmentReader

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
STRICT = ("-std=c11", "-Wall", "-Wextra", "-Wpedantic", "-Werror")
STRICT_CC = ("-std=c++17", *STRICT[1:])
DISK_CALLS = ("pread", "pwrite", "fdatasync", "fsync", "ftruncate", "renameat")
PAGES, LARGE = 24, 40
"""Of the arrays of telling.c."""


@cache
def folder() -> Path:
    """Where programs are made; it goes with the process."""
    made = tempfile.TemporaryDirectory(prefix="failover-include-")
    _kept.append(made)
    return Path(made.name)


_kept: list[tempfile.TemporaryDirectory[str]] = []


@cache
def program(name: str, *sources: str, flags: tuple[str, ...] = ("-O2", *STRICT), compiler: str = "gcc") -> Path:
    """Compile files of this folder (or of examples/) to a program of that name."""
    paths = [HERE / source if (HERE / source).exists() else ROOT / source for source in sources or (f"{name}.c",)]
    made = folder() / name
    command = [compiler, *flags, "-g", f"-I{ROOT / 'include'}", "-pthread", "-o", str(made), *map(str, paths), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return made


def telling_with_log() -> Path:
    """telling.c whose calls to the disk are noted, or fail."""
    wrapped = ",".join(f"--wrap={call}" for call in DISK_CALLS)
    flags = ("-O1", "-std=c11", "-DDISK_LOG", f"-Wl,{wrapped}")
    return program("telling_with_log", "telling.c", "disk_log.c", flags=flags)


def environment(state: Path, **more: str) -> dict[str, str]:
    """Where a program finds its state, and nothing of the caller's."""
    return {"PATH": os.environ["PATH"], "FAILOVER_STATE": str(state), **more}


def output(path: Path, state: Path, *words: str, **more: str) -> str:
    """What a program prints that runs to its end."""
    done = subprocess.run(
        [path, *words], env=environment(state, **more), capture_output=True, text=True, check=False, timeout=60
    )  # fmt: skip
    return done.stdout + done.stderr


def committed_in(path: Path) -> Committed | None:
    """The newest commit of a file beside a program, by our own reader."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        reader = SegmentReader(descriptor)
    finally:
        os.close(descriptor)
    try:
        return reader.read()
    finally:
        reader.close()


def array_at(number: int, count: int) -> bytes:
    """An array of telling.c after so many steps."""
    pages = [0] * count
    for step in range(max(number - 2 * count, 1), number + 1):
        for factor in (1, 7, 13, 19):
            pages[step * factor % count] = step
    return b"".join(page.to_bytes(8, "little") * 512 for page in pages)


def number_told(found: Committed) -> int:
    """Which step a commit of telling.c is of; fails unless it is just that one."""
    number = int.from_bytes(found.region(0), "little")
    assert found.region(1) == array_at(number, PAGES) + bytes(5), f"step {number} is torn"
    ends = number.to_bytes(8, "little")
    assert found.region(2) == ends + array_at(number, LARGE) + ends, f"step {number} is torn"
    return number


def has(command: str) -> bool:
    """Whether a command is here."""
    return shutil.which(command) is not None
