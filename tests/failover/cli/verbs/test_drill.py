"""A drill's report: what it says of each move, and what counts as missed."""

from __future__ import annotations

import argparse
import json
from contextlib import nullcontext
from typing import Any

import pytest

from failover.cli.verbs import drill as module
from failover.cli.verbs.drill import Leg, Report, _missed, _told
from failover.errors import AgentRefusedError

LEG = Leg("robot1", "robot2", 5, 40.0, 0.5, 300.0, 900.0, 98.0, (100, 180))


def leg(**changes: Any) -> Leg:
    return Leg(**{name: changes.get(name, getattr(LEG, name)) for name in LEG.__struct_fields__})


@pytest.mark.parametrize(
    ("one", "at_most_ms", "said"),
    [
        (leg(), None, ""),
        (leg(), 40, ""),
        (leg(stood_still_ms=40.4), 40, ""),
        (leg(stood_still_ms=41.0), 40, "from robot1 to robot2 it stood still for 41 ms, longer than 40 ms"),
        (leg(stood_still_ms=None), None, ""),
        (leg(stood_still_ms=None), 40, "from robot1 to robot2 it stood still for an unknown time, longer than 40 ms"),
        (leg(output=(100, 80)), None, "from robot1 to robot2 20 bytes of output were taken back that readers may have seen"),
    ],
)
def test_what_counts_as_missed(one: Leg, at_most_ms: int | None, said: str) -> None:
    assert _missed(one, at_most_ms) == ([said] if said else [])


def test_the_report_ends_with_where_the_component_is() -> None:
    legs = (leg(), leg(source="robot2", target="robot1", epoch=6, checkpoint_age_ms=120.0))
    well = _told(Report("/lab/x", "robot1", "robot2", "robot1", "If robot1 is silent for 220 ms, robot2 runs it.", legs, ()))
    assert well[0].startswith("robot1 → robot2, epoch 5: it stood still 40.0 ms (± 0.5 ms); the order took 300 ms")
    assert (
        well[2]
        == "a real loss would have cost 120 ms of its work, and the silence: If robot1 is silent for 220 ms, robot2 runs it."
    )
    assert well[-1] == "/lab/x is back at robot1: all was as promised"
    bad = _told(Report("/lab/x", "robot1", "robot2", "robot2", "", legs[:1], ("it did not move",)))
    assert bad[-2:] == ["MISSED: it did not move", "/lab/x runs at robot2"]


class Agent:
    """Of a robot whose component ends, or whose user gives up, once it has moved."""

    def __init__(self, ending: str) -> None:
        self.ending, self.moved = ending, False

    def ask(self, verb: str, **wanted: Any) -> dict[str, Any]:
        if verb == "handover":
            self.moved = True
            return {"to": wanted["to"], "epoch": 6, "took_ms": 300.0, "sentence": ""}
        if verb == "logs":
            return {"totals": [0, 0]}
        if self.moved and self.ending == "interrupted":
            raise KeyboardInterrupt
        here, there = ("robot2", "robot1") if self.moved else ("robot1", "robot2")
        component = {"name": "/lab/x", "role": "primary", "primary": here, "standby": there, "epoch": 5, "state": "running"}
        component |= {"state": "ended", "standby": "", "protection": "none"} if self.moved else {"protection": "protected"}
        peers = [{"role": "robot"}] * 2 if self.ending == "away" else []
        return {"robot": "robot1", "peers": peers, "components": [component | {"home": "robot3"}]}


def drilled(monkeypatch: pytest.MonkeyPatch, ending: str) -> int:
    monkeypatch.setattr(module, "connect", lambda _: nullcontext(Agent(ending)))
    return module.drill(argparse.Namespace(name="x", json=True, yes=True, at_most_ms=None))


def test_a_component_that_ends_meanwhile_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(module, "PATIENCE_S", 1.0)
    assert drilled(monkeypatch, "ended") == 1
    report = json.loads(capsys.readouterr().out)
    assert report["runs_at"] == "" and "/lab/x has ended since it moved to robot2" in report["missed"][0]


def test_of_three_robots_a_component_that_is_away_is_not_moved_for_it_would_not_come_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(AgentRefusedError, match=r"it runs at robot1 and belongs at robot3.*; failover failback x first"):
        drilled(monkeypatch, "away")


def test_whoever_gives_up_is_told_how_to_find_the_component_and_to_bring_it_back(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(KeyboardInterrupt):
        drilled(monkeypatch, "interrupted")
    said = capsys.readouterr().err
    assert "failover status /lab/x shows where it runs" in said and "failover handover /lab/x --to robot1" in said
