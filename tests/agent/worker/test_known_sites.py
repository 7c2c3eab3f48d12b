"""Sites that were edited by hand are found when the agent starts; those that all members granted are kept."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from agent.config import Config, Settings, check_team
from agent.core_config import team_config
from agent.errors import ConfigError
from agent.main_loop import vote_record
from agent.worker import known_sites
from failover.config.team import Robot, Team, sites_digest
from failover.core.frames.frame import Part, Receiver
from failover.core.frames.lane import FrameLane
from failover.core.node import Node
from failover.core.types import Rule, VoteRecord
from failover.core.wire.messages import Beat


def settings(directory: Path, sites: dict[str, str], change: int = 1, me: str = "r1") -> Settings:
    robots = {
        name: Robot((f"10.0.0.{place}:7420",), f"10.0.0.{place}:7421", seat=place, site=site)
        for place, (name, site) in enumerate(sites.items(), start=1)
    }
    config = Config(robot=me, state_directory=str(directory), insecure=True)
    return Settings(directory / "agent.toml", config, Team("lab", robots, change=change), "")


def begins(one: Settings) -> None:
    known_sites.check(one)
    known_sites.note(one)


def test_sites_that_were_edited_by_hand_are_refused_and_a_granted_change_is_not(tmp_path: Path) -> None:
    before = {"r1": "", "r2": "", "r3": "", "r9": "hall"}
    begins(settings(tmp_path, before))
    begins(settings(tmp_path, before))
    edited = settings(tmp_path, {**before, "r3": "hall"})
    with pytest.raises(ConfigError, match=r"r3 would be at another site .* edited by hand"):
        known_sites.check(edited)
    with pytest.raises(ConfigError, match=r"r9 would be at another site .* edited by hand"):
        known_sites.check(settings(tmp_path, dict.fromkeys(before, "")))
    granted = settings(tmp_path, {**before, "r3": "hall"}, change=2)
    known_sites.note(granted)  # while the agent runs
    begins(granted)
    with pytest.raises(ConfigError, match="edited by hand"):
        known_sites.check(settings(tmp_path, before, change=2))


def test_the_first_site_is_no_matter_for_an_editor_either(tmp_path: Path) -> None:
    begins(settings(tmp_path, {"r1": "", "r2": ""}))
    with pytest.raises(ConfigError, match="raise change to 2"):
        known_sites.check(settings(tmp_path, {"r1": "", "r2": "hall"}))
    begins(settings(tmp_path, {"r1": "", "r2": "hall"}, change=2))


def test_a_robot_that_was_enrolled_by_hand_moves_nobody(tmp_path: Path) -> None:
    begins(settings(tmp_path, {"r1": "", "r2": ""}))
    begins(settings(tmp_path, {"r1": "", "r2": "", "r9": "hall"}))
    begins(settings(tmp_path, {"r1": "", "r2": "", "r3": "", "r9": "hall"}))
    with pytest.raises(ConfigError, match="r9 would be at another site"):
        known_sites.check(settings(tmp_path, {"r1": "", "r2": "", "r3": "", "r9": ""}))


def test_a_robot_of_another_team_has_that_teams_sites(tmp_path: Path) -> None:
    begins(settings(tmp_path, {"r1": "", "r2": "hall"}))
    other = settings(tmp_path, {"r1": "hall", "r2": ""})
    begins(replace(other, team=replace(other.team, team="dock")))


def test_sites_without_a_record_of_them_are_for_a_robot_that_has_not_decided_yet(tmp_path: Path) -> None:
    """At the first start with this release the file is not there, and the vote record is."""
    sited, plain = settings(tmp_path, {"r1": "", "r2": "hall"}), settings(tmp_path, {"r1": "", "r2": ""})
    known_sites.check(sited)
    (tmp_path / vote_record.FILE_NAME).write_text("")
    for torn in (None, "torn", "[]", '{"team": "lab", "change": 1, "sites": 3}'):
        if torn is not None:
            (tmp_path / known_sites.FILE_NAME).write_text(torn)
        with pytest.raises(ConfigError, match="this robot has decided before") as refused:
            known_sites.check(sited)
        known_sites.check(plain)
    (cure,) = re.findall(r"write ({.*}) into", str(refused.value))
    (tmp_path / known_sites.FILE_NAME).write_text(cure)
    begins(sited)


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


def test_frames_of_robots_that_know_other_sites_bring_their_heartbeat_and_no_item(tmp_path: Path) -> None:
    """A change in progress needs the heartbeats; `agent.worker.hub` finds out whether they may count."""
    one = settings(tmp_path, {"r1": "", "r2": "", "r3": "", "r9": "hall"}).team
    other = settings(tmp_path, {"r1": "", "r2": "", "r3": "hall"}).team
    none = settings(tmp_path, {"r1": "", "r2": "", "r3": ""}).team
    lane = FrameLane("r2", "lab", other.roster_of_site(""), 5, 10_000)
    key = b"k" * 32
    lane.speak("r1", key)
    receiver = Receiver("r1", "lab", one.roster_of_site(""))
    receiver.accept("r2", key)
    beat = Beat("r2", 5, 1)
    ((sealed,), _) = lane.seal(beat, (), 0)
    opened = receiver.open(sealed.datagrams[0])
    assert isinstance(opened, Part) and opened.beat == beat and not opened.alike
    assert none.roster_of_site("") == none.roster(), "as before there were sites"
    assert not sites_digest(none)
