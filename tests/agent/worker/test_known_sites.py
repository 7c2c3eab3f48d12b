"""Sites that were edited by hand are found when the agent starts; those that all members granted are kept."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from agent.config import Config, Settings, check_team
from agent.core_config import team_config
from agent.errors import ConfigError
from agent.worker import known_sites
from failover.config.team import Robot, Team, sites_digest
from failover.core.node import Node
from failover.core.types import Rule, VoteRecord


def settings(directory: Path, sites: dict[str, str], change: int = 1, me: str = "r1") -> Settings:
    robots = {
        name: Robot((f"10.0.0.{place}:7420",), f"10.0.0.{place}:7421", seat=place, site=site)
        for place, (name, site) in enumerate(sites.items(), start=1)
    }
    config = Config(robot=me, state_directory=str(directory), insecure=True)
    return Settings(directory / "agent.toml", config, Team("lab", robots, change=change), "")


def test_sites_that_were_edited_by_hand_are_refused_and_a_granted_change_is_not(tmp_path: Path) -> None:
    before = {"r1": "", "r2": "", "r3": "", "r9": "hall"}
    known_sites.check(settings(tmp_path, before))
    known_sites.check(settings(tmp_path, before))
    edited = settings(tmp_path, {**before, "r3": "hall"})
    with pytest.raises(ConfigError, match="edited by hand"):
        known_sites.check(edited)
    with pytest.raises(ConfigError, match="edited by hand"):
        known_sites.check(settings(tmp_path, dict.fromkeys(before, "")))
    granted = settings(tmp_path, {**before, "r3": "hall"}, change=2)
    known_sites.note(granted)  # while the agent runs
    known_sites.check(granted)
    with pytest.raises(ConfigError, match="edited by hand"):
        known_sites.check(settings(tmp_path, before, change=2))


def test_the_first_site_is_no_matter_for_an_editor_either(tmp_path: Path) -> None:
    known_sites.check(settings(tmp_path, {"r1": "", "r2": ""}))
    with pytest.raises(ConfigError, match="edited by hand"):
        known_sites.check(settings(tmp_path, {"r1": "", "r2": "hall"}))
    known_sites.check(settings(tmp_path, {"r1": "", "r2": "", "r3": "hall"}, change=2))


def test_a_torn_file_is_none(tmp_path: Path) -> None:
    (tmp_path / known_sites.FILE_NAME).write_text("torn")
    known_sites.check(settings(tmp_path, {"r1": "", "r2": "hall"}))
    with pytest.raises(ConfigError, match="edited by hand"):
        known_sites.check(settings(tmp_path, {"r1": "", "r2": ""}))


def test_the_members_of_a_site_alone_decide(tmp_path: Path) -> None:
    here = settings(tmp_path, {"r1": "", "r2": "", "r8": "hall", "r9": "hall", "r10": "hall"})
    assert (team_config(here).peers, team_config(here).rule) == (("r2",), Rule.PAIR)
    assert sorted(here.far) == ["r10", "r8", "r9"]
    there = replace(here, config=replace(here.config, robot="r9"))
    assert (team_config(there).peers, team_config(there).rule) == (("r10", "r8"), Rule.MAJORITY)
    assert here.team.roster_of_site("").names == ("r1", "r2")


def test_a_witness_may_have_a_site_of_its_own_where_it_votes_nowhere(tmp_path: Path) -> None:
    here = settings(tmp_path, {"r1": "", "r2": "", "vault": "vault"})
    vault = replace(here.team.robots["vault"], role="witness")
    here = here.with_robots({**here.team.robots, "vault": vault})
    here.path.write_text("")
    assert (team_config(here).peers, team_config(here).witnesses, team_config(here).rule) == (("r2",), (), Rule.PAIR)
    there = replace(here, config=replace(here.config, robot="vault"))
    node = Node(team_config(there), 1, VoteRecord(), 0)
    assert node.status(10**10).healthy, "it is alone, as it is meant to be"
    check_team(there, there.team)
    with pytest.raises(ConfigError, match="would have no vote"):
        check_team(there, replace(there.team, robots={"r1": there.team.robots["r1"], "vault": vault.at("")}))


def test_robots_that_know_other_sites_do_not_read_each_others_frames(tmp_path: Path) -> None:
    one = settings(tmp_path, {"r1": "", "r2": "", "r3": "", "r9": "hall"}).team
    other = settings(tmp_path, {"r1": "", "r2": "", "r3": "", "r9": "", "r10": "hall"}).team
    none = settings(tmp_path, {"r1": "", "r2": "", "r3": ""}).team
    assert len({one.roster_of_site("").digest, other.roster_of_site("").digest, none.roster_of_site("").digest}) == 3
    assert none.roster_of_site("") == none.roster(), "as before there were sites"
    assert not sites_digest(none)
