"""Four agents on one switch: each frame is one datagram for all; a robot that it does not reach gets its own, and lives."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import failover
from failover.cli.demo.robots import Pace, RobotMachine, ip_command
from failover.client.control import SOCKET_VARIABLE
from failover.core.frames.media import Cast
from tests.e2e import bridged, robots, teams
from tests.e2e.bridged import SwitchStage
from tests.e2e.test_takeover import COUNT

pytestmark = pytest.mark.skipif(not robots.has_cable(), reason="needs network namespaces: run as root")

PACE = Pace(20, 400)
COUNTER = ("/usr/bin/python3", "-S", "-c", COUNT.format(limit=1_000_000))
"""A lease that a busy machine does not use up."""


@contextmanager
def four(directory: Path) -> Iterator[SwitchStage]:
    with bridged.on_one_switch(directory, 4, pace=PACE) as stage:
        bridged.settled(stage)
        yield stage


def no_multicast_to(stage: SwitchStage, port: str, flood: str = "off") -> None:
    """Have the switch forward no multicast to a port; it forwards broadcasts."""
    stage.on_switch(ip_command() or "ip", "link", "set", "switch", "type", "bridge", "mcast_snooping", "0")
    stage.on_switch("bridge", "link", "set", "dev", port, "mcast_flood", flood)


def by_unicast(robot: RobotMachine) -> object:
    return bridged.medium(robot)["by_unicast"]


def test_each_frame_is_one_datagram_for_all_and_brings_heartbeats_and_items(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FAILOVER_BOARD", raising=False)
    with four(tmp_path) as stage:
        boards = []
        for robot in stage.robots:
            monkeypatch.setenv(SOCKET_VARIABLE, str(robot.socket))
            boards.append(failover.board())
        for number, board in enumerate(boards):
            board.item("ball").put({"x": float(number), "y": 2.0})
        for board in boards:
            for number, name in enumerate(stage.names):
                robots.until(lambda b=board, n=name, x=number: seen(b, n) == x, f"the ball of {name}")
        came = bridged.frames_at(stage.robots[0], 1.0)
        assert {one.rank for one in came} == {1, 2, 3}
        cast = [one for one in came if one.to.startswith("239.77.")]
        assert len(cast) > len(came) * 3 / 4, "few were sent to this robot besides"
        robots.until(lambda: all(teams.hears_all(robot) for robot in stage.robots), "each robot to hear all others")
        for board in boards:
            board.close()


def seen(board: failover.Board, robot: str) -> float | None:
    try:
        return float(board.item("ball").get(robot).value["x"])
    except failover.NeverWrittenError:
        return None


def test_a_robot_that_no_multicast_reaches_is_served_by_unicast_and_its_component_stays(tmp_path: Path) -> None:
    with four(tmp_path) as stage:
        first, *_, last = stage.robots
        bridged.run_at_last(last, "count", *COUNTER)
        robots.until_protected(last)
        epoch = robots.component(last, "count")["epoch"]
        no_multicast_to(stage, last.name)
        for robot in stage.robots[:-1]:
            robots.until(lambda one=robot: last.name in by_unicast(one), f"{robot.name} to serve {last.name} by unicast")
        robots.until(lambda: all(teams.hears_all(robot) for robot in stage.robots), "each robot to hear all others")
        before = len(robots.numbers(last))
        robots.until(lambda: len(robots.numbers(last)) > before + 20, "it to go on")
        now = robots.component(last, "count")
        assert (now["role"], now["epoch"]) == ("primary", epoch)
        assert robots.component(first, "count")["primary"] == last.name
        no_multicast_to(stage, last.name, "on")
        bridged.settled(stage)


def test_where_multicast_reaches_no_robot_frames_are_broadcast(tmp_path: Path) -> None:
    with four(tmp_path) as stage:
        for name in stage.names:
            no_multicast_to(stage, name)
        robots.until(lambda: all(bridged.is_cast_to_all(robot, Cast.BROADCAST) for robot in stage.robots), "broadcast everywhere")
        assert "none has heard a multicast" in str(bridged.medium(stage.robots[0])["because"])
        robots.until(lambda: all(teams.hears_all(robot) for robot in stage.robots), "each robot to hear all others")
