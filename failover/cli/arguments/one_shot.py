"""check, capture, restore, inspect, demo, completion: verbs that need no agent."""

from __future__ import annotations

import argparse

from failover.cli.arguments.resources import REFUSES, RESETS, add_connections, add_devices, add_shared_files, add_shared_memory
from failover.cli.arguments.shared import add_agent, add_json, add_pid


def check(room: argparse.ArgumentParser) -> None:
    """Of ``failover check``."""
    either = room.add_mutually_exclusive_group()
    add_pid(either, optional=True)
    either.add_argument("--table", action="store_true", help="show what failover preserves of any program, and what it refuses")
    add_agent(room)


def capture(room: argparse.ArgumentParser) -> None:
    """Of ``failover capture``."""
    add_pid(room)
    room.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        required=True,
        help="the snapshot's file; written whole or not at all, readable by you alone",
    )
    room.add_argument(
        "--leave-running", action="store_true", help="leave the program running (default: end it once the snapshot is safe)"
    )
    room.add_argument("--force", action="store_true", help="replace FILE if it exists")
    add_shared_files(room)
    add_devices(room)
    carries = "carry: take those of TCP along, or refuse the capture; not with --leave-running"
    add_connections(room, f"{RESETS}; {carries}; {REFUSES} (default: reset)", "reset")
    add_shared_memory(room, "refuse")
    add_json(room)


def restore(room: argparse.ArgumentParser) -> None:
    """Of ``failover restore``."""
    room.add_argument("file", metavar="FILE", help="a snapshot made by failover capture")
    add_restore_options(room)


def add_restore_options(room: argparse.ArgumentParser) -> None:
    """How a program is started from a snapshot's file."""
    room.add_argument("--wait", action="store_true", help="stay until the program ends, and pass on its exit status")
    room.add_argument(
        "--trust",
        action="store_true",
        help="give the program all rights that FILE asks for, also if FILE is not root's (default: its owner's at most)",
    )
    room.add_argument(
        "--contents",
        metavar="DIR",
        default="",
        help="files of the program that this machine lacks, each named by its digest, as failover archive fetch brings them",
    )
    add_shared_files(room)
    add_devices(room)
    what = (
        "carry: take up all TCP connections with others, or refuse the restore; reset: take up none "
        "(default: take up those that the capture took along, where that is possible)"
    )
    add_connections(room, what, choices=("reset", "carry"))
    add_json(room)


def inspect(room: argparse.ArgumentParser) -> None:
    """Of ``failover inspect``."""
    room.add_argument("file", metavar="FILE", help="a snapshot's file")
    room.add_argument("--vmas", action="store_true", help="list every mapping as well")
    add_json(room)


def demo(room: argparse.ArgumentParser) -> None:
    """Of ``failover demo``."""
    room.add_argument("--picture", metavar="FILE", help="write what was shown to FILE as an SVG picture too")
    add_json(room)


def completion(room: argparse.ArgumentParser) -> None:
    """Of ``failover completion``."""
    room.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="the shell to complete for")
