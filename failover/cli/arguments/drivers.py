"""names, call, send, path, graph: drivers, and messages to them."""

from __future__ import annotations

import argparse
from typing import Final

from failover.cli.arguments.shared import add_json, positive

SECONDS_MAX: Final = 86_400.0


def names(room: argparse.ArgumentParser) -> None:
    """Of ``failover names``."""
    room.add_argument("prefix", metavar="PATH", nargs="?", default="", help="only what is registered there or below")
    add_json(room)


def call(room: argparse.ArgumentParser) -> None:
    """Of ``failover call``."""
    _name_of_driver(room)
    room.add_argument("call_verb", metavar="ACT", help="what it is to do: a verb that failover names shows")
    room.add_argument("body", metavar="JSON", nargs="?", help="with what: a table of its arguments, or the only one")
    _timeout(room)
    add_json(room)


def send(room: argparse.ArgumentParser) -> None:
    """Of ``failover send``."""
    _name_of_driver(room)
    room.add_argument("message", metavar="JSON", help="a message, as ENVELOPE.md says; - reads it from standard input")
    _timeout(room)
    add_json(room)


def graph(room: argparse.ArgumentParser) -> None:
    """Of ``failover graph``."""
    room.add_argument("-w", "--watch", action="store_true", help="show it again and again, until Ctrl-C")
    room.add_argument("--every-ms", metavar="MS", type=positive, default=2_000, help="with --watch (default: 2000)")
    room.add_argument("--dot", action="store_true", help="print a graph for Graphviz")
    add_json(room)


def path(room: argparse.ArgumentParser) -> None:
    """Of ``failover path``."""
    room.add_argument("id", metavar="ID", help="of the message, as failover call --json prints it")
    add_json(room)


def _name_of_driver(room: argparse.ArgumentParser) -> None:
    room.add_argument("name", metavar="NAME", help="a driver: its path, an alias, or an address")


def _timeout(room: argparse.ArgumentParser) -> None:
    room.add_argument(
        "--timeout-s", metavar="S", type=_seconds, default=5.0, help="seconds to wait for the answer (default: %(default)s)"
    )


def _seconds(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number <= SECONDS_MAX:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is no number of seconds above 0")
    return number
