"""Robots that share only etcd and an archive: one dies, the other resumes its program; the one that comes back stands by."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.agent.coordinator.etcd_server import why_not
from tests.e2e import apart, robots
from tests.e2e.apart import NAME

pytest.importorskip("cryptography")
pytest.importorskip("obstore")

pytestmark = [
    pytest.mark.root,
    pytest.mark.slow,
    pytest.mark.timeout(900),
    pytest.mark.skipif(not robots.has_cable(), reason="needs network namespaces"),
    pytest.mark.skipif(bool(why_not()), reason=why_not() or "etcd is here"),
]


def test_a_robot_resumes_from_the_archive_what_one_ran_that_it_never_hears(tmp_path: Path) -> None:
    with apart.site(tmp_path) as site:
        first, second = site.robots["robot1"], site.robots["robot2"]
        apart.start_program(site, first)
        robots.until(lambda: apart.is_held(second), "a copy of the archive at the other robot")
        robots.until_protected(first)
        notes = " ".join(robots.component(second, NAME)["notes"])
        assert "its checkpoint here came from the archive" in notes, notes
        assert all(peer["state"] != "live" for peer in first.status()["peers"] + second.status()["peers"])
        had = robots.component(second, NAME)["sequence"]
        robots.until(lambda: apart.is_held(second, had), "a later copy")
        epoch = robots.component(first, NAME)["epoch"]

        first.cut_power()
        before = site.acts()
        robots.until_taken_over(second, NAME)
        after = apart.acts_more(site)[len(before) :]
        assert robots.component(second, NAME)["epoch"] > epoch
        assert 0 < after[0].number <= before[-1].number, "it goes on from a copy, not from its beginning"
        counted = [act.number for act in after]
        assert counted == list(range(counted[0], counted[0] + len(counted))), "each number once, in order"

        first = site.boot("robot1")
        robots.until(lambda: apart.role(first) == "standby", "the robot that is back to follow")
        epoch = robots.component(second, NAME)["epoch"]
        robots.until(lambda: apart.held_epoch(first) == epoch, "a copy of the other's epoch at the robot that is back")
        second.cut_power()
        robots.until_taken_over(first, NAME)
        acts = apart.acts_more(site)
        assert apart.overlaps(acts) == 0
        assert acts[-1].number > after[0].number
