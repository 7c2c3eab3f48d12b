"""Descriptors of every kind: captured, killed and brought back three times in a row, then the program looks at what it has.

One tracee for a family of kinds, one case for each thing that could be lost: see ``tests/tracees``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.checkpoint.round_trip import captured, captured_and_killed, ended, expect_ok, restored, start_tracee

pytestmark = [pytest.mark.compiler, pytest.mark.root]

Compiled = Callable[..., Path]

ROUNDS = 3

CASES = {
    "event_descriptors": (
        "eventfd_counter eventfd_semaphore eventfd_full eventfd_many "
        "timer_relative timer_absolute_monotonic timer_absolute_realtime timer_absolute_boottime timer_periodic timer_unread "
        "timer_disarmed signalfd_waiting "
        "epoll_simple epoll_ready epoll_nested epoll_once epoll_edge epoll_exclusive epoll_renumbered epoll_waiting"
    ),
}


@pytest.mark.parametrize(("program", "case"), [(program, case) for program, cases in CASES.items() for case in cases.split()])
def test_what_a_program_has_open_is_as_it_was_after_three_restores(
    program: str, case: str, compiled: Compiled, tmp_path: Path
) -> None:
    tracee = start_tracee(compiled(program, "-O2"), tmp_path, case)
    captured(tracee)
    for _ in range(ROUNDS):
        with ended(tracee):
            snapshot = captured_and_killed(tracee)
        tracee = restored(snapshot, tmp_path)
    with ended(tracee):
        captured(tracee)
        tracee.tell()
        expect_ok(tracee)
