"""The tables of the benchmarks: percentiles, ratios beside ours, the content of the written page."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from benchmarks import machine, results
from benchmarks.figures import Absent, Figure, Findings, number, percentile, ratio, table
from benchmarks.interference import gaps

OURS = Figure("stop", "10 MB", "ms", (1.0, 2.0, 3.0))
THEIRS = Figure("stop", "10 MB", "ms", (20.0,), "other")
FACTS = {"cores": "2", "load average at the start": "0.10 0.10 0.10"}


def cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_a_percentile_is_one_of_the_values() -> None:
    values = [float(value) for value in range(100, -1, -1)]
    assert [percentile(values, share) for share in (0.0, 0.5, 0.95, 1.0)] == [0.0, 50.0, 95.0, 100.0]
    assert percentile([7.0], 0.95) == 7.0


def test_others_are_divided_by_ours_in_the_same_case_alone() -> None:
    elsewhere = Figure("stop", "100 MB", "ms", (5.0,), "other")
    figures = (OURS, THEIRS, elsewhere)
    assert [ratio(figure, figures) for figure in figures] == [None, 10.0, None]


def test_nothing_is_divided_by_nought() -> None:
    assert ratio(THEIRS, (Figure("stop", "10 MB", "ms", (0.0,)), THEIRS)) is None


def test_a_table_of_ours_alone_has_no_column_for_others() -> None:
    head, _, line = table([OURS]).splitlines()
    assert cells(head) == ["measured", "case", "unit", "min", "median", "p95", "p99", "max", "n"]
    assert cells(line) == ["stop", "10 MB", "ms", "1.00", "2.00", "3.00", "3.00", "3.00", "3"]


def test_a_table_with_others_says_who_and_how_much_more() -> None:
    lines = [cells(line) for line in table([OURS, THEIRS]).splitlines()]
    assert lines[0][2] == "by" and lines[0][-1] == "÷ failover"
    assert (lines[2][2], lines[2][-1]) == ("failover", "")
    assert (lines[3][2], lines[3][-1]) == ("other", "10.0 ×")
    assert {len(line) for line in lines} == {11}


@pytest.mark.parametrize(("value", "text"), [(0.123, "0.12"), (12.34, "12.3"), (1234.5, "1,234"), (0.0, "0.00")])
def test_a_number_has_the_digits_that_matter(value: float, text: str) -> None:
    assert number(value) == text


def test_the_page_tells_who_was_not_measured_and_why() -> None:
    found = Findings("Stops", "How long.", (OURS,), (Absent("CRIU", "needs root"),))
    page = results.page("python -m benchmarks", FACTS, "", [found])
    assert "* cores: 2" in page
    assert "Not measured: CRIU: needs root." in page
    assert "## Stops\n\nHow long.\n\n| measured" in page


def test_a_busy_machine_is_said_on_the_page() -> None:
    said = machine.warning(0.5)
    assert said.startswith("50% of this machine's time goes to something else")
    assert machine.warning(0.01) == ""
    assert f"**{said}.**" in results.page("python -m benchmarks", FACTS, said, [])


def test_what_the_host_gave_to_others_is_said_beside_the_figures() -> None:
    earlier, later = machine.Ticks(100, 10, 50), machine.Ticks(140, 20, 100)
    stolen = (later - earlier).stolen_share
    assert stolen == pytest.approx(0.1)
    assert "The host gave 10% of this machine's time to others" in results.section(Findings("Stops", "", (OURS,), (), stolen))
    assert "The host" not in results.section(Findings("Stops", "", (OURS,), (), 0.005))


def test_the_clock_ticks_of_this_machine_go_on() -> None:
    before = machine.ticks()
    while (passed := machine.ticks() - before).used + passed.idle == 0:
        pass
    assert passed.whole == passed.used + passed.stolen + passed.idle
    assert 0 <= passed.stolen_share <= 1


def test_the_record_holds_every_single_value(tmp_path: Path) -> None:
    results.write(tmp_path, "python -m benchmarks", FACTS, "", [Findings("Stops", "How long.", (OURS, THEIRS))])
    record = json.loads((tmp_path / results.RECORD).read_text())
    assert record["machine"] == FACTS
    assert record["findings"][0]["figures"][0] == {
        "benchmark": "stop",
        "case": "10 MB",
        "unit": "ms",
        "values": [1.0, 2.0, 3.0],
        "who": "failover",
    }
    assert (tmp_path / results.PAGE).read_text().count("\n| stop |") == 2


def test_the_facts_are_those_of_this_machine() -> None:
    facts = machine.facts(0.0)
    assert facts["cores"] == str(os.cpu_count())
    assert facts["kernel"] == os.uname().release
    assert "unknown" not in (facts["processor"], facts["memory"])


def test_gaps_lie_between_neighbours_inside_the_span() -> None:
    instants = [1.0, 2.0, 2.02, 2.05, 9.0]
    assert gaps(instants, 2.0, 3.0) == pytest.approx((20.0, 30.0))
    assert gaps(instants, 5.0, 6.0) == ()
