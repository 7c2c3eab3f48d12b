"""Health asked at each of two robots: the answer is the same, and never better than what is known."""

from __future__ import annotations

from typing import Any

import pytest

from failover.client.health import is_healthy, is_unprotected, sight

PRIMARY = {
    "name": "/lab/count",
    "primary": "robot1",
    "role": "primary",
    "state": "running",
    "epoch": 2,
    "standby": "robot2",
    "protection": "protected",
}
STANDBY = {**PRIMARY, "role": "standby", "state": "held", "protection": "none"}

ROBOTS = ("robot1", "robot2")

CASES: dict[str, tuple[dict[str, Any] | None, dict[str, Any] | None, bool]] = {
    "protected": ({}, {}, True),
    "unprotected": ({"protection": "none", "standby": ""}, {}, False),
    "its first checkpoint has not come": ({"protection": "none"}, {}, False),
    "protected no longer": ({"protection": "stopped"}, {}, False),
    "degraded": ({"protection": "degraded", "state": "degraded"}, {}, False),
    "failed": ({"state": "failed"}, {"state": "failed"}, False),
    "held still, before any peer counts as dead": ({"state": "frozen"}, {}, False),
    "others write to its file": ({"contested": ["a file"]}, {}, False),
    "refused by its standby": ({}, {"lacks": ["a disk"]}, False),
    "not stored at its standby": ({}, {"unstored": "no space"}, False),
    "cold at its standby": ({}, {"cold": "it ended"}, False),
    "held by both": ({"role": "standby", "state": "held", "protection": "none"}, {}, False),
    "ended": ({"role": "none", "state": "ended"}, {"role": "none", "state": "ended"}, True),
    "released": ({"role": "none", "state": "released"}, {"role": "none", "state": "released"}, True),
    "ended, and its standby has not heard": ({"role": "none", "state": "ended"}, {}, True),
    "taken over": ({"role": "standby", "state": "held"}, {"role": "primary", "epoch": 3, "standby": ""}, False),
}


def asked(robot: str, sights: dict[str, dict[str, Any]], dead: dict[str, bool], answers: bool = True) -> dict[str, Any]:
    """What the agent of a robot answers, where the robots see one component so."""
    (other,) = (name for name in ROBOTS if name != robot)
    state = {True: "dead", False: "live"}
    one = {**sights[robot], "elsewhere": {other: sights[other]} if answers else {}}
    return {
        "robot": robot,
        "peers": [{"name": other, "state": state[dead.get(robot, False)]}],
        "peers_elsewhere": {other: {robot: state[dead.get(other, False)]}} if answers else {},
        "components": [one],
    }


@pytest.mark.parametrize(("first", "second", "well"), CASES.values(), ids=CASES)
def test_both_robots_answer_the_same(first: dict[str, Any], second: dict[str, Any], well: bool) -> None:
    sights = {"robot1": {**PRIMARY, **first}, "robot2": {**STANDBY, **second}}
    seen = {robot: sight(asked(robot, sights, {})["components"][0]) for robot in ROBOTS}
    assert {robot: is_healthy(asked(robot, sights, {})) for robot in ROBOTS} == dict.fromkeys(ROBOTS, well)
    assert seen["robot1"]["state"] == seen["robot2"]["state"]
    assert is_unprotected(seen["robot1"]) == is_unprotected(seen["robot2"])


@pytest.mark.parametrize("which", ROBOTS)
def test_a_robot_that_one_counts_as_dead_is_told_by_both(which: str) -> None:
    sights = {"robot1": PRIMARY, "robot2": STANDBY}
    assert not any(is_healthy(asked(robot, sights, {which: True})) for robot in ROBOTS)


def test_where_the_primary_has_not_answered_nothing_is_called_healthy() -> None:
    status = asked("robot2", {"robot1": PRIMARY, "robot2": STANDBY}, {}, answers=False)
    assert not is_healthy(status)
    ended = asked("robot2", {"robot1": PRIMARY, "robot2": {**STANDBY, "role": "none", "state": "ended"}}, {}, answers=False)
    assert is_healthy(ended)
