"""A child that stands for a process that has ended does not outlive the step that it was born for."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import pytest

from checkpoint.engines import ptrace_restore, restore_threads
from checkpoint.errors import RestoreError
from checkpoint.resources.departed import Departed


def test_a_stand_in_ends_where_what_is_wanted_of_it_cannot_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []

    def refuse(_: Any) -> None:
        raise RestoreError("cannot open it")

    monkeypatch.setattr(restore_threads, "spawn_any", lambda *_: SimpleNamespace(pid=os.getpid()))
    monkeypatch.setattr(restore_threads, "end", lambda child, _: ended.append(child.pid))
    restoring, stub = SimpleNamespace(_tracee=None, _start_registers=b""), SimpleNamespace(base=1 << 40, run=refuse)
    with pytest.raises(RestoreError):
        ptrace_restore.ProcessRestore._open_what_is_left(restoring, stub, [Departed(())], ())  # type: ignore[arg-type]
    assert ended == [os.getpid()]
