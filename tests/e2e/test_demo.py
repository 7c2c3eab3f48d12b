"""The demo as a person runs it: the programs outlive their robot, and nothing is left, however it ends."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

SHORT_FIRST = """\
import sys
from failover.cli import main
from failover.cli.demo import play

play.LENGTHS = (0, 1)
sys.exit(main.main(["demo"]))
"""
"""The demo on a machine so busy that its programs are over before they are protected."""

COMMAND = [sys.executable, "-m", "failover.cli.main", "demo"]
BOUND_S = 100.0
NOBODY = 65534


def wait_for(what: str, condition: Callable[[], bool]) -> None:
    """Poll until a condition holds."""
    deadline = time.monotonic() + BOUND_S
    while not condition():
        assert time.monotonic() < deadline, f"waited in vain for {what}"
        time.sleep(0.02)


@pytest.fixture
def place() -> Iterator[Path]:
    """A directory with a short name, for sockets have little room for one, that anybody may use."""
    directory = Path(tempfile.mkdtemp(prefix="fo-", dir="/tmp"))
    directory.chmod(0o777)
    yield directory
    shutil.rmtree(directory, ignore_errors=True)


def environment(directory: Path) -> dict[str, str]:
    """Ours, with every temporary directory inside ``directory``."""
    return os.environ | {"TMPDIR": str(directory)}


def processes_in(directory: Path) -> list[int]:
    """Processes whose command line or working directory names the directory: what the demo has started."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal() or int(entry.name) == os.getpid():
            continue
        try:
            named = str(directory).encode() in (entry / "cmdline").read_bytes() or str(directory) in os.readlink(entry / "cwd")
        except OSError:
            continue
        if named:
            found.append(int(entry.name))
    return found


def assert_nothing_left(directory: Path) -> None:
    """No process, no file."""
    wait_for("every process to end", lambda: processes_in(directory) == [])
    assert list(directory.iterdir()) == []


def assert_outlived(ran: subprocess.CompletedProcess[str]) -> None:
    """The demo says that all outputs are equal, and gives its figures."""
    assert ran.returncode == 0, ran.stdout + ran.stderr
    told = json.loads(ran.stdout)
    assert told["equal"] is True
    for program in told["programs"]:
        assert program["equal"] is True
        assert program["exit_status"] == 0
        assert program["outage_ms"] > 0
        assert program["lag_ms"] is not None
        assert program["freeze_us_median"] > 0


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_the_programs_of_the_demo_outlive_their_robot(place: Path) -> None:
    ran = subprocess.run([*COMMAND, "--json"], env=environment(place), capture_output=True, text=True, check=False)
    assert_outlived(ran)
    assert_nothing_left(place)


@pytest.mark.slow
@pytest.mark.root
@pytest.mark.timeout(300)
def test_an_ordinary_user_sees_the_same(place: Path) -> None:
    if not may_run():
        pytest.skip(f"{sys.executable} cannot be run by an ordinary user here; run the tests as one to see it")
    ran = subprocess.run(
        [*COMMAND, "--json"],
        env=environment(place) | {"HOME": str(place)},
        user=NOBODY,
        group=NOBODY,
        extra_groups=[],
        capture_output=True,
        text=True,
        check=False,
    )
    assert_outlived(ran)
    assert_nothing_left(place)


def may_run() -> bool:
    """Whether an ordinary user may run this Python and this project here."""
    try:
        command = [sys.executable, "-c", "import failover"]
        return subprocess.run(command, user=NOBODY, group=NOBODY, check=False, capture_output=True).returncode == 0
    except PermissionError:
        return False


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_programs_that_end_before_they_are_protected_are_shown_once_more_with_more_to_do(place: Path) -> None:
    command = [sys.executable, "-c", SHORT_FIRST]
    ran = subprocess.run(command, env=environment(place), capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    lines = ran.stdout.splitlines()
    early = [index for index, line in enumerate(lines) if "ended at robot1, before the power was cut" in line]
    assert len(early) == 1
    assert lines[early[0]].endswith("; trying again, with programs that take longer")
    assert any("power cut" in line for line in lines[early[0] :])
    assert lines[-1] == "every program resumed, and its output is complete"
    assert_nothing_left(place)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["ctrl-c", "terminated"])
def test_a_demo_that_is_interrupted_leaves_nothing(place: Path, number: signal.Signals) -> None:
    with subprocess.Popen(COMMAND, env=environment(place), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as ran:
        assert ran.stdout is not None
        said = []
        while line := ran.stdout.readline():
            said.append(line)
            if " runs on robot1 " in line:
                break
        else:
            pytest.fail(f"the demo ended early: {''.join(said)}")
        assert processes_in(place) != []
        ran.send_signal(number)
        rest, _ = ran.communicate()
    assert ran.returncode == 130
    assert "Traceback" not in rest
    assert_nothing_left(place)
