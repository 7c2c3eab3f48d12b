"""failover ps and failover task: what is shown, what an order does, and each mistake with its sentence."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import failover
from failover.cli import main
from failover.client.control import Result
from failover.core.schedule import layout
from failover.schedule.overview import open_schedule
from failover.schedule.task import ScheduledTask
from tests.failover.boards.conftest import place
from tests.failover.boards.programs import program
from tests.failover.cli.stand_in import StandIn

__all__ = ["place"]

MS = 1_000_000
ODOMETRY = """
with failover.scheduled("odometry", period=0.02) as task:
    task.wait_activation()
    say("begun")
    for tick in task:
        pass
"""


@pytest.fixture
def task(place: Path) -> Iterator[ScheduledTask]:
    """The mapper, which has run three times, after an odometry that no one has declared."""
    with failover.scheduled("mapper", period=0.005, deadline=0.004, after="odometry") as running:
        for _ in range(3):
            running.wait_activation()
        running.end()
        yield running


def said(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    """Exit status, standard output and standard error of one command line."""
    status = main.main(list(argv))
    out, err = capsys.readouterr()
    return status, out, err


def tasks(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """Task → what ps tells of it."""
    _, out, _ = said(capsys, "ps", "--json")
    return {one["task"]: one for one in json.loads(out)["tasks"]}


def test_ps_shows_each_task_and_what_is_missing(task: ScheduledTask, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, err = said(capsys, "ps")
    assert (status in (0, 1), err) == (True, "")  # 1: the test holds up its next activation
    assert "mapper" in out and "odometry (not declared)" in out and "5.00 ms" in out
    told = tasks(capsys)["mapper"]
    assert (told["state"], told["period_ms"], told["deadline_ms"], told["ended"]) == ("waiting", 5.0, 4.0, 3)
    assert told["late_p50_ms"] > 0


def test_ps_shows_a_task_below_the_component_whose_program_runs_it(
    place: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the locks of the component's processes: names do not tell."""
    with failover.scheduled("keep", period=1), program(ODOMETRY) as odometry:
        odometry.hear()
        facts = {"primary": "robot1", "role": "primary", "epoch": 1, "standby": "robot2", "protection": "protected"}
        driving = {**facts, "name": "/lab/robot1/driving", "state": "running", "pid": odometry.pid}
        status = {"robot": "robot1", "peers": [{"name": "robot2", "state": "live"}], "components": [driving]}
        agent = StandIn(tmp_path / "control.sock", lambda request: [Result(status)])
        monkeypatch.setenv("FAILOVER_SOCKET", str(agent.path))
        try:
            told = json.loads(said(capsys, "ps", "--json")[1])
            assert {one["task"]: one["component"] for one in told["tasks"]} == {"odometry": driving["name"], "keep": ""}
            assert [robot["robot"] for robot in told["robots"]] == ["robot1", "robot2"]
            _, out, _ = said(capsys, "ps")
            assert "└─ odometry" in out and "├─ driving" in out and "└─ other programs" in out
        finally:
            agent.close()


def test_ps_ends_with_1_if_nobody_runs_a_task(task: ScheduledTask, capsys: pytest.CaptureFixture[str]) -> None:
    assert said(capsys, "task", "add", "logger", "period_ms=1000", "after=mapper")[0] == 0
    status, out, _ = said(capsys, "ps")
    assert status == 1 and "logger" in out
    assert tasks(capsys)["logger"]["state"] == "idle"


def test_a_task_is_changed_while_it_runs_and_removed(task: ScheduledTask, capsys: pytest.CaptureFixture[str]) -> None:
    assert said(capsys, "task", "set", "mapper", "period_ms=8", "overrun=queue", "after=")[0] == 0
    assert task.wait_activation() is not None
    file = open_schedule()
    assert layout.read_course(file.table, 0).period_ns == 8 * MS
    assert layout.read_terms(file.table, 0)[1].after == ()
    file.close()
    assert said(capsys, "task", "remove", "mapper")[0] == 0
    assert task.wait_activation() is None
    assert "mapper" not in tasks(capsys)


def test_a_histogram_counts_each_activation(task: ScheduledTask, capsys: pytest.CaptureFixture[str]) -> None:
    status, out, _ = said(capsys, "task", "histogram", "mapper", "--json")
    told = json.loads(out)
    assert (status, sum(told["late"].values()), sum(told["took"].values())) == (0, 3, 3)
    status, out, _ = said(capsys, "task", "histogram", "mapper")
    assert status == 0 and "#" in out and "below" in out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("set", "maper", "period_ms=5"), "did you mean 'mapper'"),
        (("set", "mapper", "colour=5"), "'colour=5' is no setting of a task; there are period_ms"),
        (("set", "mapper", "period_ms=x"), "'x' is no number"),
        (("set", "mapper", "period_ms=nan"), "period is nan"),
        (("set", "mapper", "deadline_ms=50"), "longer than its period"),
        (("set", "mapper", "mode=eco"), "there is no mode 'eco'"),
        (("set", "mapper", "after=mapper"), "after itself"),
        (("set", "mapper", "budget_ms=4", "cpus=0", "deadline_ms=2"), "its budget"),
        (("add", "big", "period_ms=10", "budget_ms=9999"), "its budget"),
        (("remove", "nothing"), "no such task"),
        (("histogram", "nothing"), "no such task"),
    ],
)
def test_a_mistake_is_one_sentence_and_changes_nothing(
    task: ScheduledTask, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], sentence: str
) -> None:
    before = tasks(capsys)["mapper"]
    status, out, err = said(capsys, "task", *words)
    assert (status, out, err.count("\n")) == (1, "", 1)
    assert sentence in err
    after = tasks(capsys)["mapper"]
    assert {key: before[key] for key in ("period_ms", "deadline_ms", "after")} == {
        key: after[key] for key in ("period_ms", "deadline_ms", "after")
    }


def test_what_does_not_fit_is_refused_unless_it_is_forced(task: ScheduledTask, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("task", "add", "big", "period_ms=10", "budget_ms=9", "cpus=0")
    assert said(capsys, *words)[0] == 0
    more = ("task", "add", "more", "period_ms=10", "budget_ms=2", "cpus=0")
    status, _, err = said(capsys, *more)
    assert status == 1 and "on processor 0 need 110%" in err
    assert "more" not in tasks(capsys)
    status, out, _ = said(capsys, *more, "--force")
    assert status == 0 and "110%" in out and "more" in tasks(capsys)


def test_a_robot_without_tasks_says_how_one_begins(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, _, err = said(capsys, "ps")
    assert status == 1 and "there is no schedule in" in err and "failover.scheduled()" in err
    assert not place.exists()


HANGING = """
with failover.scheduled("hangs", period=0.02, deadline=0.01) as task:
    task.wait_activation()
    say("begun")
    hear()
    task.end()
    say("ended")
    hear()
"""


def test_a_task_that_hangs_misses_its_deadline_before_it_ends(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with failover.scheduled("keep", period=1), program(HANGING) as hanging:
        assert hanging.hear() == "begun"
        while not tasks(capsys)["hangs"]["past_deadline_ms"]:
            pass  # 10 ms later it is
        told = tasks(capsys)["hangs"]
        assert (told["state"], told["misses"], told["ended"]) == ("running", 1, 0)
        status, out, _ = said(capsys, "ps")
        assert status == 1 and "past its deadline" in out
        hanging.tell("end")
        assert hanging.hear() == "ended"
        assert tasks(capsys)["hangs"]["ended"] == 1


def test_a_process_that_is_stopped_misses_its_deadline(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = "with failover.scheduled('stops', period=0.02) as task:\n    for tick in task: say('begun')"
    with failover.scheduled("keep", period=1), program(text) as stopping:
        stopping.hear()
        os.kill(stopping.pid, signal.SIGSTOP)
        while Path(f"/proc/{stopping.pid}/stat").read_text().split()[2] != "T":
            pass
        ended = tasks(capsys)["stops"]["ended"]
        while not tasks(capsys)["stops"]["past_deadline_ms"]:
            pass
        told = tasks(capsys)["stops"]
        assert (told["misses"] >= 1, told["ended"]) == (True, ended)
        os.kill(stopping.pid, signal.SIGCONT)


@pytest.mark.parametrize(
    ("word", "sentence"),
    [
        ("cpus=-1", "cpus=-1: processors have the numbers 0 to 63"),
        ("cpus=0,99999999999", "cpus=99999999999: processors have the numbers 0 to 63"),
        ("cpus=nan", "cpus=nan: 'nan' is no whole number"),
        ("cpus=1.5", "cpus=1.5: '1.5' is no whole number"),
        ("priority=inf", "priority=inf: 'inf' is no whole number"),
        ("priority=nan", "priority=nan: 'nan' is no whole number"),
        ("priority=1.5", "priority=1.5: '1.5' is no whole number"),
        ("period_ms=nan", "period is nan: give seconds"),
    ],
)
def test_a_number_that_cannot_be_is_a_sentence(
    task: ScheduledTask, capsys: pytest.CaptureFixture[str], word: str, sentence: str
) -> None:
    status, _, err = said(capsys, "task", "add", "logger", "period_ms=20", word)
    assert status == 1 and sentence in err
