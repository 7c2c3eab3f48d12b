"""A file whose times are set wakes who watches it; writes, and times set one by one, do not."""

from __future__ import annotations

import os
import select
from contextlib import closing
from pathlib import Path

import pytest

from agent.system.inotify import Touches


def is_told(touches: Touches) -> bool:
    waiting = select.poll()
    waiting.register(touches.fileno(), select.POLLIN)
    return bool(waiting.poll(0))


def test_what_sets_the_times_is_told_once_and_a_write_is_not(tmp_path: Path) -> None:
    path = tmp_path / "own"
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT)
    path.unlink()  # it watches the file, not the name
    with closing(Touches(descriptor)) as touches:
        touches.heed()  # of the loss of its name
        os.pwrite(descriptor, b"x", 0)
        assert not is_told(touches)
        for _ in range(1_000):
            os.utime(descriptor)
        assert is_told(touches)
        touches.heed()
        assert not is_told(touches)
        touches.heed()
    os.close(descriptor)


def test_what_is_no_file_is_refused_in_a_sentence() -> None:
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(OSError, match="inotify_add_watch"):
        Touches(2**20)
    assert len(os.listdir("/proc/self/fd")) == before
