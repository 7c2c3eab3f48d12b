"""A real directory server for tests: slapd, as an ordinary user, on free ports of this machine, with a small organisation."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ORDINARY: Final = 65534
"""Its user, where the tests have root's rights."""

AS_ORDINARY: Final = ("setpriv", f"--reuid={ORDINARY}", f"--regid={ORDINARY}", "--clear-groups")

SCHEMAS: Final = ("core", "cosine", "nis", "inetorgperson")
PASSWORD: Final = "right for {}"
SUFFIX: Final = "dc=lab"
SERVICE: Final = f"cn=service,{SUFFIX}"
SECRET: Final = "of the service account"
ADMIN, ADMIN_SECRET = f"cn=admin,{SUFFIX}", "of the administrator"
MANY: Final = 10_000
COMMANDS: Final = ("slapd", "slapadd", "openssl")
WHERE: Final = f"{os.environ['PATH']}:/usr/sbin"
REQUIRED: Final = "FAILOVER_TEST_LDAP"
"""With the value ``required`` in the environment, what is missing here is an error."""

CONFIGURATION: Final = """
{schemas}
modulepath /usr/lib/ldap
moduleload back_mdb
pidfile {place}/pid
TLSCertificateFile {place}/certificate
TLSCertificateKeyFile {place}/key
sizelimit unlimited
database mdb
maxsize 268435456
suffix {suffix}
rootdn cn=admin,{suffix}
rootpw "{admin_secret}"
directory {place}/entries
index objectClass,uid,member,uniqueMember,memberUid eq
access to attrs=userPassword by anonymous auth by * none
access to * by users read by * none
"""


def why_not() -> str:
    """Why there can be no such server here; "" if there can.

    Raises:
        RuntimeError: there must be one, because the environment says so.
    """
    lacks = [command for command in COMMANDS if shutil.which(command, path=WHERE) is None]
    if importlib.util.find_spec("ldap") is None:
        lacks.append("python-ldap")
    reason = f"needs {', '.join(lacks)}: ./run test as root installs what it lacks" if lacks else ""
    if reason and os.environ.get(REQUIRED) == "required":
        raise RuntimeError(reason)
    return reason


def people(many: int) -> str:
    """The organisation in LDIF: pilots are drivers and drivers pilots (a circle), students owners; ``many`` is in many groups."""
    users = ("driver", "operator", "student", "stranger", "many", "deep")
    found = ["dn: dc=lab\nobjectClass: domain\ndc: lab"]
    found += [f"dn: ou={name},dc=lab\nobjectClass: organizationalUnit\nou: {name}" for name in ("people", "groups")]
    role = "objectClass: organizationalRole\nobjectClass: simpleSecurityObject"
    found.append(f"dn: {SERVICE}\n{role}\ncn: service\nuserPassword: {SECRET}")
    for name in users:
        person = f"objectClass: inetOrgPerson\nuid: {name}\ncn: {name}\nsn: {name}\nuserPassword: {PASSWORD.format(name)}"
        found.append(f"dn: {dn(name)}\n{person}")
    found += [
        group("pilots", dn("driver"), group_dn("drivers")),
        group("drivers", group_dn("pilots")),
        group("guests", dn("stranger")),
        group("owners", group_dn("students")),
        f"dn: {group_dn('operators')}\nobjectClass: posixGroup\ncn: operators\ngidNumber: 7001\nmemberUid: operator",
        f"dn: {group_dn('students')}\nobjectClass: groupOfUniqueNames\ncn: students\nuniqueMember: {dn('student')}",
        group("odd \\28name\\29\\2a", dn("many")),
    ]
    found += [group("level1", dn("deep"))] + [group(f"level{level}", group_dn(f"level{level - 1}")) for level in range(2, 11)]
    found += [group(f"group{number}", dn("many")) for number in range(many)]
    return "\n\n".join(found) + "\n"


def dn(user: str) -> str:
    """Of a person."""
    return f"uid={user},ou=people,dc=lab"


def group_dn(name: str) -> str:
    """Of a group."""
    return f"cn={name},ou=groups,dc=lab"


def group(name: str, *members: str) -> str:
    """One entry."""
    plain = name.replace("\\28", "(").replace("\\29", ")").replace("\\2a", "*")
    lines = [f"dn: {group_dn(name)}", "objectClass: groupOfNames", f"cn: {plain}", *(f"member: {member}" for member in members)]
    return "\n".join(lines)


@dataclass(frozen=True)
class Site:
    """What a server holds, in LDIF, below which suffix, and where it is reached; ports of 0: any free ones."""

    ldif: str
    suffix: str = SUFFIX
    named: str = "IP:127.0.0.1"
    port: int = 0
    port_tls: int = 0


class Slapd:
    """One server. ``port``: plain and StartTLS; ``port_tls``: ldaps; ``certificate``: what its clients must trust."""

    def __init__(self, place: Path, site: Site, within: Sequence[str] = ()) -> None:
        self.place = place
        self._within = tuple(within)
        self.port, self.port_tls = site.port or _free_port(), site.port_tls or _free_port()
        self.certificate = place / "certificate"
        self.process: subprocess.Popen[bytes] | None = None
        (place / "entries").mkdir()
        make_certificate(place, site.named)
        schemas = "\n".join(f"include /etc/ldap/schema/{name}.schema" for name in SCHEMAS)
        text = CONFIGURATION.format(place=place, schemas=schemas, suffix=site.suffix, admin_secret=ADMIN_SECRET)
        (place / "slapd.conf").write_text(text)
        (place / "people.ldif").write_text(site.ldif)
        for path in (place, *place.iterdir()):
            if os.geteuid() == 0:
                os.chown(path, ORDINARY, ORDINARY)
        filled = self._started("slapadd", "-q", "-f", str(place / "slapd.conf"), "-l", str(place / "people.ldif"))
        assert filled.wait() == 0, (place / "said").read_text()

    def start(self) -> None:
        """Serve, and return once it takes connections."""
        urls = f"ldap://127.0.0.1:{self.port} ldaps://127.0.0.1:{self.port_tls}"
        self.process = self._started("slapd", "-d", "0", "-f", str(self.place / "slapd.conf"), "-h", urls)
        while True:
            assert self.process.poll() is None, (self.place / "said").read_text()
            probe = [*self._within, "bash", "-c", f": </dev/tcp/127.0.0.1/{self.port_tls}"]
            if subprocess.run(probe, stderr=subprocess.DEVNULL, check=False).returncode == 0:
                return
            time.sleep(0.02)

    def kill(self) -> None:
        """As a power cut does."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()

    def signal(self, number: signal.Signals) -> None:
        """SIGSTOP hangs it, SIGCONT lets it go on."""
        assert self.process is not None
        self.process.send_signal(number)

    def _started(self, name: str, *words: str) -> subprocess.Popen[bytes]:
        command = shutil.which(name, path=WHERE)
        assert command is not None
        become = [*self._within, *AS_ORDINARY] if os.geteuid() == 0 else []
        with (self.place / "said").open("ab") as said:
            return subprocess.Popen([*become, command, *words], stdout=said, stderr=said)


def filled(many: int, within: Sequence[str] = ()) -> contextlib.AbstractContextManager[Slapd]:
    """`serving` the organisation of these tests, with so many groups of one user."""
    return serving(Site(people(many)), within)


@contextlib.contextmanager
def serving(site: Site, within: Sequence[str] = ()) -> Iterator[Slapd]:
    """A server that serves.

    Args:
        within: what to put before its command line, to have it in another network.
    """
    place = Path(tempfile.mkdtemp(prefix="slapd-"))
    place.chmod(0o755)
    server = Slapd(place, site, within)
    try:
        server.start()
        yield server
    finally:
        server.kill()
        shutil.rmtree(place)


def make_certificate(place: Path, name: str = "IP:127.0.0.1") -> None:
    """A key, and a certificate for this machine that vouches for itself."""
    words = "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:P-256 -nodes -days 2 -subj /CN=127.0.0.1"
    named = ["-addext", f"subjectAltName={name}", "-keyout", str(place / "key"), "-out", str(place / "certificate")]
    subprocess.run([*words.split(), *named], check=True, capture_output=True)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])
