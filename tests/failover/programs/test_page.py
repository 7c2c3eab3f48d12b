"""What docs/programs.md says first is typed, and does what it says; then the same with a bundle, by the command line alone."""

from __future__ import annotations

import contextlib
import getpass
import io
import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from failover.cli import main
from failover.drivers.here import Here
from failover.drivers.lookup import lookup
from failover.errors import NameUnknownError
from tests.failover.drivers.serving import until
from tests.failover.programs.senders import RULES

ROOT = Path(__file__).parents[3]
PATH = "University/Lab/Robotino/Engines/3/PWM"


def typed(*words: str) -> str:
    """What a command prints; in this process, which has loaded all of it."""
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.chdir(ROOT):
        assert main.main(words) == 0
    return said.getvalue()


def is_registered(here: Here) -> bool:
    """Whether commands find it; its lock is held a moment before."""
    try:
        return bool(lookup(here, PATH))
    except NameUnknownError:
        return False


@contextmanager
def running(here: Here, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    """``failover program run``, until the body ends."""
    with subprocess.Popen([sys.executable, "-m", "failover", "program", "run", *words], cwd=ROOT) as process:
        try:
            until(lambda: is_registered(here))
            yield process
        finally:
            process.send_signal(signal.SIGINT)


def test_the_three_commands_of_the_page(here: Here) -> None:
    page = (ROOT / "docs" / "programs.md").read_text()
    with running(here, "examples/programs/engine_1"):
        assert "failover program run examples/programs/engine_1 &" in page
        assert "failover call engine set '{\"duty\": 0.4}'" in page
        typed("call", "engine", "set", '{"duty": 0.4}')
        assert "failover program switch engine examples/programs/engine_2 --wait" in page
        assert typed("program", "switch", "engine", "examples/programs/engine_2", "--wait").startswith("2.0 is committed")
        read = typed("call", "engine", "read").strip()
        assert read in page, read


def test_a_bundle_by_the_command_line(here: Here, folder: Path) -> None:
    pytest.importorskip("cryptography")
    team, key = folder / "t", folder / "a.key"
    team.mkdir()
    (team / "programs.toml").write_text(typed("program", "key", str(key), "--owner", getpass.getuser()))
    (team / "rights.toml").write_text(RULES.format(user=getpass.getuser()).replace("Lab/robot1", "University"))
    for number in ("1", "2"):
        file = str(folder / f"{number}.bundle")
        typed("program", "pack", f"examples/programs/engine_{number}", "-o", file, "--key", str(key))
        typed("program", "verify", file, "--directory", str(team))
        typed("program", "send", file, "--directory", str(team))
    with running(here, "engine", "1.0", "--directory", str(team)):
        typed("call", "engine", "set", "0.4")
        assert typed("program", "switch", "engine", "2.0", "--wait").startswith("2.0 is committed")
        (found,) = json.loads(typed("program", "list", "--json"))["programs"]
        assert [one["state"] for one in found["versions"]] == ["retired", "active"]
        assert any("network" in one for one in [*found["host"]["enforced"], *found["host"]["not_enforced"]])
        assert "took over within" in typed("program", "log", "engine")
