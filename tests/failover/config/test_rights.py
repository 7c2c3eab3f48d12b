"""rights.toml: every mistake is told with file, line and key; the sample is read, and decides as it says."""

from __future__ import annotations

import json
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from failover.config import rights
from failover.config.rights import RIGHTS_FILE, RightsFile
from failover.core.rights.rules import Subject, decide
from failover.errors import FileMistakeError

SAMPLE = Path(__file__).parent.parent.parent.parent / "systemd" / RIGHTS_FILE
RULE = '[[rights.rules]]\ngroups = ["a"]\nverbs = ["see"]\npaths = ["**"]\n'
LDAP = '[rights]\nsource = "ldap"\n[rights.ldap]\nserver = "{}"\nbase = "dc=x"\n'


def written(directory: Path, text: str) -> Path:
    """A team directory with this file."""
    (directory / RIGHTS_FILE).write_text(text)
    return directory


def test_without_a_file_there_are_no_rules(tmp_path: Path) -> None:
    assert rights.read(tmp_path) is None


def test_the_sample_is_read_and_each_rule_knows_its_line(tmp_path: Path) -> None:
    found = rights.read(written(tmp_path, SAMPLE.read_text()))
    assert found is not None
    lines = [number for number, line in enumerate(SAMPLE.read_text().splitlines(), 1) if line == "[[rights.rules]]"]
    assert [rule.place for rule in found.rules] == [f"{tmp_path / RIGHTS_FILE}:{line}" for line in lines]
    pwm = "University/Lab/Robotino/Engines/3/PWM"
    assert decide(found.rules, Subject("uid:1", frozenset({"drivers"})), "call", pwm, 10 * 60)
    assert not decide(found.rules, Subject("uid:1", frozenset({"operators", "students"})), "program", pwm, 10 * 60)


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("[rights]\nsorce = 'file'\n", 2, "unknown key 'sorce'; did you mean 'source'?"),
        ("[rights]\nsource = 'fil'\n", 2, "did you mean 'file'?"),
        (RULE + RULE + "hour = 'Mon'\n", 9, "unknown key 'hour'; did you mean 'hours'?"),
        (RULE + RULE + "hours = 'Mo'\n", 9, "hours = 'Mo' is not understood"),
        (RULE + RULE.replace("see", "sea"), 7, "did you mean 'see'?"),
        (RULE + RULE + "deny = 'yes'\n", 9, "rights.rules.1.deny"),
        (RULE + RULE.replace("**", "a*"), 8, "one whole step"),
        (RULE + '[[rights.rules]]\nverbs = ["see"]\npaths = ["**"]\n', 5, "groups is empty"),
        ("[rights]\nsource = 'ldap'\n", 2, "needs server and base"),
        (LDAP.format("http://x"), 3, "no address"),
        (LDAP.format("ldap://10.0.0.7") + "tls = 'none'\n", 3, "in the clear to 10.0.0.7"),
        (LDAP.format("ldap://10.0.0.7") + "[rights.groups]\na = ['b']\n", 6, "the server tells groups"),
        ("rights = 3\n", 1, "rights"),
    ],
)
def test_a_mistake_is_told_with_its_line(tmp_path: Path, text: str, line: int, said: str) -> None:
    with pytest.raises(FileMistakeError, match=re.escape(said)) as refused:
        rights.read(written(tmp_path, text))
    assert f"{RIGHTS_FILE}:{line}:" in str(refused.value)


def test_the_commands_tell_the_rules_and_one_answer(tmp_path: Path) -> None:
    written(tmp_path, SAMPLE.read_text())

    def typed(*words: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "failover", "rights", *words, "--json", "--directory", str(tmp_path)]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    assert len(json.loads(typed("list").stdout)["rules"]) == 4
    yes, no = typed("why", "anna", "operate", "/lab/robot1/mapper"), typed("why", "anna", "grant", "/lab/robot1/mapper")
    assert (yes.returncode, json.loads(yes.stdout)["allow"]) == (0, True)
    assert (no.returncode, json.loads(no.stdout)["allow"]) == (1, False)
    stranger = typed("why", "no-such-user", "see", "a")
    written(tmp_path, LDAP.format("ldaps://10.0.0.7"))
    alone = typed("why", "anna", "see", "a", "--socket", str(tmp_path / "none"))
    assert alone.returncode == 3 and "name groups to try: --groups a,b" in json.loads(alone.stdout)["message"]
    assert stranger.returncode == 1 and "has no user 'no-such-user'" in json.loads(stranger.stdout)["message"]


def test_a_file_that_could_not_be_read_for_want_of_a_descriptor_is_read_at_the_next_look(tmp_path: Path) -> None:
    file = RightsFile(written(tmp_path, RULE))
    free = os.open(tmp_path, os.O_RDONLY)
    os.close(free)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (free, hard))
    try:
        looks = [file.look(), file.look()]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert looks == [True, False] and file.rights is None and "Too many open files" in file.mistake
    assert file.look() and file.rights is not None and not file.mistake
    written(tmp_path, "[")
    assert file.look() and file.mistake and not file.look(), "a mistake in it stays until it changes"
