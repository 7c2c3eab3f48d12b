"""The processes of a test's robot, by what stands in their command lines."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from failover.cli.demo.robots import RobotMachine

MODULES = {"main_loop": "agent.main", "worker": "agent.worker.process", "keeper": "checkpoint", "guard": "agent.guard.server"}
"""Of each part of an agent: the third word of its command line, or the fourth."""


def command_lines(robot: RobotMachine) -> Iterator[tuple[int, list[str]]]:
    """Its processes and the words of their command lines, without those that end meanwhile."""
    for pid in robot.processes():
        try:
            line = Path(f"/proc/{pid}/cmdline").read_bytes()
        except (FileNotFoundError, ProcessLookupError):
            continue
        yield pid, line.decode(errors="replace").split("\0")


def naming(robot: RobotMachine, what: str) -> list[int]:
    """Its processes whose command lines have this in a word."""
    return [pid for pid, words in command_lines(robot) if any(what in word for word in words)]


def parts(robot: RobotMachine, name: str) -> list[int]:
    """Its processes that play this part of an agent; see `MODULES`."""
    return [pid for pid, words in command_lines(robot) if MODULES[name] in words[2:5]]
