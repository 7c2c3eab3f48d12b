"""Five robots, a server, a witness under real faults: nothing acts twice, nothing acknowledged is lost, everything resumes.

Each fault is real: signals to processes, cables and ways of the network that are cut, disks that are full or new (`tests.chaos`).
Here half of the kinds of fault occur once; FAILOVER_FAULTS=200 makes as many, FAILOVER_SEED chooses which, at which member,
and for how long.
"""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Final

import pytest

from tests.chaos.faults import KINDS
from tests.e2e import robots

FAULTS: Final = int(os.environ.get("FAILOVER_FAULTS", str(len(KINDS) // 2)))
SEED: Final = os.environ.get("FAILOVER_SEED") or str(random.randrange(1 << 32))
ROOT: Final = Path(__file__).parents[2]


@pytest.mark.root
@pytest.mark.slow
@pytest.mark.command("tc")
@pytest.mark.skipif(not robots.has_cable(), reason="needs network namespaces: cables must be laid and pulled")
@pytest.mark.timeout(600 + 90 * FAULTS)
def test_whatever_fails_no_two_copies_act_and_nothing_acknowledged_is_lost_and_everything_goes_on(tmp_path: Path) -> None:
    evidence = Path(os.environ.get("FAILOVER_EVIDENCE", tmp_path / "chaos"))
    command = [sys.executable, "-m", "tests.chaos", "--faults", str(FAULTS), "--seed", SEED, "--directory", str(evidence)]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == 0, f"see above, and {evidence}"
    shutil.rmtree(evidence, ignore_errors=True)
