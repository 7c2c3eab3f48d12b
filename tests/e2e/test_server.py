"""A server: what it keeps and shows, and that its full disk is reported and harms no component."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from checkpoint.snapshot import format
from failover.cli.demo.robots import RobotMachine
from tests.e2e import robots, teams
from tests.e2e.test_full_disk import full
from tests.e2e.test_orders import COUNTING, counted

KEEP = 'keep_checkpoints = 3\nkeep_for = "3s"\n'
KEPT = re.compile(r"kept for robot1: /demo/robot1/count, \d+ checkpoints and [1-9]\d* older, [\d.]+ [KM]B, .* old")
DISK = "size=48m"

pytestmark = pytest.mark.root


@contextmanager
def small_disk(place: Path) -> Iterator[None]:
    """A file system of its own for what survives a power cut."""
    place.mkdir(parents=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", DISK, "disk", str(place)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)


def olds(server: RobotMachine) -> list[Path]:
    return sorted((server.directory / "state" / "store" / "history").glob("*/*"))


def test_a_server_keeps_what_it_was_told_to_shows_it_and_a_full_disk_harms_nobody(tmp_path: Path) -> None:
    with small_disk(tmp_path / "stage" / "hall" / "state"), teams.acting(tmp_path, settings=KEEP) as stage:
        first, hall = stage.members["robot1"], stage.members["hall"]
        robots.run(first, "count", *COUNTING)
        robots.until(lambda: KEPT.search(robots.failover(hall, "status").stdout), "the server to show what it keeps")
        old = robots.until(lambda: olds(hall), "older checkpoints")[0]
        assert len(olds(hall)) <= 3 and format.verify(old).is_base
        with full(hall):
            robots.until_status(hall, 1, "was not stored at hall", "No space left on device")
            robots.until(lambda: not olds(hall), "what is kept for people to give its room, also what a fold has just put there")
            before = len(counted(first))
            robots.until(lambda: len(counted(first)) > before, "the standby to take checkpoints meanwhile")
            robots.until_protected(first)
        robots.until(lambda: not robots.component(hall, "count")["unstored"], "the server to store again")
        numbers = counted(first)
        assert numbers == list(range(len(numbers)))
