"""A robot comes back with an empty disk: it has forgotten how often it started, and its team has not."""

from __future__ import annotations

from pathlib import Path

from tests.e2e import robots, teams
from tests.e2e.teams import hears_all


def test_a_robot_with_a_new_disk_is_believed_again_without_a_restart_of_its_peers(tmp_path: Path) -> None:
    with teams.acting(tmp_path, {"robot1": "robot", "robot2": "robot"}) as stage:
        stage.cut_power("robot2")
        stage.switch_on("robot2")  # a second life, which its peer remembers
        robots.until(lambda: hears_all(stage.members["robot1"]), "robot1 to hear it")
        lived = stage.members["robot2"].status()["life"]
        before = stage.members["robot1"].status()["pid"]
        stage.cut_power("robot2")
        stage.switch_on("robot2", empty=True)
        robots.until(lambda: hears_all(stage.members["robot1"]), "robot1 to believe it")
        robots.until(lambda: hears_all(stage.members["robot2"]), "robot2 to be heard")
        assert stage.members["robot2"].status()["life"] == lived + 1
        assert stage.members["robot1"].status()["pid"] == before
        assert "its state directory is new" in stage.members["robot2"].log.read_text()
