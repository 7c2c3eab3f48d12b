"""A component that one user has reserved: others' orders are refused at each robot; a takeover asks nothing."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from failover.client.control import Control
from failover.errors import AgentRefusedError
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_owners import GROUP, Pair, as_alice, open_the_way

pytestmark = pytest.mark.root

ASK = """
try:
    with Control.open(Path(sys.argv[1])) as link:
        print(json.dumps(link.ask(sys.argv[2], **json.loads(sys.argv[3]))))
except FailoverError as error:
    print(json.dumps({"refused": str(error)}))
"""
RUN = """
with Control.open(Path(sys.argv[1])) as link:
    argv = ["/usr/bin/env", "python3", "-Sc", "while 1: __import__('time').sleep(9)"]
    print(json.dumps(link.ask("run", name="hers", argv=argv, wait=False)))
"""


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    open_the_way(tmp_path)
    with robots.two_robots(tmp_path, f'group = "{GROUP}"\n') as both:
        yield both


def alice(robot: RobotMachine, verb: str, /, **arguments: Any) -> dict[str, Any]:
    ran = as_alice(robot, ASK, robot.socket, verb, json.dumps(arguments))
    assert ran.returncode == 0, ran.stderr
    answer: dict[str, Any] = json.loads(ran.stdout)
    return answer


def refused(asked: RobotMachine, verb: str, /, **arguments: Any) -> str:
    """Why root's order is refused."""
    with pytest.raises(AgentRefusedError) as told, Control.open(asked.socket) as link:
        link.ask(verb, **arguments)
    return str(told.value)


def test_a_reservation_refuses_orders_of_others_at_all_robots_also_at_one_that_was_away_and_no_takeover(pair: Pair) -> None:
    first, second = pair
    robots.until(lambda: alice(first, "ping").get("robot"), "the socket to be the group's, too")
    begun = as_alice(first, RUN, first.socket)
    assert begun.returncode == 0, begun.stderr
    robots.until_protected(first, "hers")
    assert "at most 240 min" in alice(first, "reserve", name="hers", span_ms=10**9)["refused"]
    assert "without rights.toml only its owner and root" in alice(first, "reserve", name="/demo/robot2", span_ms=9)["refused"]
    told = alice(first, "reserve", name="hers", span_ms=3_600_000, why="new wheels")
    assert "reserved by uid 7001 until" in told["sentence"]
    robots.until(lambda: len(second.status()["reservations"]) == 1, "robot2 to hear of it")

    for robot in pair:  # told to the other one, and asked of the one that carries it out
        for verb in ("handover", "stop", "release", "failback"):
            assert "hers is reserved by uid 7001 until" in refused(robot, verb, name="hers")
        (shown,) = robot.status()["reservations"]
        assert (shown["user"], shown["why"]) == ("uid 7001", "new wheels")
        assert robots.component(robot, "hers")["reserved"]["path"].endswith("/hers")
    assert "is reserved" in refused(first, "drain", robot="robot1")
    assert "is reserved" in refused(second, "reserve", name="/demo", span_ms=60_000)
    with Control.open(second.socket) as link:
        (path,) = (one["name"] for one in link.ask("status")["components"])
        assert "is reserved" in link.ask("may", rights=["operate"], paths=[path])["answers"]["operate"][path]
    assert alice(first, "handover", name="hers")["to"] == "robot2"
    robots.until_protected(second, "hers")

    robots.keep_on(first)
    robots.stop_agent(first)
    said = robots.failover(second, "reserve", "/demo/robot2", "--for", "1h", "--why", "calibration")
    assert said.returncode == 0 and "/demo/robot2 is reserved by root until" in said.stdout, said.stderr
    assert "is reserved by root" in str(alice(second, "run", name="/demo/robot2/x", argv=["/bin/true"], wait=False))
    robots.start_agent(first)
    robots.until(lambda: robots.answers(first) and len(first.status()["reservations"]) == 2, "robot1 to hear what it missed")
    said = robots.failover(second, "unreserve", "/demo/robot2")
    assert said.returncode == 0 and "free again" in said.stdout
    robots.until(lambda: len(first.status()["reservations"]) == 1, "robot1 to hear of the end")
    assert "is not reserved" in robots.failover(first, "unreserve", "/demo/robot2").stderr
    assert "one line of at most 120 characters" in refused(first, "reserve", name="/demo", span_ms=9, why="x" * 121)
    assert "hers is reserved by uid 7001 until" in robots.failover(first, "status").stdout

    second.cut_power()
    robots.until_taken_over(first, "hers")
    said = robots.failover(first, "unreserve", "hers")
    assert said.returncode != 0 and "is reserved by uid 7001" in said.stderr and "--break" in said.stderr
    said = robots.failover(first, "unreserve", "hers", "--break")
    assert said.returncode == 0 and "root has broken the reservation of uid 7001" in said.stdout
    with Control.open(first.socket) as link:
        link.ask("release", name="hers")
