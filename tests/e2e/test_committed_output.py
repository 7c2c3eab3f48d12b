"""Output that was not promised is not seen: a reader of a component across power cuts reads one history, each line once.

Each line carries a random number of the instant in which it was written, and a sum over all numbers before it. A reader that saw
a line that a takeover took back finds that the sums do not fit: no program could write the same line again. (With
``--output=immediate`` these tests fail.) FAILOVER_KILLS=50 cuts the power that often, at instants that FAILOVER_SEED chooses.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import pytest
from msgspec.structs import replace

from agent.guard.output_pump import HOLD_LIMIT, READ_SIZE
from failover.cli.demo.robots import RobotMachine, Stage
from tests.e2e import robots
from tests.e2e.test_kept_state_killed import come_back

CUTS: Final = int(os.environ.get("FAILOVER_KILLS", "3"))
SEED: Final = os.environ.get("FAILOVER_SEED") or str(random.randrange(1 << 32))
SPREAD_S: Final = 0.3
"""Instants of death lie in here: a capture begins every 0.1 s."""

MORE: Final = 50
"""Lines that show that it goes on."""

ORDINARY: Final = """
import os, time, zlib
number = total = 0
while True:
    dice = os.urandom(4).hex()
    total = zlib.crc32(dice.encode(), total)
    line = f"{number} {dice} {total}\\n".encode()
    while line:  # print(flush=True) of CPython loses a page where a stop leaves a write half done that waits for room in a pipe
        line = line[os.write(1, line):]
    number += 1
    time.sleep(0.003)
"""
KEEPING: Final = """
import os, zlib
import failover
kept = failover.resume("dice", default={"number": 0, "total": 0})
for _ in failover.every(0.003):
    dice = os.urandom(4).hex()
    kept["total"] = zlib.crc32(dice.encode(), kept["total"])
    print(kept["number"], dice, kept["total"])
    kept["number"] += 1
"""
PROGRAMS: Final = {
    "ptrace": ("/usr/bin/python3", "-S", "-c", ORDINARY),
    "cooperative": (sys.executable, "-c", KEEPING),
}


WIDE: Final = ("urandom(4)", "urandom(4096)")
"""What to change in a program so that it writes megabytes a second."""


def lines_of(content: bytes) -> list[bytes]:
    """The whole lines of what was seen so far."""
    return content.splitlines()[: content.count(b"\n")]


def check_history(content: bytes) -> int:
    """Every line follows from those before it; how many there are."""
    total = 0
    for number, line in enumerate(lines_of(content)):
        told, dice, claimed = line.split()
        total = zlib.crc32(dice, total)
        assert (int(told), int(claimed)) == (number, total), f"line {number} does not follow from those before it: {line!r}"
    return len(lines_of(content))


def command(robot: RobotMachine, verb: str, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "failover.cli.main", verb, "--socket", str(robot.socket), *arguments]


@contextmanager
def stage_of(directory: Path) -> Iterator[Stage]:
    """Two robots that share the loopback, so that one that was switched off can come back."""
    with Stage(directory / "stage", replace(robots.means(), own_network=False)) as stage:
        stage.directory.mkdir()
        stage.start()
        for robot in stage.robots:
            robots.keep_on(robot)
        first, second = stage.robots
        robots.until(lambda: robots.connected(first) and robots.connected(second), "the robots to hear each other")
        yield stage


@contextmanager
def reading(path: Path, *commands: list[str]) -> Iterator[list[Path]]:
    """Readers, each into a file of its own; they are ended at last, and must not have ended before."""
    files = [path / f"seen{number}" for number in range(len(commands))]
    readers = [subprocess.Popen(words, stdout=file.open("wb")) for words, file in zip(commands, files, strict=True)]
    try:
        yield files
        assert [reader.poll() for reader in readers] == [None] * len(readers), "a reader ended"
    finally:
        for reader in readers:
            reader.kill()
            reader.wait()


def primary(stage: Stage) -> RobotMachine | None:
    """The robot that runs it and is protected by the other."""
    for robot in stage.robots:
        shown = robots.component(robot, "dice") if robots.answers(robot) else {}
        if shown.get("role") == "primary" and shown["state"] == "running" and shown["protection"] == "protected":
            return robot
    return None


def until_more(files: list[Path]) -> None:
    """Until every reader has seen more."""
    before = [len(lines_of(file.read_bytes())) for file in files]
    for file, seen in zip(files, before, strict=True):
        robots.until(lambda file=file, seen=seen: len(lines_of(file.read_bytes())) > seen + MORE, "a reader to see more")  # type: ignore[misc]


@pytest.mark.timeout(max(120, CUTS * 30))
@pytest.mark.parametrize("engine", PROGRAMS)
def test_a_reader_sees_each_line_once_and_in_order_across_power_cuts(tmp_path: Path, engine: str) -> None:
    print(f"FAILOVER_SEED={SEED}")
    dice = random.Random(f"{engine} {SEED}")
    with stage_of(tmp_path) as stage:
        first, second = stage.robots
        running = command(first, "run", "--name", "dice", "--engine", engine, "--output", "committed", "--", *PROGRAMS[engine])
        with reading(tmp_path, running) as (at_first,):
            robots.until(lambda: robots.component(second, "dice").get("snapshots"), "a checkpoint at robot2")
            with reading(second.directory, command(second, "logs", "--follow", "dice")) as (at_second,):
                files = [at_first, at_second]
                for _ in range(CUTS):
                    robot = robots.until(lambda: primary(stage), "one robot to run it, the other to protect it")
                    until_more(files)
                    time.sleep(dice.uniform(0, SPREAD_S))  # not a wait for anything: the instant of the cut
                    robot.cut_power()
                    come_back(stage, robot)
                until_more(files)
                for file in files:
                    assert check_history(file.read_bytes()) > CUTS * MORE
        for robot in stage.robots:
            assert not robots.mistake(robot), robots.mistake(robot)


def waits(robot: RobotMachine) -> int:
    """Bytes that are held back there."""
    return int(robots.component(robot, "dice")["output_waiting"])


@pytest.mark.sampled(2)
@pytest.mark.parametrize("engine", PROGRAMS)
def test_while_nobody_stands_by_output_waits_and_at_last_the_program_too(tmp_path: Path, engine: str) -> None:
    argv = tuple(word.replace(*WIDE) for word in PROGRAMS[engine])
    with stage_of(tmp_path) as stage:
        first, second = stage.robots
        assert not robots.failover(
            first, "run", "--detach", "--name", "dice", "--engine", engine, "--output", "committed", "--", *argv
        ).returncode
        robots.until_protected(first, "dice")
        second.cut_power()
        robots.until(lambda: waits(first) > HOLD_LIMIT, "the limit to be reached")
        seen = robots.output(first, "dice")
        taken = robots.checkpoints(first, "dice")
        robots.until(lambda: robots.checkpoints(first, "dice") > taken + 2, "checkpoints to be taken all the same")
        assert waits(first) <= HOLD_LIMIT + READ_SIZE, "the program waits"
        assert any("held back (--output=committed)" in note for note in robots.component(first, "dice")["notes"])
        assert robots.output(first, "dice") == seen, "nothing more was shown"
        come_back(stage, second)
        robots.until(lambda: waits(first) < HOLD_LIMIT // 2, "the output to go on")
        for robot in stage.robots:
            whole = robots.output(robot, "dice")
            assert check_history(whole), robot.name
            assert len(whole) > len(seen) + HOLD_LIMIT // 2, robot.name
