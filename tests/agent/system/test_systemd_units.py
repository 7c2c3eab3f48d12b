"""The service in which an agent runs: the one that a shutdown must end before the agent's components."""

from __future__ import annotations

import pytest

from agent.system.systemd_units import own_service

UNIFIED = "0::/failover.slice/failover-agent.service\n"
HYBRID = "4:memory:/system.slice/other.service\n1:name=systemd:/failover.slice/mine.service\n0::/failover.slice/mine.service\n"
OF_A_USER = "0::/user.slice/user-1000.slice/user@1000.service/app.slice/failover-agent.service\n"
BELOW = "0::/system.slice/robot.service/payload\n"
SHELL = "0::/user.slice/user-0.slice/session-3.scope\n"


@pytest.mark.parametrize(
    ("cgroups", "service"),
    [
        (UNIFIED, "failover-agent.service"),
        (HYBRID, "mine.service"),
        (OF_A_USER, "failover-agent.service"),
        (BELOW, "robot.service"),
        (SHELL, ""),
        ("", ""),
    ],
)
def test_the_service_is_read_from_the_cgroup(cgroups: str, service: str) -> None:
    assert own_service(cgroups) == service
