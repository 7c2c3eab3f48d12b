"""status, top and why: how the team is, and how it came to that."""

from __future__ import annotations

import argparse

from failover.cli.arguments.shared import add_agent, ago, positive


def status(room: argparse.ArgumentParser) -> None:
    """Of ``failover status``."""
    room.add_argument("name", metavar="NAME", nargs="?", help="only this component, with all that is known of it")
    room.add_argument("-b", "--brief", action="store_true", help="one line, and one for each component that is not well")
    room.add_argument("-w", "--watch", action="store_true", help="show it again and again, until Ctrl-C")
    room.add_argument("--every-ms", metavar="MS", type=positive, default=500, help="with --watch (default: 500)")
    add_agent(room)


def top(room: argparse.ArgumentParser) -> None:
    """Of ``failover top``."""
    room.add_argument("--every-ms", metavar="MS", type=positive, default=1000, help="between two looks (default: 1000)")
    add_agent(room)


def why(room: argparse.ArgumentParser) -> None:
    """Of ``failover why``."""
    room.add_argument("name", metavar="NAME", nargs="?", help="only this component, and how its robots saw each other")
    room.add_argument("--robot", metavar="ROBOT", help="only the entries of that robot")
    room.add_argument("--since", metavar="AGO", type=ago, help="only younger entries: 90s, 10min, 2h, 3d")
    room.add_argument("-b", "--brief", action="store_true", help="one line each, without the facts below it")
    add_agent(room)
