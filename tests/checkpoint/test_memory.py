"""The memory of a process that ends while it is read."""

from __future__ import annotations

import subprocess
from typing import Any

import numpy as np
import pytest

from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.memory import Memory


def test_a_process_that_ends_between_two_ways_to_read_it_is_said_to_have_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its memory goes before its PID does: the first way finds pages that are not mapped, the second finds nobody."""
    gone = subprocess.Popen(["true"])
    gone.wait()
    memory = Memory(gone.pid)

    def unmapped(*_: Any) -> None:
        raise CaptureError("Bad address")

    monkeypatch.setattr(memory, "read_into", unmapped)
    with pytest.raises(ProcessGoneError):
        memory.read_pages(np.array([[abi.PAGE_SIZE, 2 * abi.PAGE_SIZE]], dtype=np.uint64))
