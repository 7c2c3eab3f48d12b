"""The demo with a program that is unhealthy for a while: it waits; if that lasts, it says why."""

from __future__ import annotations

import subprocess
from typing import Any, cast

import pytest

from failover.cli.demo import play
from failover.cli.demo.programs import Program
from failover.cli.demo.watch import Watcher
from failover.errors import FailoverError

LATE = {"state": "degraded", "reasons": [], "notes": ["snapshots do not arrive: the connection was lost"]}


class Named:
    """Of a program: its name is all that counts here."""

    name = "/demo/chaos"


@pytest.fixture
def act() -> play.Act:
    return play.Act(cast(Program, Named()), cast("subprocess.Popen[bytes]", None), cast(Watcher, None), cast(Watcher, None))


def at(monkeypatch: pytest.MonkeyPatch, now_s: float) -> None:
    monkeypatch.setattr(play.time, "monotonic", lambda: now_s)


def test_snapshots_that_are_late_for_a_moment_do_not_end_it(act: play.Act, monkeypatch: pytest.MonkeyPatch) -> None:
    for begun_s in (0.0, 100.0):
        at(monkeypatch, begun_s)
        play._bear(act, LATE)
        at(monkeypatch, begun_s + play.DEGRADED_S)
        play._bear(act, LATE)
        assert act.degraded_s == begun_s
        play._bear(act, {"state": "running"})
        assert act.degraded_s is None


def test_what_stays_degraded_ends_it_with_the_reason(act: play.Act, monkeypatch: pytest.MonkeyPatch) -> None:
    at(monkeypatch, 5.0)
    play._bear(act, LATE)
    at(monkeypatch, 5.1 + play.DEGRADED_S)
    with pytest.raises(FailoverError, match="/demo/chaos is degraded: snapshots do not arrive: the connection was lost"):
        play._bear(act, LATE)


@pytest.mark.parametrize("told", [{"reasons": ["no room"], "notes": ["other"]}, {"notes": ["no room"]}])
def test_what_has_failed_ends_it_at_once(act: play.Act, told: dict[str, Any]) -> None:
    with pytest.raises(FailoverError, match="/demo/chaos is failed: no room"):
        play._bear(act, {"state": "failed", **told})
