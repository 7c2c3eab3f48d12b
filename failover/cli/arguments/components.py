"""run, protect, release, stop, logs, handover, failback, drill, promote, prefer, reserve, unreserve: one component.

drain, undrain: a robot's.
"""

from __future__ import annotations

import argparse
import shlex
from typing import Final

from checkpoint.program import cpu_baseline
from failover.cli.arguments.resources import (
    REFUSES,
    RESETS,
    add_carry,
    add_connections,
    add_devices,
    add_shared_files,
    add_shared_memory,
)
from failover.cli.arguments.shared import add_agent, add_name, add_pid, ago, positive, signal_number

DRAIN_S: Final = 300.0
"""How long ``failover drain`` waits: a large program on a slow link takes minutes."""

HOOKS: Final = {
    "before_capture": "before the agent takes a whole snapshot of it, and before the last one of a handover",
    "before_resume": "on a robot, before it resumes there",
    "after_resume": "on a robot, after it resumed there; FAILOVER_* variables tell robot, epoch, generation and reason",
}
"""Occasions for a command that comes with a program, and when they are."""


def run(room: argparse.ArgumentParser) -> None:
    """Of ``failover run``."""
    room.add_argument(
        "--name", metavar="NAME", help="its name, a path such as /lab/robot1/mapper (default: made from the command)"
    )
    room.add_argument("--detach", action="store_true", help="print the name and return; see failover logs")
    _add_wait(room, "with --detach: ")
    room.add_argument(
        "--no-isolate", dest="isolate", action="store_false", help="keep it in this machine's PIDs and clocks (default: its own)"
    )
    room.add_argument(
        "--engine",
        choices=("auto", "ptrace", "cooperative"),
        default="auto",
        help="ptrace: the agent captures the program from outside; cooperative: the program itself says what "
        "must survive (failover.resume, failover.component), and starts again from that (default: auto: the agent detects it)",
    )
    room.add_argument(
        "--portable",
        nargs="?",
        choices=("no", *cpu_baseline.LEVELS),
        const=cpu_baseline.DEFAULT,
        default="",
        metavar="LEVEL",
        help="have libraries choose code that every processor of a level can run, so that it can resume at lesser processors: "
        f"{', '.join(cpu_baseline.LEVELS)}, or no (default: as agent.toml says; without LEVEL: {cpu_baseline.DEFAULT})",
    )
    room.add_argument(
        "--output",
        choices=("immediate", "committed"),
        default="immediate",
        help="committed: show output only once another robot holds a checkpoint that contains it; then no takeover takes back or "
        "repeats output that you saw (default: immediate: show it as the program writes it)",
    )
    for hook, when in HOOKS.items():
        option = f"--{hook.replace('_', '-')}"
        room.add_argument(option, metavar="CMD", type=shlex.split, default=[], help=f"run this, as you, {when}")
    add_carry(room)
    add_shared_files(room)
    add_devices(room)
    add_connections(room, f"{RESETS}; carry: a handover takes those of TCP along; {REFUSES} (default: as agent.toml says: reset)")
    add_shared_memory(room, "as agent.toml says: refuse")
    room.add_argument("--user", metavar="USER", help="run it as this user, by name or number (only root may; default: as you)")
    room.add_argument("command", metavar="CMD", nargs="+", help="the program and its arguments, after --")
    add_agent(room)


def protect(room: argparse.ArgumentParser) -> None:
    """Of ``failover protect``."""
    add_pid(room)
    room.add_argument("--name", metavar="NAME", help="its name (default: /TEAM/ROBOT/pid-PID)")
    add_carry(room)
    add_shared_files(room)
    add_devices(room)
    add_connections(room, f"{RESETS}; carry: a handover takes those of TCP along; {REFUSES} (default: as agent.toml says: reset)")
    add_shared_memory(room, "as agent.toml says: refuse")
    _add_wait(room)
    add_agent(room)


def _add_wait(room: argparse.ArgumentParser, when: str = "") -> None:
    room.add_argument(
        "--wait", action="store_true", help=f"{when}return when another robot holds a checkpoint, and show how far that is"
    )


def named(room: argparse.ArgumentParser) -> None:
    """Of a verb about one component that takes no more."""
    add_name(room)
    add_agent(room)


def stop(room: argparse.ArgumentParser) -> None:
    """Of ``failover stop``."""
    add_name(room)
    room.add_argument("--signal", metavar="N", type=signal_number, default=15, help="number or name (default: TERM)")
    add_agent(room)


def logs(room: argparse.ArgumentParser) -> None:
    """Of ``failover logs``."""
    add_name(room)
    room.add_argument("-f", "--follow", action="store_true", help="follow until the program ends, or Ctrl-C")
    room.add_argument("--stream", type=int, choices=(1, 2), help="standard output (1) or standard error (2) alone")
    room.add_argument("--since", metavar="AGO", type=ago, help="only what was written since then: 90s, 10min, 2h, 3d")
    room.add_argument("--tail", metavar="N", type=positive, help="only the last N lines of each stream, and what follows")
    room.add_argument("-t", "--times", action="store_true", help="before each line, when it was written")
    add_agent(room)


def handover(room: argparse.ArgumentParser) -> None:
    """Of ``failover handover``."""
    add_name(room)
    room.add_argument("--to", metavar="ROBOT", help="the target robot (default: its standby)")
    add_agent(room)


def drill(room: argparse.ArgumentParser) -> None:
    """Of ``failover drill``."""
    add_name(room)
    room.add_argument(
        "--at-most-ms", metavar="MS", type=positive, help="fail where the program stood still for longer (default: no limit)"
    )
    room.add_argument("-y", "--yes", action="store_true", help="do not ask for confirmation")
    add_agent(room)


def promote(room: argparse.ArgumentParser) -> None:
    """Of ``failover promote``."""
    add_name(room)
    room.add_argument(
        "--robot", metavar="ROBOT", help="the robot that shall run it (default: the one with the newest checkpoint)"
    )
    room.add_argument("-y", "--yes", action="store_true", help="do not ask for confirmation, at any risk")
    add_agent(room)


def prefer(room: argparse.ArgumentParser) -> None:
    """Of ``failover prefer``."""
    add_name(room)
    room.add_argument("robot", metavar="ROBOT", help="the robot that should run it whenever it can")
    add_agent(room)


def reserve(room: argparse.ArgumentParser) -> None:
    """Of ``failover reserve``."""
    _add_reserved(room)
    room.add_argument("--for", dest="span_ms", metavar="SPAN", type=ago, required=True, help="90s, 10min, 2h; at most 4h")
    room.add_argument("--why", metavar="TEXT", required=True, help="what others are told, one line")
    add_agent(room)


def unreserve(room: argparse.ArgumentParser) -> None:
    """Of ``failover unreserve``."""
    _add_reserved(room)
    room.add_argument("--break", dest="breaks", action="store_true", help="also where it is another user's")
    add_agent(room)


def _add_reserved(room: argparse.ArgumentParser) -> None:
    room.add_argument("name", metavar="NAME", help="a component, or a path, /TEAM or /TEAM/ROBOT, for all below it")


def drain(room: argparse.ArgumentParser) -> None:
    """Of ``failover drain``."""
    undrain(room)
    room.add_argument(
        "--timeout", type=float, default=DRAIN_S, metavar="S", help="seconds to wait for the moves (default: %(default)g)"
    )


def undrain(room: argparse.ArgumentParser) -> None:
    """Of ``failover undrain``."""
    room.add_argument("robot", metavar="ROBOT", help="a robot of the team")
    add_agent(room)
