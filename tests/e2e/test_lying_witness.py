"""A witness whose key was stolen: its sender is changed. It lies for some seconds, and the robots' programs run on."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from failover.cli.demo.robots import RobotMachine
from failover.config.team import Role
from tests.e2e import robots, teams
from tests.e2e.test_orders import COUNTING

ROLES: dict[str, Role] = {"robot1": "robot", "robot2": "robot", "gate": "witness"}
BEATS = 150
"""That were refused: three seconds of them."""

LIAR = """
import os

from msgspec.structs import replace

from failover.core import beat_builder as speaker

honest = speaker.Speaker.beat
CHANGES = {
    "finished": lambda me, entry: replace(entry, state=10, epoch=entry.epoch + 1),
    "ended here": lambda me, entry: replace(entry, state=10, epoch=entry.epoch + 1, primary=me),
    "epoch": lambda me, entry: replace(entry, epoch=(1 << 40) - 1),
    "runs": lambda me, entry: replace(entry, state=3, epoch=entry.epoch + 1, primary=me),
    "keeps": lambda me, entry: replace(entry, generation=entry.epoch * 64, sequence=1 << 40, digest=b"forged"),
}


def beat(self, *said_of, **more):
    said = honest(self, *said_of, **more)
    try:
        with open(os.environ["FAILOVER_TEST_LIE"]) as file:
            change = CHANGES[file.read()]
    except (OSError, KeyError):
        return said
    return replace(said, entries=tuple(change(said.sender, entry) for entry in said.entries))


speaker.Speaker.beat = beat
"""
"""Run by every Python of the witness's agent before anything else."""

TOLD = {
    "finished": "the witness gate says that /demo/robot1/{name} is finished in epoch 2, which robot1 denies",
    "ended here": "the witness gate says by itself that /demo/robot1/{name} is finished",
    "epoch": "the witness gate says epoch 1099511627775 of /demo/robot1/{name}, 1099511627774 above the one known here",
    "runs": "the witness gate says that it is primary of /demo/robot1/{name}",
    "keeps": "the witness gate says that it keeps checkpoints of /demo/robot1/{name}",
}

pytestmark = [pytest.mark.timeout(900), pytest.mark.root, pytest.mark.command("unshare")]


class LyingStage(teams.TeamStage):
    """The witness lies while there is a file that says how."""

    @property
    def lie(self) -> Path:
        return self.directory / "lie"

    def command(self, name: str, config: Path) -> list[str]:
        command = super().command(name, config)
        if self._roles[name] != "witness":
            return command
        (self.directory / "sitecustomize.py").write_text(LIAR)
        return ["env", f"PYTHONPATH={self.directory}", f"FAILOVER_TEST_LIE={self.lie}", *command]


def refused(robot: RobotMachine, sentence: str) -> int:
    """How often words of the witness were not believed, of which the last one was this."""
    gate = next(peer for peer in robot.status()["peers"] if peer["name"] == "gate")
    found = (re.match(r"not believed, (\d+) times, last \d+ s ago: (.*)", note) for note in gate["notes"])
    return max((int(one[1]) for one in found if one is not None and one[2].startswith(sentence)), default=0)


def test_a_lying_witness_stops_nothing_and_is_named(tmp_path: Path) -> None:
    with LyingStage(tmp_path / "stage", ROLES) as stage:
        stage.directory.mkdir(exist_ok=True)
        stage.start()
        first, second = stage.members["robot1"], stage.members["robot2"]
        for name in ("count", "again"):
            robots.run(first, name, *COUNTING)
            robots.until_protected(first, name)
        for lie, sentence in TOLD.items():
            before = {name: len(robots.output(first, name).split()) for name in ("count", "again")}
            stage.lie.write_text(lie)
            for robot in (first, second):
                told = [sentence.format(name=name) for name in before]
                robots.until(
                    lambda robot=robot, told=told: max(refused(robot, one) for one in told) >= BEATS,
                    f"{robot.name} to name the liar of {lie}",
                )
            stage.lie.unlink()
            for name, lines in before.items():
                assert (robots.component(first, name)["role"], robots.component(first, name)["epoch"]) == ("primary", 1)
                assert robots.component(second, name)["role"] == "standby"
                robots.until(lambda name=name, lines=lines: len(robots.output(first, name).split()) > lines, f"{name} to go on")
        shown = robots.failover(second, "status")
        assert shown.returncode == 1 and "gate: not believed, " in shown.stdout, shown
        assert "the witness gate says" in robots.failover(first, "why").stdout
        stage.cut_power("robot1")
        for name in ("count", "again"):
            robots.until(lambda name=name: robots.component(second, name).get("role") == "primary", "robot2 to be elected")
