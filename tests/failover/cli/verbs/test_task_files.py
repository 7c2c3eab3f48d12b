"""failover task import and failover trace: what is declared, what a trace holds."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import pytest

import failover
from failover.cli import main
from failover.schedule.overview import open_schedule
from failover.schedule.trace import Activation, Traced, as_events
from tests.failover.boards.conftest import place

__all__ = ["place"]


def said(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    status = main.main(list(argv))
    out, err = capsys.readouterr()
    return status, out, err


def test_all_of_a_file_is_declared_or_nothing(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "pman.conf"
    path.write_text("vision 1 0 1 40\nagent 2 1 1 30\n")
    with failover.scheduled("keep", period=1):
        assert said(capsys, "task", "import", str(path), "--tick-ms", "33") == (0, "declared 2 tasks\n", "")
        file = open_schedule()
        periods = {row.name: row.terms.period_ns for row in file.rows().values() if row.terms is not None}
        assert periods == {"keep": 10**9, "vision": 33_000_000, "agent": 66_000_000}
        path.write_text("third 1 0 1 40\nfourth 2 1\n")
        status, _, err = said(capsys, "task", "import", str(path), "--tick-ms", "33")
        assert status == 1 and "pman.conf:2: 3 words" in err
        assert file.row_of("third") is None
        file.close()
        status, _, err = said(capsys, "task", "import", str(tmp_path / "none"), "--tick-ms", "33")
        assert status == 1 and "No such file" in err


def test_a_trace_has_the_activations_of_each_task_and_their_order(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    over = threading.Event()

    def run(name: str, after: tuple[str, ...]) -> None:
        with failover.scheduled(name, period=0.01, after=after, deadline=0.01) as task:
            for _ in task:
                if over.is_set():
                    return

    with failover.scheduled("keep", period=1):
        threads = [threading.Thread(target=run, args=words) for words in (("first", ()), ("second", ("first",)))]
        for thread in threads:
            thread.start()
        path = tmp_path / "robot.pftrace"
        try:
            while said(capsys, "task", "histogram", "second")[0]:
                pass
            while True:  # until a busy machine has let some activations be seen
                status, out, err = said(capsys, "trace", "-o", str(path), "--for", "1s")
                assert (status, err) == (0, "")
                assert "activations of" in out
                events = json.loads(path.read_text())["traceEvents"]
                slices = [event for event in events if event["ph"] == "X"]
                if {event["name"] for event in slices} >= {"first", "second"} and any(event["ph"] == "s" for event in events):
                    break
        finally:
            over.set()
            for thread in threads:
                thread.join()
        tracks = {event["args"]["name"]: event["tid"] for event in events if event["name"] == "thread_name"}
        assert set(tracks) == {"keep", "first", "second"}
        assert all(event["tid"] == tracks[event["name"]] and event["dur"] >= 0 for event in slices)
        arrows = {event["id"]: event["ts"] for event in events if event["ph"] == "s"}
        assert all(event["ts"] >= arrows[event["id"]] for event in events if event["ph"] == "f")


def test_an_arrow_leads_from_what_covers_an_activation(place: Path) -> None:
    with failover.scheduled("slow", period=0.1), failover.scheduled("fast", period=0.01, after="slow"):
        file = open_schedule()
        rows = file.rows()
        file.close()
    slow, fast = (next(index for index, row in rows.items() if row.name == name) for name in ("slow", "fast"))
    activations = [
        Activation(slow, 0, 1000, 1001, 1010),
        Activation(slow, 1, 1100, 1101, 1110),
        Activation(fast, 9, 1090, 1091, 1095),
        Activation(fast, 10, 1100, 1112, 1115),
        Activation(fast, 11, 1200, 1201),
    ]
    told = as_events(Traced(rows, "robot1", activations, [(fast, 1130)], {fast: 2}))
    starts = [event["ts"] for event in told["traceEvents"] if event["ph"] == "s"]
    ends = [event["ts"] for event in told["traceEvents"] if event["ph"] == "f"]
    assert (starts, ends) == ([1.009, 1.109, 1.109], [1.091, 1.112, 1.201])
    assert told["otherData"] == {"robot": "robot1", "unseen": {"fast": 2}}
    assert [event["name"] for event in told["traceEvents"] if event["ph"] == "i"] == ["deadline missed"]


def test_mistakes_are_sentences(place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, _, err = said(capsys, "trace", "-o", str(tmp_path / "t"), "--for", "1s")
    assert status == 1 and "there is no schedule in" in err
    with failover.scheduled("keep", period=1):
        status, _, err = said(capsys, "trace", "-o", str(tmp_path / "t"), "--for", "soon")
        assert status == 1 and "--for soon" in err
        status, _, err = said(capsys, "trace", "-o", str(tmp_path / "none" / "t"), "--for", "1s")
        assert status == 1 and "No such file" in err
