"""Copies of checkpoints in an archive come by themselves, and a machine with nothing but the team's keys goes on from one."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import pytest

from failover.archive import keys
from tests import s3_servers
from tests.e2e import robots
from tests.e2e.robots import RobotMachine
from tests.e2e.test_deaths import COUNT, kill, revived
from tests.robot_processes import naming, parts

pytest.importorskip("cryptography")

pytestmark = [pytest.mark.root, pytest.mark.timeout(900)]

KEEP = 2
PATIENCE_S = 240.0
BOOTS_FAST = "boot_patience_s = 1\n"

T = TypeVar("T")


def until(condition: Callable[[], T], what: str) -> T:
    """An archive's process yields to all others: on a busy machine it takes its time."""
    return robots.until(condition, what, PATIENCE_S)


def settings(place: str, endpoint: str = "") -> str:
    return f'[store]\ns3 = "{place}"\ns3_endpoint = "{endpoint}"\ns3_every_s = 1\ns3_keep = {KEEP}\n'


@contextlib.contextmanager
def archive_of(kind: str, tmp_path: Path) -> Iterator[tuple[str, str]]:
    """A place, and the URL of its server."""
    directory = tmp_path / "place"
    directory.mkdir()
    with s3_servers.server(kind, directory) as url:
        yield f"s3://{s3_servers.BUCKET}/robots", url


def give_key(*machines: RobotMachine) -> Path:
    """A team directory as a new machine gets it: team file, archive key, and the recovery key, which no robot has."""
    team = machines[0].directory / "team"
    path = keys.new_key(team)
    for robot in machines[1:]:
        shutil.copy2(path, keys.key_path(robot.directory / "team"))
    alone = machines[0].directory.parent.parent / "new machine"
    (alone / "keys").mkdir(parents=True)
    shutil.copy2(team / "team.toml", alone)
    shutil.copy2(path, alone / "keys")
    shutil.move(keys.recovery_path(team), alone / "keys")
    return alone


def archive(act: str, *arguments: str) -> Any:
    ran = subprocess.run(
        [sys.executable, "-m", "failover.cli.main", "archive", act, *arguments, "--json"],
        capture_output=True,
        text=True,
        check=False,
        timeout=PATIENCE_S,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return json.loads(ran.stdout)


def behind(robot: RobotMachine) -> list[str]:
    return [note for note in robot.status()["notes"] if "ARCHIVE BEHIND" in note]


@pytest.mark.sampled(2)
@pytest.mark.slow
@pytest.mark.parametrize("kind", s3_servers.KINDS)
def test_a_machine_with_nothing_but_the_teams_keys_goes_on_where_all_robots_were_lost(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in s3_servers.environment().items():
        monkeypatch.setenv(name, value)
    with archive_of(kind, tmp_path) as (place, url):
        here = ("--place", place, "--endpoint", url)
        with robots.two_robots(tmp_path, settings(place, url), own_network=False) as (first, second):
            alone = str(give_key(first, second))
            robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
            robots.until_protected(first)

            def copies() -> list[dict[str, Any]]:
                found: list[dict[str, Any]] = archive("list", "count", "--directory", alone, *here)["copies"]
                return found

            until(copies, "a copy")
            first_copy = copies()[-1]["sequence"]
            until(lambda: copies()[0]["sequence"] > first_copy, "a newer copy")
            assert behind(second) == [], "it runs nothing, and archives nothing"
            counted = len(robots.numbers(first))
            newest = copies()[0]["sequence"]
            until(lambda: copies()[0]["sequence"] > newest, "a later copy")
            second.cut_power()
            first.cut_power()
        snapshot = str(tmp_path / "count.snapshot")
        fetched = archive("fetch", "count", "--output", snapshot, "--directory", alone, *here)
    assert (fetched["component"], fetched["robot"]) == ("/demo/robot1/count", "robot1")
    assert goes_on(snapshot) > counted // 2


def goes_on(snapshot: str) -> int:
    """Restore a program that counts; the number at which it goes on, after it has counted some more."""
    command = [sys.executable, "-m", "failover.cli.main", "restore", snapshot, "--wait", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        try:
            said = [process.stdout.readline().strip() for _ in range(200)]
        finally:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(PATIENCE_S)
    words = max((at for at, line in enumerate(said) if not line.isdecimal()), default=-1)  # the command's own, between its lines
    counted = [int(line) for line in said[words + 1 :]]
    assert len(counted) > 100, said
    assert counted == list(range(counted[0], counted[0] + len(counted))), "each number once, in order"
    return counted[0]


def test_an_archive_that_is_behind_is_told_with_the_cure_and_nothing_waits_for_it(tmp_path: Path) -> None:
    place = tmp_path / "disk"
    with robots.two_robots(tmp_path, settings(str(place))) as (first, second):
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
        robots.until_protected(first)
        (said,) = until(lambda: behind(first), "the status to tell that nothing is archived")
        assert "/demo/robot1/count: it has had no copy for" in said
        until(lambda: "failover archive key makes one" in behind(first)[0], "the key to be missing")
        give_key(first, second)
        until(lambda: "mount the disk" in behind(first)[0], "the place to be missing")
        before = robots.checkpoints(second, "count")
        until(lambda: robots.checkpoints(second, "count") > before + 3, "checkpoints at the standby all the same")
        assert robots.component(first, "count")["protection"] == "protected"
        place.mkdir()
        until(lambda: not behind(first), "the archive to have caught up")
        why = robots.failover(first, "why", "count").stdout
        assert "its checkpoints do not reach the archive" in why and "its checkpoints reach the archive again" in why


@pytest.mark.slow
def test_a_team_that_lost_every_disk_recovers_a_component_from_its_archive(tmp_path: Path) -> None:
    place = tmp_path / "disk"
    place.mkdir()
    with robots.two_robots(tmp_path, BOOTS_FAST + settings(str(place))) as (first, second):
        give_key(first, second)
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
        robots.until_protected(first)
        until(lambda: newest(place), "a copy")
        counted, copied = len(robots.numbers(first)), newest(place)
        until(lambda: newest(place) > copied, "a later copy")
        for robot in (first, second):
            robots.keep_on(robot)
            kill(robot, ("main_loop", "worker", "guard"))
        for robot in (first, second):
            until(lambda robot=robot: is_gone(robot), "everything of it to have ended")  # type: ignore[misc]
            for name in ("state", "run"):
                shutil.rmtree(robot.directory / name)
        said = recovered(second, "count")
        assert "robot2 holds /demo/robot1/count as robot1 archived it, epoch 1; start the agent" in said
        for robot in (first, second):
            robots.start_agent(robot)
        until(lambda: robots.answers(first) and robots.answers(second), "both agents to answer")
        robots.until_taken_over(second)
        until(lambda: robots.numbers(second)[-1] > counted, "it to go on")
        robots.until_protected(second)
        numbers = robots.numbers(second)
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), "each number once, in order"


def newest(place: Path) -> str:
    """The name of the newest copy; "" where there is none."""
    return max((path.name for path in place.glob("*/@*/*.sealed")), default="")


def is_gone(robot: RobotMachine) -> bool:
    """Whether nothing of its agent and of its programs is left."""
    is_running = naming(robot, "print(i, flush=True)")
    return not is_running and not any(parts(robot, name) for name in ("main_loop", "worker", "guard", "keeper"))


def recovering(robot: RobotMachine, name: str) -> subprocess.CompletedProcess[str]:
    """What failover-agent recover does at a robot whose agent is stopped."""
    command = [sys.executable, "-m", "agent.main", "recover", name, "--config", str(robot.directory / "agent.toml")]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=PATIENCE_S)


def recovered(robot: RobotMachine, name: str) -> str:
    """The same where it succeeds: what it says."""
    ran = recovering(robot, name)
    assert ran.returncode == 0, ran.stderr
    return ran.stdout


def test_the_process_of_an_archive_may_die_and_ends_with_its_worker(tmp_path: Path) -> None:
    place = tmp_path / "disk"
    place.mkdir()
    with robots.two_robots(tmp_path, settings(str(place))) as (first, second):
        give_key(first, second)
        robots.run(first, "count", "/usr/bin/python3", "-S", "-c", COUNT)
        until(lambda: list(place.rglob("*.sealed")), "a copy")
        (archivist,) = until(lambda: archivists(first), "its process")
        assert os.getpriority(os.PRIO_PROCESS, archivist) >= 10
        os.kill(archivist, 9)
        until(lambda: archivists(first) not in ([], [archivist]), "another one")
        until(lambda: not behind(first), "copies again")
        (archivist,) = archivists(first)
        robots.keep_on(first)
        kill(first, ("worker",))
        revived(first, ("worker",))
        until(lambda: robots.has_ended(archivist), "the one of the worker that was killed to end")
        until(lambda: archivists(first), "that of the next worker")


def archivists(robot: RobotMachine) -> list[int]:
    return naming(robot, "agent.archive.process")
