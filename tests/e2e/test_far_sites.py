"""Two robots, each at a site of its own, behind 200 ms, 2 % loss and cuts: items, messages, and nobody dead for being far.

FAILOVER_CUT_S says how long a cut lasts, 8 s unless it is set.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import failover
from failover.cli import key_pairs
from failover.cli.demo.robots import NAMES, RobotMachine, Stage, ip_inside, run, wait_for_network
from failover.config import team
from failover.config.team import Robot, Team
from failover.drivers.here import DIRECTORY, ROBOT, TEAM
from tests.e2e import robots
from tests.e2e.long_wire import ADDRESS, LongWire, long_wire

ROOT = Path(__file__).parents[2]
SITES = ("harbour", "hall")
BOARD = """
[board.items.ball]
type = "i8"
[board.items.mode]
type = "char[16]"
"""
FOUND_S = 240.0
"""Some scans for names, 20 s apart, on a busy machine."""

MESSAGES = 60
ASKS_A_SECOND = 2
VALUES = 8
CUT_S = float(os.environ.get("FAILOVER_CUT_S", "8"))

DRIVER = """
import failover
@failover.driver("Lab/robot1/Ledger")
class Ledger:
    def __init__(self):
        self.noted = []
    @failover.command
    def note(self, number: int) -> int:
        self.noted.append(number)
        print(number, flush=True)
        return len(self.noted)
print("begins", flush=True)
failover.run(Ledger)
"""
CALLER = f"""
import sys, time, failover
with failover.proxy("Lab/robot1/Ledger", sender="mission", durable=True) as ledger:
    for number in range({MESSAGES}):
        ledger.post("note", number=number).add_done_callback(lambda done: print(done.result(), flush=True))
        time.sleep(0.1)
    ledger.flush(timeout=3600)
"""

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(not robots.has_cable() or not Path("/dev/net/tun").exists(), reason="needs network namespaces and TUN"),
]


class FarStage(Stage):
    """Two robots that nothing but a long wire joins."""

    wire: LongWire

    def __init__(self, directory: Path) -> None:
        super().__init__(directory, robots.means(), cables=())
        self._laid = contextlib.ExitStack()

    def __exit__(self, *what: object) -> None:
        places = [robot.socket.parent / "board" for robot in self.robots]
        boards = [place.resolve() for place in places if place.is_symlink()]
        self._laid.close()
        super().__exit__(*what)
        for board in boards:
            shutil.rmtree(board, ignore_errors=True)

    def _write_team(self) -> None:
        members = Team("demo")
        for index, (name, site) in enumerate(zip(NAMES, SITES, strict=True), start=1):
            public, secret = key_pairs.new_pair()
            directory = self.directory / name / "team"
            directory.mkdir(parents=True)
            team.write_secret_key(directory, name, secret)
            host = ADDRESS.format(index)
            members = team.enrol(members, name, Robot((f"{host}:7420",), f"{host}:7421", "robot", public, site=site))
        for name in NAMES:
            directory = self.directory / name / "team"
            team.write(directory, members)
            path = directory / team.TEAM_FILE
            path.write_text(path.read_text() + BOARD)

    def join(self) -> None:
        for robot in self.robots:
            wait_for_network(robot)
            run(ip_inside(robot, "link", "set", "lo", "up"))
        self.wire = self._laid.enter_context(long_wire(self.robots))

    @contextlib.contextmanager
    def running(self, robot: str, script: str) -> Iterator[Path]:
        """A process in a robot's network, with its team; the file into which it writes."""
        machine = next(one for one in self.robots if one.name == robot)
        output = self.directory / f"{robot}.output"
        with tempfile.TemporaryDirectory(prefix="fo-", dir="/tmp") as meeting:  # short: a unix socket's address has 107 bytes
            own = {"PYTHONPATH": str(ROOT), ROBOT: robot, TEAM: str(machine.directory / "team"), DIRECTORY: meeting}
            inside = ["nsenter", "--net", f"--target={machine.process.pid}", sys.executable, "-c", script]
            with output.open("wb") as written:
                process = subprocess.Popen(
                    inside, env={**os.environ, **own}, stdout=written, cwd=meeting, stderr=subprocess.STDOUT
                )
            try:
                yield output
            finally:
                process.kill()
                process.wait()


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[FarStage]:
    with FarStage(tmp_path / "stage") as stage:
        stage.directory.mkdir()
        try:
            stage.start()
            robots.until(lambda: all(is_connected(robot) for robot in stage.robots), "the robots to be connected")
            yield stage
            for robot in stage.robots:
                assert not robots.mistake(robot), f"a mistake in the agent of {robot.name}:\n{robots.mistake(robot)}"
        finally:
            for robot in stage.robots:
                print(
                    f"--- {robot.name} said:", *robot.log.read_text(errors="replace").splitlines()[-robots.LOG_LINES :], sep="\n"
                )


def is_connected(robot: RobotMachine) -> bool:
    far = robot.status()["far"]
    return bool(far) and all(one["lane"] == "connected" for one in far)


def open_board(robot: RobotMachine, monkeypatch: pytest.MonkeyPatch) -> failover.Board:
    monkeypatch.delenv("FAILOVER_BOARD", raising=False)
    monkeypatch.setenv("FAILOVER_SOCKET", str(robot.socket))
    return failover.board()


def now_ns() -> int:
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def has_come(board: failover.Board, robot: str, item: str, value: object) -> bool:
    try:
        return bool(board.item(item).get(robot).value == value)
    except failover.NeverWrittenError:
        return False


def test_items_follow_with_a_true_bound_and_after_a_cut_the_newest_one_comes_first(
    stage: FarStage, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = stage.robots
    with open_board(first, monkeypatch) as here, open_board(second, monkeypatch) as there:
        ball, seen = there.item("ball"), here.item("ball")
        there.item("mode").put("before")
        robots.until(lambda: has_come(here, second.name, "mode", "before"), "the mode")
        begun, read = now_ns(), []
        while len({value for _, value, _, _ in read}) < VALUES:  # the value is the instant of its put
            ball.put(now_ns())
            with contextlib.suppress(failover.NeverWrittenError):
                reading = seen.get(second.name)
                at_ns = now_ns()
                assert reading.age_max_ns >= at_ns - reading.value - 10_000_000, "it is older than the bound of its age says"
                read.append((reading.number, reading.value, reading.age_ns, at_ns))
            time.sleep(0.01)
        values = [value for _, value, _, _ in read]
        assert values == sorted(values)
        assert len(set(values)) <= ASKS_A_SECOND * (now_ns() - begun) / 1e9 + 2, "one value for each question"
        for _, value, age_ns, at_ns in read:
            assert age_ns <= at_ns - value + 10_000_000, "a lower bound of its age"
        stage.wire.cut()
        cut_at = now_ns()
        until = time.monotonic() + CUT_S
        while time.monotonic() < until:
            ball.put(now_ns())
            time.sleep(0.01)
        there.item("mode").put("after")
        before = reading = seen.get(second.name)
        assert reading.value < cut_at and reading.age_ns > (CUT_S - 2) * 1e9, "its age tells of the cut"
        assert {one["name"] for one in first.status()["far"]} == {second.name}
        assert not first.status()["peers"], "it is no peer, and none that is dead"
        last = now_ns()
        ball.put(last)
        stage.wire.mend()
        fresh: list[int] = []

        def is_fresh() -> bool:
            value = seen.get(second.name).value
            if value != before.value:
                fresh.append(value)
            return bool(fresh)

        robots.until(is_fresh, "a value after the cut")
        assert fresh == [last], "the newest one, and none of before: the cut was longer than TCP sends an answer again"
        robots.until(lambda: has_come(here, second.name, "mode", "after"), "the other item")


def test_messages_come_in_order_and_none_twice_over_a_cut(stage: FarStage) -> None:
    first, second = stage.robots
    with stage.running(first.name, DRIVER) as noted:
        robots.until(lambda: noted.read_text(), "the driver to begin")
        with stage.running(second.name, CALLER) as answered:
            robots.until(lambda: len(answered.read_text().split()) > 5, "the first answers", FOUND_S)
            stage.wire.cut()
            time.sleep(CUT_S)
            assert len(answered.read_text().split()) < MESSAGES
            stage.wire.mend()
            robots.until(lambda: len(answered.read_text().split()) >= MESSAGES, "all answers", FOUND_S)
            assert answered.read_text().split() == [str(1 + number) for number in range(MESSAGES)]
        numbers = [line for line in noted.read_text().splitlines() if line.isdecimal()]
        assert numbers == [str(number) for number in range(MESSAGES)]


def test_a_far_robot_has_no_part_in_decisions(stage: FarStage) -> None:
    first, second = stage.robots
    robots.run(first, "count", sys.executable, "-c", "import time\nwhile True: time.sleep(0.1)")
    robots.until(lambda: robots.component(first, "count").get("inner_pid"), "it to run")
    before = robots.component(first, "count")["epoch"]
    status = first.status()
    assert (status["rule"], status["peers"]) == ("pair", [])
    assert [(one["name"], one["site"], one["role"]) for one in status["far"]] == [("robot2", "hall", "robot")]
    moved = robots.failover(first, "handover", "count", "--to", "robot2")
    assert moved.returncode and "the team knows robot1" in moved.stderr
    stage.wire.cut()
    robots.until(lambda: not is_connected(second) or not is_connected(first), "the cut to be noticed")
    assert not second.status()["components"], "the far robot knows nothing of it"
    assert robots.component(first, "count")["epoch"] == before
    shown = robots.failover(first, "status")
    assert "robot2" in shown.stdout and "at hall" in shown.stdout and "dead" not in shown.stdout
