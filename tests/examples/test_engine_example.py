"""The engine of examples/, and everything that docs/drivers.md tells to type, in processes of their own."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "engine.py"
PAGE = (ROOT / "docs" / "drivers.md").read_text()
LIMIT_S = 100


@pytest.fixture
def place(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the drivers of this test meet."""
    found = tmp_path_factory.mktemp("d") / "m"
    monkeypatch.setenv("FAILOVER_DRIVERS", str(found))
    monkeypatch.setenv("FAILOVER_ROBOT", "robot1")
    monkeypatch.delenv("FAILOVER_TEAM", raising=False)
    return found


@pytest.fixture
def engine(place: Path) -> Iterator[subprocess.Popen[str]]:
    """The driver, once it takes messages."""
    with subprocess.Popen([sys.executable, EXAMPLE], stderr=subprocess.PIPE, text=True) as driver:
        try:
            assert driver.stderr is not None and "takes messages" in driver.stderr.readline()
            yield driver
        finally:
            driver.kill()


def ran(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, timeout=LIMIT_S, check=True, env=os.environ).stdout


def test_the_caller_of_the_example_drives_the_engine(engine: subprocess.Popen[str]) -> None:
    told = ran(sys.executable, str(EXAMPLE), "drive", "engine").splitlines()
    assert told == ["{'duty': 1.0, 'rpm': 3000.0, 'moves': 10}", *["2.5 A"] * 3]


def test_the_first_three_commands_of_the_page_work(engine: subprocess.Popen[str]) -> None:
    block = re.findall(r"```\n(.*?)```", PAGE, re.DOTALL)[0]
    first, *others = [line.partition("  #")[0].strip() for line in block.splitlines()]
    assert first == "python3 examples/engine.py &" and len(others) == 2
    outputs = [ran(sys.executable, "-m", "failover", *shlex.split(line)[1:]) for line in others]
    assert "PWM" in outputs[0] and outputs[1] == "null\n"
    assert '"duty": 0.4' in ran(sys.executable, "-m", "failover", "call", "engine", "read")


@pytest.mark.skipif(shutil.which("nc") is None, reason="needs nc (Debian package netcat-openbsd)")
def test_three_lines_through_nc_move_the_engine(engine: subprocess.Popen[str], place: Path) -> None:
    (message,) = re.findall(r"```json\n(.*?)```", PAGE, re.DOTALL)
    (socket,) = place.glob("*.hand")
    answer = subprocess.run(
        ["nc", "-N", "-U", socket], input=message, capture_output=True, text=True, timeout=LIMIT_S, check=True
    ).stdout
    assert '"ok":null' in answer
    assert '"duty": 0.4' in ran(sys.executable, "-m", "failover", "call", "engine", "read")
