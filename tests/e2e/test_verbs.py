"""Every verb as a first-time user types it: each error is one sentence with a cure; nothing is left."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import signal
import subprocess
import sys
import termios
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from failover.cli import main
from failover.cli.verbs import status
from failover.client.control import STATUS
from tests.e2e import robots
from tests.e2e.robots import RobotMachine

HEALTHY, FAILED, USAGE, NO_AGENT = 0, 1, 2, 3
NOBODY = 65534

assert status.status, "loaded before anybody becomes another user"

Pair = tuple[RobotMachine, RobotMachine]


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pair]:
    """Two robots for all of these tests, with a component called "sleeper" at the first: nothing here changes either."""
    with robots.two_robots(tmp_path_factory.mktemp("verbs")) as both:
        robots.run(both[0], "sleeper", "/bin/sleep", "100000")
        robots.until_protected(both[0], "sleeper")
        yield both


@pytest.fixture(autouse=True)
def forgotten(pair: Pair) -> Iterator[None]:
    """What failed in one test is not the next one's."""
    yield
    for component in pair[0].status()["components"]:
        if component["state"] == "failed":
            assert robots.failover(pair[0], "release", component["name"]).returncode == HEALTHY
    robots.until(lambda: all(robots.failover(robot, "status").returncode == HEALTHY for robot in pair), "all to be well")


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
        (("failback", "sleeper"), HEALTHY, "runs at robot1 already, where it was started"),
        (("protect", "1073741823"), FAILED, "No such process"),
        (("protect", "me"), USAGE, "is not a whole number above zero"),
        (("logs", "nobody"), FAILED, "no component is called 'nobody'"),
        (("why", "nobody"), FAILED, "no component is called 'nobody'"),
        (("statsu",), USAGE, "'statsu' is none of demo, run, protect"),
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
    assert "is protected already, as /demo/robot1/sleeper; failover release ends that" in ran.stderr


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
def test_somebody_else_is_told_that_he_may_not(pair: Pair, capfd: pytest.CaptureFixture[str]) -> None:
    path = pair[0].socket
    for parent in [*path.parents][:-2]:
        parent.chmod(parent.stat().st_mode | 0o055)
    child = os.fork()
    if child == 0:  # not executed anew: this Python may lie where nobody else may read
        os.setgroups([])
        os.setresgid(NOBODY, NOBODY, NOBODY)
        os.setresuid(NOBODY, NOBODY, NOBODY)
        ended = main.main(["status", "--socket", str(path)])
        sys.stderr.flush()
        os._exit(ended)
    _, ending = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(ending) == NO_AGENT
    assert "this user may not; use sudo, or join the group that owns the socket" in capfd.readouterr().err


def test_the_tree_fits_narrow_terminals_and_other_letters(pair: Pair) -> None:
    command = [sys.executable, "-m", "failover.cli.main", "status", "--socket", str(pair[0].socket)]
    for encoding in ("ascii", "latin-1", "utf-8"):
        environment = os.environ | {"PYTHONIOENCODING": encoding}
        ran = subprocess.run(command, env=environment, capture_output=True, check=False)
        assert ran.stderr == b""
        text = ran.stdout.decode(encoding)
        assert "/demo/robot1/sleeper" in text
        assert ("└─" in text) is (encoding == "utf-8")


@pytest.mark.parametrize(("columns", "form"), [(60, "role primary, state running"), (140, "│ primary │ running")])
@pytest.mark.parametrize("colour", [True, False])
def test_a_terminal_gets_a_table_or_a_list_with_colours_or_without(pair: Pair, columns: int, form: str, colour: bool) -> None:
    ours, theirs = pty.openpty()
    termios.tcsetwinsize(theirs, (40, columns))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "NO_COLOR", "FORCE_COLOR")}
    environment |= {"TERM": "xterm", "LC_ALL": "C.UTF-8"} | ({} if colour else {"NO_COLOR": "1"})
    command = [sys.executable, "-m", "failover.cli.main", "status", "--socket", str(pair[0].socket)]
    ran = subprocess.run(command, env=environment, stdin=theirs, stdout=theirs, stderr=theirs, check=False)
    os.close(theirs)
    shown = read_all(ours)
    assert ran.returncode == HEALTHY, shown
    assert ("\x1b[32m" in shown) is colour, "green"
    plain = re.sub(r"\x1b\[[0-9;]*m", "", shown)
    assert form in plain
    assert all(len(line) <= columns for line in plain.splitlines())


def read_all(terminal: int) -> str:
    """What was written to a terminal that nobody has open any more."""
    content = b""
    with contextlib.suppress(OSError):  # EIO: the other end is closed
        while piece := os.read(terminal, 1 << 16):
            content += piece
    os.close(terminal)
    return content.decode()


def test_watching_shows_the_team_again_and_again_until_ctrl_c(pair: Pair) -> None:
    command = [
        sys.executable,
        "-m",
        "failover.cli.main",
        "status",
        "--watch",
        "--every-ms",
        "50",
        "--socket",
        str(pair[1].socket),
    ]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as ran:
        assert ran.stdout is not None
        seen = 0
        while seen < 3:
            seen += "promise: " in ran.stdout.readline()
        ran.send_signal(signal.SIGINT)
        _, errors = ran.communicate()
    assert (ran.returncode, errors) == (HEALTHY, "")


def test_two_robots_that_start_one_name_at_once_run_it_once(pair: Pair) -> None:
    commands = [
        [sys.executable, "-m", "failover.cli.main", "run", "--detach", "--name", "/demo/one", "--socket", str(robot.socket)]
        for robot in pair
    ]
    running = [
        subprocess.Popen([*command, "--", "/bin/sleep", "100000"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for command in commands
    ]
    told = [one.communicate(timeout=robots.PATIENCE_S) for one in running]
    robots.until(lambda: len({robots.component(robot, "one").get("primary") for robot in pair}) == 1, "both to agree")
    winner = next(robot for robot in pair if robot.name == robots.component(robot, "one")["primary"])
    robots.until(lambda: robots.component(winner, "one").get("state") == "running", "it to run")
    loser = next(robot for robot in pair if robot is not winner)
    robots.until(lambda: robots.component(loser, "one").get("pid") is None, "the other copy to be gone")
    assert 0 in [one.returncode for one in running], told
    assert robots.failover(loser, "stop", "one").returncode == HEALTHY
    assert robots.failover(winner, "release", "one").returncode == HEALTHY


def story_of_both(robot: RobotMachine) -> list[dict[str, Any]]:
    """What is told there of "sleeper", once both robots have answered in time."""
    told: list[dict[str, Any]] = json.loads(robots.failover(robot, "why", "sleeper", "--json").stdout)["story"]
    return told if {line["robot"] for line in told} == {"robot1", "robot2"} else []


def assert_in_order(told: list[dict[str, Any]]) -> None:
    """Each robot's own lines as it wrote them, and nothing later than what follows it by more than the clocks can be wrong."""
    for robot in ("robot1", "robot2"):
        own = [(line["life"], line["number"]) for line in told if line["robot"] == robot]
        assert own == sorted(own)
    doubt_s = 2 * max(line["doubt_ms"] for line in told) / 1e3
    latest = 0.0
    for line in told:
        assert line["at"] >= latest - doubt_s, told
        latest = max(latest, line["at"])


def test_the_story_of_both_robots_is_told_at_either(pair: Pair) -> None:
    for robot in pair:
        told = robots.until(lambda at=robot: story_of_both(at), "both robots to tell their part")  # type: ignore[misc]
        assert_in_order(told)


def test_every_field_of_a_status_is_documented(pair: Pair) -> None:
    documented = set(re.findall(r"\w+", STATUS))

    def sleeper_at_robot2() -> dict[str, Any]:
        """What robot2 says of it, if it has answered in time."""
        shown = json.loads(robots.failover(pair[0], "status", "--json").stdout)
        for part in (shown, shown["beats"], *shown["peers"], *shown["components"]):
            assert set(part) <= documented, set(part) - documented
        sleeper = next(one for one in shown["components"] if one["name"].endswith("/sleeper"))
        return dict(sleeper["elsewhere"].get("robot2", {}))

    assert robots.until(sleeper_at_robot2, "robot2's own sight of it")["role"] == "standby"
