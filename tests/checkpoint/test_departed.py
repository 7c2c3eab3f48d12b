"""A child that stands for a process that has ended does not outlive the step that it was born for."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import pytest

from checkpoint.engines import restore_threads
from checkpoint.errors import RestoreError
from checkpoint.resources.departed import Departed


def test_a_stand_in_ends_where_what_is_wanted_of_it_cannot_be_opened(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []

    def refuse(_: Any) -> None:
        raise RestoreError("cannot open it")

    monkeypatch.setattr(restore_threads, "spawn_any", lambda *_: SimpleNamespace(pid=os.getpid()))
    monkeypatch.setattr(restore_threads, "end", lambda child, _: ended.append(child.pid))
    stub: Any = SimpleNamespace(base=1 << 40, run=refuse)
    parent: Any = None
    with pytest.raises(RestoreError):
        restore_threads.open_what_is_left(parent, b"", stub, [Departed(())], ())
    assert ended == [os.getpid()]
