"""Base of tests that capture in their own process: programs that wait for their tracer for longer than in service."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from checkpoint.arch import cpu as arch
from checkpoint.linux.trace import syscall_desk

PATIENT_NS = 900_000_000
"""A busy machine may leave a test no processor for the 100 ms of the service. It is given as a part of a second."""


@pytest.fixture(autouse=True)
def _patient_programs() -> Iterator[None]:
    """A program does not go on by itself while it is looked at because this process had to wait for a processor."""
    with pytest.MonkeyPatch.context() as patience:
        patience.setattr(arch, "ENTRY_TIMEOUT_NS", PATIENT_NS)
        patience.setattr(syscall_desk, "_busy", threading.Event())
        yield
