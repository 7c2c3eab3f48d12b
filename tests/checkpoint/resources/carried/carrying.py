"""Programs whose files travel with them, for the tests of carried files; and all that can be told of a folder."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from checkpoint.engine import CaptureOrder, Carry, ProtectOrder, Session, Terms
from checkpoint.model import Snapshot
from tests.checkpoint.round_trip import ENGINE, Program, at_last, captured_at_last, ended, start, transported

SLEEPER = "import time\nprint('ready', flush=True)\nwhile True: time.sleep(0.01)\n"


@contextlib.contextmanager
def carrying(program: Program, *paths: Path, size_max: int = 1 << 28) -> Iterator[Session]:
    """Hold a program under protection whose files travel with it."""
    order = ProtectOrder("/test/carried", terms=Terms(Carry(tuple(map(str, paths)), size_max)))
    session = at_last(lambda: ENGINE.protect(program.pid, order))
    try:
        yield session
    finally:
        session.close()


@contextlib.contextmanager
def asleep(directory: Path) -> Iterator[Program]:
    """A program that does nothing, so that a test may change its files for it."""
    program = start([sys.executable, "-c", SLEEPER], directory)
    with ended(program):
        program.wait_for_line("ready")
        yield program


def once_more(session: Session, sequence: int, parent: Snapshot | None = None) -> Snapshot:
    """The next snapshot: a delta of one that is acknowledged, or a base."""
    if parent is not None:
        session.acknowledge(parent.position)
    return transported(captured_at_last(session, CaptureOrder(base=parent is None, sequence=sequence)))


def portrait(top: Path) -> dict[str, tuple[object, ...]]:
    """All that can be told of a folder: names, kinds, modes, owners, times, contents, links."""
    told: dict[str, tuple[object, ...]] = {}
    links: dict[int, str] = {}
    for path in (top, *sorted(top.rglob("*"))):
        about, name = path.lstat(), str(path.relative_to(top))
        content: object = None
        if path.is_symlink():
            content = os.readlink(path)
        elif path.is_file():
            content = path.read_bytes(), links.setdefault(about.st_ino, name), about.st_nlink
        told[name] = (about.st_mode, about.st_uid, about.st_gid, about.st_mtime_ns, content)
    return told


def contents(top: Path) -> dict[str, tuple[object, ...]]:
    """All that can be told of a folder but times, which change when something is made beside, and taken away again."""
    return {name: (*about[:3], about[4]) for name, about in portrait(top).items()}
