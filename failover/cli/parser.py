"""What can be typed: every verb with its arguments, its help and its examples.

Only this file knows argparse. A verb is a row of the table at the bottom; the function that does it is named there as
``module:function`` and loaded when the verb is used, so that ``failover status`` does not pay for ``failover demo``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from textwrap import dedent
from typing import Final

from failover import __version__

EXIT_STATUSES: Final = "Exit status: 0 healthy, 1 failed or degraded, 2 usage, 3 no agent."


@dataclass(frozen=True, slots=True)
class Verb:
    """One verb of the command line.

    Attributes:
        summary: one line, for the list of verbs.
        story: what it does, and examples; dedented before it is shown.
        arguments: adds the verb's own arguments to its parser.
        function: ``module:function``; takes the parsed arguments, returns the exit status.
    """

    name: str
    summary: str
    story: str
    arguments: Callable[[argparse.ArgumentParser], None]
    function: str


def verbs() -> tuple[str, ...]:
    """The names of all verbs."""
    return tuple(verb.name for verb in VERBS)


def build() -> argparse.ArgumentParser:
    """The whole parser."""
    parser = argparse.ArgumentParser(
        prog="failover",
        description="A program outlives its robot: it goes on elsewhere, from where it stood a fraction of a second ago.",
        epilog=f"{EXIT_STATUSES} `failover VERB --help` explains a verb with examples. Start with: failover demo",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="version", version=f"failover {__version__}")
    rooms = parser.add_subparsers(dest="verb", metavar="VERB", required=True, title="verbs")
    for verb in VERBS:
        room = rooms.add_parser(
            verb.name,
            help=verb.summary,
            description=dedent(verb.story).strip(),
            epilog=EXIT_STATUSES,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        verb.arguments(room)
        room.set_defaults(function=verb.function, room=room)
    return parser


# --- Arguments that several verbs share ------------------------------------------------------------------------------


def _json(room: argparse.ArgumentParser) -> None:
    room.add_argument("--json", action="store_true", help="print one JSON object instead of text")


def _agent(room: argparse.ArgumentParser) -> None:
    room.add_argument(
        "--socket",
        metavar="PATH",
        help="the agent's control socket (default: $FAILOVER_SOCKET, else your own, else the system's)",
    )
    _json(room)


def _name(room: argparse.ArgumentParser) -> None:
    room.add_argument("name", metavar="NAME", help="the component's name, as failover status shows it")


def positive(text: str) -> int:
    """A whole number above zero, as a PID or a period is."""
    number = int(text) if text.isdecimal() else 0
    if number <= 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number above zero")
    return number


def _pid(room: argparse.ArgumentParser, optional: bool = False) -> None:
    room.add_argument("pid", metavar="PID", type=positive, nargs="?" if optional else None, help="the process")


# --- One shot: no agent needed ---------------------------------------------------------------------------------------


def _capture(room: argparse.ArgumentParser) -> None:
    _pid(room)
    room.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        required=True,
        help="the snapshot's file; written whole or not at all, readable by you alone",
    )
    room.add_argument(
        "--leave-running", action="store_true", help="let the program run on (default: it is ended once the snapshot is safe)"
    )
    room.add_argument("--force", action="store_true", help="replace FILE if it exists")
    _json(room)


def _restore(room: argparse.ArgumentParser) -> None:
    room.add_argument("file", metavar="FILE", help="a snapshot made by failover capture")
    room.add_argument("--wait", action="store_true", help="stay until the program ends, and pass on its exit status")
    _json(room)


def _inspect(room: argparse.ArgumentParser) -> None:
    room.add_argument("file", metavar="FILE", help="a snapshot's file")
    room.add_argument("--vmas", action="store_true", help="list every mapping as well")
    _json(room)


def _check(room: argparse.ArgumentParser) -> None:
    _pid(room, optional=True)
    _json(room)


def _completion(room: argparse.ArgumentParser) -> None:
    room.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="the shell to complete for")


VERBS: Final = (
    Verb(
        "check",
        "can this machine, or this process, be protected; and what to change",
        """
        Without PID: what this machine offers, and what is missing. With PID: whether that process can be captured now,
        what would come back otherwise than it was, and every reason why not. The process is not touched.

          failover check
          failover check 4711
        """,
        _check,
        "failover.cli.oneshot:check",
    ),
    Verb(
        "capture",
        "one snapshot of a process into a file; no agent needed",
        """
        Write the whole state of a running process to FILE: memory, registers, open files, timers, signals. The process is
        ended afterwards, so that it cannot run twice; --leave-running lets it go on.

          failover capture 4711 -o mapper.snapshot
          failover capture 4711 -o before.snapshot --leave-running
        """,
        _capture,
        "failover.cli.oneshot:capture",
    ),
    Verb(
        "restore",
        "a process goes on from a snapshot in a file; no agent needed",
        """
        Start the program of FILE where it stood. Prints its PID on a line of its own and returns while it runs on.
        The old PID is kept where this user may choose it and it is free.

          failover restore mapper.snapshot
          failover restore --wait mapper.snapshot && echo it ended well
        """,
        _restore,
        "failover.cli.oneshot:restore",
    ),
    Verb(
        "inspect",
        "what a snapshot's file holds",
        """
        Show the process, its memory, files and settings as a snapshot holds them, after verifying every byte of it.

          failover inspect mapper.snapshot
          failover inspect --json mapper.snapshot | jq .position
        """,
        _inspect,
        "failover.cli.oneshot:inspect",
    ),
    Verb(
        "completion",
        "completion of verbs and options for your shell",
        """
        Print a script that teaches a shell to complete this command.

          failover completion bash > ~/.local/share/bash-completion/completions/failover
        """,
        _completion,
        "failover.cli.completion:completion",
    ),
)
