"""The Debian package on clean machines: installed, used, replaced, removed (`docs/testing.md` says how to run these tests)."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from tests.e2e import machines, robots
from tests.e2e.machines import Machine
from tests.e2e.service import SERVICE, component, make_team, started, status, two_robots
from tests.e2e.test_systemd_power import expect_it_to_go_on_at, expect_nothing_to_move, protected

PACKAGE: Final = os.environ.get("FAILOVER_TEST_PACKAGE", "")
SYSTEM: Final = os.environ.get("FAILOVER_TEST_DEBIAN", "")

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(machines.why_not()), reason=machines.why_not() or "-"),
    pytest.mark.skipif(not (PACKAGE and SYSTEM), reason="FAILOVER_TEST_PACKAGE, FAILOVER_TEST_DEBIAN say with what"),
]

OURS: Final = ("/etc", "/usr", "/var/lib/failover", "/run", "/lib/systemd")
KEPT: Final = ("/usr/bin/deb", "/var/lib/dpkg", "/run/systemd/transient")
SIZE_MAX_KB: Final = 120_000
"""Of the files that the package lays."""


def install(machine: Machine) -> None:
    """What a person types."""
    shutil.copy(PACKAGE, machine.root / "root/failover.deb")
    machine.run("dpkg", "--install", "/root/failover.deb")


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    """One clean machine with the package, alone in its team; the service runs."""
    with machines.booted(tmp_path, "robot1", Path(SYSTEM)) as one:
        before = laid(one)
        assert before == set()
        install(one)
        make_team(one, robot1="127.0.0.1")
        one.run("systemctl", "enable", "--now", SERVICE)
        robots.until(lambda: status(one)["robot"] == "robot1", "the agent to answer")
        yield one
        print(one.run("journalctl", "--unit", SERVICE, "--no-pager", "--lines=100", check=False).stdout)


def laid(machine: Machine) -> set[str]:
    """Everything there that has our name."""
    found = machine.run("find", *(place for place in OURS if (machine.root / place[1:]).exists()), "-iname", "*failover*").stdout
    return {path for path in found.splitlines() if not path.startswith(KEPT)}


def told(machine: Machine, field: str) -> str:
    """What the package manager knows about the package."""
    return machine.run("dpkg-query", "--show", f"--showformat=${{{field}}}", "failover").stdout


def is_enabled(machine: Machine) -> bool:
    """Whether the service starts with the machine."""
    return machine.run("systemctl", "is-enabled", SERVICE, check=False).stdout.strip() == "enabled"


def test_two_clean_machines_protect_a_program_by_the_package(tmp_path: Path) -> None:
    with two_robots(tmp_path, install, Path(SYSTEM)) as (first, second):
        assert is_enabled(first) and is_enabled(second), "create and join have enabled the service"
        protected(first, "cut")
        first.end()
        expect_it_to_go_on_at(second, "cut")


def test_the_package_is_replaced_under_a_program_of_a_pair_and_nothing_moves(tmp_path: Path) -> None:
    with two_robots(tmp_path, install, Path(SYSTEM)) as (first, second):
        protected(first, "stays")
        expect_nothing_to_move(first, second, "stays", "dpkg", "--install", "/root/failover.deb")


def test_the_package_brings_a_command_pages_headers_and_completions(machine: Machine) -> None:
    assert machine.run("failover", "--version").stdout.startswith("failover ")
    assert told(machine, "Conffiles").split()[0] == "/etc/failover/agent.toml"
    files = set(machine.run("dpkg", "--listfiles", "failover").stdout.splitlines())
    pages = {"/usr/share/man/man1/failover.1.gz", "/usr/share/man/man8/failover-agent.8.gz"}
    shells = {
        "/usr/share/bash-completion/completions/failover",
        "/usr/share/zsh/vendor-completions/_failover",
        "/usr/share/fish/vendor_completions.d/failover.fish",
    }
    assert files >= pages | shells | {"/usr/include/failover.h", "/usr/include/failover_task.h"}
    assert "handover" in machine.run("zcat", "/usr/share/man/man1/failover.1.gz").stdout
    assert int(told(machine, "Installed-Size")) <= SIZE_MAX_KB
    imported = machine.run("/usr/bin/python3", "-c", "import checkpoint", check=False)
    assert "No module named 'checkpoint'" in imported.stderr
    nowhere = machine.run("grep", "-rlI", str(machines.CHECKOUT), "/usr/lib/failover", "/usr/bin", check=False).stdout
    assert nowhere == ""


def test_the_package_says_what_it_is_made_of(machine: Machine) -> None:
    bill = json.loads((machine.root / "usr/share/doc/failover/sbom.cdx.json").read_text())
    told = {one["name"]: one["version"] for one in bill["components"]}
    lists = [(machines.CHECKOUT / f"requirements{kind}.txt").read_text() for kind in ("", "-programs", "-page", "-tui")]
    assert told == dict(re.findall(r"(?m)^([a-z0-9-]+)==(\S+)", "\n".join(lists)))
    for one in bill["components"]:
        (digest,) = (said["content"] for said in one["hashes"])
        assert any(f"--hash=sha256:{digest}" in text for text in lists), one["name"]
    there = machine.run("find", "/usr/lib/failover", "-name", "*.dist-info").stdout.splitlines()
    assert len(there) == len(told) + 1
    ours = bill["metadata"]["component"]
    assert machine.run("failover", "--version").stdout.split() == [ours["name"], ours["version"]]


def test_a_program_runs_on_while_the_package_is_replaced(machine: Machine) -> None:
    pid = started(machine, "stays", "import time\nwhile True: time.sleep(0.01)\n")
    agent = machine.property(SERVICE, "MainPID")
    machine.run("sed", "-i", "s/^#beat_ms = .*/beat_ms = 25/", "/etc/failover/agent.toml")
    machine.run("dpkg", "--install", "/root/failover.deb")
    robots.until(lambda: machine.property(SERVICE, "MainPID") not in (agent, "0"), "the new agent")
    robots.until(lambda: component(machine, "stays").get("pid") == pid, "the new agent to find the program")
    assert (machine.root / f"proc/{pid}").exists()
    assert "beat_ms = 25" in (machine.root / "etc/failover/agent.toml").read_text()


def test_the_package_is_not_removed_from_under_a_program_and_a_purge_leaves_nothing(machine: Machine) -> None:
    started(machine, "runs", "import time\nwhile True: time.sleep(0.01)\n")
    refused = machine.run("dpkg", "--purge", "failover", check=False)
    assert refused.returncode and "failover is not removed: programs that it started run here: 1;" in refused.stderr
    assert component(machine, "runs")["state"] == "running"
    machine.run("failover", "stop", "runs")
    robots.until(lambda: machine.run("dpkg", "--purge", "failover", check=False).returncode == 0, "the package to go")
    assert machine.run("systemctl", "is-active", SERVICE, check=False).stdout.strip() == "inactive"
    assert laid(machine) == set()
