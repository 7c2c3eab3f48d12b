"""Every verb as somebody uses it for the first time: what is wrong is said in a sentence, with what to do; nothing is left."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e import robots
from tests.e2e.robots import RobotMachine

HEALTHY, FAILED, USAGE, NO_AGENT = 0, 1, 2, 3
NOBODY = 65534

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    """Two robots for all of these tests, with a component called "sleeper" at the first: nothing here changes either."""
    with robots.two_robots(tmp_path_factory.mktemp("verbs")) as both:
        robots.run(both[0], "sleeper", "/bin/sleep", "100000")
        robots.until(lambda: robots.component(both[0], "sleeper").get("protection") == "protected", "a checkpoint at robot2")
        yield both


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("run", "--", "/nonexistent"), FAILED, "cannot start /nonexistent: No such file or directory"),
        (("run", "--name", "two words", "--", "/bin/true"), FAILED, "cannot name a component: use a path such as"),
        (("run", "--name", "sleeper", "--", "/bin/true"), FAILED, "it runs here; failover stop or release it first"),
        (("run",), USAGE, "the following arguments are required: CMD"),
        (("run", "--", "/bin/sh", "-c", "exit 3"), 3, ""),
        (("run", "--", "/bin/sh", "-c", "kill -SEGV $$"), 128 + signal.SIGSEGV, "no checkpoint to resume it from"),
        (("stop", "nobody"), FAILED, "no component is called 'nobody'; this team protects"),
        (("stop", "sleeper", "--signal", "FOO"), USAGE, "is no signal; give a number or a name such as TERM"),
        (("handover", "nobody"), FAILED, "no component is called 'nobody'"),
        (("handover", "sleeper", "--to", "robot1"), FAILED, "runs at robot1 already"),
        (("handover", "sleeper", "--to", "mars"), FAILED, "the team knows robot1, robot2"),
        (("prefer", "sleeper", "mars"), FAILED, "the team knows robot1, robot2"),
        (("prefer", "sleeper"), USAGE, "the following arguments are required: ROBOT"),
        (("failback", "sleeper"), HEALTHY, "runs at robot1, where it belongs"),
        (("protect", "1073741823"), FAILED, "No such process"),
        (("protect", "me"), USAGE, "is not a whole number above zero"),
        (("logs", "nobody"), FAILED, "no component is called 'nobody'"),
        (("why", "nobody"), FAILED, "no component is called 'nobody'"),
        (("statsu",), USAGE, "invalid choice: 'statsu'"),
    ],
    ids=lambda value: " ".join(value)[:30] if isinstance(value, tuple) else None,
)
def test_what_is_wrong_is_said_with_what_to_do(pair: Pair, arguments: tuple[str, ...], status: int, said: str) -> None:
    ran = robots.failover(pair[0], arguments[0], *arguments[1:])
    assert (ran.returncode, "Traceback" in ran.stderr) == (status, False), ran
    assert said in ran.stdout + ran.stderr
    if ran.returncode == FAILED:
        assert ran.stderr.startswith("failover: "), ran.stderr


def test_errors_in_json_are_one_object_with_the_kind(pair: Pair) -> None:
    ran = robots.failover(pair[0], "stop", "nobody", "--json")
    assert ran.returncode == FAILED
    assert json.loads(ran.stdout)["error"] == "UnknownComponentError"


def test_a_refused_start_leaves_nothing_and_what_failed_can_be_forgotten(pair: Pair) -> None:
    first, second = pair
    assert robots.failover(first, "run", "--name", "absent", "--", "/nonexistent").returncode == FAILED
    assert robots.failover(first, "run", "--name", "crash", "--", "/bin/sh", "-c", "kill -SEGV $$").returncode == 128 + 11
    for robot in pair:
        shown = robots.failover(robot, "status").stdout
        assert "absent" not in shown
        robots.until(lambda at=robot: robots.component(at, "crash").get("state") == "failed", "the failure to be known")  # type: ignore[misc]
    assert robots.failover(second, "release", "crash").returncode == HEALTHY  # at the robot where it did not run
    for robot in pair:
        robots.until(lambda at=robot: "crash" not in robots.failover(at, "status").stdout, "it to be forgotten")  # type: ignore[misc]


def test_a_process_that_is_protected_already_is_refused_by_its_name(pair: Pair) -> None:
    pid = robots.component(pair[0], "sleeper")["pid"]
    ran = robots.failover(pair[0], "protect", str(pid))
    assert ran.returncode == FAILED
    assert "is protected already, as /demo/robot1/sleeper; failover release lets it go" in ran.stderr


def test_ctrl_c_reaches_the_program_and_its_exit_status_comes_back(pair: Pair) -> None:
    script = "import signal, sys\nsignal.signal(2, lambda *_: sys.exit(5))\nprint('ready', flush=True)\nsignal.pause()"
    command = [sys.executable, "-m", "failover.cli.main", "run", "--socket", str(pair[0].socket)]
    with subprocess.Popen([*command, "--", "/usr/bin/python3", "-c", script], stdout=subprocess.PIPE, text=True) as ran:
        assert ran.stdout is not None
        assert ran.stdout.readline() == "ready\n"
        ran.send_signal(signal.SIGINT)
        assert ran.wait(timeout=robots.PATIENCE_S) == 5


def test_without_an_agent_the_socket_and_the_cure_are_named(tmp_path: Path) -> None:
    for verb in (["status"], ["logs", "x"], ["handover", "x"], ["release", "x"], ["run", "--", "/bin/true"]):
        command = [sys.executable, "-m", "failover.cli.main", verb[0], "--socket", str(tmp_path / "none"), *verb[1:]]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        assert ran.returncode == NO_AGENT
        assert f"cannot reach the agent at {tmp_path}/none: no agent has been started there" in ran.stderr


@pytest.mark.root
def test_somebody_else_is_told_that_he_may_not(pair: Pair) -> None:
    directory = pair[0].socket
    for parent in [*directory.parents][:-2]:
        parent.chmod(parent.stat().st_mode | 0o055)
    command = [sys.executable, "-m", "failover.cli.main", "status", "--socket", str(directory)]
    try:
        ran = subprocess.run(command, user=NOBODY, group=NOBODY, extra_groups=[], capture_output=True, text=True, check=False)
    except PermissionError:
        pytest.skip(f"{sys.executable} cannot be run by an ordinary user here")
    if "No module named" in ran.stderr or "Permission denied" in ran.stderr:
        pytest.skip("an ordinary user cannot run this project here")
    assert ran.returncode == NO_AGENT, ran
    assert "this user may not; use sudo, or join the group that owns the socket" in ran.stderr


def test_the_tree_fits_narrow_terminals_and_other_letters(pair: Pair) -> None:
    command = [sys.executable, "-m", "failover.cli.main", "status", "--socket", str(pair[0].socket)]
    for encoding in ("ascii", "latin-1", "utf-8"):
        environment = os.environ | {"PYTHONIOENCODING": encoding}
        ran = subprocess.run(command, env=environment, capture_output=True, check=False)
        assert ran.stderr == b""
        text = ran.stdout.decode(encoding)
        assert "/demo/robot1/sleeper" in text
        assert ("└─" in text) is (encoding == "utf-8")
