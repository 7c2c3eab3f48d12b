"""A small run of `tests.failover.boards.torn` in the suite; FAILOVER_BOARD_OPERATIONS and FAILOVER_BOARD_KILLS make it long."""

from __future__ import annotations

import os
import random
from pathlib import Path

import pytest

from tests.failover.boards.torn import run

OPERATIONS = int(os.environ.get("FAILOVER_BOARD_OPERATIONS", "200000"))
KILLS = int(os.environ.get("FAILOVER_BOARD_KILLS", "20"))
SEED = int(os.environ.get("FAILOVER_SEED", str(random.randrange(1 << 32))))


def test_no_read_is_torn_whenever_the_writer_is_killed(place: Path) -> None:
    print(f"seed {SEED}")
    result = run(OPERATIONS, KILLS, 1024, SEED)
    print(result)
    assert result.wrong == 0
    assert result.kills >= KILLS and result.puts + result.gets >= OPERATIONS
    assert result.changes > 0
    assert not place.exists()


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="a put must run during a copy: two processors are needed")
def test_the_same_without_the_zeroing_is_torn(place: Path) -> None:
    """So the test above can fail. Values of 64 KiB: the longer a copy takes, the sooner a put falls into it."""
    result = run(1 << 40, 1 << 40, 65536, SEED, broken=True, until_wrong=True)
    print(result)
    assert result.torn > 0
