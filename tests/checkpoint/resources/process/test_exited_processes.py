"""A child that stands for a process that has ended does not outlive the step for which it was created."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import pytest

from checkpoint.engines.ptrace.restore import threads
from checkpoint.errors import RestoreError
from checkpoint.resources.process.exited_processes import Departed


def test_a_stand_in_ends_where_what_is_wanted_of_it_cannot_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []

    def refuse(_: Any) -> None:
        raise RestoreError("cannot open it")

    monkeypatch.setattr(threads, "spawn_any", lambda *_: SimpleNamespace(pid=os.getpid()))
    monkeypatch.setattr(threads, "end", lambda child, _: ended.append(child.pid))
    stub: Any = SimpleNamespace(base=1 << 40, run=refuse)
    parent: Any = None
    with pytest.raises(RestoreError):
        threads.open_what_is_left(parent, b"", stub, [Departed(())], ())
    assert ended == [os.getpid()]
