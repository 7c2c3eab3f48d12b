"""The first entry into a program, where something of it fails on our side: nothing of ours stays inside."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

import pytest

from checkpoint.linux import entry
from tests.checkpoint.round_trip import captured, ended, protected, start


def test_of_a_keeper_without_a_descriptor_left_none_stays_in_the_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It finds what is written without write protection, and says why."""

    def none_left(_tid: int) -> int:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    sleeps = "import time; print('ready', flush=True); time.sleep(600)"
    with ended(start([sys.executable, "-S", "-c", sleeps], tmp_path)) as program:
        program.wait_for_line("ready")
        had = sorted(os.listdir(f"/proc/{program.pid}/fd"))
        with monkeypatch.context() as patched:
            patched.setattr(entry, "pidfd_of", none_left)
            for _ in "enter", "enter again":
                with protected(program) as session:
                    assert any("Too many open files" in note for note in session.notes)
                    assert entry.left_open(program.pid) == ()
        assert sorted(os.listdir(f"/proc/{program.pid}/fd")) == had
        captured(program)
