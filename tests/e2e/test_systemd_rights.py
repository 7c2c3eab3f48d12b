"""Rights by a directory server under systemd: a service of its own asks it, users get what the rules give to their groups.

On a booted machine with the service as it is shipped, rights.toml, two users with accounts, and a real slapd in its network.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator

import pytest

from tests.agent.directory import slapd
from tests.agent.directory.slapd import ORDINARY, SECRET, SERVICE, Slapd
from tests.e2e import machines, robots
from tests.e2e import service as services
from tests.e2e.machines import Machine
from tests.e2e.service import as_user, robot_with_users, started, status

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.skipif(bool(machines.why_not() or slapd.why_not()), reason=machines.why_not() or slapd.why_not() or "-"),
]

PWM = "University/Lab/Robotino/Engines/3/PWM"
RULES = """
[rights]
source = "ldap"

[rights.ldap]
server = "ldaps://127.0.0.1:{port}"
base = "dc=lab"
account = "{account}"
password_file = "/etc/failover/directory.secret"
ca_file = "/etc/failover/directory.pem"
timeout_s = 30

[[rights.rules]]
groups = ["drivers", "students"]
verbs = ["see", "program"]
paths = ["**"]

[[rights.rules]]
groups = ["operators"]
verbs = ["*", "!grant"]
paths = ["**"]
"""


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    """A robot with two users."""
    with robot_with_users(tmp_path_factory.mktemp("machines"), driver=7001, operator=7002) as booted:
        yield booted


@pytest.fixture(scope="module")
def server(machine: Machine) -> Iterator[Slapd]:
    """A directory server in the robot's network; the robot's agent knows it."""
    with slapd.filled(1, within=("nsenter", f"--net=/proc/{machine.pid}/ns/net")) as found:
        folder = machine.root / "etc/failover"
        shutil.copy(found.certificate, folder / "directory.pem")
        (folder / "directory.pem").chmod(0o644)
        (folder / "directory.secret").write_text(SECRET)
        (folder / "directory.secret").chmod(0o600)
        (folder / "team/rights.toml").write_text(RULES.format(port=found.port_tls, account=SERVICE))
        machine.run("systemctl", "start", services.SERVICE)
        yield found


def directory_units(machine: Machine) -> list[str]:
    """The services that ask the directory."""
    listed = machine.run("systemctl", "list-units", "--plain", "--no-legend", "--state=active", "failover-directory-*")
    return [line.split()[0] for line in listed.stdout.splitlines()]


def test_users_get_what_the_rules_give_to_their_groups_in_the_directory(machine: Machine, server: Slapd) -> None:
    started(machine, "counter")
    code, said = as_user(machine, "driver", "failover", "status")
    assert "/lab/robot1/counter" in said and "which answered" in said, (code, said)
    code, said = as_user(machine, "driver", "failover", "stop", "counter")
    assert code == 1 and "ldap:driver may not operate /lab/robot1/counter: no rule allows it to drivers, pilots" in said
    assert as_user(machine, "operator", "failover", "stop", "counter")[0] == 0


def test_why_knows_users_without_an_account(machine: Machine, server: Slapd) -> None:
    code, said = as_user(machine, "root", "failover", "rights", "why", "student", "see", "/lab/robot1/counter")
    assert code == 0 and "rights.toml:13 allows it to students on **" in said, said
    code, said = as_user(machine, "root", "failover", "rights", "why", "stranger", "see", "/lab/robot1/counter")
    assert code == 1 and "no rule allows it to guests" in said, said
    code, said = as_user(machine, "driver", "failover", "rights", "why", "student", "see", "/lab/robot1/counter")
    assert code == 1 and "ldap:driver may not grant" in said, said


def test_the_directory_is_asked_by_a_service_of_its_own_without_roots_rights(machine: Machine, server: Slapd) -> None:
    as_user(machine, "driver", "failover", "status")
    (unit,) = directory_units(machine)
    process = machine.root / f"proc/{machine.property(unit, 'MainPID')}"
    standing = (process / "status").read_text().splitlines()
    number = "\t".join([str(ORDINARY)] * 4)
    assert {f"Uid:\t{number}", f"Gid:\t{number}", "Groups:\t ", "CapEff:\t0000000000000000", "NoNewPrivs:\t1"} <= set(standing)
    (copies,) = (machine.root / "var/lib/failover/rights").iterdir()
    assert (copies.stat().st_uid, copies.stat().st_mode & 0o777) == (ORDINARY, 0o600)
    machine.run("systemctl", "stop", services.SERVICE)
    robots.until(lambda: not directory_units(machine), "it to end with the agent")
    machine.run("systemctl", "start", services.SERVICE)


def test_without_the_server_copies_serve_also_after_a_restart_and_never_for_programs(machine: Machine, server: Slapd) -> None:
    as_user(machine, "driver", "failover", "status")
    assert as_user(machine, "root", "failover", "rights", "why", "driver", "program", PWM)[0] == 0
    server.kill()
    machine.run("systemctl", "restart", services.SERVICE)
    code, said = as_user(machine, "driver", "failover", "rights", "why", "driver", "see", PWM)
    assert code == 0 and "rights by a copy" in said, said
    code, said = as_user(machine, "root", "failover", "rights", "why", "driver", "program", PWM)
    assert code == 1 and "program needs a live answer of the directory" in said, said
    assert "which has not answered" in status(machine)["rights"]
