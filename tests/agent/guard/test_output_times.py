"""When output was written: exact where it is new, right after a takeover, and never the reason that output is lost."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from agent.guard import output_times
from agent.guard.output_logs import OutputLogs, discard
from agent.guard.output_times import SIZE_MAX, STEP_NS, OutputTimes, Times
from checkpoint.model import OutputPiece

S = 10**9


@pytest.fixture
def calendar(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The instant that the calendar shows, in its only place."""
    shown = [1_000 * S]
    monkeypatch.setattr(output_times.clock, "wall_ns", lambda _: shown[0])
    return shown


def written(logs: OutputLogs, content: bytes) -> None:
    logs.mark()
    logs.write(1, logs.bounds(1).size, content)


def test_bytes_have_the_instant_at_which_they_were_written(tmp_path: Path, calendar: list[int]) -> None:
    logs = OutputLogs(tmp_path)
    for second, content in ((1_000, b"one\n"), (1_005, b"two\n"), (1_009, b"three\n")):
        calendar[0] = second * S
        written(logs, content)
        calendar[0] += STEP_NS // 2
        written(logs, b"+")  # at once after it: the same mark
    logs.close()
    times = Times(tmp_path)
    assert times.of(1, 0, 17) == [(0, 1_000 * S), (5, 1_005 * S), (10, 1_009 * S)]
    assert times.of(1, 7, 12) == [(7, 1_005 * S), (10, 1_009 * S)]
    assert times.since(1_003 * S) == (5, 0) and times.since(1_009 * S) == (10, 0)
    assert times.since(1_010 * S) is None, "nothing is so new"


def test_what_a_takeover_took_back_has_the_instant_at_which_it_was_written_again(tmp_path: Path, calendar: list[int]) -> None:
    logs = OutputLogs(tmp_path)
    for second in range(1_000, 1_010):
        calendar[0] = second * S
        written(logs, b"0123456789")
    logs.truncate((45, 0))
    calendar[0] = 1_020 * S
    written(logs, b"again, and more than before")
    logs.close()
    times = Times(tmp_path)
    assert times.of(1, 38, 70) == [(38, 1_003 * S), (40, 1_004 * S), (45, 1_020 * S)]
    assert times.since(1_015 * S) == (45, 0)


def test_at_a_standby_bytes_have_the_instant_at_which_they_came(tmp_path: Path, calendar: list[int]) -> None:
    logs = OutputLogs(tmp_path)
    for second, offset in ((1_000, 0), (1_001, 5), (1_002, 10)):
        calendar[0] = second * S
        logs.apply((OutputPiece(1, offset, b"12345"), OutputPiece(2, 0, b"")))
        logs.apply((OutputPiece(1, offset + 5, b""),))
    calendar[0] = 1_050 * S
    logs.apply((OutputPiece(1, 15, b""),))
    logs.close()
    assert Times(tmp_path).of(1, 0, 15) == [(0, 1_000 * S), (5, 1_001 * S), (10, 1_002 * S)]
    assert (tmp_path / output_times.NAME).stat().st_size == 3 * 24, "what brings no output makes no mark"


def test_the_file_does_not_grow_for_ever_and_the_newest_times_stay_exact(tmp_path: Path, calendar: list[int]) -> None:
    times, sizes = OutputTimes(tmp_path), 0
    for number in range(3 * SIZE_MAX // 24):
        calendar[0] = (1_000 * S) + number * STEP_NS
        times.mark(lambda number=number: (number, 0))  # type: ignore[misc]
        sizes = max(sizes, (tmp_path / output_times.NAME).stat().st_size)
    assert sizes <= SIZE_MAX + 24
    found = Times(tmp_path)
    assert found.of(1, number - 50, number + 1) == [(at, 1_000 * S + at * STEP_NS) for at in range(number - 50, number + 1)]
    old = found.of(1, 100, 101)[0][1]
    assert old <= 1_000 * S + 100 * STEP_NS, "never later than it was"
    assert old >= 1_000 * S, "a coarser time"


def test_a_time_that_cannot_be_noted_is_left_out_and_output_is_kept(tmp_path: Path) -> None:
    (tmp_path / output_times.NAME).symlink_to("/dev/null")
    logs = OutputLogs(tmp_path)
    written(logs, b"kept")
    assert logs.read(1, 0, committed=False).content == b"kept"
    logs.close()


def test_another_users_component_of_the_same_name_has_none_of_the_times_before(tmp_path: Path) -> None:
    logs = OutputLogs(tmp_path)
    written(logs, b"first")
    logs.close()
    discard(tmp_path)
    assert Times(tmp_path).of(1, 0, 5) == [] and not os.path.exists(tmp_path / output_times.NAME)


def test_a_mark_that_a_power_cut_left_unfinished_is_not_read_and_spoils_none(tmp_path: Path, calendar: list[int]) -> None:
    for content in (b"first", b"then"):
        calendar[0] += S
        logs = OutputLogs(tmp_path)
        written(logs, content)
        logs.close()
        with (tmp_path / output_times.NAME).open("ab") as file:
            file.write(b"torn")
    assert Times(tmp_path).of(1, 0, 9) == [(0, 1_001 * S), (5, 1_002 * S)]


def test_where_no_mark_tells_all_of_it_may_be_new(tmp_path: Path) -> None:
    logs = OutputLogs(tmp_path)
    logs.write(1, 0, b"of an agent that made no marks")
    logs.close()
    assert Times(tmp_path).since(1_000 * S) == (0, 0)


def test_how_much_there_is_is_not_asked_for_at_each_write(tmp_path: Path, calendar: list[int]) -> None:
    logs, asked = OutputLogs(tmp_path), 0

    def totals() -> tuple[int, int]:
        nonlocal asked
        asked += 1
        return 0, 0

    logs.totals = totals  # type: ignore[method-assign]
    for _ in range(10):
        logs.mark()
    logs.close()
    assert asked == 1, "once within a tenth of a second"
