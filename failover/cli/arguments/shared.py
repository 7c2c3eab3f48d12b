"""What the arguments of several files share: the parser's class, common options, forms of values."""

from __future__ import annotations

import argparse
import os
from textwrap import dedent
from typing import Any, Final

from checkpoint.sentences import near
from failover.config.choices import none_of
from failover.config.quantities import span_ms

EXIT_STATUSES: Final = "Exit status: 0 healthy, 1 failed or degraded, 2 usage, 3 no agent."

NUMBER_MAX: Final = (1 << 31) - 1
"""What a PID can be at most."""


class Parser(argparse.ArgumentParser):
    """One that names the choices for a value that is none of them, and the one that was probably meant."""

    def _check_value(self, action: argparse.Action, value: object) -> None:
        if action.choices is not None and value not in action.choices:
            raise argparse.ArgumentError(action, none_of(value, action.choices))


def add_act(acts: Any, name: str, shared: argparse.ArgumentParser, summary: str, description: str) -> argparse.ArgumentParser:
    """An act of a verb, as ``failover team`` has them.

    Args:
        acts: of `argparse.ArgumentParser.add_subparsers`.
        shared: has the arguments that each act of the verb takes.
    """
    room: argparse.ArgumentParser = acts.add_parser(
        name,
        parents=[shared],
        help=summary,
        description=dedent(description).strip(),
        epilog=EXIT_STATUSES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    return room


def add_json(room: argparse.ArgumentParser) -> None:
    """--json: the answer as one object."""
    room.add_argument("--json", action="store_true", help="print one JSON object instead of text")


def add_agent(room: argparse.ArgumentParser) -> None:
    """--socket and --json: which agent is asked, and in which form the answer is printed."""
    room.add_argument(
        "--socket",
        metavar="PATH",
        help="the agent's control socket (default: $FAILOVER_SOCKET, else your own, else the system's)",
    )
    add_json(room)


def add_name(room: argparse.ArgumentParser) -> None:
    """NAME: of a component."""
    room.add_argument("name", metavar="NAME", help="the component's name, as failover status shows it")


def add_pid(room: argparse._ActionsContainer, optional: bool = False) -> None:
    """PID: of a process on this machine."""
    room.add_argument("pid", metavar="PID", type=positive, nargs="?" if optional else None, help="the process")


def add_team_directory(room: argparse.ArgumentParser) -> None:
    """--directory: where the team file is."""
    room.add_argument(
        "--directory",
        metavar="DIR",
        default=os.environ.get("FAILOVER_TEAM") or "/etc/failover/team",
        help="the team directory (default: $FAILOVER_TEAM, else /etc/failover/team)",
    )


def add_place_of_board(room: argparse.ArgumentParser) -> None:
    """--board: where the board and the schedule of this robot are."""
    room.add_argument(
        "--board", metavar="DIR", help="the board's directory (default: $FAILOVER_BOARD, else the agent's, else this user's)"
    )


def add_repeated(room: argparse.ArgumentParser, every_ms: int) -> None:
    """--watch and --every-ms: what is shown is shown again, as often as that."""
    room.add_argument("--watch", action="store_true", help="again and again until Ctrl-C")
    room.add_argument(
        "--every-ms",
        metavar="MS",
        type=whole,
        default=every_ms,
        help="the span over which rates are taken (default: %(default)s)",
    )


def positive(text: str) -> int:
    """A whole number above zero, as a PID or a period is."""
    number = int(text) if text.isdecimal() and len(text) <= len(str(NUMBER_MAX)) else 0
    if not 0 < number <= NUMBER_MAX:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is not a whole number above zero, or too large a one")
    return number


def ago(text: str) -> int:
    """A span of time such as 90s or 10min, in milliseconds."""
    try:
        return span_ms(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def whole(text: str) -> int:
    """A number of bytes or milliseconds, from 1 on."""
    if not text.isascii() or not text.isdigit() or not 0 < int(text[:10]) <= NUMBER_MAX:
        raise argparse.ArgumentTypeError(f"{text!r} is no number from 1 to {NUMBER_MAX}")
    return int(text)


def signal_number(text: str) -> int:
    """A signal's number, from a number or a name with or without SIG."""
    import signal

    try:
        return signal.Signals(int(text)) if text.isdecimal() else signal.Signals["SIG" + text.upper().removeprefix("SIG")]
    except (ValueError, KeyError):
        meant = near(text.upper(), (one.name.removeprefix("SIG") for one in signal.Signals))
        raise argparse.ArgumentTypeError(f"{text!r} is no signal; give a number or a name such as TERM{meant}") from None


def wake_signal(text: str) -> int:
    """The number of a signal for which a program can have a handler."""
    number = signal_number(text)
    if number in (9, 19):  # SIGKILL, SIGSTOP
        raise argparse.ArgumentTypeError(f"{text!r} ends or stops a program and wakes none; give a signal such as CONT or USR1")
    return number
