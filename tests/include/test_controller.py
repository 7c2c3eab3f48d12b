"""examples/controller.c, killed again and again: the plant that it controls does not notice."""

from __future__ import annotations

import os
import random
import subprocess
import time
from pathlib import Path

import pytest

from tests.include.programs import STRICT, environment, output, program

pytestmark = pytest.mark.compiler

STEPS = 3000
KILLS = 8
SEED = int(os.environ.get("FAILOVER_SEED", str(random.randrange(1 << 32))))


def controller() -> Path:
    return program("controller", "examples/controller.c", flags=("-O2", *STRICT))


def killed_after(seconds: float, state: Path) -> list[str]:
    """What a run prints until it is killed."""
    started = subprocess.Popen(
        [controller(), "1", str(STEPS)],
        env=environment(state),
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert started.stdout is not None
    first = started.stdout.readline()
    time.sleep(seconds)
    started.kill()
    lines = (first + started.communicate()[0]).splitlines(keepends=True)
    return [line.rstrip("\n") for line in lines if line.endswith("\n")]


def test_a_controller_that_is_killed_goes_on_and_its_output_is_continuous(tmp_path: Path) -> None:
    """Steps after the last commit are made again, to the same numbers; no step is missing, none differs."""
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    alone, killed = tmp_path / "alone", tmp_path / "killed"
    alone.mkdir()
    killed.mkdir()
    expected = output(controller(), alone, "0", str(STEPS)).splitlines()
    assert len(expected) == STEPS
    reached, begun = 0, []
    for _ in range(KILLS):
        lines = killed_after(dice.random() * 0.25, killed)
        first = int(lines[0].split()[0])
        assert first <= reached + 1, f"steps {reached + 1} to {first - 1} were never made, seed {SEED}"
        assert lines == expected[first - 1 : first - 1 + len(lines)]
        reached = max(reached, first - 1 + len(lines))
        begun.append(first)
    lines = output(controller(), killed, "0", str(STEPS)).splitlines()
    assert lines[0].startswith("going on at step ") or lines[-1].startswith("going on at step ")
    rest = [line for line in lines if not line.startswith("going on")]
    assert int(rest[0].split()[0]) <= reached + 1 and rest == expected[-len(rest) :]
    assert begun[-1] > 1, "it never went on"
