"""Three robots on one machine, of which one is at another site: who decides with whom, with files that differ, too."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from failover.config import team
from tests.e2e import robots
from tests.e2e.teams import TeamStage, hears_all
from tests.e2e.test_orders import COUNTING

pytestmark = [pytest.mark.slow, pytest.mark.timeout(600)]

NAMES = ("robot1", "robot2", "robot3")


class SitedStage(TeamStage):
    """robot1 and robot2 are at one site, robot3 is at the site hall."""

    def _write_team(self) -> None:
        super()._write_team()
        for name in NAMES:
            self.edit(name, robot3_at="hall")

    def edit(self, name: str, *, robot3_at: str, change: int = 0, bulk: str = "") -> None:
        """Have another team.toml at one member."""
        directory = self.directory / name / "team"
        known = team.read(directory)
        robot3 = known.robots["robot3"].at(robot3_at)
        edited = {**known.robots, "robot3": replace(robot3, bulk=bulk or robot3.bulk)}
        team.write(directory, replace(known, robots=edited, change=change))


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[SitedStage]:
    with SitedStage(tmp_path / "stage", dict.fromkeys(NAMES, "robot")) as stage:
        stage.directory.mkdir()
        try:
            stage.start()
            yield stage
        finally:
            for name, member in stage.members.items():
                print(f"--- {name} said:", *member.log.read_text(errors="replace").splitlines()[-robots.LOG_LINES :], sep="\n")


def test_a_site_of_two_goes_on_alone_while_the_other_site_is_silent(stage: SitedStage) -> None:
    """With robot3 among those that count, robot2 would be one of three, and would stand still."""
    first, second, third = stage.members.values()
    robots.run(first, "count", *COUNTING)
    robots.until_protected(first)
    assert [peer["name"] for peer in first.status()["peers"]] == ["robot2"] and first.status()["rule"] == "pair"
    third.freeze()
    stage.cut_power("robot1")
    robots.until(lambda: robots.component(second, "count").get("restores"), "robot2 to resume it")
    robots.until(lambda: len(robots.numbers(second)) > 10, "it to go on")


def test_robots_that_know_other_sites_are_known_to_live_and_count_for_nothing_else(stage: SitedStage) -> None:
    first = stage.members["robot1"]
    robots.run(first, "count", *COUNTING)
    robots.until_protected(first)
    stage.cut_power("robot2")
    stage.edit("robot2", robot3_at="dock", change=1)
    second = stage.switch_on("robot2")
    for one, other in ((first, "robot2"), (second, "robot1")):
        robots.until(lambda one=one, other=other: f"and {other} know other sites" in str(one.status()), "the sentence")
        robots.until(lambda one=one: one.status()["peers"][0]["state"] == "live", "it to be known to live")
        assert not one.status()["peers"][0]["hears_us"]
    assert not robots.component(second, "count").get("restores")
    stage.cut_power("robot2")
    stage.edit("robot2", robot3_at="hall", change=2)
    stage.switch_on("robot2")
    robots.until_protected(first)


def test_an_address_that_differs_leaves_a_site_as_it_is(stage: SitedStage) -> None:
    """A new file comes to one robot after the other."""
    first = stage.members["robot1"]
    robots.run(first, "count", *COUNTING)
    robots.until_protected(first)
    stage.cut_power("robot2")
    stage.edit("robot2", robot3_at="hall", bulk="127.0.0.1:9")
    second = stage.switch_on("robot2")
    robots.until(lambda: hears_all(first) and hears_all(second), "robot1 and robot2 to hear each other")
    robots.until_protected(first)
