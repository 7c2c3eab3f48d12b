"""The commands of docs/rights.md, typed: rules of a file, a reservation, then a real directory server, which goes away."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.agent.directory import slapd
from tests.agent.directory.slapd import Site, Slapd
from tests.e2e import robots
from tests.e2e.test_decorator_page_typed import Terminal, terminal
from tests.e2e.test_owners import open_the_way

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "rights.md").read_text()
AS_USER = Path(__file__).with_name("as_user.py")
BLOCKS = re.findall(r"```(?:toml)?\n(.*?)```", PAGE, re.DOTALL)
COMMANDS, DECISION, STATUS, RESERVE, REFUSAL, LDAP = BLOCKS

ACCOUNTS = {"anna": 7001, "user1": 7002}
"""Those of the page who have an account on the robot; all others are known to the directory alone."""

MACHINE = """
mount --bind {etc} /etc && mount -t tmpfs none /run && mount -t tmpfs none /var/lib && ip link set lo up || exit
echo 0 > /proc/sys/net/ipv4/ip_unprivileged_port_start
sudo() {{ "$@"; }}
anna() {{ {python} {as_user} anna "$@"; }}
user1() {{ {python} {as_user} user1 "$@"; }}
export -f sudo anna user1
exec bash 2>&1
"""
"""A machine of this test's own: its accounts, its directory server by the name of the page, nothing of the real /etc/failover."""

AGENT = """
mkdir -p /etc/failover r1
failover team create lab --empty --directory /etc/failover/team
failover team enrol robot1 127.0.0.1:7430 --bulk 127.0.0.1:7431 --directory /etc/failover/team
printf 'robot = "robot1"\\ngroup = "robotics"\\n' > /etc/failover/agent.toml
"""
BEGIN = """
install -d -m 750 -g robotics /run/failover
unshare --pid --mount-proc --kill-child failover-agent 2> r1/log & echo $! > r1/pid
"""
"""The directory as the service's unit has it made."""

PEOPLE = """
dn: dc=example,dc=org
objectClass: domain
dc: example

dn: cn=robots,dc=example,dc=org
objectClass: organizationalRole
objectClass: simpleSecurityObject
cn: robots
userPassword: of the robots

dn: uid=anna,dc=example,dc=org
objectClass: inetOrgPerson
uid: anna
cn: anna
sn: anna

dn: uid=bob,dc=example,dc=org
objectClass: inetOrgPerson
uid: bob
cn: bob
sn: bob

dn: cn=operators,dc=example,dc=org
objectClass: groupOfNames
cn: operators
member: uid=anna,dc=example,dc=org

dn: cn=students,dc=example,dc=org
objectClass: groupOfNames
cn: students
member: uid=bob,dc=example,dc=org
"""
SITE = Site(PEOPLE, "dc=example,dc=org", "DNS:directory.example.org", 389, 636)

pytestmark = [
    pytest.mark.root,
    pytest.mark.command("unshare"),
    pytest.mark.command("ip"),
    pytest.mark.command("bash"),
    pytest.mark.skipif(bool(slapd.why_not()), reason=slapd.why_not() or "-"),
]


def lay_etc(etc: Path) -> None:
    """As this machine has it, with the name of the page's directory."""
    shutil.copytree("/etc", etc, symlinks=True, ignore=shutil.ignore_patterns("failover"))
    with (etc / "hosts").open("a") as file:
        file.write("127.0.0.1 directory.example.org\n")


def add_accounts(etc: Path) -> None:
    """Those of the page's users."""
    with (etc / "passwd").open("a") as file:
        file.writelines(f"{name}:x:{uid}:7000::/:/bin/sh\n" for name, uid in ACCOUNTS.items())
    with (etc / "group").open("a") as file:
        file.write("robotics:x:7000:\n")


@contextmanager
def machine(folder: Path) -> Iterator[Terminal]:
    lay_etc(folder / "etc")
    script = MACHINE.format(etc=folder / "etc", python=sys.executable, as_user=AS_USER)
    command = ["unshare", "--net", "--mount", "--propagation", "private", "bash", "-c", script]
    with terminal(folder, command) as typed:
        try:
            yield typed
        finally:
            print(typed.type(f"tail -n {robots.LOG_LINES} r1/log"))  # shown by pytest where a test fails


def as_said(shown: str) -> re.Pattern[str]:
    """What the page shows; ages, instants and lines of files may be others."""
    return re.compile(re.sub(r"(12\\ s|14:32:10|(?<=toml:)26)", r"[\\d:.]+( \\w+)?", re.escape(shown.strip())))


@contextmanager
def directory(folder: Path, typed: Terminal) -> Iterator[Slapd]:
    """The directory server of the page, in the machine's network; the machine believes its certificate."""
    with slapd.serving(SITE, ("nsenter", f"--net=/proc/{typed.shell.pid}/ns/net")) as server:
        certificates = folder / "etc/ssl/certs/ca-certificates.crt"
        certificates.unlink(missing_ok=True)
        shutil.copy(server.certificate, certificates)
        (folder / "secret").write_text("of the robots")
        typed.type("cp secret /etc/failover/directory.secret; chmod 600 /etc/failover/directory.secret")
        yield server


def test_rules_reservations_and_a_directory_server_as_the_page_tells_it(tmp_path: Path) -> None:
    open_the_way(tmp_path)
    with machine(tmp_path) as typed:
        said = typed.type(AGENT)
        assert "robot1" in typed.type("cat /etc/failover/team/team.toml"), said
        said = typed.type(f"cd {ROOT}\n{COMMANDS}cd - >/dev/null")
        assert said.splitlines()[-1] == DECISION.strip(), said
        assert said.count("allow") == 4 and "all else is denied" in said
        add_accounts(tmp_path / "etc")
        named = DECISION.replace("user:anna", f"uid:{ACCOUNTS['anna']}").strip()
        assert typed.type(COMMANDS.splitlines()[-1]).strip() == named

        assert "uid:7002 may not start" in typed.type("failover rights why user1 start /lab/robot1/mapper")
        typed.type("""sed -i 's/^operators = .*/operators = ["anna", "user1"]/' /etc/failover/team/rights.toml""")
        typed.type(BEGIN)
        robots.until(lambda: "rights: 4 rules" in typed.type("failover status"), "the agent to read the rules")
        said = typed.type("user1 failover run --name /lab/robot1/mapper --detach -- sleep 1000000")
        robots.until(lambda: "mapper" in typed.type("anna failover status"), f"the mapper to run after: {said}")
        for line in RESERVE.splitlines():
            said = typed.type(f"anna {line}")
            if "mapper" in line and "unreserve" not in line:
                assert as_said(REFUSAL).search(typed.type("user1 failover stop mapper")), said
            assert "Traceback" not in said and "failover:" not in said, (line, said)

        with directory(tmp_path, typed) as server:
            rules = (ROOT / "systemd" / "rights.toml").read_text().partition("[[rights.rules]]")
            (tmp_path / "new").write_text(LDAP + "".join(rules[1:]))
            typed.type("cp new /etc/failover/team/rights.toml")
            why = "failover rights why {} {} /lab/robot1/mapper"
            said = robots.until(lambda: _has("ldap:", typed.type(why.format("anna", "operate"))), "the server to be asked")
            assert as_said(DECISION.replace("user:", "ldap:")).search(said), said
            assert as_said(STATUS).search(typed.type("failover status")), typed.type("failover status")
            assert "ldap:bob may not see" in typed.type(why.format("bob", "see"))
            assert "ldap:anna may program" in typed.type(why.format("anna", "program"))
            server.kill()
            assert "program needs a live answer" in typed.type(why.format("anna", "program"))
            assert "which has not answered" in typed.type("failover status")
            assert "ldap:anna may operate" in typed.type(why.format("anna", "operate"))


def _has(words: str, text: str) -> str:
    return text if words in text else ""
