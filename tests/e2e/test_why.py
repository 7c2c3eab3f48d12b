"""The story of a takeover, as somebody reads it who was not there: at either robot, after the agents were restarted."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_deaths import COUNT

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        robots.run(both[0], "count", "/usr/bin/python3", "-S", "-c", COUNT)
        robots.until_protected(both[0])
        yield both


def why(robot: RobotMachine, *arguments: str) -> dict[str, Any]:
    ran = robots.failover(robot, "why", "--json", *arguments)
    assert ran.returncode == 0, ran
    answer: dict[str, Any] = json.loads(ran.stdout)
    return answer


def lines(robot: RobotMachine, words: str, *arguments: str) -> list[dict[str, Any]]:
    return [line for line in why(robot, *arguments)["story"] if words in line["did"]]


def test_a_takeover_is_told_with_what_was_seen_and_what_it_cost_and_outlives_the_agent(pair: Pair) -> None:
    first, second = pair
    first.cut_power()
    robots.until(lambda: robots.component(second, "count").get("role") == "primary", "robot2 to take over")
    robots.until(lambda: bool(lines(second, "goes on from checkpoint")), "the story to be told")
    (claim,) = lines(second, "claims epoch", "--robot", "robot2")
    (seen,) = claim["seen"]
    assert (seen["robot"], seen["state"]) == ("robot1", "dead")
    assert seen["silent_ms"] >= seen["limit_ms"] > 0 and all(silent >= seen["limit_ms"] for silent in seen["links"].values())
    assert claim["epoch"] == claim["epoch_before"] + 1 and claim["late_ms"] >= 0
    assert claim["checkpoint"] and claim["checkpoint_age_ms"] >= 0
    assert "the last word of the robot" in lines(second, "acts again")[0]["did"]
    by_robot = {one["robot"]: one for one in why(second)["robots"]}
    assert not by_robot["robot1"]["answered"] and by_robot["robot1"]["reason"]
    shown = robots.failover(second, "why", "count").stdout
    assert "robot1: counted as dead, silent for" in shown and "robot1 did not tell its part:" in shown, shown

    before = why(second, "count", "--robot", "robot2")["story"]
    robots.keep_on(second)
    robots.stop_agent(second)
    robots.start_agent(second)
    robots.until(lambda: robots.answers(second), "the agent to be back")
    after = why(second, "count", "--robot", "robot2")["story"]
    assert [(line["life"], line["number"], line["did"]) for line in after][: len(before)] == [
        (line["life"], line["number"], line["did"]) for line in before
    ]
    assert lines(second, "begins, life 2", "--robot", "robot2")


def test_a_frozen_primary_says_how_much_output_nobody_holds_and_both_stories_are_one(pair: Pair) -> None:
    """robot1's agent is stopped (not its program): its guard freezes what it runs, robot2 takes over, then robot1 hears of it."""
    first, second = pair
    agent = robots.host_pid(first, first.status()["pid"])
    os.kill(agent, signal.SIGSTOP)
    robots.until(lambda: robots.component(second, "count").get("role") == "primary", "robot2 to take over")
    os.kill(agent, signal.SIGCONT)
    robots.until(lambda: robots.component(first, "count").get("role") == "standby", "robot1 to follow")
    robots.until(lambda: bool(lines(first, "is told stale")), "the story to be told")
    for robot in pair:
        told = why(robot, "count")
        assert all(one["answered"] for one in told["robots"])
        did = [(line["robot"], line["did"]) for line in told["story"]]
        claimed = next(at for at, (by, what) in enumerate(did) if by == "robot2" and "claims epoch" in what)
        stale = next(at for at, (by, what) in enumerate(did) if by == "robot1" and "is told stale" in what)
        assert claimed < stale, did
        assert any(line["robot"] == "robot1" and "itself stood still" in line["did"] for line in told["story"])
    robots.until(lambda: any(line["output_pending"] is not None for line in why(first)["story"]), "the output to be counted")


def test_only_what_is_young_enough_is_told(pair: Pair) -> None:
    first, _ = pair
    robots.until(lambda: bool(lines(first, "is its standby")), "the story to be told")
    assert why(first, "--since", "1h")["story"]
    assert why(first, "--since", "1ms")["story"] == []
    assert robots.failover(first, "why", "--since", "yesterday").returncode == 2
    assert "the team knows no robot 'mars', only robot1, robot2" in robots.failover(first, "why", "--robot", "mars").stderr
