"""The service that a process belongs to, and whether systemd starts it again by itself."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

from checkpoint.linux import systemd_service
from checkpoint.linux.systemd_service import Service, own_service, restarted_service
from failover.cli.agent_service import SERVICE
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


def _answers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, restart: str, main: int, unit: str = "robot.service") -> None:
    """Has systemctl say this of the service of every process."""
    systemctl = tmp_path / "systemctl"
    asked = f'[ "$*" = "show --property=Restart,MainPID -- {unit}" ]'
    systemctl.write_text(f"#!/bin/sh\n{asked} && echo Restart={restart} && echo MainPID={main}\n")
    systemctl.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    monkeypatch.setattr(systemd_service, "_service_and_user", lambda _: (unit, ""))


@pytest.mark.parametrize(("said", "found"), [("always", "always"), ("on-failure", "on-failure"), ("no", ""), ("", "")])
def test_systemd_is_asked_about_the_service_of_a_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: str, found: str
) -> None:
    _answers(tmp_path, monkeypatch, said, os.getpid())
    assert restarted_service(os.getpid()) == (Service("robot.service", found) if found else None)
    notes = notes_of_service(os.getpid())
    assert bool(notes) is bool(found)
    assert not found or (f"robot.service, which says Restart={found}" in notes[0] and "Restart=no" in notes[0])


def test_a_note_is_for_the_main_process_of_a_service_and_who_is_above_it_and_not_for_its_jobs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with subprocess.Popen(["cat"], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as job:
        _answers(tmp_path, monkeypatch, "always", os.getpid())
        assert notes_of_service(os.getpid()) and not notes_of_service(job.pid)
        _answers(tmp_path, monkeypatch, "always", job.pid)
        assert notes_of_service(os.getpid()) and notes_of_service(job.pid)
        for main in (0, 1 << 30):  # it has none, or it has ended
            _answers(tmp_path, monkeypatch, "always", main)
            assert not notes_of_service(job.pid)
        _answers(tmp_path, monkeypatch, "always", job.pid, SERVICE)
        assert not notes_of_service(job.pid)


def test_where_systemd_does_not_answer_nothing_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(systemd_service, "_service_and_user", lambda _: ("robot.service", ""))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert restarted_service(os.getpid()) is None
    (tmp_path / "systemctl").write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / "systemctl").chmod(0o755)
    assert restarted_service(os.getpid()) is None
    assert restarted_service(0) is None
