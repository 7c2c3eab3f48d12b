"""An operator's orders on two real robots: handover and back, prefer, release, stop."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.errors import AgentRefusedError
from tests.e2e import robots, teams
from tests.e2e.robots import RobotMachine

COUNT = "import time\ni = 0\nwhile True:\n    print(i, flush=True)\n    i += 1\n    time.sleep(0.01)\n"
COUNTING = ("/usr/bin/python3", "-S", "-c", COUNT)
MORE = 20
"""Numbers that show that it counts on."""

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with robots.two_robots(tmp_path) as both:
        yield both


def protected_count(pair: Pair) -> None:
    """A counting program at the first robot, protected by the second."""
    robots.run(pair[0], "count", *COUNTING)
    robots.until(lambda: robots.component(pair[0], "count").get("protection") == "protected", "a checkpoint at robot2")


def counted(robot: RobotMachine) -> list[int]:
    return [int(line) for line in robots.output(robot, "count").split()]


def expect_more(robot: RobotMachine) -> None:
    """It counts on at this robot, and its output as a whole has no gap and no repetition."""
    before = len(counted(robot))
    robots.until(lambda: len(counted(robot)) > before + MORE, f"the count to go on at {robot.name}")
    numbers = counted(robot)
    assert numbers == list(range(len(numbers)))


def order(at: RobotMachine, verb: str, **arguments: object) -> dict[str, object]:
    with at.control() as link:
        return link.ask(verb, **arguments)


def runs_at(pair: Pair, robot: RobotMachine) -> bool:
    """Whether both robots say that it runs there and nowhere else."""
    return all(robots.component(one, "count").get("primary") == robot.name for one in pair)


def test_a_handover_and_the_way_back_leave_no_gap(pair: Pair) -> None:
    first, second = pair
    protected_count(pair)
    for source, target in ((first, second), (second, first), (first, second)):
        robots.until(lambda at=source: robots.component(at, "count").get("protection") == "protected", "its protection")  # type: ignore[misc]
        answer = order(source, "handover", name="count", to=target.name)
        assert answer["to"] == target.name
        robots.until(lambda at=target: runs_at(pair, at), f"both to know that it runs at {target.name}")  # type: ignore[misc]
        expect_more(target)


def test_a_handover_to_nobody_is_refused_and_the_program_runs_on(pair: Pair) -> None:
    protected_count(pair)
    with pytest.raises(AgentRefusedError, match="robot7"):
        order(pair[0], "handover", name="count", to="robot7")
    expect_more(pair[0])


def test_a_preferred_robot_gets_the_component(pair: Pair) -> None:
    first, second = pair
    protected_count(pair)
    order(first, "prefer", name="count", robot="robot2")
    robots.until(lambda: runs_at(pair, second), "it to move to the preferred robot")
    expect_more(second)


def test_failback_brings_a_component_home(pair: Pair) -> None:
    first, second = pair
    protected_count(pair)
    order(first, "handover", name="count", to="robot2")
    robots.until(lambda: robots.component(second, "count").get("protection") == "protected", "its protection at robot2")
    order(second, "failback", name="count")
    robots.until(lambda: runs_at(pair, first), "it to be back home")
    expect_more(first)


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_of_three_robots_the_preferred_one_is_lost_is_back_and_runs_it_again(tmp_path: Path) -> None:
    with teams.acting(tmp_path, {"robot1": "robot", "robot2": "robot", "robot3": "robot"}) as stage:
        first = stage.members["robot1"]
        robots.run(first, "count", *COUNTING)
        order(first, "prefer", name="count", robot="robot1")
        robots.until_protected(first)
        stage.cut_power("robot1")
        left = [stage.members[name] for name in ("robot2", "robot3")]
        heir = robots.until(
            lambda: next((one for one in left if robots.component(one, "count").get("restores")), None), "an heir"
        )
        robots.until_protected(heir)
        assert robots.component(heir, "count")["standby"] in ("robot2", "robot3")
        first = stage.switch_on("robot1")
        robots.until_taken_over(first)
        expect_more(first)


def test_orders_may_be_given_at_either_robot(pair: Pair) -> None:
    first, second = pair
    protected_count(pair)
    order(second, "handover", name="count", to="robot2")
    robots.until(lambda: runs_at(pair, second), "it to move")
    expect_more(second)
    robots.until(lambda: robots.component(second, "count").get("protection") == "protected", "its protection at robot2")
    order(first, "stop", name="count")
    robots.until(lambda: robots.component(second, "count").get("state") == "ended", "its end at robot2")


def test_stop_ends_a_component_everywhere(pair: Pair) -> None:
    first, second = pair
    protected_count(pair)
    answer = order(first, "stop", name="count")
    assert os.WTERMSIG(int(str(answer["exit_status"]))) == signal.SIGTERM
    robots.until(lambda: robots.component(second, "count").get("state") == "ended", "robot2 to know the end")
    numbers = counted(second)
    assert numbers == list(range(len(numbers)))


def runs(pid: int) -> bool:
    """Whether a process is there and nobody holds it still; whoever has just been captured is let go a moment later."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "SR"


def test_a_released_component_runs_on_unprotected(pair: Pair) -> None:
    first, second = pair
    protected_count(pair)
    inner = robots.component(first, "count")["pid"]
    victim = robots.host_pid(first, inner)
    order(first, "release", name="count")
    robots.until(lambda: robots.component(second, "count").get("state") == "released", "robot2 to forget it")
    robots.until(lambda: runs(victim), "it to run on")


def test_a_released_program_outlives_an_agent_restart_and_a_namesake(pair: Pair) -> None:
    first, _ = pair
    protected_count(pair)
    inner = robots.component(first, "count")["pid"]
    released = robots.host_pid(first, inner)
    assert list(first.directory.rglob("*.running"))
    order(first, "release", name="count")
    assert not list(first.directory.rglob("*.running")), "its guard was told, too, when the order was answered"
    worker = first.status()["lanes_pid"]
    os.kill(robots.host_pid(first, worker), signal.SIGKILL)
    robots.until(lambda: robots.answers(first) and first.status()["lanes_pid"] != worker, "the agent's other half to be back")
    namesake = "import time\nfor i in range(50):\n    print('namesake', i, flush=True)\n    time.sleep(0.01)\n"
    ran = robots.failover(first, "run", "--name", "count", "--", "/usr/bin/python3", "-S", "-c", namesake)
    assert ran.stdout.splitlines() == [f"namesake {number}" for number in range(50)]  # while the released one writes on
    robots.until(lambda: runs(released), "it to run on")
