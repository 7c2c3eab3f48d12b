"""Carried files across two robots with separate file trees: killed at random moments, database and memory agree on the other."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from failover.cli.demo.robots import RobotMachine, Stage
from tests.checkpoint.resources.carried.test_carried_files import COUNTER
from tests.e2e.robots import (
    LOG_LINES,
    component,
    connected,
    failover,
    means,
    mistake,
    numbers,
    output,
    result,
    until,
    until_protected,
    until_status,
)

pytestmark = pytest.mark.skipif(
    os.geteuid() != 0 or not means().own_pids, reason="needs root: each robot has a file tree of its own in its mount namespace"
)


NOBODY = 65534
KILLS = int(os.environ.get("FAILOVER_CARRY_KILLS", "1"))
SEED = int(os.environ.get("FAILOVER_SEED", str(random.randrange(1 << 32))))

LEDGER = Path(__file__).with_name("ledger.py")


class OwnTrees(Stage):
    """Robots that see another folder of their own at the same path."""

    def command(self, name: str, config: Path) -> list[str]:
        """See `Stage.command`."""
        disk = self.directory / name / "disk"
        disk.mkdir(exist_ok=True)
        here = self.directory / "here"
        here.mkdir(exist_ok=True)
        lay = 'mount --make-rprivate / && mount --bind "$0" "$1" && shift 1 && exec "$@"'
        return ["unshare", "--mount", "sh", "-c", lay, str(disk), str(here), *super().command(name, config)]


@contextmanager
def robots(directory: Path, settings: str = "") -> Iterator[tuple[RobotMachine, RobotMachine, Path]]:
    """robot1 and robot2, and the folder that each has for itself."""
    with OwnTrees(directory / "stage", replace(means(), own_network=False), settings) as stage:
        stage.directory.mkdir()
        stage.start()
        first, second = stage.robots
        try:
            until(lambda: connected(first) and connected(second), "the robots to hear each other")
            yield first, second, stage.directory / "here"
            assert not mistake(second)
        finally:
            for robot in stage.robots:
                print(f"--- {robot.name} said:", *robot.log.read_text(errors="replace").splitlines()[-LOG_LINES:], sep="\n")


def run_carrying(
    robot: RobotMachine, name: str, carry: list[str], *argv: str, engine: str = "ptrace", user: str = ""
) -> dict[str, Any]:
    """Start a program under protection with what travels with it."""
    wanted = {"argv": list(argv), "name": name, "env": {"PATH": "/usr/bin:/bin", "LC_ALL": "C"}, "cwd": "/", "wait": False}
    with robot.control() as link:
        return link.ask("run", **wanted, engine=engine, carry=carry, user=user)


def disk(robot: RobotMachine) -> Path:
    """The folder of a robot, as we see it."""
    return robot.directory / "disk"


@pytest.mark.parametrize("kill", range(KILLS))
@pytest.mark.parametrize("mode", ["delete", "wal"])
def test_a_database_goes_on_at_a_robot_that_never_had_it(tmp_path: Path, mode: str, kill: int) -> None:
    """Power is cut at a random moment; on the other robot nothing acknowledged is missing, and memory and database agree."""
    seed = SEED
    print("seed", seed)
    with robots(tmp_path) as (first, second, here):
        path, enough = here / "data" / "steps.db", tmp_path / "enough"
        (disk(first) / "data").mkdir()
        command = sys.executable, str(COUNTER), str(path), mode, "1", str(enough)
        started = run_carrying(first, "count", [str(here / "data")], *command)
        assert not started["reasons"], started
        until_protected(first)
        seen = random.Random(seed + kill).randrange(20, 200)
        until(lambda: len(numbers(first)) > seen, f"{seen} steps")
        acknowledged = until(lambda: numbers(second), "steps that are safe")
        first.cut_power()
        until(lambda: len(numbers(second)) > len(acknowledged) + 100, "steps at the other robot")
        enough.touch()
        ended = result(second, "count")
        lines = output(second, "count").decode().split()
        assert ended["exit_status"] == 0, lines[-3:]
        assert lines == [*map(str, range(1, len(lines))), "ok"]
        assert len(acknowledged) < len(lines)
        assert (disk(second) / "data" / "steps.db").exists()


def until_more(robot: RobotMachine, count: int) -> None:
    """Until the component has written so many more lines there."""
    begun = len(numbers(robot))
    until(lambda: len(numbers(robot)) > begun + count, f"{count} more steps")


def test_a_program_with_a_log_of_its_own_goes_there_and_comes_back(tmp_path: Path) -> None:
    """Handed over to and fro, and killed: everywhere its folder is as its memory has it, and what stood there is kept."""
    seed = SEED
    print("seed", seed)
    dice = random.Random(seed)
    with robots(tmp_path) as (first, second, here):
        folder, enough = here / "ledger", tmp_path / "enough"
        (disk(first) / "ledger").mkdir()
        (disk(second) / "ledger").mkdir()
        (disk(second) / "ledger" / "his").write_text("stood here before")
        run_carrying(first, "count", [str(folder)], sys.executable, str(LEDGER), str(folder), str(enough))
        until_protected(first)
        for robot, other in ((first, second), (second, first)):
            until_more(robot, dice.randrange(10, 60))
            ordered = failover(robot, "handover", "count")
            assert ordered.returncode == 0, ordered.stderr
            until_protected(other)
        kept = sorted((disk(second)).glob(".failover-kept-ledger/*/ledger/his"))
        assert [path.read_text() for path in kept] == ["stood here before"]
        first.cut_power()
        until_more(second, 1000)
        enough.touch()
        ended = result(second, "count")
        lines = output(second, "count").decode().split()
        assert ended["exit_status"] == 0, lines[-3:]
        assert lines == [*map(str, range(1, len(lines))), "ok"]


KEEPS_STATE = """
import sys, time
from pathlib import Path
import failover

path = Path(sys.argv[1])
state = failover.resume("rows", default={"rows": 0})
lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
if not state["rows"] <= len(lines) <= state["rows"] + 1 or lines != [b"row %d\\n" % index for index in range(len(lines))]:
    print("state", state["rows"], "file", len(lines), lines[-2:], flush=True)
    sys.exit(1)
if failover.resumed() is not None:
    print("# resumed with", len(lines) - state["rows"], "more", flush=True)
with path.open("wb", buffering=0) as rows:
    rows.write(b"".join(lines[: state["rows"]]))
    while state["rows"] < 1_000_000:
        rows.write(b"row %d\\n" % state["rows"])
        state["rows"] += 1
        print(state["rows"], flush=True)
        failover.commit()
        time.sleep(0.005)
"""


def test_files_of_a_program_that_keeps_its_state_are_of_an_instant_of_its_commit(tmp_path: Path) -> None:
    """It writes a row, then commits: elsewhere the file has all rows of the state, and at most the next one."""
    script = tmp_path / "rows.py"
    script.write_text(KEEPS_STATE)
    with robots(tmp_path) as (first, second, here):
        path = here / "rows"
        run_carrying(first, "count", [str(path)], sys.executable, str(script), str(path), engine="cooperative")
        until_protected(first)
        until(lambda: len(numbers(first)) > 100, "some rows")
        first.cut_power()
        until(lambda: b"# resumed with" in output(second, "count"), "its resumption")
        said = until(lambda: lines if len(lines := output(second, "count").decode().splitlines()) > 150 else [], "more rows")
        assert [line for line in said if line.startswith("state")] == []
        assert [int(line) for line in said if not line.startswith("#")][:150] == list(range(1, 151))


WRITES_AND_READS = """
i=0
while :; do
    i=$((i+1)); echo $i > $0/n; read m < $0/n; [ $m = $i ] || exit 1
    [ $((i % 20)) = 0 ] && echo $i
done
"""


def test_files_of_an_ordinary_user_travel_with_his_rights() -> None:
    """In a folder that is his, below one that is root's: what is replaced is kept in his own."""
    # Each run of pytest closes the folder of all runs to other users.
    with tempfile.TemporaryDirectory() as directory, robots(Path(directory)) as (first, second, here):
        Path(directory).chmod(0o755)
        here.parent.chmod(0o755)
        for robot in (first, second):
            disk(robot).chmod(0o755)
            (disk(robot) / "data").mkdir()
            (disk(robot) / "data" / "n").write_text(robot.name)
            for path in (disk(robot) / "data", disk(robot) / "data" / "n"):
                os.chown(path, NOBODY, NOBODY)
        folder = str(here / "data")
        run_carrying(first, "count", [folder], "/bin/dash", "-c", WRITES_AND_READS, folder, user=str(NOBODY))
        until_protected(first)
        until(lambda: len(numbers(first)) > 5, "some lines")
        first.cut_power()
        begun = len(numbers(second))
        until(lambda: len(numbers(second)) > begun + 5, "more lines")
        (kept,) = (disk(second) / "data" / ".failover-kept-data").iterdir()
        assert ((kept / "n").read_text(), kept.stat().st_uid) == ("robot2", NOBODY)


def test_a_standby_without_room_for_the_files_is_named_and_mends_itself(tmp_path: Path) -> None:
    """Protection says so, before anybody needs it; nothing is acknowledged that could not be laid down."""
    with robots(tmp_path) as (first, second, here):
        pid = second.processes()[0]
        inside = ["nsenter", f"--target={pid}", "--mount"]
        subprocess.run([*inside, "mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", str(here)], check=True)
        (disk(first) / "data").mkdir()
        (disk(first) / "data" / "large").write_bytes(os.urandom(8 << 20))
        code = "import time\nwhile True:\n    print(1, flush=True)\n    time.sleep(0.05)"
        run_carrying(first, "count", [str(here / "data")], sys.executable, "-c", code)
        until_status(first, 1, "need 8192 KiB", "make room there")
        assert component(first, "count")["protection"] != "protected"
        subprocess.run([*inside, "mount", "-o", "remount,size=64m", str(here)], check=True)
        until_protected(first)
