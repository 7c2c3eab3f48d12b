"""The schedule, used without a mapping: it is the same file, and who makes it shorter ends nobody."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import pytest

from failover.boards import SCHEDULE_NAME, directory
from failover.boards.schedule_file import ScheduleFile
from failover.boards.unmapped_schedule import UnmappedSchedule
from failover.core.schedule import layout, orders
from failover.core.schedule.orders import Outcome, Rows
from failover.core.schedule.terms import Declaration, Terms
from failover.errors import ScheduleError

MS = 1_000_000
VISION = Declaration("vision", Terms(period_ns=100 * MS))
CONTROL = Declaration("control", Terms(period_ns=50 * MS, phase_ns=5 * MS))


def schedule(place: Path) -> Path:
    place.mkdir()
    directory.make_schedule(place, "robot1")
    return place / SCHEDULE_NAME


def give(file: ScheduleFile, declared: Declaration) -> None:
    with contextlib.closing(file):
        file.give(lambda rows, held: orders.added(rows, [declared], held))


def test_orders_leave_the_same_bytes_as_through_a_mapping(tmp_path: Path) -> None:
    mapped, unmapped = schedule(tmp_path / "mapped"), schedule(tmp_path / "unmapped")
    unmapped.write_bytes(mapped.read_bytes())  # the same origin
    for declared in (VISION, CONTROL):
        give(ScheduleFile.open(mapped), declared)
        give(UnmappedSchedule.at(unmapped), declared)
        assert unmapped.read_bytes() == mapped.read_bytes()
    with contextlib.closing(UnmappedSchedule.at(mapped)) as file:
        assert {row.name for row in file.rows().values()} == {"vision", "control"}
        assert file.row_of("control") == 1 and file.generation % 2 == 0 and not file.is_gone


def test_an_order_of_another_process_is_seen_by_the_next(tmp_path: Path) -> None:
    path = schedule(tmp_path / "place")
    with contextlib.closing(UnmappedSchedule.at(path)) as file:
        give(ScheduleFile.open(path), VISION)
        file.give(lambda rows, held: orders.added(rows, [CONTROL], held))
    with contextlib.closing(ScheduleFile.open(path)) as seen:
        assert {row.name for row in seen.rows().values()} == {"vision", "control"}


@pytest.mark.parametrize("size", [0, 100, layout.row_at(0), layout.row_at(1) + 8])
def test_who_makes_it_shorter_ends_nobody(tmp_path: Path, size: int) -> None:
    path = schedule(tmp_path / "place")
    give(ScheduleFile.open(path), VISION)
    with contextlib.closing(UnmappedSchedule.at(path)) as file:

        def order(rows: Rows, held: frozenset[int]) -> Outcome:
            os.truncate(path, size)
            return orders.added(rows, [CONTROL], held)

        file.give(order)  # the kernel ends a process that touches a mapping of it now
        os.truncate(path, size)
        file.rows()
        assert file.is_gone is (size == 0)
    with pytest.raises(ScheduleError, match="this is no schedule"):
        UnmappedSchedule.at(path)


def test_a_file_that_takes_nothing_is_told_in_a_sentence(tmp_path: Path) -> None:
    path = schedule(tmp_path / "place")
    with contextlib.closing(UnmappedSchedule.at(path)) as file:
        read_only = os.open(path, os.O_RDONLY)
        os.dup2(read_only, file.descriptor)  # the kernel refuses the write, as it does where the file system is full
        os.close(read_only)
        with pytest.raises(ScheduleError, match=r"cannot write .*: Bad file descriptor"):
            file.write([(layout.row_at(0), b"x")])
