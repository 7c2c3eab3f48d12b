"""Two robots of two releases: each has a root file system, a C library and programs of its own, and runs the other's.

Runs if FAILOVER_OTHER_ROOT names the root of another release than this machine's, with the packages that our Python needs:
``debootstrap --include=perl,python3,libffi8,libssl3t64 trixie DIRECTORY`` makes one. Nothing in it is changed: robot2 has it
below an overlay.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from failover.cli.demo.robots import RobotMachine, Stage
from tests.e2e import robots
from tests.e2e.test_brought_programs import CPYTHON, contents_of, goes_on

OTHER_ROOT = os.environ.get("FAILOVER_OTHER_ROOT", "")

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(not OTHER_ROOT, reason="needs FAILOVER_OTHER_ROOT: debootstrap makes one"),
]

CHECKOUT = Path(__file__).resolve().parents[2]

LAY = r"""
set -e
root=$1; shift
mount -t tmpfs tmpfs "$WORK"; mkdir "$WORK/up" "$WORK/work" "$WORK/root"
mount -t overlay overlay -o "lowerdir=$root,upperdir=$WORK/up,workdir=$WORK/work" "$WORK/root"
cd "$WORK/root"
mount -t proc proc proc; mount --rbind /sys sys; mount --rbind /dev dev; mount -t tmpfs tmpfs run
for place in $PLACES; do mkdir -p ".$place"; mount --rbind "$place" ".$place"; done
mkdir -p run/old; pivot_root . run/old; cd /; umount -l /run/old
exec "$@"
"""

PERL = '$| = 1; for ($i = 0;; $i++) { print "$i\\n"; select(undef, undef, undef, 0.01) }'

BC = 'i = 0\nwhile (i < 1000000) { print i, "\\n"; i = i + 1; for (j = 0; j < 2000; j++) { k = j * j } }\n'

Pair = tuple[RobotMachine, RobotMachine]


class TwoReleases(Stage):
    """robot2 has another root; of this machine it sees our checkout, the Python of the tests, and the stage."""

    def command(self, name: str, config: Path) -> list[str]:
        """See `Stage.command`."""
        host = super().command(name, config)
        if name == "robot1":
            return host
        work = self.directory.parent / "work"
        work.mkdir()
        places = sorted({str(CHECKOUT), sys.prefix, sys.base_prefix, str(self.directory)})
        lay = ["env", f"WORK={work}", f"PLACES={' '.join(places)}", "bash", "-c", LAY, "lay", OTHER_ROOT]
        return ["unshare", "--mount", "--propagation", "private", *lay, *host]


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    with TwoReleases(tmp_path / "stage", robots.means()) as stage:
        stage.directory.mkdir()
        stage.start()
        first, second = stage.robots
        try:
            robots.until(lambda: robots.connected(first) and robots.connected(second), "the robots to hear each other")
            yield first, second
            assert not robots.mistake(first)
            assert not robots.mistake(second)
        finally:
            for robot in stage.robots:
                print(
                    f"--- {robot.name} said:", *robot.log.read_text(errors="replace").splitlines()[-robots.LOG_LINES :], sep="\n"
                )


def test_cpython_goes_on_at_a_robot_of_another_release_that_has_no_such_interpreter(pair: Pair) -> None:
    first, second = pair
    robots.run(first, "count", "/usr/bin/python3", "-S", "-c", CPYTHON)
    robots.until_protected(first)
    assert contents_of(second)
    goes_on(second, first.cut_power)


def test_bc_goes_to_the_other_release_and_back_to_its_own_files(pair: Pair, tmp_path: Path) -> None:
    if not shutil.which("bc"):
        pytest.skip("needs bc")
    first, second = pair
    program = first.directory.parent / "count.bc"
    program.write_text(BC)
    robots.run(first, "count", "/usr/bin/stdbuf", "-oL", "/usr/bin/bc", "-q", str(program))
    robots.until_protected(first)
    goes_on(second, lambda: robots.failover(first, "handover", "count", "--to", second.name))
    robots.until_protected(second)
    goes_on(first, lambda: robots.failover(second, "failback", "count"))
    running = robots.host_pid(first, robots.component(first, "count")["pid"])
    assert os.readlink(f"/proc/{running}/exe") == os.path.realpath("/usr/bin/bc")


def test_a_program_of_the_other_release_goes_on_here(pair: Pair) -> None:
    """It was linked against a C library that this machine has not."""
    first, second = pair
    robots.run(second, "count", "/usr/bin/perl", "-e", PERL)
    robots.until_protected(second)
    assert contents_of(first)
    goes_on(first, second.cut_power)
