"""bridge zenoh: the board and the drivers for programs of another middleware."""

from __future__ import annotations

import argparse
from typing import Final

from failover.cli.arguments.board import add_choice, add_rate
from failover.cli.arguments.shared import add_act, add_json, add_place_of_board

USUAL: Final = "tcp/127.0.0.1:7447"


def bridge(room: argparse.ArgumentParser) -> None:
    """Of ``failover bridge`` and its acts."""
    acts = room.add_subparsers(dest="act", metavar="MIDDLEWARE", title="middlewares", required=True)
    shared = argparse.ArgumentParser(add_help=False)
    add_json(shared)
    add_place_of_board(shared)
    zenoh = add_act(acts, "zenoh", shared, "items as keys, gets of them, calls of drivers, liveliness", ZENOH_DESCRIPTION)
    add_choice(zenoh)
    zenoh.add_argument(
        "--connect", metavar="ENDPOINT", action="append", default=[], help=f"of a router, {USUAL}; may be given again"
    )
    zenoh.add_argument(
        "--listen",
        metavar="ENDPOINT",
        action="append",
        default=[],
        help=f"have programs connect here; may be given again (default without --connect and --config: {USUAL})",
    )
    zenoh.add_argument("--config", metavar="FILE", default="", help="of the session, in zenoh's own form: TLS, users, scouting")
    zenoh.add_argument(
        "--unsafe-listen", action="store_true", help="allow a --listen that other machines reach: they can read the board"
    )
    zenoh.add_argument("--prefix", metavar="KEY", help="of all keys (default: the team's name; without an agent: failover)")
    zenoh.add_argument("--calls", action="store_true", help="carry calls to drivers, with the rights of this user")
    add_rate(zenoh)
    zenoh.add_argument("--socket", metavar="PATH", help="the control socket of the agent that is asked for the team's name")
    zenoh.set_defaults(function="failover.cli.verbs.bridges:zenoh")


ZENOH_DESCRIPTION: Final = """
    Show the board to programs of zenoh until Ctrl-C. Each put of an item is published as JSON at PREFIX/ROBOT/ITEM, with its
    number and its age; a get of such keys, wildcards too, is answered with the newest values. PREFIX/ROBOT is alive, in zenoh's
    sense, while the robot runs. With --calls a get of PREFIX/@call/DRIVER/VERB calls a driver with the fields of its payload. A
    zenoh program can put nothing. The library comes with the extra "zenoh": pip install 'failover[zenoh]'.

    By itself the session knows no users and no encryption: it listens at this machine alone, finds no others, and is found by
    none. A file of zenoh's own may say otherwise (--config).

      failover bridge zenoh
      failover bridge zenoh --connect tcp/10.0.0.5:7447 --items 'ball*' --calls
    """
