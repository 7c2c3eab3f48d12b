"""A program that keeps its state, an ordinary user's, under the service as it is shipped."""

from __future__ import annotations

import os
import signal
import sys

import pytest

from tests.e2e import machines, robots
from tests.e2e.machines import CHECKOUT, Machine
from tests.e2e.service import ADDRESSES, SERVICE, component, control, counted
from tests.e2e.test_systemd_power import SNAPSHOTS, USER, expect_it_to_go_on_at, pair

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.skipif(bool(machines.why_not()), reason=machines.why_not() or "-"),
]

__all__ = ["pair"]

COUNTER = """
import sys
import failover

@failover.component(name="kept", every=0.01)
class Counter:
    count: int = failover.kept(default=0)

    def on_resume(self, resumed: failover.Resumed) -> None:
        print(resumed.epoch, resumed.why, file=sys.stderr)

    def step(self) -> None:
        print(self.count)
        self.count += 1

failover.run(Counter)
"""


def started(machine: Machine) -> int:
    """The counter, as a user who is not root; the PID of its program, there."""
    with control(machine) as link:
        environment = {"PATH": "/usr/bin", "PYTHONPATH": str(CHECKOUT)}
        argv = [sys.executable, "-c", COUNTER]
        answer = link.ask("run", argv=argv, name="kept", env=environment, cwd="/", wait=False, user=USER, engine="auto")
        return int(answer["pid"])


def test_a_kept_state_outlives_a_crash_its_robot_and_a_restart_of_the_service(pair: tuple[Machine, Machine]) -> None:
    first, second = pair
    pid = started(first)
    expect_snapshots_at(second)
    os.kill(first.outer(pid), signal.SIGKILL)
    expect_it_to_go_on_at(first, "kept")

    expect_snapshots_at(second)
    safe = len(counted(second, "kept"))
    first.end()
    expect_it_to_go_on_at(second, "kept")
    assert len(counted(second, "kept")) > safe

    before = component(second, "kept")
    second.run("ip", "address", "add", f"{ADDRESSES['robot2']}/24", "dev", "lo")  # the cable has gone with the other machine
    second.run("systemctl", "restart", SERVICE)
    robots.until(lambda: component(second, "kept").get("pid") == before["pid"], "the agent to find its component again")
    expect_snapshots_at(second)
    assert component(second, "kept")["restores"] == 0, "none since the restart"
    numbers = counted(second, "kept")
    assert numbers == list(range(len(numbers)))


def expect_snapshots_at(machine: Machine) -> None:
    """Some that were made later than now."""
    before = int(component(machine, "kept").get("snapshots") or 0)
    robots.until(lambda: int(component(machine, "kept").get("snapshots") or 0) > before + SNAPSHOTS, "snapshots")
