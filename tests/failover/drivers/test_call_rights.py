"""Who may call a driver, by rights.toml: users of the robot by the kernel's word, persons at other robots by their robot's."""

from __future__ import annotations

import os
import pwd
from pathlib import Path

import msgspec
import pytest

from failover.cli import main
from failover.drivers.call_rights import CallRights
from failover.errors import CallRefusedError
from tests.failover.drivers.devices import ENGINE, Engine
from tests.failover.drivers.serving import Lab, called, serving, until

PATH = "University/Lab/Engines/3/PWM"
ME = pwd.getpwuid(os.geteuid()).pw_name
RULES = """
[rights.groups]
drivers = ["anna"]
students = ["bert"]

[[rights.rules]]
groups = ["drivers", "students", "@robots"]
verbs = ["see", "call"]
paths = ["University/**"]

[[rights.rules]]
groups = ["students"]
deny = true
verbs = ["call"]
paths = ["**/Engines/**"]
"""


@pytest.mark.parametrize(
    ("by", "is_allowed"), [("anna", True), ("bert", False), ("carl", False), ("", True), ("root", False), ("a\0b", False)]
)
def test_persons_at_another_robot_get_what_the_rules_say(tmp_path: Path, by: str, is_allowed: bool) -> None:
    (tmp_path / "rights.toml").write_text(RULES)
    assert (CallRights(tmp_path, PATH).refusal(None, "robot2", by) == "") == is_allowed


def test_a_refusal_is_the_sentence_of_rights_why(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "rights.toml").write_text(RULES)
    refusal = CallRights(tmp_path, PATH).refusal(None, "robot2", "bert")
    assert main.main(["rights", "why", "bert", "call", PATH, "--directory", str(tmp_path)]) == 1
    assert capsys.readouterr().out.strip() == refusal
    assert f"{tmp_path}/rights.toml:" in refusal and "denies it to students on **/Engines/**" in refusal


def test_a_user_of_the_robot_is_who_the_kernel_says_and_root_stands_above(tmp_path: Path) -> None:
    (tmp_path / "rights.toml").write_text(RULES)
    asked = CallRights(tmp_path, PATH)
    assert asked.refusal(0, None, "bert") == ""
    assert "may not call" in asked.refusal(54_321, None, "anna")


def test_a_mistake_in_the_file_gives_no_right_and_says_where(tmp_path: Path) -> None:
    (tmp_path / "rights.toml").write_text(RULES + 'verb = ["call"]\n')
    refusal = CallRights(tmp_path, PATH).refusal(None, "robot2", "anna")
    assert refusal.startswith("no right can be given: ") and "rights.toml:" in refusal


def test_without_the_file_who_reaches_the_driver_may(tmp_path: Path) -> None:
    assert CallRights(tmp_path, PATH).refusal(54_321, None, "") == CallRights(tmp_path, PATH).refusal(None, "robot2", "x") == ""


def test_a_right_that_is_taken_away_ends_with_the_next_call(folder: Path) -> None:
    lab = Lab(folder, "robot1", "robot2")
    rules = folder / "rights.toml"
    allow = f'[rights.groups]\nx = ["anna"]\n[[rights.rules]]\ngroups = ["x"]\nverbs = ["call"]\npaths = ["{ENGINE}"]\n'
    rules.write_text(allow)
    with serving(Engine, msgspec.structs.replace(lab.here("robot1"), rules=folder)) as engine:
        with called(lab.here("robot2"), "engine") as proxy:
            assert proxy._by == ME
            proxy._by = "anna"
            proxy.call("set", duty=0.25)
            rules.write_text(allow.replace('["call"]', '["see"]'))  # read anew when it is looked at, and no process is told

            def is_denied() -> bool:
                try:
                    proxy.call("set", duty=0.5)
                except CallRefusedError as error:
                    return error.kind == "denied" and f"may not call {ENGINE}" in str(error)
                return False

            until(is_denied)
            before = len(engine.instance.heard)
            with pytest.raises(CallRefusedError, match="may not call"):
                next(proxy.stream("current"))
            assert is_denied() and len(engine.instance.heard) == before
            assert proxy.call("_describe")["path"] == ENGINE
