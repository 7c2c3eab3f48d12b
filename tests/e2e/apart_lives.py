"""``python -m tests.e2e.apart_lives --lives 50``: robots that share only etcd and an archive, and what may happen to them.

Needs root, etcd, and the servers of S3 for tests. In each life something befalls the robot that runs the program: its power is
cut, it is cut off from etcd, or from etcd and the archive at once; or the archive, or etcd, is out of reach of both. The program
resumes at the other robot from a copy in the archive, or runs on where nothing is to be replaced. It ends with the times of the
takeovers and how often a copy acted after another one had; that must be 0.
"""

from __future__ import annotations

import argparse
import random
import statistics
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Final

from failover.cli.demo.robots import RobotMachine
from tests.e2e import apart, robots
from tests.e2e.apart import ETCD, NAME, STORE, Act, Site

KINDS: Final = ("power", "etcd", "both", "store", "etcd gone")
PATIENCE_S: Final = 180.0
GONE_S: Final = 6.0
"""How long etcd, or the archive, is out of reach where nobody is to be replaced: longer than a takeover takes."""


class Lives:
    """What was seen so far."""

    def __init__(self, site: Site, dice: random.Random) -> None:
        self._site, self._dice = site, dice
        self._runs = site.robots["robot1"].name
        self.kinds: Counter[str] = Counter()
        self.takeovers_s: list[float] = []
        self.lost: list[int] = []

    @property
    def _robot(self) -> RobotMachine:
        return self._site.robots[self._runs]

    @property
    def _other(self) -> RobotMachine:
        return self._site.other(self._robot)

    def begin(self) -> None:
        """Have the program run, and a copy of it at the other robot."""
        apart.start_program(self._site, self._robot)
        self._settle()

    def one(self) -> str:
        """One life, and what came of it."""
        kind = self._dice.choice(KINDS)
        time.sleep(self._dice.uniform(0, 2 * apart.EVERY_S))
        self.kinds[kind] += 1
        if kind == "store":
            return self._store_is_gone()
        if kind == "etcd gone":
            return self._etcd_is_gone()
        return self._replaced(kind)

    def _replaced(self, kind: str) -> str:
        robot, other, site = self._robot, self._other, self._site
        before = len(site.acts())
        if kind == "power":
            robot.cut_power()
        else:
            for host in (ETCD,) if kind == "etcd" else (ETCD, STORE):
                site.reach(robot, host, is_on=False)
        robots.until(lambda: apart.role(other) == "primary", f"{other.name} to take over", PATIENCE_S)
        last = {act.life for act in site.acts()[:before]}

        def fresh() -> list[Act]:
            """Its acts; what the first one says of its instant may be from before the copy was made."""
            found = [act for act in site.acts()[before:] if act.life not in last]
            return found if len(found) > 1 else []

        new = robots.until(fresh, "its first acts", PATIENCE_S)
        old = next(act for act in reversed(site.acts()) if act.life != new[0].life)
        took_s, lost = (new[1].at_ns - old.at_ns) / 1e9, old.number + 1 - new[0].number
        assert new[0].number > 0, f"{other.name} began anew, although the archive had a copy"
        assert took_s > 0, f"{other.name} acted {-took_s:.1f} s before the last act of {robot.name}"
        self.takeovers_s.append(took_s)
        self.lost.append(lost)
        if kind == "power":
            site.boot(robot.name)
        else:
            for host in (ETCD, STORE):
                site.reach(robot, host, is_on=True)
        self._runs = other.name
        self._settle()
        return f"{kind}: {other.name} acts {took_s:.1f} s after the last act of {robot.name}, {lost} steps are done again"

    def _store_is_gone(self) -> str:
        """Nothing moves, and the status says that the archive does not answer."""
        self._both(STORE, is_on=False)
        robots.until(
            lambda: any("archive" in note for note in self._other.status()["notes"]), "the status to tell of it", PATIENCE_S
        )
        apart.acts_more(self._site, PATIENCE_S)
        self._both(STORE, is_on=True)
        self._settle()
        return f"store: {self._robot.name} ran on"

    def _etcd_is_gone(self) -> str:
        """Robots that never hear each other stand still; the one that ran goes on, and no other one takes over."""
        self._both(ETCD, is_on=False)
        robots.until(lambda: robots.component(self._robot, NAME).get("state") == "frozen", "it to stand still", PATIENCE_S)
        time.sleep(self._dice.uniform(0, GONE_S))
        self._both(ETCD, is_on=True)
        holds = robots.until(
            lambda: [one for one in self._site.robots.values() if robots.component(one, NAME).get("state") == "running"],
            "one of them to run it",
            PATIENCE_S,
        )
        self._runs = holds[0].name
        self._settle()
        return f"etcd gone: {self._runs} went on"

    def _both(self, host: str, *, is_on: bool) -> None:
        for robot in self._site.robots.values():
            self._site.reach(robot, host, is_on=is_on)

    def _settle(self) -> None:
        """Until the one acts and the other holds a copy of its present epoch."""
        apart.acts_more(self._site, PATIENCE_S)

        def is_settled() -> bool:
            epoch = robots.component(self._robot, NAME).get("epoch")
            return apart.role(self._other) == "standby" and apart.held_epoch(self._other) == epoch

        robots.until(is_settled, f"{self._other.name} to hold a copy of what {self._runs} runs", PATIENCE_S)


def main() -> int:
    """Live; 1 if a promise was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.e2e.apart_lives", description=__doc__)
    parser.add_argument("--lives", type=int, default=10, help="how many")
    parser.add_argument("--seed", default=str(random.randrange(1 << 32)), help="of the dice")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="apart-") as directory, apart.site(Path(directory)) as site:
        lives = Lives(site, random.Random(arguments.seed))
        print(f"seed {arguments.seed}: {arguments.lives} lives; a copy each {apart.EVERY_S} s, lease {apart.PACE.lease_ms} ms")
        lives.begin()
        try:
            for number in range(1, arguments.lives + 1):
                print(f"{number}: {lives.one()}; overlaps {apart.overlaps(site.acts())}", flush=True)
        except KeyboardInterrupt:
            print("called off; until then:")
        overlaps = apart.overlaps(site.acts())
        print(f"lives: {dict(lives.kinds)}; acts {len(site.acts())}; overlaps {overlaps}")
        if lives.takeovers_s:
            middle, worst = statistics.median(lives.takeovers_s), max(lives.takeovers_s)
            print(f"takeovers {len(lives.takeovers_s)}: p50 {middle:.1f} s, worst {worst:.1f} s")
            print(f"steps done again: p50 {statistics.median(lives.lost):.0f}, worst {max(lives.lost)}, of 50 a second")
    return 1 if overlaps else 0


if __name__ == "__main__":
    sys.exit(main())
