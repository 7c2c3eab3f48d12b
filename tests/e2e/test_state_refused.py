"""A program that cannot resume with its state says so where operators read it: the takeover failed, and the checkpoint stays."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.e2e import robots

pytestmark = pytest.mark.root

MORE = 20
"""Numbers that show that it counts on."""

COUNT = """
import pathlib, sys, time
from dataclasses import dataclass
import failover

@dataclass
class Count:
    value: list[str] if pathlib.Path(sys.argv[1]).exists() else int

count = failover.resume("count", default=Count(0))
while True:
    print(count.value)
    count.value += 1
    failover.commit()
    time.sleep(0.01)
"""
"""Another version of it is installed once that file is there: one for which the state is none."""

COLD = '[components."/demo/robot1/count"]\nwarm = false\n'


def test_a_program_that_refuses_its_state_is_a_takeover_that_failed_and_no_end(tmp_path: Path) -> None:
    script, other_version = tmp_path / "count.py", tmp_path / "other-version"
    script.write_text(COUNT)
    with robots.two_robots(tmp_path, COLD) as (first, second):
        robots.run(first, "count", sys.executable, str(script), str(other_version), cwd=str(tmp_path), engine="cooperative")
        robots.until_protected(first)
        other_version.touch()
        first.cut_power()
        said = "exit code 1 before its first commit; it said: failover.errors.FitError"
        robots.until(lambda: any(said in note for note in robots.component(second, "count")["notes"]), "the reason in its status")
        assert robots.component(second, "count")["exit_status"] is None
        other_version.unlink()
        robots.until(lambda: robots.component(second, "count")["state"] == "running", "another try")
        before = len(robots.numbers(second))
        robots.until(lambda: len(robots.numbers(second)) > before + MORE, "it to go on")
        counted = robots.numbers(second)
        assert counted == list(range(len(counted)))
        assert said in robots.failover(second, "why", "count").stdout
