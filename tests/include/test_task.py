"""failover_task.h: tasks in C and in Python on one schedule; mistakes are sentences."""

from __future__ import annotations

import itertools
import os
import subprocess
from collections.abc import Container, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import failover
from failover import ScheduleError
from failover.boards import SCHEDULE_NAME, SCHEDULE_PLACE
from failover.boards.schedule_file import ScheduleFile
from failover.core.schedule import layout, orders
from failover.core.schedule.activation import State
from failover.core.schedule.orders import Change
from failover.core.schedule.terms import Declaration, Terms
from tests.include.board_programs import place_for_board
from tests.include.programs import STRICT, STRICT_CC, has, program

pytestmark = pytest.mark.compiler

MS = 1_000_000


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    with place_for_board() as found:
        monkeypatch.setenv("FAILOVER_BOARD", str(found))
        yield found


@contextmanager
def loop(name: str, *numbers: object) -> Iterator[subprocess.Popen[str]]:
    """The C program; killed at the end."""
    words = [str(program("task_loop")), name, *map(str, numbers)]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ.copy())
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def line(process: subprocess.Popen[str]) -> list[str]:
    assert process.stdout is not None
    return process.stdout.readline().split()


def opened(place: Path) -> ScheduleFile:
    return ScheduleFile.open(place / SCHEDULE_NAME)


def ended_of(place: Path, name: str) -> int:
    """How many activations of a task have ended."""
    file = opened(place)
    row = file.row_of(name)
    count = 0 if row is None else layout.read_live(file.table, row).counts.ended
    file.close()
    return count


@pytest.mark.parametrize(
    ("compiler", "strict"),
    [("gcc", STRICT), ("clang", STRICT), ("musl-gcc", STRICT), ("aarch64-linux-gnu-gcc", STRICT), ("g++", STRICT_CC)],
)
def test_it_compiles_without_a_warning(compiler: str, strict: tuple[str, ...], tmp_path: Path) -> None:
    if not has(compiler):
        pytest.skip(f"needs {compiler}, which is not installed here")
    source = tmp_path / ("main.cc" if "++" in compiler else "main.c")
    source.write_text('#include "failover_task.h"\nint main(void) { ft_close(0); return 0; }\n')
    include = Path(__file__).parents[2] / "include"
    words = [compiler, *strict, "-O2", "-pthread", f"-I{include}", "-c", str(source), "-o", str(tmp_path / "made.o")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_task_in_c_keeps_to_the_origin_and_python_reads_its_row(place: Path) -> None:
    with failover.scheduled("keep", period=1), loop("c", 5 * MS, 2 * MS, 0, 0, "-", 6, 0) as process:
        ticks = [line(process) for _ in range(6)]
        assert line(process) == ["over", "0"]
        process.wait()
        file = opened(place)
        row = file.row_of("c")
        assert row is not None
        origin = file.header.origin_ns
        assert all(int(due) == origin + 2 * MS + int(number) * 5 * MS for number, due, *_ in ticks)
        live = layout.read_live(file.table, row)
        assert (live.state, live.counts.started, live.counts.ended) == (State.IDLE, 6, 6)
        assert live.counts.skipped >= sum(int(tick[2]) for tick in ticks)
        assert sum(layout.read_histogram(file.table, row, layout.LATENESS_FIELD)) == 6
        assert sum(layout.read_histogram(file.table, row, layout.DURATION_FIELD)) == 6
        assert layout.read_terms(file.table, row)[1].deadline_ns == 5 * MS
        file.close()
    assert not place.exists()


@pytest.mark.parametrize(("early", "possible"), [(0, range(1, 5 * MS // 50 + 1)), (-1, [0]), (MS, [MS])])
def test_a_task_in_c_wakes_as_early_as_it_is_told_or_has_learnt_and_begins_at_no_instant_too_soon(
    place: Path, early: int, possible: Container[int]
) -> None:
    with loop("c", 5 * MS, 0, 0, 0, "-", 20, 0, early) as process:
        ticks = [line(process) for _ in range(20)]
        assert all(int(begun) >= int(due) for _, due, _, begun, _ in ticks)
        assert line(process) == ["over", "0"]
        assert int(line(process)[1]) in possible


def test_on_a_robot_without_a_board_c_and_python_share_the_agents_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("FAILOVER_BOARD", raising=False)
    monkeypatch.setenv("FAILOVER_SOCKET", str(tmp_path / "control.sock"))
    place = tmp_path / SCHEDULE_PLACE
    place.mkdir()
    with loop("c", 5 * MS, 0, 0, 0, "-", 2, 0) as process:
        assert len([line(process) for _ in range(2)]) == 2
        process.wait()
    with failover.scheduled("python", period=0.005, after="c") as task:
        assert task.wait_activation() is not None  # at the deadline: no process runs its predecessor
    file = opened(place)
    assert [row.name for row in file.rows().values()] == ["c", "python"]
    assert layout.read_live(file.table, 0).counts.ended == 2
    assert (file.header.flags, oct((place / SCHEDULE_NAME).stat().st_mode & 0o777)) == (0, "0o660")
    file.close()


def test_a_task_in_c_that_others_declared_takes_its_terms_along_to_another_schedule(place: Path) -> None:
    with failover.board(), failover.scheduled("keep", period=1000):
        file = opened(place)
        declared = Declaration("c", Terms(period_ns=5 * MS, phase_ns=2 * MS, budget_ns=MS), ("odometry",))
        file.give(lambda rows, held: orders.added(rows, [declared], held))
        with loop("c", "-", 0, 0, 0, "-", 0, 0) as process:
            line(process)
            file.give(lambda rows, held: orders.changed(rows, [Change("c", {"period_ns": 10 * MS})], held))
            row = file.row_of("c") or 0
            while layout.read_live(file.table, row).adopted != layout.serial_of(file.table, row):
                line(process)
            (place / SCHEDULE_NAME).unlink()  # as where the program resumes on another robot
            file.words[layout.GENERATION_AT // 8] = layout.GONE
            file.close()
            while not (place / SCHEDULE_NAME).exists():
                line(process)
            while ended_of(place, "c") < 3:
                line(process)
            file = opened(place)
            rows = {row.name: row.terms for row in file.rows().values()}
            file.close()
            terms = rows["c"]
            assert terms is not None and "odometry" in rows
            assert (terms.period_ns, terms.phase_ns, terms.budget_ns, len(terms.after)) == (10 * MS, 2 * MS, MS, 1)


def test_the_last_program_in_c_leaves_nothing(place: Path) -> None:
    with loop("once", 0, 0, 0, 0, "-", 0, 0) as process:
        assert line(process)[0] == "0"
        assert line(process) == ["over", "1"]
        process.wait()
    assert not place.exists()


@pytest.mark.parametrize("overrun", [0, 1, 2])
def test_overruns_are_counted_as_in_python(place: Path, overrun: int) -> None:
    with (
        failover.scheduled("keep", period=1),
        loop("c", 2 * MS, 0, 1000 * MS if overrun else 0, overrun, "-", 8, 5 * MS) as process,
    ):
        ticks = [line(process) for _ in range(8)]
        numbers = [int(tick[0]) for tick in ticks]
        steps = [later - one for one, later in itertools.pairwise(numbers)]
        assert (
            all(step >= 3 for step in steps)
            if overrun == 0
            else all(step >= 2 for step in steps)
            if overrun == 1
            else set(steps) == {1}
        )
        assert [int(tick[2]) for tick in ticks[1:]] == [step - 1 for step in steps]
        assert line(process) == ["over", "0"]
        file = opened(place)
        counts = layout.read_live(file.table, file.row_of("c") or 0).counts
        assert counts.overruns >= counts.skipped >= sum(steps) - len(steps)
        file.close()


def test_a_task_in_c_runs_after_one_in_python_and_the_other_way_round(place: Path) -> None:
    with (
        failover.scheduled("b", period=0.01, deadline=5, overrun="queue", after="a") as between,
        loop("a", 10 * MS, 0, 0, 1, "-", 0, MS) as first,
        loop("c", 20 * MS, 0, 5000 * MS, 1, "b", 0, 0) as last,
    ):
        line(first)
        mine, last_begun = {}, []
        while len(last_begun) < 5:
            tick = between.wait_activation()
            assert tick is not None
            begun = tick.due_ns + tick.late_ns
            between.end()
            mine[tick.number] = (begun, between.live.ended_ns)
            if ended_of(place, "c") > len(last_begun):
                last_begun.append(line(last))
        assert between.live.counts.orphaned == 0
        ended = {}
        while max(ended, default=0) < max(mine):
            number, _, _, _, at = line(first)
            ended[int(number)] = int(at)
        before = [(begun, ended[number]) for number, (begun, _) in mine.items() if number in ended]
        assert before and all(begun >= at for begun, at in before)
        for number, _, _, begun, _ in last_begun:
            newest = max((one for one in mine if one <= int(number) * 2), default=None)
            assert newest is None or int(begun) >= mine[newest][1]


def test_a_change_reaches_a_task_in_c_that_sleeps_and_a_removal_ends_it(place: Path) -> None:
    with failover.scheduled("keep", period=1), loop("c", 10**12, 0, 0, 0, "-", 0, 0) as process:
        while True:
            file = opened(place)
            row = file.row_of("c")
            if row is not None and layout.read_live(file.table, row).state is State.WAITING:
                break
            file.close()
        file.give(lambda rows, held: orders.changed(rows, [Change("c", {"period_ns": 10 * MS})], held))
        assert len(line(process)) == len(line(process)) == 5
        file.give(lambda rows, _: orders.removed(rows, ["c"]))
        while (words := line(process))[0] != "over":
            pass
        assert words == ["over", "1"]
        file.close()


@pytest.mark.parametrize(
    ("name", "numbers", "said"),
    [
        ("c", (5, 0, 0, 0, "-"), "a period of 5 ns"),
        ("c", (-5, 0, 0, 0, "-"), "a time of -5 ns"),
        ("c", (10 * MS, 0, 20 * MS, 0, "-"), "longer than its period"),
        ("c", (10 * MS, 0, 0, 7, "-"), "overrun 7"),
        ("c", (10 * MS, 0, 0, 0, "c"), "its predecessor c cannot be"),
        ("c", (10 * MS, 0, 0, 0, "-", 2 * MS), "early_ns 2000000; 1 to 1000000"),
        ("keep", (2000 * MS, 0, 0, 0, "-"), "is run by pid"),
        ("nothing", ("-", 0, 0, 0, "-"), "has no task nothing"),
        ("free", (1000 * MS, 0, 0, 0, "later"), "free after later"),
    ],
)
def test_a_mistake_is_one_sentence_and_changes_nothing(place: Path, name: str, numbers: tuple[object, ...], said: str) -> None:
    with failover.scheduled("keep", period=1), failover.scheduled("later", period=1, after="free"):
        file = opened(place)
        before = {index: row for index, row in file.rows().items() if row.terms is not None}
        with loop(name, *numbers[:5], 1, 0, *numbers[5:]) as process:
            words = line(process)
            assert words[0] == "error" and said in " ".join(words)
        assert {index: row for index, row in file.rows().items() if row.terms is not None} == before
        file.close()


def test_python_is_told_which_process_runs_a_task(place: Path) -> None:
    with failover.scheduled("keep", period=1), loop("c", 10 * MS, 0, 0, 0, "-", 0, 0) as process:
        line(process)
        with pytest.raises(ScheduleError, match=f"run by pid {process.pid} already"):
            failover.scheduled("c", period=0.01)
