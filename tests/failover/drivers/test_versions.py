"""Callers that speak an earlier version of a driver's verbs are understood beside those that speak the newest one."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Annotated, Any

import msgspec
import pytest

import failover
from failover.cli import main
from failover.core.messaging.envelope import Envelope
from failover.drivers.actor import Actor
from failover.drivers.declare import declaration_of
from failover.drivers.here import Here
from failover.drivers.lookup import lookup
from failover.drivers.proxy import Proxy
from failover.errors import CallRefusedError, DriverError
from tests.failover.drivers.serving import LIMIT_S, called, serving


class PerCent:
    """Version 1 counted in per cent, and had a verb of another name."""

    def __init__(self, motor: Motor) -> None:
        self.motor = motor

    @failover.command(coalesce="latest")
    def set(self, percent: Annotated[float, msgspec.Meta(ge=-100, le=100)]) -> None:
        self.motor.set(duty=percent / 100)

    @failover.query
    def get(self) -> float:
        return 100 * self.motor.read()["duty"]

    @failover.stream(rate_hz=50)
    def power(self) -> float:
        return 100 * self.motor.power()


@failover.driver("Lab/Motor", alias="motor", speaks="2", earlier={"1": PerCent})
class Motor:
    duty = 0.0

    def __init__(self) -> None:
        self.heard: list[float] = []

    @failover.command(coalesce="latest")
    def set(self, duty: Annotated[float, msgspec.Meta(ge=-1, le=1)]) -> None:
        self.duty = duty
        self.heard.append(duty)

    @failover.query
    def read(self) -> dict[str, float]:
        return {"duty": self.duty}

    @failover.stream(rate_hz=50)
    def power(self) -> float:
        return abs(self.duty)


def speaking(here: Here, version: str) -> Proxy:
    return Proxy(here, lookup(here, "motor"), version=version)


def test_each_caller_is_understood_in_the_version_that_it_speaks(here: Here) -> None:
    with serving(Motor, here) as motor:
        with speaking(here, "1") as old, speaking(here, "2") as new, called(here, "motor") as newest:
            old.call("set", percent=40)
            assert [new.call("read"), newest.call("read"), old.call("get")] == [{"duty": 0.4}, {"duty": 0.4}, 40]
            new.call("set", duty=0.5)
            assert [next(one.stream("power")) for one in (old, new, newest)] == [50, 0.5, 0.5]
            done = old.post("set", 60)
            assert done.result(LIMIT_S) is None and motor.instance.heard == [0.4, 0.5, 0.6]


def test_what_a_version_has_not_is_refused_with_what_there_is(here: Here) -> None:
    with serving(Motor, here), speaking(here, "1") as old, speaking(here, "3") as later, called(here, "motor") as newest:
        with pytest.raises(CallRefusedError, match="percent"):
            old.call("set", percent=101)
        for refused in (lambda: old.call("read"), lambda: later.call("read"), lambda: newest.call("get")):
            with pytest.raises(CallRefusedError, match=r"it has set, read, power, set@1, get@1, power@1$"):
                refused()
        with pytest.raises(CallRefusedError, match="no stream 'power@3'"):
            next(later.stream("power"))


def test_commands_of_different_versions_do_not_become_one() -> None:
    motor, clock = Motor(), itertools.count(1)
    actor = Actor(motor, declaration_of(Motor), "robot1/motor")
    for place, (verb, body) in enumerate([("set@1", 20), ("set@1", 30), ("set", 0.4), ("set@2", 0.5)]):
        assert actor.came(Envelope(verb=verb, body=body, id=str(place), sender="robot1/mission"), "way", next(clock)) == []
    answers = [one for _ in range(3) for one in actor.handle(lambda: next(clock))]
    assert [(one.re, one.ok) for one in answers] == [("0", {"merged_into": "1"}), ("1", None), ("2", None), ("3", None)]
    assert motor.heard == [0.3, 0.4, 0.5]


def test_the_command_line_shows_and_calls_verbs_of_each_version(here: Here, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(Motor, here):
        assert main.main(["call", "motor", "set@1", '{"percent": 30}']) == 0
        assert main.main(["call", "motor", "read"]) == 0 and '{"duty": 0.3}' in capsys.readouterr().out
        assert main.main(["names"]) == 0
        assert "set read power set@1 get@1 power@1" in capsys.readouterr().out
        assert main.main(["graph"]) == 0
        assert "set@1" in capsys.readouterr().out


class Kept:
    """A version cannot keep anything of its own."""

    duty: float = failover.kept(default=0.0)

    @failover.query
    def read(self) -> float:
        return self.duty


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ({"earlier": {"1": PerCent}}, 'says no version of its own: write speaks="2"'),
        ({"speaks": "1", "earlier": {"1": PerCent}}, "speaks '1', and earlier={'1': …} names that, too"),
        ({"speaks": "1@2"}, "'1@2' is no version"),
        ({"speaks": "2", "earlier": {"x" * 17: PerCent}}, "letters, digits and points, 16 at most"),
        ({"speaks": "2", "earlier": {"1": Kept}}, "Kept keeps attributes: only Newest may"),
        ({"speaks": "2", "earlier": {"1": object}}, "object has no verb"),
        ({"speaks": 2}, 'write speaks="2", earlier={"1": Version1}'),
        ({"speaks": "2", "earlier": {1: PerCent}}, "do not name versions as text"),
        ({"speaks": "2", "earlier": [PerCent]}, "do not name versions as text"),
        ({"speaks": "2", "earlier": {"1": Kept()}}, "a class for each earlier one"),
        (
            {"speaks": "99", "earlier": {str(one): PerCent for one in range(30)}},
            "has 91 verbs with those of its earlier versions",
        ),
    ],
)
def test_versions_that_cannot_be_told_apart_are_refused_at_once(said: dict[str, Any], why: str) -> None:
    class Newest:
        @failover.query
        def read(self) -> float:
            return 0.0

    declare: Callable[[type], type] = failover.driver("Lab/Newest", **said)
    with pytest.raises(DriverError) as refused:
        declare(Newest)
    assert why in str(refused.value)


@pytest.mark.parametrize("version", [1, "1@2", "x" * 17])
def test_a_caller_of_no_version_is_told_at_once(here: Here, version: Any) -> None:
    with serving(Motor, here), pytest.raises(DriverError, match=r'is none: write text, such as version="1"'):
        speaking(here, version)
