"""Reads of a process that has ended, or is becoming another program, are reported as such."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from checkpoint.engines.ptrace.facts import probe
from checkpoint.errors import ProcessGoneError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptors import descriptor_numbers
from checkpoint.linux.procfs.particulars import Afresh
from checkpoint.resources import refusals
from checkpoint.resources.survey import glance
from tests.checkpoint.round_trip import as_nobody


@contextmanager
def zombie() -> Iterator[int]:
    """A process that has ended, which still has its place: its program's file is gone before it is, as in an execution."""
    pid = os.posix_spawn("/bin/true", ["true"], {})
    os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
    try:
        yield pid
    finally:
        os.waitpid(pid, 0)


def test_the_program_of_who_has_ended_cannot_be_read() -> None:
    assert procfs.head_of_program(os.getpid(), 5) == b"\x7fELF\x02"
    with zombie() as pid, pytest.raises(ProcessGoneError, match=f"program file of pid {pid}"):
        procfs.head_of_program(pid, 5)


@pytest.mark.root
@pytest.mark.parametrize("look", [lambda pid: procfs.read_bytes(pid, "environ"), descriptor_numbers, glance])
def test_to_an_ordinary_user_too_who_has_ended_is_gone_and_not_forbidden(look: Callable[[int], object]) -> None:
    """What is left of it is root's."""

    def story() -> str:
        with zombie() as pid:
            look(pid)
        return "read"

    assert as_nobody(story).startswith("ProcessGoneError: ")


def test_who_ends_in_the_middle_of_a_look_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """All that was asked before was still answered."""
    with zombie() as pid:
        status = procfs.status(pid)
        monkeypatch.setattr(procfs, "read_bytes", lambda *_: b"")
        with pytest.raises(ProcessGoneError, match="becomes another program"):
            probe._require_permission(pid, status)


def test_who_has_ended_is_not_taken_for_one_whose_children_are_to_live_elsewhere() -> None:
    """Of it the links of most namespaces lead nowhere, as one does of a program that has called unshare(2)."""
    with zombie() as pid:
        assert [reason for reason in refusals._refuse_namespaces(pid, Afresh(pid)) if "its children" in reason] == []
