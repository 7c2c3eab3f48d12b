"""The schedule of a robot without a board: the agent provides a directory, the first task makes the table in it."""

from __future__ import annotations

import grp
import os
import subprocess
import sys
from pathlib import Path

import pytest

import failover
from agent.errors import AgentError
from agent.worker import schedule_place
from failover.boards import SCHEDULE_NAME, SCHEDULE_PLACE, directory
from failover.boards.schedule_file import ScheduleFile

ROOT = Path(__file__).parents[3]
SECOND = """
import failover
with failover.scheduled("second", period=0.01) as task:
    task.wait_activation()
"""


@pytest.fixture
def runtime(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The agent's, and where programs look for it."""
    monkeypatch.delenv(directory.VARIABLE, raising=False)
    monkeypatch.setenv("FAILOVER_SOCKET", str(tmp_path / "control.sock"))
    monkeypatch.setattr(directory, "SHARED_MEMORY", tmp_path)
    return tmp_path


def test_tasks_of_two_programs_share_the_schedule_that_the_first_one_makes_and_none_removes(runtime: Path) -> None:
    schedule_place.provide(runtime, "")
    second = [sys.executable, "-c", SECOND]
    with failover.scheduled("first", period=0.01, after="second") as first:
        subprocess.run(second, cwd=ROOT, check=True, env=os.environ.copy())
        assert first.wait_activation() is not None
        file = ScheduleFile.open(runtime / SCHEDULE_PLACE / SCHEDULE_NAME)
        assert [row.name for row in file.rows().values()] == ["first", "second"]
        assert file.header.flags == 0
        file.close()
    assert [path.name for path in (runtime / SCHEDULE_PLACE).iterdir()] == [SCHEDULE_NAME]
    schedule_place.provide(runtime, "")  # the next agent
    with failover.scheduled("first", period=0.01) as first:
        assert first.live.counts.started == 1


def test_the_members_of_a_group_share_it(runtime: Path) -> None:
    name = grp.getgrgid(os.getegid()).gr_name
    schedule_place.provide(runtime, name)
    place = runtime / SCHEDULE_PLACE
    before = os.umask(0o077)
    try:
        with failover.scheduled("first", period=1):
            modes = [oct(path.stat().st_mode & 0o7777) for path in (place, place / SCHEDULE_NAME)]
    finally:
        os.umask(before)
    assert modes == ["0o2770", "0o660"]
    assert (place / SCHEDULE_NAME).stat().st_gid == os.getegid()
    with pytest.raises(AgentError, match="no such group"):
        schedule_place.provide(runtime, "no-such-group")


def test_a_user_who_may_not_use_it_has_an_own_schedule(runtime: Path) -> None:
    schedule_place.provide(runtime, "")
    assert directory.find_schedule() == runtime / SCHEDULE_PLACE
    (runtime / SCHEDULE_PLACE).rename(runtime / "elsewhere")
    assert directory.find_schedule() == directory.find() != runtime / SCHEDULE_PLACE


def test_a_schedule_of_an_earlier_boot_goes(runtime: Path) -> None:
    schedule_place.provide(runtime, "")
    path = runtime / SCHEDULE_PLACE / SCHEDULE_NAME
    directory.make_schedule(runtime / SCHEDULE_PLACE, "robot1")
    schedule_place.provide(runtime, "")
    assert path.exists()
    with path.open("r+b") as file:
        file.seek(40)
        file.write(bytes(16))
    schedule_place.provide(runtime, "")
    assert not path.exists()
