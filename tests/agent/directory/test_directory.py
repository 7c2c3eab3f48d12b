"""Rights by a real slapd: the table of users, verbs and paths; a server that is killed, hung, or not the right one; bad names."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from agent.directory.answers import FREE_TRIES, Answers
from agent.directory.bounded import REQUESTS, BoundedServer
from agent.directory.client import DirectoryProcess
from agent.directory.messages import Question
from agent.directory.server import LdapServer, UnknownUserError, WrongPasswordError
from agent.errors import DirectoryError
from failover.config.rights import RIGHTS_FILE, LdapConfig
from failover.core.rights.rules import NEVER_BY_DEFAULT, VERBS, Subject, decide, make_rule
from tests.agent.directory.slapd import (
    ADMIN,
    ADMIN_SECRET,
    MANY,
    PASSWORD,
    SECRET,
    SERVICE,
    Slapd,
    dn,
    filled,
    make_certificate,
    why_not,
)
from tests.failover.core.rights.table import CASES, GROUPS, MONDAY_NOON, RULES, expected

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not() or "-")


@pytest.fixture(scope="module")
def slapd() -> Iterator[Slapd]:
    """One server for all tests that leave it in peace."""
    with filled(MANY) as server:
        yield server


@pytest.fixture
def alive() -> Iterator[Slapd]:
    """A server of the test's own, which it may kill and start."""
    with filled(1) as server:
        yield server


def config_of(slapd: Slapd, **other: object) -> LdapConfig:
    """By ldaps; with the service account."""
    known = {
        "server": f"ldaps://127.0.0.1:{slapd.port_tls}",
        "base": "dc=lab",
        "account": SERVICE,
        "ca_file": str(slapd.certificate),
    }
    return msgspec.convert({**known, "timeout_s": 60, **other}, LdapConfig)


def server_of(slapd: Slapd, **other: object) -> LdapServer:
    return LdapServer(config_of(slapd, **other), SECRET)


class Clocks:
    """Times that a test sets."""

    def __init__(self) -> None:
        self.now_s = 1_000.0
        self.calendar_s = 1_800_000_000.0

    def answers(self, slapd: Slapd, path: Path, **other: object) -> Answers:
        """Answers by these clocks, that go on with the copies at ``path``."""
        config = config_of(slapd, **other)
        server = BoundedServer(server_of(slapd, **other), REQUESTS * config.timeout_s)
        return Answers(config, server, path / "copies", lambda: self.now_s, lambda: self.calendar_s)


# --- Who is it -------------------------------------------------------------------------------------------------------


def test_the_table_of_users_verbs_and_paths_holds(slapd: Slapd) -> None:
    server = server_of(slapd)
    subjects = {user: Subject(f"ldap:{user}", server.groups(user, PASSWORD.format(user))) for user in GROUPS}
    assert {user: subject.groups - {"pilots"} for user, subject in subjects.items()} == GROUPS
    wrong = [case for case in CASES if decide(RULES, subjects[case[0]], case[1], case[2], MONDAY_NOON).allow != expected(*case)]
    assert wrong == []


@pytest.mark.parametrize("scheme", ["ldap", "ldaps"])
def test_passwords_travel_encrypted_and_only_the_right_one_is_taken(slapd: Slapd, scheme: str) -> None:
    server = server_of(slapd, server=f"{scheme}://127.0.0.1:{slapd.port if scheme == 'ldap' else slapd.port_tls}")
    assert "drivers" in server.groups("driver", PASSWORD.format("driver"))
    for wrong in ("wrong", PASSWORD.format("operator"), "", "\0", PASSWORD.format("driver") + "\0x"):
        with pytest.raises((WrongPasswordError, UnknownUserError)):
            server.groups("driver", wrong)


@pytest.mark.parametrize("scheme", ["ldap", "ldaps"])
def test_a_server_with_a_wrong_certificate_is_not_believed(slapd: Slapd, scheme: str, tmp_path: Path) -> None:
    make_certificate(tmp_path)  # another one, for the same name
    address = f"{scheme}://127.0.0.1:{slapd.port if scheme == 'ldap' else slapd.port_tls}"
    with pytest.raises(DirectoryError, match=re.escape(address)) as refused:
        server_of(slapd, server=address, ca_file=str(tmp_path / "certificate")).groups("driver", PASSWORD.format("driver"))
    assert not isinstance(refused.value, WrongPasswordError)


ASKED = """
import json
import sys
from pathlib import Path
from agent.directory import server
from agent.errors import DirectoryError
from failover.config.rights import LdapConfig
server.SYSTEM = Path(sys.argv[1])
try:
    print(sorted(server.LdapServer(LdapConfig(**json.loads(sys.argv[2])), sys.argv[3]).groups("driver", None)))
except DirectoryError as error:
    print(type(error).__name__, error)
"""


def asked_with(system: Path, address: str, tls: str = "require", **environment: str) -> str:
    """What a process is answered in whose system this file names the certificates; it was started in that file's folder."""
    config = {"server": address, "base": "dc=lab", "account": SERVICE, "tls": tls, "timeout_s": 60}
    words = [sys.executable, "-c", ASKED, str(system), json.dumps(config), SECRET]
    known = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3]), "HOME": str(system.parent), **environment}
    return subprocess.run(words, cwd=system.parent, env=known, check=True, capture_output=True, text=True).stdout


@pytest.mark.parametrize("where", ["ldaprc", ".ldaprc", "LDAPTLS_CACERT", "LDAPCONF"])
def test_who_owns_the_folder_or_the_environment_does_not_say_which_server_is_trusted(
    slapd: Slapd, tmp_path: Path, where: str
) -> None:
    make_certificate(tmp_path)
    system, foreign = tmp_path / "ldap.conf", tmp_path / (where if "rc" in where else "own.conf")
    system.write_text(f"# of the system\nTLS_CACERT\t{tmp_path / 'certificate'}\n")
    foreign.write_text(f"TLS_CACERT {slapd.certificate}\n")
    environment = {"LDAPTLS_CACERT": str(slapd.certificate), "LDAPCONF": str(foreign)}
    chosen = {where: environment[where]} if where in environment else {}
    address = f"ldaps://127.0.0.1:{slapd.port_tls}"
    assert asked_with(system, address, **chosen).startswith("DirectoryError")
    system.write_text(f"TLS_CACERT {slapd.certificate}\n")
    assert "DirectoryError" not in asked_with(system, address, **chosen), "the system's is believed"


def test_without_certificates_a_plain_server_is_asked_and_an_encrypted_one_is_told(slapd: Slapd, tmp_path: Path) -> None:
    system, plain = tmp_path / "ldap.conf", f"ldap://127.0.0.1:{slapd.port}"
    for text, why in (
        (f"TLS_CACERT {tmp_path}/none\n", f"the certificates in {tmp_path}/none cannot be read"),
        ("", "has no TLS_CACERT"),
    ):
        system.write_text(text)
        assert "DirectoryError" not in asked_with(system, plain, "none")
        for address in (plain, f"ldaps://127.0.0.1:{slapd.port_tls}"):
            said = asked_with(system, address)
            assert said.startswith("DirectoryError") and why in said


def test_plain_is_for_this_machine_alone(slapd: Slapd) -> None:
    assert "drivers" in server_of(slapd, server=f"ldap://127.0.0.1:{slapd.port}", tls="none").groups("driver", None)
    with pytest.raises(msgspec.ValidationError, match=r"in the clear to 192\.0\.2\.1"):
        server_of(slapd, server="ldap://192.0.2.1", tls="none")


@pytest.mark.parametrize(
    "name",
    [
        "*",
        "*)(uid=*",
        "driver)(|(uid=*",
        "driver*",
        "\\2a",
        "driver\0",
        "",
        "x" * 5_000,
        dn("driver"),
        "driver,ou=people",
        "(",
        "\n",
    ],
)
def test_a_name_is_never_read_as_a_filter_or_a_dn(slapd: Slapd, name: str) -> None:
    for password in (None, PASSWORD.format("driver")):
        with pytest.raises(UnknownUserError):
            server_of(slapd).groups(name, password)


def test_a_user_of_ten_thousand_groups_has_all_of_them(slapd: Slapd) -> None:
    groups = server_of(slapd).groups("many", None)
    assert groups == {"odd (name)*", *(f"group{number}" for number in range(MANY))}
    last = make_rule([f"group{MANY - 1}"], ["see"], ["**"], deny=True)
    assert not decide([make_rule(["group0"], ["*"], ["**"]), last], Subject("ldap:many", groups), "see", "a", 0)


def test_groups_of_groups_are_followed_to_the_eighth_and_no_further(slapd: Slapd) -> None:
    assert server_of(slapd).groups("deep", None) == {f"level{level}" for level in range(1, 9)}


def test_a_service_account_with_a_wrong_password_is_told_and_is_no_users_fault(slapd: Slapd) -> None:
    with pytest.raises(DirectoryError, match="see password_file") as refused:
        LdapServer(config_of(slapd), "wrong").groups("driver", PASSWORD.format("driver"))
    assert not isinstance(refused.value, WrongPasswordError)


# --- When the server is away -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("trouble", ["killed", "hung"])
def test_without_the_server_a_copy_serves_but_for_program_and_grant(alive: Slapd, tmp_path: Path, trouble: str) -> None:
    clocks = Clocks()
    right, wrong = PASSWORD.format("driver"), "wrong"
    answers = clocks.answers(alive, tmp_path)
    assert answers.answer(Question("driver", "call", right)).refusal == ""
    if trouble == "killed":
        alive.kill()
    else:
        alive.signal(signal.SIGSTOP)
    clocks.now_s += 10_000
    clocks.calendar_s += 3 * 3_600
    later = clocks.answers(alive, tmp_path, timeout_s=0.3)  # another life of the process: the copy is on the disk
    for verb in VERBS:
        answer = later.answer(Question("driver", verb, right))
        if verb in NEVER_BY_DEFAULT:
            assert "needs a live answer" in answer.refusal and not answer.groups, verb
        else:
            assert answer.groups == ("drivers", "pilots") and "rights by a copy 3 h old" in answer.copy, (verb, answer)
    assert "not the password" in later.answer(Question("driver", "see", wrong)).refusal
    assert "there is no copy" in later.answer(Question("operator", "see", PASSWORD.format("operator"))).refusal
    offline = clocks.answers(alive, tmp_path, timeout_s=0.3, offline_program=True)
    assert offline.answer(Question("driver", "program", right)).groups == ("drivers", "pilots")
    clocks.calendar_s += 70 * 3_600
    assert "older than 72 h" in clocks.answers(alive, tmp_path, timeout_s=0.3).answer(Question("driver", "see", right)).refusal
    clocks.calendar_s -= 100 * 3_600
    assert "from the future" in clocks.answers(alive, tmp_path, timeout_s=0.3).answer(Question("driver", "see", right)).refusal


def test_a_server_that_is_back_is_asked_again(alive: Slapd, tmp_path: Path) -> None:
    clocks = Clocks()
    answers = clocks.answers(alive, tmp_path, refresh_s=1)
    assert answers.answer(Question("driver", "see")).copy == ""
    alive.kill()
    clocks.now_s += 100
    assert "by a copy" in answers.answer(Question("driver", "see")).copy
    alive.start()
    clocks.now_s += 100
    assert answers.answer(Question("driver", "see")).copy == ""


def test_a_user_who_is_removed_at_the_server_is_gone_after_the_refresh_and_leaves_no_copy(alive: Slapd, tmp_path: Path) -> None:
    clocks = Clocks()
    answers = clocks.answers(alive, tmp_path, refresh_s=300)
    import ldap

    admin = ldap.initialize(f"ldap://127.0.0.1:{alive.port}")
    admin.simple_bind_s(ADMIN, ADMIN_SECRET)
    person = [("objectClass", [b"inetOrgPerson"]), ("cn", [b"gone"]), ("sn", [b"gone"]), ("userPassword", [b"secret"])]
    admin.add_s(dn("gone"), [*person, ("uid", [b"gone"])])
    assert answers.answer(Question("gone", "see", "secret")).refusal == ""
    admin.delete_s(dn("gone"))
    admin.unbind_s()
    assert answers.answer(Question("gone", "see", "secret")).refusal == ""  # within refresh_s
    assert "no entry" in answers.answer(Question("gone", "program", "secret")).refusal  # these are always asked anew
    assert "no entry" in answers.answer(Question("gone", "see", "secret")).refusal
    alive.kill()
    clocks.now_s += 1_000
    assert "there is no copy" in answers.answer(Question("gone", "see", "secret")).refusal


def test_a_hundred_wrong_passwords_slow_their_origin_down_and_no_other(slapd: Slapd, tmp_path: Path) -> None:
    clocks = Clocks()
    answers = clocks.answers(slapd, tmp_path)
    waits = []
    for _ in range(100):
        began = clocks.now_s
        while "try again" in (answer := answers.answer(Question("driver", "see", "wrong", "10.0.0.9"))).refusal:
            clocks.now_s += 1
        assert answer.refusal
        waits.append(clocks.now_s - began)
    assert waits[:FREE_TRIES] == [0] * FREE_TRIES and waits[FREE_TRIES : FREE_TRIES + 3] == [1, 2, 4] and set(waits[20:]) == {60}
    right = PASSWORD.format("driver")
    assert "try again" in answers.answer(Question("driver", "see", right, "10.0.0.9")).refusal
    assert answers.answer(Question("driver", "see", right, "console")).refusal == ""
    assert answers.answer(Question("driver", "see", None, "console")).refusal == ""


def test_copies_are_their_owners_alone_and_hold_no_password(slapd: Slapd, tmp_path: Path) -> None:
    clocks = Clocks()
    right = PASSWORD.format("driver")
    clocks.answers(slapd, tmp_path).answer(Question("driver", "see", right))
    path = tmp_path / "copies"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600 and right.encode() not in path.read_bytes()
    whole = path.read_bytes()
    for spoiled in (whole[:-1], b"", b"\xff" * 50):
        path.write_bytes(spoiled)
        assert clocks.answers(slapd, tmp_path).answer(Question("driver", "see", right)).refusal == ""
    path.write_bytes(whole)
    path.chmod(0o620)
    assert clocks.answers(slapd, tmp_path)._copies == {}


# --- The process -----------------------------------------------------------------------------------------------------


def test_the_process_answers_as_its_own_user_and_is_replaced_when_it_dies(slapd: Slapd, tmp_path: Path) -> None:
    state = Path(tempfile.mkdtemp(prefix="rights-state-"))
    state.chmod(0o700)  # as root's own is
    secret = tmp_path / "secret"
    secret.write_text(SECRET)
    secret.chmod(0o600)
    told = config_of(slapd, password_file=str(secret))
    keys = ("server", "base", "account", "ca_file", "password_file")
    lines = [f'{key} = "{getattr(told, key)}"' for key in keys]
    (tmp_path / RIGHTS_FILE).write_text('[rights]\nsource = "ldap"\n[rights.ldap]\ntimeout_s = 60\n' + "\n".join(lines) + "\n")

    async def asked() -> None:
        process = DirectoryProcess(tmp_path, state)
        try:
            answer = await process.ask(Question("driver", "call", PASSWORD.format("driver")))
            assert answer.groups == ("drivers", "pilots"), answer
            child = process._child
            assert child is not None
            if os.geteuid() == 0:
                assert Path(f"/proc/{child.pid}").stat().st_uid not in (0,)
            child.kill()
            child.wait()
            assert (await process.ask(Question("driver", "call"))).groups == ("drivers", "pilots")
            secret.chmod(0o644)
            process.close()
            assert "gave no answer" in (await process.ask(Question("driver", "call"))).refusal
        finally:
            process.close()
            shutil.rmtree(state)

    asyncio.run(asked())
