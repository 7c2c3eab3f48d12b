"""The examples, killed again and again and started again: their output has no gap, and they end as without kills."""

from __future__ import annotations

import os
import random
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from checkpoint.engines.cooperative.session import regions_of
from failover.kept_state.file_store import StateFile, folder_of

EXAMPLES = Path(__file__).parents[2] / "examples"
KILLS = int(os.environ.get("FAILOVER_EXAMPLE_KILLS", "4"))
SEED = int(os.environ.get("FAILOVER_SEED", str(random.randrange(1 << 32))))
LIMIT_S = 60
HALF_WRITTEN = re.compile(r".* had not arrived whole and was removed\n")
"""What the store says after a kill in the middle of a write."""

PROGRAMS = [("ekf", ("150",)), ("mission", ()), ("driver", ("150",))]


class Life:
    """The example, in a process of its own, from its start to its death; its state lies in the folder."""

    def __init__(self, folder: Path, name: str, arguments: tuple[str, ...]) -> None:
        environment = {key: value for key, value in os.environ.items() if not key.startswith("FAILOVER_")}
        command = [sys.executable, EXAMPLES / f"{name}.py", *arguments]
        self._folder = folder
        self._printed, self._said = folder / "printed", folder / "said"
        with open(self._printed, "w") as printed, open(self._said, "w") as said:
            self._process = subprocess.Popen(command, cwd=folder, env=environment, stdout=printed, stderr=said)

    def kill_after_first_line(self, delay_s: float) -> None:
        """At an instant between two steps, in one, or in a commit."""
        deadline = time.monotonic() + LIMIT_S
        while not self._printed.stat().st_size and self._process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.005)
        time.sleep(delay_s)  # not a wait for anything: the instant of the kill
        self.kill()

    def wait_until_kept(self) -> None:
        """A busy machine prints a line long before its thread has written anything."""
        deadline = time.monotonic() + LIMIT_S
        while not any(self._folder.glob("*.state/@*/*.base")):
            assert self._process.poll() is None and time.monotonic() < deadline, self._said.read_text()
            time.sleep(0.005)

    def kill(self) -> None:
        """Whether or not it still runs."""
        self._process.kill()
        self._process.wait()

    def end(self) -> None:
        """Let it come to its end."""
        try:
            assert self._process.wait(LIMIT_S) == 0, self._said.read_text()
        finally:
            self.kill()

    def told(self) -> tuple[int, list[str]]:
        """After which step it went on (0: it began), and every whole line that it printed."""
        said = HALF_WRITTEN.sub("", self._said.read_text())
        found = re.fullmatch(r"goes on after \w+ (\d+), [\d.]+ s old\n", said)
        assert found or not said, said
        lines = self._printed.read_text().splitlines(keepends=True)
        return int(found[1]) if found else 0, [line.rstrip("\n") for line in lines if line.endswith("\n")]


def number_of(line: str) -> int:
    return int(line.split()[0])


def state_in(folder: Path, name: str) -> dict[str, bytes]:
    """What is stored, byte for byte."""
    file = StateFile(folder_of(name, folder), name)
    snapshot = file.load()
    file.close()
    assert snapshot is not None
    return {region.name: bytes(content) for region, content in regions_of(snapshot)}


@pytest.mark.parametrize(("name", "arguments"), PROGRAMS, ids=[name for name, _ in PROGRAMS])
def test_an_example_that_is_killed_goes_on_and_ends_as_one_that_is_not(
    name: str, arguments: tuple[str, ...], tmp_path: Path
) -> None:
    dice = random.Random(SEED)
    print(f"FAILOVER_SEED={SEED}")
    quiet, killed = tmp_path / "quiet", tmp_path / "killed"
    quiet.mkdir()
    killed.mkdir()
    undisturbed, lives = Life(quiet, name, arguments), []
    try:
        for number in range(KILLS):
            life = Life(killed, name, arguments)
            if number == 0:
                life.wait_until_kept()
            life.kill_after_first_line(dice.random() * 0.3)
            lives.append(life.told())
        life = Life(killed, name, arguments)
        life.end()
        lives.append(life.told())
        undisturbed.end()
    finally:
        undisturbed.kill()
    _, expected = undisturbed.told()
    assert [number_of(line) for line in expected] == list(range(1, len(expected) + 1))

    printed, before = 0, 0
    for resumed_after, lines in lives:
        assert before <= resumed_after <= printed, (
            f"it goes on from a commit: not an older one, and no step is left out; seed {SEED}"
        )
        assert lines == expected[resumed_after : resumed_after + len(lines)], f"the same lines, from there on; seed {SEED}"
        before, printed = resumed_after, max(printed, resumed_after + len(lines))
    assert printed == len(expected)
    assert lives[-1][0] > 0, "it was resumed at least once, or this test shows nothing"
    assert state_in(killed, name) == state_in(quiet, name)
