"""Where the fencing token is in an environment."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from checkpoint.engine import CaptureOrder, ProtectOrder
from checkpoint.linux.procfs import descendants, procfs
from checkpoint.program import epoch_variable
from tests.checkpoint.round_trip import ENGINE, at_last, captured_at_last, ended, start


def test_the_digits_of_any_epoch_are_found_where_they_can_be_written_over() -> None:
    environment = b"PATH=/bin\0" + epoch_variable.assignment(7) + b"\0HOME=/root\0"
    place = epoch_variable.place_in(environment)
    assert place is not None
    renewed = environment[:place] + epoch_variable.digits(2**64 - 1) + environment[place + epoch_variable.DIGITS :]
    assert len(renewed) == len(environment)
    assert (epoch_variable.epoch_in(environment), epoch_variable.epoch_in(renewed)) == (7, 2**64 - 1)


@pytest.mark.parametrize(
    "environment",
    [b"", b"\0\0", b"FAILOVER_EPOCH=7\0", b"XFAILOVER_EPOCH=00000000000000000007\0", b"FAILOVER_EPOCH=0000000000000000000x\0"],
)
def test_what_is_no_token_of_ours_is_left_alone(environment: bytes) -> None:
    assert epoch_variable.place_in(environment) is None
    assert epoch_variable.epoch_in(environment) == 0


class Bytes:
    """The memory of a process, after each piece that was written."""

    def __init__(self, content: bytes) -> None:
        self.states = [content]

    def read(self, address: int, size: int) -> bytes:
        return self.states[-1][address : address + size]

    def write_each(self, contents: list[tuple[int, bytes]]) -> None:
        for address, content in contents:
            before = self.states[-1]
            self.states.append(before[:address] + content + before[address + len(content) :])


@pytest.mark.parametrize(("old", "new"), [(1, 2), (9, 10), (99, 1_000), (8, 11), (1_999, 2_000), (2**40 - 2, 2**40 - 1)])
def test_who_reads_the_digits_in_their_order_while_they_are_renewed_reads_no_epoch_above_the_new_one(old: int, new: int) -> None:
    memory = Bytes(b"PATH=/bin\0" + epoch_variable.assignment(old) + b"\0")
    epoch_variable.renew(memory, 0, len(memory.states[0]), new)
    place = epoch_variable.place_in(memory.states[0])
    assert place is not None
    seen = {old}
    for first in range(len(memory.states)):
        for then in range(first, len(memory.states)):
            for cut in range(epoch_variable.DIGITS):
                read = (
                    memory.states[first][place : place + cut] + memory.states[then][place + cut : place + epoch_variable.DIGITS]
                )
                seen.add(int(read))
    assert max(seen) == new
    epoch_variable.renew(memory, 0, len(memory.states[0]), new)
    assert len(memory.states) == 1 + epoch_variable.DIGITS, "it stands there already"


def test_a_program_that_goes_on_under_a_later_epoch_finds_it_after_the_next_capture(tmp_path: Path) -> None:
    """Each of its processes does, and the snapshots tell what it finds."""
    told = epoch_variable.assignment(1).decode().partition("=")
    with ended(start(["/bin/sh", "-c", "sleep 1000 & sleep 1000"], tmp_path, env={told[0]: told[2]})) as program:
        session = at_last(lambda: ENGINE.protect(program.pid, ProtectOrder("/test/token")))
        try:
            for sequence, epoch in enumerate((1, 1, 5, 5, 12), 1):
                order = CaptureOrder(base=sequence == 1, sequence=sequence, epoch=epoch)
                snapshot = captured_at_last(session, order)
                session.acknowledge(snapshot.position)
                assert len(snapshot.members) == 2
                for pid in (program.pid, *descendants.children(program.pid)):
                    assert epoch_variable.epoch_in(procfs.read_bytes(pid, "environ")) == epoch
        finally:
            session.close()
            for child in descendants.children(program.pid):
                os.kill(child, signal.SIGKILL)
