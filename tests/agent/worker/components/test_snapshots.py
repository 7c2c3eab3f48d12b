"""The state of a copy that lost its primacy is kept aside, though the first attempt to capture it fails."""

from __future__ import annotations

import asyncio
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from agent.worker.components.component import Captured, Component
from agent.worker.components.context import Surroundings
from agent.worker.components.snapshots import Snapshots
from agent.worker.components.statistics import Figures
from checkpoint.errors import CaptureError
from checkpoint.keeper.messages import memfd_holding
from checkpoint.model import Position
from failover.core import acts

NAME = "/lab/robot1/mapper"
STATE = b"all that it had become"
LOST = acts.KeepAside(NAME, 3, "robot2 holds epoch 4, this copy had epoch 3")


class Frozen:
    """Stands for a component whose program does not run for so many captures; each freeze lets it be looked into."""

    def __init__(self, failures: int) -> None:
        self.failures, self.freezes, self.captures = failures, 0, 0

    async def freeze(self, *, exposed: bool) -> None:
        assert exposed
        self.freezes += 1

    async def capture(self, *, base: bool, hold: bool, **_: object) -> Captured:
        assert base and hold
        self.captures += 1
        if self.captures <= self.failures:
            raise CaptureError("pid 4711 did not run for 1 s while failover examined it")
        taken = dict.fromkeys(Captured.__struct_fields__, 0) | {"position": Position(3, 9, b""), "parent": None}
        return Captured(**cast(Any, taken | {"snapshot": memfd_holding(STATE, "state")}))


def kept_aside(program: Frozen, directory: Path) -> bytes:
    """The state that lies in the robot's state directory afterwards."""
    around = cast(Surroundings, SimpleNamespace(places=SimpleNamespace(logs=directory / "logs")))
    snapshots = Snapshots(NAME, around, Figures())
    return asyncio.run(snapshots.keep_aside(cast(Component, program), LOST)).read_bytes()


@pytest.mark.parametrize("failures", [0, 1])
def test_a_copy_that_lost_is_captured_again_where_its_program_did_not_run(failures: int, tmp_path: Path) -> None:
    program = Frozen(failures)
    assert kept_aside(program, tmp_path) == STATE
    assert program.captures == program.freezes == failures + 1


def test_a_copy_that_cannot_be_captured_twice_is_not_kept_and_says_why(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="did not run for 1 s"):
        kept_aside(Frozen(2), tmp_path)
    assert not (tmp_path / "lost").exists()
