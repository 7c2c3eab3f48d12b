"""The service in which an agent runs: the one that a shutdown must end before the agent's components."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from agent.system import systemd_units
from agent.system.systemd_units import is_restarted, own_service

UNIFIED = "0::/failover.slice/failover-agent.service\n"
HYBRID = "4:memory:/system.slice/other.service\n1:name=systemd:/failover.slice/mine.service\n0::/failover.slice/mine.service\n"
UNUSED = "1:name=systemd:/\n0::/failover.slice/failover-agent.service\n"
OF_A_USER = "0::/user.slice/user-1000.slice/user@1000.service/app.slice/failover-agent.service\n"
BELOW = "0::/system.slice/robot.service/payload\n"
SHELL = "0::/user.slice/user-0.slice/session-3.scope\n"


@pytest.mark.parametrize(
    ("cgroups", "service"),
    [
        (UNIFIED, "failover-agent.service"),
        (HYBRID, "mine.service"),
        (UNUSED, "failover-agent.service"),
        (OF_A_USER, "failover-agent.service"),
        (BELOW, "robot.service"),
        (SHELL, ""),
        ("", ""),
    ],
)
def test_the_service_is_read_from_the_cgroup(cgroups: str, service: str) -> None:
    assert own_service(cgroups) == service


@pytest.mark.parametrize(
    ("jobs", "expected"),
    [
        ("41 failover-agent.service restart running\n", True),
        ("41 failover-agent.service stop running\n", False),
        ("41 other-failover-agent.service restart running\n", False),
        ("", False),
        ("No jobs running.\n", False),
    ],
)
def test_a_restart_is_told_from_a_stop_by_the_job_that_systemd_carries_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jobs: str, expected: bool
) -> None:
    systemctl = tmp_path / "systemctl"
    systemctl.write_text(f'#!/bin/sh\n[ "$1 $6" = "list-jobs failover-agent.service" ] && printf "{jobs}"\n')
    systemctl.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(systemd_units, "_own_cgroups", lambda: UNIFIED)
    monkeypatch.setattr(systemd_units, "starter", lambda: "/usr/bin/systemd-run")
    assert is_restarted() is expected


def test_an_agent_that_systemd_did_not_start_is_told_of_no_restart(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(systemd_units.STARTED, raising=False)
    assert not is_restarted()
