"""What an agent tells systemd: that it is ready, that its loop lives, that it ends."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from agent.system import systemd_units
from failover.cli.demo.robots import free_ports
from failover.config import team
from failover.config.team import Robot, Team

BOUND_S = 60.0
WATCHDOG_US = 300_000


@pytest.fixture
def config(tmp_path: Path) -> Path:
    beat, bulk = free_ports(2)
    team.write(tmp_path / "team", Team("lab", {"robot1": Robot((f"127.0.0.1:{beat}",), f"127.0.0.1:{bulk}")}))
    path = tmp_path / "agent.toml"
    path.write_text(
        f'robot = "robot1"\nteam_directory = "{tmp_path}/team"\ninsecure = true\n'
        f'state_directory = "{tmp_path}/state"\nruntime_directory = "{tmp_path}/run"\n'
    )
    return path


def hear(ear: socket.socket, line: str) -> None:
    """Read datagrams until one holds the line."""
    while line not in ear.recv(4096).decode().splitlines():
        pass


def test_systemd_is_told_of_readiness_of_every_turn_and_of_the_end(config: Path, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.bind(str(tmp_path / "notify"))
        ear.settimeout(BOUND_S)
        told = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": str(WATCHDOG_US)}
        agent = subprocess.Popen([sys.executable, "-m", "agent.main", "--config", str(config)], env=told)
        try:
            hear(ear, "READY=1")
            for _ in range(3):
                hear(ear, "WATCHDOG=1")
            agent.send_signal(signal.SIGTERM)
            hear(ear, "STOPPING=1")
            assert agent.wait(BOUND_S) == 0
        finally:
            agent.kill()
            agent.wait()


def test_a_loop_that_stands_still_feeds_no_watchdog(config: Path, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as ear:
        ear.bind(str(tmp_path / "notify"))
        ear.settimeout(BOUND_S)
        told = {**os.environ, "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": str(WATCHDOG_US)}
        agent = subprocess.Popen([sys.executable, "-m", "agent.main", "--config", str(config)], env=told)
        try:
            hear(ear, "WATCHDOG=1")
            agent.send_signal(signal.SIGSTOP)
            os.waitid(os.P_PID, agent.pid, os.WSTOPPED)
            ear.settimeout(0.0)
            with contextlib.suppress(BlockingIOError):
                while ear.recv(4096):  # what was said before it stood still
                    pass
            ear.settimeout(3 * WATCHDOG_US / 1e6)
            with pytest.raises(TimeoutError):
                ear.recv(4096)
            agent.send_signal(signal.SIGCONT)
            ear.settimeout(BOUND_S)
            hear(ear, "WATCHDOG=1")
            agent.terminate()
            assert agent.wait(BOUND_S) == 0
        finally:
            agent.kill()
            agent.wait()


def test_only_the_service_itself_asks_systemd_for_services(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot of the demo, under a CI runner that is a service, would have its guards outside its own namespaces."""
    monkeypatch.setenv("INVOCATION_ID", "0" * 32)
    monkeypatch.setenv(systemd_units.STARTED, str(os.getpid()))
    assert systemd_units.starter() == ""
