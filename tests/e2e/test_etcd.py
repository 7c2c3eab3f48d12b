"""Two robots with ``rule = "etcd"`` and a real etcd: the primary is lost, etcd is gone, the primary does not reach etcd."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.agent.coordinator.etcd_server import why_not
from tests.e2e import etcd_site, robots
from tests.e2e.etcd_site import Site, counts_on, epoch, reaches, role, speakers, started, state, until_told

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(not robots.has_cable(), reason="needs network namespaces: a robot must be cut off from etcd alone"),
    pytest.mark.skipif(bool(why_not()), reason=why_not() or "etcd is here"),
]

LEAPS_S = 8
"""Longer than a takeover takes where nothing hinders it."""


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    with etcd_site.site(tmp_path) as made:
        yield made


def test_a_primary_that_is_lost_is_replaced_with_etcds_vote(site: Site) -> None:
    started(site)
    before = epoch(site.first)
    robots.counts_on_elsewhere(site.first, site.second, 10)
    assert epoch(site.second) > before
    assert "reaches etcd; 2 of 3 votes decide" in site.second.status()["promise"]


def test_while_etcd_is_gone_programs_run_on_and_nobody_is_taken_over(site: Site) -> None:
    started(site)
    before = epoch(site.first)
    site.etcd.kill()
    until_told(site.first, "does not reach etcd", "nobody is taken over", "no etcd answers")
    assert robots.failover(site.first, "status").returncode == 1
    assert "no etcd answers" in robots.failover(site.first, "check").stdout
    for _ in range(3):
        counts_on(site.first)
    assert (role(site.first), role(site.second)) == ("primary", "standby")
    assert epoch(site.first) == before

    site.first.cut_power()
    until_told(site.second, "stand still until it hears more")
    assert role(site.second) == "standby", "a robot alone cannot know that the other one is lost"
    site.etcd.start()
    robots.until_taken_over(site.second)


def test_a_primary_that_does_not_reach_etcd_runs_on_as_long_as_it_hears_its_neighbour(site: Site) -> None:
    started(site)
    before = epoch(site.first)
    site.reach(site.first, is_on=False)
    until_told(site.first, "does not reach etcd")
    counts_on(site.first)
    assert (role(site.first), role(site.second)) == ("primary", "standby")
    assert epoch(site.first) == before

    site.pull_cable(site.first)
    robots.until(lambda: state(site.first) == "frozen", "it to stand still: its standby may reach etcd")
    robots.until_taken_over(site.second)
    site.reach(site.first, is_on=True)
    site.lay_cable(site.first)
    robots.until(lambda: role(site.first) == "standby", "it to follow the one that etcd voted for")
    robots.until_protected(site.second)


def test_a_lease_clock_of_etcd_that_leaps_moves_nothing(site: Site) -> None:
    """etcd ends every lease too soon, as after a leap of its clock, again and again for longer than a takeover takes."""
    started(site)
    before = epoch(site.first)
    site.pull_cable(site.first)
    until_told(site.second, "hears 0 of 1 other members and reaches etcd")
    until_s = time.monotonic() + LEAPS_S
    while time.monotonic() < until_s:
        for lease in site.asked("lease/leases", {}).get("leases", ()):
            site.asked("lease/revoke", {"ID": lease["ID"]})
        assert role(site.second) == "standby"
    counts_on(site.first)
    assert (role(site.first), epoch(site.first)) == ("primary", before)


def test_another_process_takes_the_place_of_one_that_speaks_with_etcd_and_ends(site: Site) -> None:
    (ended,) = speakers(site.first)
    os.kill(ended, signal.SIGKILL)
    told = "the process that speaks with etcd has ended"
    robots.until(lambda: told in " ".join(site.first.status()["notes"]), "the status to tell of it")
    robots.until(lambda: speakers(site.first) not in ([], [ended]), "another one")
    robots.until(lambda: reaches(site.first) and not site.first.status()["notes"], "etcd to be reached again")
    site.first.cut_power()
    robots.until(lambda: not site.first.processes(), "nothing of the robot to be left")


def test_a_primary_that_hears_no_neighbour_runs_on_with_etcds_vote(site: Site) -> None:
    started(site)
    before = epoch(site.first)
    site.pull_cable(site.first)
    until_told(site.first, "hears 0 of 1 other members and reaches etcd; 2 of 3 votes decide")
    counts_on(site.first)
    assert (role(site.first), role(site.second)) == ("primary", "standby")

    site.etcd.stop()
    robots.until(lambda: state(site.first) == "frozen", "it to stand still while etcd hangs")
    site.etcd.go_on()
    robots.until(lambda: state(site.first) in ("running", "degraded"), "it to go on: its epoch still stands")
    assert epoch(site.first) == before
    counts_on(site.first)
