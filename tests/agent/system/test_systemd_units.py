"""The service in which an agent runs: the one that a shutdown must end before the agent's components."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from agent.system import systemd_units
from agent.system.systemd_units import is_restarted

UNIFIED = "0::/failover.slice/failover-agent.service\n"


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
