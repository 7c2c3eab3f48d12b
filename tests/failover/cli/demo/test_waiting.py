"""A demo on a busy machine tells what it waits for; when it gives up it names the load, the cure and the place of the logs."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from failover.cli.demo import robots, waiting
from failover.cli.demo.play import Play
from failover.cli.demo.robots import Means, Stage
from failover.cli.demo.screen import PlainScreen
from failover.errors import FailoverError


class StuckStage(Stage):
    """Its agents never answer, as on a machine that is too busy."""

    def command(self, name: str, config: Path) -> list[str]:
        return ["sh", "-c", f"echo {name} has begun; exec sleep 600"]


@pytest.fixture
def stuck(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[list[str], str]:
    """The lines of such a demo, and its error."""
    monkeypatch.setattr(robots, "START_S", 1.0)
    monkeypatch.setattr(waiting, "TOLD_EVERY_S", 0.2)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    screen = PlainScreen()
    with StuckStage(tmp_path / "stage", Means(own_pids=False, own_network=False), tell=screen.say) as stage:
        with pytest.raises(FailoverError) as told:
            Play(stage, screen).perform()
    return screen.transcript, str(told.value)


def test_it_tells_what_it_waits_for_and_how_long(stuck: tuple[list[str], str]) -> None:
    lines, _ = stuck
    assert len(lines) >= 2
    assert all(re.search(r" s  waiting for the agent of robot1 to answer: \d s of 1 s at most$", line) for line in lines), lines


def test_when_it_gives_up_it_names_state_figure_cure_and_logs(stuck: tuple[list[str], str], tmp_path: Path) -> None:
    _, error = stuck
    assert error.startswith("the demo gave up: the agent of robot1 did not answer in 1 s. This machine has a load of ")
    assert "\n" not in error
    logs = Path(error.partition("The agents' logs are in ")[2].removesuffix("."))
    assert logs.is_relative_to(tmp_path)
    assert (logs / "robot1.log").read_text() == "robot1 has begun\n"
    shutil.rmtree(logs)


@pytest.mark.parametrize(
    ("load", "said"),
    [
        (40.0, "This machine has a load of 40.0 on 2 cores: that is too much for the demo. End other programs"),
        (0.5, "This machine has a load of 0.5 on 2 cores, so that is not the cause."),
    ],
)
def test_the_load_is_the_cause_only_where_it_is_high(load: float, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waiting.os, "getloadavg", lambda: (load, load, load))
    monkeypatch.setattr(waiting.os, "sched_getaffinity", lambda _: {0, 1})
    assert waiting.load_and_cure().startswith(said)


def test_a_wait_says_how_far_it_has_come(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waiting, "TOLD_EVERY_S", 0.0)
    told: list[str] = []
    wait = waiting.Waiting("the programs to end", 480.0, told.append)
    assert not wait.is_over(lambda: "chaos: 43 %")
    assert told == ["waiting for the programs to end: 0 s of 480 s at most; chaos: 43 %"]
