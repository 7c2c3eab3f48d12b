"""Keeps the states of copies that lost their primacy, for inspection by a person. failover never resumes from one by itself."""

from __future__ import annotations

import glob
from pathlib import Path
from typing import Final

from checkpoint.store.index import folder_name
from checkpoint.store.whole_file import write_whole

KEPT: Final = 3
"""Of each component, the ones of the newest epochs: each is as large as the program's memory."""


def keep(directory: Path, component: str, epoch: int, content: bytes) -> Path:
    """Write one down, durably, and forget the oldest; returns where it lies.

    Raises:
        OSError: the directory cannot be written.
    """
    directory.mkdir(mode=0o700, exist_ok=True)
    stem = f"{folder_name(component)}-epoch"
    path = directory / f"{stem}{epoch}.snapshot"
    write_whole(path, content)
    known = directory.glob(f"{glob.escape(stem)}*.snapshot")
    for older in sorted(known, key=lambda one: _epoch(one, stem))[:-KEPT]:
        older.unlink(missing_ok=True)
    return path


def _epoch(path: Path, stem: str) -> int:
    number = path.name.removeprefix(stem).removesuffix(".snapshot")
    return int(number) if number.isdecimal() else 0
