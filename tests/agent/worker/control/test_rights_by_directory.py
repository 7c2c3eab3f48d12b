"""The control socket asks a real slapd who users are: the table of rights, users without an account, a server that is away."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import signal
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from agent.errors import RefusedError
from agent.worker.control.queries import Lines, Questions
from agent.worker.control.rights_gate import RightsGate
from failover.config.rights import RIGHTS_FILE
from failover.core.rights.rules import NEVER_BY_DEFAULT, VERBS, Rule
from tests.agent.directory.slapd import SECRET, SERVICE, Slapd, filled, make_certificate, why_not
from tests.agent.worker.control.test_rights_gate import NOBODY, Robot
from tests.failover.core.rights.table import CASES, RULES, expected

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not() or "-")

PWM = "University/Lab/Robotino/Engines/3/PWM"
ALL_SEE = '[[rights.rules]]\ngroups = ["@all"]\nverbs = ["see"]\npaths = ["lab/*"]\n'
LDAP = """[rights]
source = "ldap"
[rights.ldap]
server = "ldaps://127.0.0.1:{port}"
base = "dc=lab"
account = "{account}"
password_file = "{secret}"
ca_file = "{certificate}"
timeout_s = {timeout_s}
"""


def as_toml(rule: Rule) -> str:
    """The rule as a file has it, at all hours."""
    lists = (("groups", rule.groups), ("verbs", sorted(rule.verbs)), ("paths", list(rule.patterns)))
    lines = [f"{key} = {json.dumps(list(value))}" for key, value in lists]
    return "\n".join(["[[rights.rules]]", *lines, f"deny = {json.dumps(rule.deny)}"]) + "\n"


@pytest.fixture
def slapd() -> Iterator[Slapd]:
    """A server that the test may stop."""
    with filled(1) as server:
        yield server


class Console:
    """One robot's control socket, as users of the robot ask it."""

    def __init__(self, team: Path, state: Path, slapd: Slapd) -> None:
        self._team, self._slapd = team, slapd
        self._secret = team / "secret"
        self._secret.write_text(SECRET)
        self._secret.chmod(0o600)
        self.gate = RightsGate(team, state)
        self._verbs = Questions(cast(Lines, Robot()), self.gate).gated()
        self.write()

    def write(self, certificate: Path | None = None, timeout_s: float = 60) -> None:
        """Write the rules anew, so that the next question is one of a new process that knows nothing but its copies."""
        ldap = LDAP.format(
            port=self._slapd.port_tls,
            account=SERVICE,
            secret=self._secret,
            certificate=certificate or self._slapd.certificate,
            timeout_s=timeout_s,
        )
        aside = self._team / "new"
        aside.write_text(ldap + ALL_SEE + "".join(map(as_toml, RULES)))
        aside.replace(self._team / RIGHTS_FILE)

    def ask(self, verb: str, uid: int, **arguments: Any) -> dict[str, Any]:
        """Ask as a user."""
        say = SimpleNamespace(caller=SimpleNamespace(uid=uid))
        return asyncio.run(cast(Any, self._verbs[verb](cast(Any, say), arguments)))

    def why(self, user: str, verb: str, path: str = PWM, uid: int | None = None) -> dict[str, Any]:
        """``failover rights why``, as root, or as the user ``uid``."""
        return self.ask("rights", os.geteuid() if uid is None else uid, user=user, right=verb, path=path)

    def standing(self) -> str:
        """The line of the status."""
        return str(self.ask("status", os.geteuid())["rights"])


@pytest.fixture
def console(tmp_path: Path, slapd: Slapd) -> Iterator[Console]:
    """One robot with the table's rules and that server."""
    state = Path(tempfile.mkdtemp(prefix="rights-state-"))
    found = Console(tmp_path, state, slapd)
    yield found
    found.gate.close()
    shutil.rmtree(state)


def refusal(question: Callable[[], object]) -> str:
    with pytest.raises(RefusedError) as refused:
        question()
    return str(refused.value)


@pytest.mark.timeout(600)
def test_the_table_holds_for_users_that_only_the_directory_knows(console: Console) -> None:
    """Four users × eight verbs × six paths; each answer says why."""
    assert "not asked yet" in console.standing()
    wrong = []
    for user, verb, path in CASES:
        answer = console.why(user, verb, path)
        said = f"ldap:{user} may {'' if answer['allow'] else 'not '}{verb} {path}: "
        if answer["allow"] != expected(user, verb, path) or not answer["because"].startswith(said):
            wrong.append((user, verb, path, answer))
    assert wrong == []
    assert "which answered" in console.standing()


@pytest.mark.parametrize("trouble", ["killed", "hung", "wrong certificate"])
def test_without_the_server_copies_serve_and_the_status_says_so(console: Console, slapd: Slapd, trouble: str) -> None:
    assert console.why("student", "call")["allow"] and console.why("student", "program", "University")["allow"]
    certificate = None
    if trouble == "killed":
        slapd.kill()
    elif trouble == "hung":
        slapd.signal(signal.SIGSTOP)
    else:
        other = slapd.place / "other"
        other.mkdir()
        make_certificate(other)
        certificate = other / "certificate"
    console.write(certificate, timeout_s=0.3)
    for verb in VERBS:
        if verb in NEVER_BY_DEFAULT:
            assert f"{verb} needs a live answer" in refusal(lambda verb=verb: console.why("student", verb, "University"))
        else:
            assert "rights by a copy" in console.why("student", verb, "University")["because"], verb
    assert "there is no copy of operator" in refusal(lambda: console.why("operator", "see"))
    told = console.standing()
    assert "has not answered since the agent began" in told and "never for program and grant" in told, told
    assert "start the server, or mend [rights.ldap]" in told
    if trouble == "killed":
        slapd.start()
    elif trouble == "hung":
        slapd.signal(signal.SIGCONT)
    console.write()
    assert console.why("student", "program", "University")["allow"]
    assert "which answered" in console.standing()


@pytest.mark.parametrize("name", ["*", "*)(uid=*", "driver)(|(uid=*", "driver*", "\\2a", "driver,ou=people", "(", "\n"])
def test_a_name_that_is_a_filter_finds_no_user(console: Console, name: str) -> None:
    assert "no right can be given to" in refusal(lambda: console.why(name, "see"))


def test_what_is_no_name_or_no_path_is_refused_before_the_server_is_asked(console: Console) -> None:
    for arguments in ({"user": ""}, {"user": "x" * 257}, {"user": 7}, {"right": None}, {"path": ["a"]}, {"more": "a"}):
        known: dict[str, Any] = {"user": "driver", "right": "see", "path": PWM}
        assert "its arguments are not right" in refusal(lambda known=known | arguments: console.ask("rights", 0, **known))
    assert "not asked yet" in console.standing()
    assert "did you mean 'see'" in console.why("driver", "sea")["because"]
    assert "is no path" in console.why("driver", "see", "a//b")["because"]


def test_a_user_may_ask_about_itself_and_by_grant_about_others(console: Console) -> None:
    answer = console.why("nobody", "see", "lab/robot1", uid=NOBODY)
    assert answer["allow"] and answer["place"].endswith(":10"), answer
    assert f"uid:{NOBODY} may not grant {PWM}" in refusal(lambda: console.why("driver", "see", uid=NOBODY))
