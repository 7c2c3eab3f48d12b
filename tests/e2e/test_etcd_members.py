"""Two robots and an etcd of three members: one is lost, two are lost, the leader stands still, one does not reach the others."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.agent.coordinator.etcd_server import why_not
from tests.e2e import etcd_site, robots
from tests.e2e.apart import ACTS, acts_in, overlaps
from tests.e2e.etcd_site import Site, counts_on, epoch, reaches, role, started, state, until_told

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.timeout(600),
    pytest.mark.skipif(not robots.has_cable(), reason="needs network namespaces: members must be cut off from each other"),
    pytest.mark.skipif(bool(why_not()), reason=why_not() or "etcd is here"),
]

RUNNING = ("running", "degraded")


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with etcd_site.site(tmp_path, 3) as made:
        yield made


def lead_from_elsewhere(site: Site, member: int) -> None:
    """Have a member lead that is not this one."""
    other = next(number for number in range(len(site.members)) if number != member)
    if site.leader() == member:
        target = site.asked("maintenance/status", {}, other)["header"]["member_id"]
        site.asked("maintenance/transfer-leadership", {"targetID": target}, member)
        robots.until(lambda: site.leader() != member, "another member to lead")


def act_together(site: Site, record: Path) -> None:
    """The program acts in a file that both robots share, and only etcd decides who runs it."""
    started(site, ("/usr/bin/python3", "-S", "-c", ACTS, str(record)))
    site.pull_cable(site.first)
    until_told(site.second, "hears 0 of 1 other members and reaches etcd")
    until_told(site.first, "hears 0 of 1 other members and reaches etcd; 2 of 3 votes decide")


def acts_more(record: Path) -> None:
    before = len(acts_in(record))
    robots.until(lambda: len(acts_in(record)) > before + 5, "the program to act on")


def revision_at(site: Site, member: int) -> int:
    """How many writes a member knows of, without asking the others."""
    told = site.asked("kv/range", {"key": "AA==", "range_end": "AA==", "serializable": True}, member)
    return int(told["header"]["revision"])


@pytest.mark.sampled(2)
@pytest.mark.parametrize("is_killed", [True, False], ids=["killed", "standing still"])
def test_robots_keep_their_leases_while_the_member_that_they_ask_is_lost(site: Site, tmp_path: Path, is_killed: bool) -> None:
    record = tmp_path / "acts"
    act_together(site, record)
    before, lost = epoch(site.first), site.spoken_with(site.first)
    lead_from_elsewhere(site, lost)
    site.members[lost].kill() if is_killed else site.members[lost].stop()
    robots.until(lambda: site.spoken_with(site.first) != lost, "it to ask another member")
    for _ in range(10):
        acts_more(record)
        assert (state(site.first) in RUNNING, role(site.first), role(site.second)) == (True, "primary", "standby")
    assert epoch(site.first) == before
    assert reaches(site.first) and reaches(site.second)

    site.first.cut_power()
    robots.until_taken_over(site.second)
    acts_more(record)
    assert overlaps(acts_in(record)) == 0


def test_without_a_majority_of_etcd_programs_run_on_and_nobody_is_taken_over(site: Site) -> None:
    started(site)
    before = epoch(site.first)
    for member in site.members[:2]:
        member.kill()
    for robot in (site.first, site.second):
        until_told(robot, "does not reach etcd", "nobody is taken over", "no etcd answers")
    for _ in range(3):
        counts_on(site.first)
    assert (role(site.first), role(site.second), epoch(site.first)) == ("primary", "standby", before)

    for member in site.members[:2]:
        member.start()
    robots.until(lambda: site.first.status()["healthy"] and site.second.status()["healthy"], "etcd to be reached again")
    robots.until_protected(site.first)
    robots.counts_on_elsewhere(site.first, site.second, 10)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("is_claiming", [False, True], ids=["before the votes", "between the votes"])
def test_etcds_leader_stands_still_and_another_member_decides(site: Site, tmp_path: Path, is_claiming: bool) -> None:
    record = tmp_path / "acts"
    act_together(site, record)
    before, leader = epoch(site.first), site.leader()
    site.reach(site.first, is_on=False)  # it acts until its lease ends
    if is_claiming:
        robots.until(lambda: state(site.first) == "frozen" or state(site.second) != "standby", "it to be given up")
    site.members[leader].stop()
    robots.until_taken_over(site.second)
    acts_more(record)
    site.members[leader].go_on()
    site.reach(site.first, is_on=True)
    robots.until(lambda: role(site.first) == "standby", "the first robot to follow the seat")
    for _ in range(5):
        acts_more(record)
        assert (role(site.first), role(site.second)) == ("standby", "primary")
    assert epoch(site.second) > before
    assert overlaps(acts_in(record)) == 0


def test_a_member_that_does_not_reach_the_two_others_decides_nothing(site: Site, tmp_path: Path) -> None:
    record = tmp_path / "acts"
    act_together(site, record)
    asked, before = site.spoken_with(site.second), epoch(site.first)
    site.part(asked, is_on=True)
    robots.until(lambda: site.spoken_with(site.second) != asked, "the standby to ask another member")
    acts_more(record)
    site.first.cut_power()
    robots.until_taken_over(site.second)
    assert epoch(site.second) > before
    acts_more(record)
    behind, ahead = (revision_at(site, member) for member in (asked, site.spoken_with(site.second)))
    assert behind < ahead, "it knows nothing of the vote"
    site.part(asked, is_on=False)
    robots.until(lambda: revision_at(site, asked) > ahead, "it to learn of the vote")
    assert (role(site.second), overlaps(acts_in(record))) == ("primary", 0)
