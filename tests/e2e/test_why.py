"""The event log of a takeover, as a reader sees it who was not there: at either robot, after the agents were restarted."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import compiler
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
    robots.until_taken_over(second)
    robots.until(lambda: bool(lines(second, "resumes from checkpoint")), "the event log to tell of it")
    (claim,) = lines(second, "claims epoch", "--robot", "robot2")
    (seen,) = claim["seen"]
    assert (seen["robot"], seen["state"]) == ("robot1", "dead")
    assert seen["silent_ms"] >= seen["limit_ms"] > 0 and all(silent >= seen["limit_ms"] for silent in seen["links"].values())
    assert claim["epoch"] == claim["epoch_before"] + 1 and claim["late_ms"] >= 0
    assert claim["checkpoint"] and claim["checkpoint_age_ms"] >= 0
    acted = robots.until(lambda: lines(second, "acts again"), "what it cost to be told")
    assert "the last word of the robot" in acted[0]["did"]
    by_robot = {one["robot"]: one for one in why(second)["robots"]}
    assert not by_robot["robot1"]["answered"] and by_robot["robot1"]["reason"]
    shown = robots.failover(second, "why", "count").stdout
    assert "robot1: counted as dead, silent for" in shown and "robot1 did not send its event log:" in shown, shown

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
    assert why(second, "--since", "1h")["story"] and why(second, "--since", "1ms")["story"] == []
    assert robots.failover(second, "why", "--since", "yesterday").returncode == 2
    assert "the team knows no robot 'mars', only robot2, robot1" in robots.failover(second, "why", "--robot", "mars").stderr


SKEW = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdlib.h>
#include <time.h>
int clock_gettime(clockid_t which, struct timespec *now) {
    int (*real)(clockid_t, struct timespec *) = dlsym(RTLD_NEXT, "clock_gettime");
    int status = real(which, now);
    const char *skew = getenv("SKEW_S");
    if (status == 0 && which == CLOCK_REALTIME && skew) now->tv_sec += atoi(skew);
    return status;
}
"""
"""The calendar of the processes that load it is wrong by so many seconds."""

SKEW_S = 5


def start_with_a_wrong_clock(robot: RobotMachine, directory: Path) -> None:
    """The robot's agent ends, and starts again with its calendar `SKEW_S` ahead of everybody else's."""
    source, library = directory / "skew.c", directory / "skew.so"
    source.write_text(SKEW)
    gcc = compiler()
    assert gcc is not None
    subprocess.run([gcc, "-shared", "-fPIC", "-o", library, source], check=True)
    robots.keep_on(robot)
    robots.stop_agent(robot)
    robots.start_agent(robot, LD_PRELOAD=str(library), SKEW_S=str(SKEW_S))


@pytest.mark.compiler
def test_both_robots_tell_one_story_in_order_though_a_clock_is_wrong_by_five_seconds(pair: Pair, tmp_path: Path) -> None:
    """robot1's agent is stopped, not its program: the guard holds it still, robot2 takes over, then robot1 hears of it."""
    first, second = pair
    start_with_a_wrong_clock(second, tmp_path)
    robots.until(lambda: robots.answers(second) and robots.connected(first) and robots.connected(second), "robot2 to be back")
    robots.until_protected(first)
    agent = robots.host_pid(first, first.status()["pid"])
    os.kill(agent, signal.SIGSTOP)
    robots.until_taken_over(second)
    os.kill(agent, signal.SIGCONT)
    robots.until(lambda: robots.component(first, "count").get("role") == "standby", "robot1 to follow")
    robots.until(lambda: bool(lines(first, "hears that its copy is stale")), "the event log to tell of it")
    for robot, other, ahead_ms in ((first, "robot2", SKEW_S * 1_000), (second, "robot1", -SKEW_S * 1_000)):
        told = robots.until(lambda at=robot: told_by_both(at), "both robots to tell their part")  # type: ignore[misc]
        clocks = {one["robot"]: one["clock_offset_ms"] for one in told["robots"]}
        assert clocks[other] == pytest.approx(ahead_ms, abs=1_000) and clocks[robot.name] == 0
        expect_the_order(told["story"])
        way = "ahead of" if ahead_ms > 0 else "behind"
        shown = robots.failover(robot, "why", "count").stdout
        assert re.search(rf"^{other}: its clock is [45]\.\d+ s {way} this robot's", shown, re.MULTILINE), shown
    robots.until(lambda: any(line["output_pending"] is not None for line in why(first)["story"]), "the output to be counted")


def told_by_both(robot: RobotMachine) -> dict[str, Any]:
    """The event log of the component as it is told there, once both robots have answered in time."""
    told = why(robot, "count")
    return told if all(one["answered"] for one in told["robots"]) else {}


def expect_the_order(story: list[dict[str, Any]]) -> None:
    """robot2 noticed the silence, claimed, ran it; then robot1 woke, said so, and was told stale: whoever's clock was right."""
    did = [(line["robot"], line["did"]) for line in story]

    def places(robot: str, words: str, after: int = -1) -> list[int]:
        return [at for at, (by, what) in enumerate(did) if by == robot and words in what and at > after]

    claim = max(places("robot2", "claims epoch"))
    noticed = [at for at in places("robot2", "robot1 was silent for") if at < claim]
    woke = places("robot1", "itself stood still", after=claim)  # on a busy machine also later, once more
    assert noticed and woke, did
    stale = places("robot1", "hears that its copy is stale", after=woke[0])
    assert stale, did
    instants = [story[place]["at"] for place in (noticed[-1], claim, woke[0], stale[0])]
    assert instants == sorted(instants), "by the one clock that they are shown on"
