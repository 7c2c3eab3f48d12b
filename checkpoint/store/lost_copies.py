"""Keeps the states of copies that lost their primacy, for a person. failover never resumes from one by itself.

A file holds one state; until a person has looked at it there is no mark beside it (``.seen``).
"""

from __future__ import annotations

import contextlib
import glob
from pathlib import Path
from typing import Final
from urllib.parse import unquote

from msgspec import Struct

from checkpoint.store.index import FOLDER_PREFIX, folder_name
from checkpoint.store.whole_file import write_whole

FOLDER: Final = "lost"
"""Below the state directory."""

KEPT: Final = 3
"""Of each component, the ones of the newest epochs: each is as large as the program's memory."""

_EPOCH: Final = "-epoch"
_SUFFIX: Final = ".snapshot"
_SEEN: Final = ".seen"


class LostCopy(Struct, frozen=True):
    """One state.

    Attributes:
        component: whose; a name that was too long for a file's is cut.
        epoch: of the primacy that lost.
        at_s: when it was kept, seconds since 1970.
        seen: a person has looked at it.
    """

    path: Path
    component: str
    epoch: int
    size: int
    at_s: float
    seen: bool


def keep(directory: Path, component: str, epoch: int, content: bytes) -> Path:
    """Write one down, durably, and forget the oldest; returns where it lies.

    Raises:
        OSError: the directory cannot be written.
    """
    directory.mkdir(mode=0o700, exist_ok=True)
    stem = f"{folder_name(component)}{_EPOCH}"
    path = directory / f"{stem}{epoch}{_SUFFIX}"
    _mark(path).unlink(missing_ok=True)
    write_whole(path, content)
    known = directory.glob(f"{glob.escape(stem)}*{_SUFFIX}")
    for older in sorted(known, key=lambda one: _epoch(one, stem))[:-KEPT]:
        remove(older)
    return path


def found(directory: Path) -> list[LostCopy]:
    """All that there are, the newest first.

    Raises:
        OSError: the directory cannot be read; one that is not there holds none.
    """
    copies = []
    with contextlib.suppress(FileNotFoundError):
        for path in directory.iterdir():
            stem, epoch, number = path.name.removesuffix(_SUFFIX).rpartition(_EPOCH)
            if path.suffix != _SUFFIX or not epoch or not number.isdecimal():
                continue
            with contextlib.suppress(FileNotFoundError):  # removed meanwhile
                facts = path.stat()
                component = unquote(stem.removeprefix(FOLDER_PREFIX))
                copies.append(LostCopy(path, component, int(number), facts.st_size, facts.st_mtime, _mark(path).exists()))
    return sorted(copies, key=lambda one: (-one.at_s, one.path.name))


def look_at(path: Path) -> None:
    """A person has looked at it.

    Raises:
        OSError: that cannot be noted.
    """
    _mark(path).touch(mode=0o600)


def remove(path: Path) -> None:
    """Let one go, for good.

    Raises:
        OSError: it cannot be removed.
    """
    path.unlink(missing_ok=True)
    _mark(path).unlink(missing_ok=True)


def _mark(path: Path) -> Path:
    return path.with_name(path.name + _SEEN)


def _epoch(path: Path, stem: str) -> int:
    number = path.name.removeprefix(stem).removesuffix(_SUFFIX)
    return int(number) if number.isdecimal() else 0
