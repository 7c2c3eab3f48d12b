"""page: where the operators' page listens."""

from __future__ import annotations

import argparse
from pathlib import Path

from failover.cli.arguments.shared import add_agent
from failover.config.page import PAGE_FILE, PageConfig, read


def page(room: argparse.ArgumentParser) -> None:
    """Of ``failover page``."""
    room.add_argument("--config", metavar="FILE", help=f"its configuration (default: {PAGE_FILE}, if that is there)")
    room.add_argument(
        "--listen", metavar="ADDRESS:PORT", help="instead of the configuration's address, 127.0.0.1:7480 by default; port 0: any"
    )
    room.add_argument("--password", action="store_true", help="ask for a password, print its line for page.toml, and end")
    add_agent(room)


def config_of(arguments: argparse.Namespace) -> PageConfig:
    """What the file and the command line say, together.

    Raises:
        FileMistakeError: the file is missing or mistaken.
    """
    config = read(Path(arguments.config) if arguments.config else None)
    return config.at(arguments.listen) if arguments.listen else config
