"""Scalable vectors of aarch64 (SVE), part of which every system call destroys: a thread in which we make calls gets them back.

The program skips the test where the processor has none. `tests.checkpoint.test_tracees` tests the rest of them.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from checkpoint.arch import cpu
from checkpoint.engine import CaptureOrder, ProtectOrder
from checkpoint.errors import CaptureError
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.trace import entry, remote_syscalls
from checkpoint.linux.trace.syscall_desk import Desk
from tests.checkpoint.round_trip import (
    ENGINE,
    Program,
    calls_of,
    captured_at_last,
    ended,
    expect_ok,
    protected,
    start_tracee,
)

pytestmark = [
    pytest.mark.compiler,
    pytest.mark.root,
    pytest.mark.skipif(os.uname().machine != "aarch64", reason="registers of aarch64"),
]

WAITING = str(cpu.SYSCALLS["rt_sigtimedwait"])


@pytest.fixture(params=[(), ("threads",)], ids=["one thread", "three threads"])
def holder(request: pytest.FixtureRequest, compiled: Callable[..., Path], tmp_path: Path) -> Iterator[Program]:
    """A program whose threads hold scalable vectors."""
    with ended(start_tracee(compiled("scalable", "-O2"), tmp_path, "0", *request.param)) as program:
        yield program


def expect_undisturbed(holder: Program) -> None:
    """Have it look: it finds what it holds."""
    os.kill(holder.pid, signal.SIGUSR1)
    expect_ok(holder)


def await_all_by_themselves(holder: Program) -> None:
    """Until no thread waits for us any more."""
    holder.wait_until(lambda: WAITING not in calls_of(holder.pid), "all to go on by themselves")


def test_who_goes_on_by_itself_because_its_keeper_is_late_has_them_all(holder: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    wait_in_time = remote_syscalls._tables_when_done

    def wait_too_long(memory: Memory, desks: Sequence[Desk], end: int) -> list[bytes]:
        tables = wait_in_time(memory, desks, end)
        await_all_by_themselves(holder)
        return tables

    with protected(holder) as session:
        snapshot = captured_at_last(session, CaptureOrder(base=True, generation=1, sequence=1))
        session.acknowledge(snapshot.position)
        monkeypatch.setattr(remote_syscalls, "_tables_when_done", wait_too_long)
        with pytest.raises(CaptureError, match="has run on while failover examined it"):
            session.capture(CaptureOrder(base=False, generation=1, sequence=2))
        monkeypatch.undo()
    expect_undisturbed(holder)


def test_who_goes_on_by_itself_after_a_first_entry_has_them_all(holder: Program, monkeypatch: pytest.MonkeyPatch) -> None:
    wait_in_time = entry._wait_in_call

    def wait_too_long(*arguments: Any) -> None:
        wait_in_time(*arguments)
        await_all_by_themselves(holder)

    monkeypatch.setattr(entry, "_wait_in_call", wait_too_long)
    with pytest.raises(CaptureError, match="has run on while failover examined it"):
        ENGINE.protect(holder.pid, ProtectOrder("/test/holder")).close()
    monkeypatch.undo()
    expect_undisturbed(holder)


def test_where_there_is_no_room_for_them_beside_the_first_entry_it_is_made_all_the_same(
    holder: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Only a keeper that dies in that very entry owes them then."""
    made = cpu.entry_code
    monkeypatch.setattr(cpu, "entry_code", lambda *told: made(*told) + bytes(1 << 20) * bool(told[-1]))
    with protected(holder) as session:
        captured_at_last(session, CaptureOrder(base=True, generation=1, sequence=1))
    expect_undisturbed(holder)
