"""A table in memory, filled by orders, as tests and the sample need it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from failover.core.schedule import layout, orders
from failover.core.schedule.activation import Counts, State
from failover.core.schedule.course import Course, Overrun
from failover.core.schedule.layout import Live, View
from failover.core.schedule.orders import Outcome
from failover.core.schedule.terms import Declaration, Kind, Mode, Terms

BOOT_ID = bytes(range(16))
SAMPLE = Path(__file__).parents[3] / "samples" / "version-1.schedule"
SAMPLE_ROWS = 3
MS = 1_000_000


def new(origin_ns: int = 5_000_000_000) -> View:
    """A table without tasks."""
    content = bytearray(layout.FILE_SIZE)
    header = layout.new_header("robot1", BOOT_ID, origin_ns, layout.ALONE)
    content[: len(header)] = header
    return View(memoryview(content))


def write(view: View, outcome: Outcome) -> None:
    """An order, as the process that gives it writes it."""
    before = layout.read_rows(view)
    for index, row in outcome.written.items():
        layout.apply(view, layout.row_pieces(view, index, row, before.get(index)))
    layout.apply(view, layout.successors_pieces(layout.read_rows(view)))


def add(view: View, declarations: Iterable[Declaration]) -> None:
    write(view, orders.added(layout.read_rows(view), declarations))


def sample() -> bytes:
    """The mapper runs after the odometry, which has run; the third row is named only."""
    view = new()
    odometry = Declaration("odometry", Terms(period_ns=10 * MS, phase_ns=2 * MS, deadline_ns=8 * MS, budget_ns=MS, cpus=3))
    eco = Mode("eco", 100 * MS, budget_ns=5 * MS)
    mapper = Declaration(
        "/lab/robot1/mapper",
        Terms(kind=Kind.PERIODIC, period_ns=50 * MS, overrun=Overrun.QUEUE, strict=True, priority=40),
        ("odometry", "map"),
        (Mode("full", 50 * MS, budget_ns=20 * MS), eco),
    )
    add(view, [odometry, mapper])
    write(view, orders.changed(layout.read_rows(view), [orders.Change("/lab/robot1/mapper", mode="eco", at_next=True)]))
    layout.write_course(view, 0, Course(0, 5_002_000_000, 10 * MS))
    counts = Counts(started=8, ended=7, misses=1, overruns=2, skipped=1, orphaned=0)
    live = Live(State.RUNNING, 4711, 7, 7, 5_072_000_000, 5_072_060_000, 5_063_000_000, 5_080_000_000, counts, adopted=1)
    layout.write_live(view, 0, live)
    for late_ns in (60_000, 70_000):
        layout.count(view, 0, layout.LATENESS_FIELD, late_ns)
    layout.count(view, 0, layout.DURATION_FIELD, 1_000_000)
    return bytes(view.octets[: layout.row_at(SAMPLE_ROWS)])


if __name__ == "__main__":
    SAMPLE.write_bytes(sample())
