"""An operator brings a held component to life on two real robots, and is always told first what that risks."""

from __future__ import annotations

from pathlib import Path

from tests.e2e import robots, teams
from tests.e2e.robots import RobotMachine
from tests.e2e.test_orders import COUNTING, MORE, counted

HOLD = '[components."/demo/robot1/count"]\non_loss = "hold"\n'
FREEZE = 'when_alone = "freeze"\n'


def expect_one_history(robot: RobotMachine) -> None:
    """It counts on at this robot, without gap or repetition."""
    before = len(counted(robot))
    robots.until(lambda: len(counted(robot)) > before + MORE, f"the count to go on at {robot.name}")
    numbers = counted(robot)
    assert numbers == list(range(len(numbers)))


def test_a_held_component_runs_at_the_standby_when_it_is_promoted(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, HOLD) as (first, second):
        robots.run(first, "count", *COUNTING)
        robots.until_protected(first)
        refused = robots.failover(second, "promote", "count", "--robot", "robot1")
        assert refused.returncode == 1 and "here it is primary" in refused.stderr
        refused = robots.failover(first, "promote", "count", "--robot", "robot2")
        assert refused.returncode == 1 and "robot1 lives and has it" in refused.stderr
        first.cut_power()
        robots.until(lambda: second.status()["peers"][0]["state"] == "dead", "robot2 to miss robot1")
        told = robots.failover(second, "promote", "count")
        assert told.returncode == 1 and "if it lives it may run it too" in told.stderr
        held = robots.component(second, "count")
        assert (held["role"], held["state"]) == ("standby", "held")
        done = robots.failover(second, "promote", "count", "--yes")
        assert done.returncode == 0 and "count runs on robot2 now" in done.stdout, done
        assert robots.component(second, "count")["epoch"] > held["epoch"]
        expect_one_history(second)


def test_a_frozen_component_goes_on_where_it_stands_when_it_is_promoted(tmp_path: Path) -> None:
    with robots.two_robots(tmp_path, FREEZE) as (first, second):
        robots.run(first, "count", *COUNTING)
        robots.until_protected(first)
        second.cut_power()
        robots.until(lambda: robots.component(first, "count")["state"] == "frozen", "it to stand still")
        process, epoch = robots.component(first, "count")["pid"], robots.component(first, "count")["epoch"]
        done = robots.failover(first, "promote", "count", "--yes")
        assert done.returncode == 0 and "robot2 has not been heard" in done.stderr, done
        expect_one_history(first)
        shown = robots.component(first, "count")
        assert shown["pid"] == process and shown["epoch"] > epoch


def test_a_robot_that_has_nothing_is_sent_the_server_s_checkpoint_when_it_is_promoted(tmp_path: Path) -> None:
    with teams.acting(tmp_path, settings="patience_s = 1\n" + HOLD) as stage:
        first, hall = stage.members["robot1"], stage.members["hall"]
        robots.run(first, "count", *COUNTING)
        robots.until_protected(first)
        robots.until(lambda: robots.checkpoints(hall, "count") >= 2, "checkpoints at the server")
        stage.cut_power("robot1", "robot2")
        second = stage.switch_on("robot2", empty=True)
        robots.until(lambda: robots.component(second, "count").get("primary") == "robot1", "robot2 to know of it again")
        robots.until(lambda: "which hall keeps and sends first" in robots.failover(second, "promote", "count").stderr, "an offer")
        assert robots.component(second, "count")["state"] == "held"
        done = robots.failover(second, "promote", "count", "--yes")
        assert done.returncode == 0 and "count runs on robot2 now" in done.stdout, done
        expect_one_history(second)
