"""--carry, --shared, --device, --connections, --shared-memory: rules for what a program holds besides its memory."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import Final

from checkpoint.device_rules import rule_from

RESETS: Final = "reset: its connections with others, of TCP and unix sockets, end where it resumes"
REFUSES: Final = "refuse: do not capture it while it has one"


def add_carry(room: argparse.ArgumentParser) -> None:
    """--carry: files that travel with the program."""
    room.add_argument(
        "--carry",
        metavar="PATH",
        action="append",
        default=[],
        help="send this file, or this folder with all its content, with the program, as it was at each checkpoint; may be "
        "given again (see docs/files.md)",
    )


def add_shared_files(room: argparse.ArgumentParser) -> None:
    """--shared: files that other programs write to, too."""
    room.add_argument(
        "--shared",
        metavar="PATH",
        action="append",
        default=[],
        help="other programs write to this file, or to files in this folder, too: where the program resumes, the file keeps "
        "its content there, and the restore sets only the program's offset; may be given again (see docs/files.md)",
    )


def add_devices(room: argparse.ArgumentParser) -> None:
    """--device: a rule for each device."""
    room.add_argument(
        "--device",
        metavar="PATH=RULE",
        dest="devices",
        action="append",
        type=device,
        default=[],
        help="the rule for a device that it has open: reopen, hook, optional, or the path of the device to open in its place; "
        "may be given again (see docs/devices.md)",
    )


def add_connections(
    room: argparse.ArgumentParser, what: str, default: str = "", choices: Sequence[str] = ("reset", "carry", "refuse")
) -> None:
    """--connections: what becomes of connections with others; ``what`` says it in the help."""
    room.add_argument("--connections", choices=choices, default=default, help=f"{what} (see docs/connections.md)")


def add_shared_memory(room: argparse.ArgumentParser, default: str) -> None:
    """--shared-memory: what becomes of memory that other processes have mapped, too."""
    room.add_argument(
        "--shared-memory",
        choices=("refuse", "detach"),
        default="",
        help="detach: shared memory that other processes have mapped too becomes a copy of its own where it resumes; the others "
        f"no longer see what it writes there (default: {default}; see docs/shared-memory.md)",
    )


def device(text: str) -> tuple[str, str]:
    """A path and its rule, which the agent reads."""
    path, is_there, rule = text.rpartition("=")
    if not is_there or not path.startswith("/"):
        raise argparse.ArgumentTypeError(f"{text!r}: name the device and its rule: /dev/ttyUSB0=reopen")
    try:
        rule_from(path, rule)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return path, rule
