"""The service that a process belongs to, and whether systemd starts it again by itself."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from checkpoint.linux import systemd_service
from checkpoint.linux.systemd_service import Service, own_service, restarted_service
from failover.cli.systemd_note import notes_of_service

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
    ("cgroups", "user"),
    [(UNIFIED, ""), (OF_A_USER, "1000"), (BELOW, ""), ("0::/user.slice/user@7.service/init.scope", ""), (SHELL, "")],
)
def test_a_service_of_a_user_is_told_from_the_machines(cgroups: str, user: str) -> None:
    assert systemd_service._service_and_user(cgroups)[1] == user


@pytest.mark.parametrize(("said", "found"), [("always", "always"), ("on-failure", "on-failure"), ("no", ""), ("", "")])
def test_systemd_is_asked_about_the_service_of_a_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: str, found: str
) -> None:
    systemctl = tmp_path / "systemctl"
    systemctl.write_text(f'#!/bin/sh\n[ "$*" = "show --property=Restart --value -- robot.service" ] && echo {said}\n')
    systemctl.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(systemd_service, "_service_and_user", lambda _: ("robot.service", ""))
    assert restarted_service(os.getpid()) == (Service("robot.service", found) if found else None)
    notes = notes_of_service(os.getpid())
    assert bool(notes) is bool(found)
    assert not found or (f"robot.service, which says Restart={found}" in notes[0] and "Restart=no" in notes[0])


def test_where_systemd_does_not_answer_nothing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(systemd_service, "_service_and_user", lambda _: ("robot.service", ""))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert restarted_service(os.getpid()) is None
    (tmp_path / "systemctl").write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / "systemctl").chmod(0o755)
    assert restarted_service(os.getpid()) is None
    assert restarted_service(0) is None
