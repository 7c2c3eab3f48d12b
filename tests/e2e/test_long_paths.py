"""A runtime directory whose path is longer than a socket's address can be."""

from __future__ import annotations

from pathlib import Path

from checkpoint.linux.unix_address import PATH_SIZE_MAX
from tests.e2e import robots


def test_everything_works_below_a_path_that_no_socket_address_holds(tmp_path: Path) -> None:
    place = tmp_path / ("d" * PATH_SIZE_MAX) / ("e" * PATH_SIZE_MAX)
    place.mkdir(parents=True)
    with robots.two_robots(place) as (first, second):
        assert len(str(first.socket)) > 2 * PATH_SIZE_MAX
        robots.run(first, "sleeper", "/bin/sleep", "1000000")
        robots.until(lambda: robots.component(first, "sleeper").get("protection") == "protected", "a checkpoint at robot2")
        first.cut_power()
        robots.until(lambda: robots.component(second, "sleeper").get("state") == "running", "robot2 to take over")
        assert robots.failover(second, "stop", "sleeper").returncode == 0
