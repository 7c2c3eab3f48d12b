"""board get, put, top, users, header, import: the items that robots share."""

from __future__ import annotations

import argparse
from typing import Final

from failover.cli.arguments.shared import add_act, add_json, add_place_of_board, add_repeated, add_team_directory, whole


def board(room: argparse.ArgumentParser) -> None:
    """Of ``failover board`` and its acts."""
    shared = argparse.ArgumentParser(add_help=False)
    add_json(shared)
    add_place_of_board(room)
    add_repeated(room, 500)
    add_json(room)
    acts = room.add_subparsers(dest="act", metavar="ACT", title="acts")
    of_board = argparse.ArgumentParser(add_help=False, parents=[shared])
    add_place_of_board(of_board)
    get = add_act(acts, "get", of_board, "one item's value, how old it is, and how old it can be at most", GET_DESCRIPTION)
    get.add_argument("path", metavar="ROBOT/ITEM", help="an item of a robot; ITEM alone: of this robot")
    get.add_argument("--watch", action="store_true", help="print each new value until Ctrl-C")
    get.set_defaults(function="failover.cli.verbs.board:get")
    put = add_act(acts, "put", of_board, "put a value of this robot", PUT_DESCRIPTION)
    put.add_argument("path", metavar="ITEM", help="an item of this robot")
    put.add_argument("value", metavar="JSON", help="the value; bytes in hexadecimal; - reads it from standard input")
    put.set_defaults(function="failover.cli.verbs.board:put")
    top = add_act(acts, "top", of_board, "rates, sizes, ages and losses of every item", TOP_DESCRIPTION)
    add_repeated(top, 1000)
    top.set_defaults(function="failover.cli.verbs.board:top")
    users = add_act(acts, "users", of_board, "the programs that have the board open", USERS_DESCRIPTION)
    users.set_defaults(function="failover.cli.verbs.board:users")
    of_team = argparse.ArgumentParser(add_help=False, parents=[shared])
    add_team_directory(of_team)
    header = add_act(acts, "header", of_team, "the items as a C header", HEADER_DESCRIPTION)
    header.add_argument(
        "--rtdb", action="store_true", help="also numbers of items and agents under their own names, for failover_rtdb.h"
    )
    header.set_defaults(function="failover.cli.verbs.board_files:header")
    imported = add_act(acts, "import", shared, "an rtdb.conf as a table of team.toml", IMPORT_DESCRIPTION)
    imported.add_argument("file", metavar="FILE", help="CAMBADA's rtdb.conf, or RTDB2's rtdb2_configuration.xml")
    imported.add_argument(
        "-I", dest="include", metavar="DIR", action="append", default=[], help="a folder with headers; may be given again"
    )
    imported.add_argument("--cc", metavar="COMMAND", help="the C++ compiler (default: $CXX, else g++, c++ or clang++)")
    imported.add_argument(
        "--robot", metavar="AGENT=ROBOT", type=_pair, action="append", default=[], help="the robot that is this agent of the file"
    )
    imported.add_argument(
        "--size", metavar="BYTES", type=whole, default=1024, help="the most bytes of a key of an XML file (default: %(default)s)"
    )
    imported.set_defaults(function="failover.cli.verbs.board_files:import_file")


def _pair(text: str) -> tuple[str, str]:
    agent, separator, robot = text.partition("=")
    if not separator or not agent or not robot:
        raise argparse.ArgumentTypeError(f"{text!r} is no AGENT=ROBOT")
    return agent, robot


GET_DESCRIPTION: Final = """
    Print the newest value of an item as JSON, its age, and the age that it can have at most. Exit status 1: the value may be
    older than its bound.

      failover board get ball
      failover board get robot2/ball --json | jq .value.x
      failover board get robot2/ball --watch
    """

PUT_DESCRIPTION: Final = """
    Put a value by hand, for a test or from a shell script. One process at a time writes an item: while a program writes it, this
    command is refused and names the program.

      failover board put ball '{"x": 1.0, "y": 2.5, "v": [0, 0], "seen": 1}'
      failover board put goal '"00ff"'
    """

TOP_DESCRIPTION: Final = """
    Show, over a span, how often each item is put, how old its newest value was at half and at 99 of 100 looks, and how many
    frames carried it or were lost.

      failover board top
      failover board top --every-ms 5000 --json
    """

USERS_DESCRIPTION: Final = """
    List the programs that have this robot's board open. The kernel tells: a program that was killed is not in the list.

      failover board users
    """

HEADER_DESCRIPTION: Final = """
    Print the items of team.toml as a C header: a struct for each, its number, size and digest, and assertions that the compiler
    lays the structs out as the board does. It compiles as C11 and as C++11.

      failover board header > items.h
      failover board header --directory ~/team --rtdb > items.h
    """

IMPORT_DESCRIPTION: Final = """
    Read CAMBADA's rtdb.conf and print its items as the table [board] of team.toml, with the sizes of their C types. This command
    compiles a file that only names the types, and reads the sizes from the object file: it runs nothing of yours, and works with
    a compiler for the robots' processor. An agent needs no compiler. A mistake in the file is told with line and column.

    RTDB2's XML has no types: its keys become msgpack items of 1024 bytes.

      failover board import rtdb.conf -I include >> team.toml
      failover board import rtdb.conf -I include --cc "aarch64-linux-gnu-g++" --robot BASE_STATION=base
      failover board import rtdb2_configuration.xml >> team.toml
    """
