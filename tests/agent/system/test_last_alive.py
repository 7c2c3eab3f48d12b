"""How long a robot was off, from the sign that its agent's earlier life left on the disk."""

from __future__ import annotations

import os
import time
from pathlib import Path

from agent.system.last_alive import SIGN_S, LastAlive

S = 10**9
AGES = 60 * S
"""Of a checkpoint from before the power cut."""


def after_a_cut(path: Path, off_s: float) -> LastAlive:
    """A life that begins after an earlier one gave its last sign so long ago."""
    LastAlive.found(path).sign()
    sign_ns = time.time_ns() - int(off_s * S)
    os.utime(path, ns=(sign_ns, sign_ns))
    return LastAlive.found(path)


def test_what_the_program_did_until_the_last_sign_is_lost_and_no_more(tmp_path: Path) -> None:
    alive = after_a_cut(tmp_path / "sign", 40.0)
    lost_ns = AGES - alive.off_ns(AGES)
    assert lost_ns <= (20 + SIGN_S) * S
    assert lost_ns > 15 * S, "the earlier life may have worked until its last sign"


def test_a_checkpoint_of_this_life_knows_no_time_off(tmp_path: Path) -> None:
    alive = after_a_cut(tmp_path / "sign", 40.0)
    assert alive.off_ns(0) == 0


def test_a_checkpoint_that_is_younger_than_the_last_sign_has_lost_nothing_but_its_age(tmp_path: Path) -> None:
    alive = after_a_cut(tmp_path / "sign", 40.0)
    assert alive.off_ns(10 * S) <= 10 * S


def test_without_a_sign_nothing_is_known(tmp_path: Path) -> None:
    assert LastAlive.found(tmp_path / "sign").off_ns(AGES) == 0


def test_a_sign_is_given_wherever_the_disk_takes_it(tmp_path: Path) -> None:
    LastAlive.found(tmp_path / "gone" / "sign").sign()  # and no error where it does not
    path = tmp_path / "sign"
    before_ns = time.time_ns() - S
    LastAlive.found(path).sign()
    assert LastAlive.found(path).before_ns >= before_ns
