"""board get, put, top, users, record, replay, serve, header, import: the items that robots share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any, Final

from failover.cli.arguments.shared import add_act, add_json, add_place_of_board, add_repeated, add_team_directory, whole
from failover.config import quantities

RATE_MAX: Final = 1000
"""Looks a second: a look at a hundred items takes some tens of microseconds."""
PORT_MAX: Final = 65535
PACE_MIN: Final = 0.001
PACE_MAX: Final = 1000.0


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
    _recordings(acts, of_board)
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


def _recordings(acts: Any, of_board: argparse.ArgumentParser) -> None:
    """Of ``record``, ``replay`` and ``serve``."""
    some = argparse.ArgumentParser(add_help=False, parents=[of_board])
    add_choice(some)
    record = add_act(acts, "record", some, "each put of each item, with its age, into an MCAP file", RECORD_DESCRIPTION)
    record.add_argument("file", metavar="FILE", help="the file, team.mcap, which must not exist yet; with --recover, it must")
    record.add_argument("--for", dest="span", metavar="SPAN", type=_span_ms, help="end after 10s, 5min, 2h (default: at Ctrl-C)")
    _add_looks(record)
    record.add_argument(
        "--max-size",
        metavar="SIZE",
        type=_size,
        default=0,
        help="begin another file, team-2.mcap, from 500MB or 2GB on (default: 256MB)",
    )
    record.add_argument("--keep", metavar="COUNT", type=whole, default=0, help="of these files, keep so many, the newest")
    record.add_argument(
        "--recover", action="store_true", help="record nothing: give FILE, whose recorder was killed, its end and its index"
    )
    record.set_defaults(function="failover.cli.verbs.board_recordings:record")
    serve = add_act(acts, "serve", some, "the board live, for Foxglove and other programs of its protocol", SERVE_DESCRIPTION)
    serve.add_argument(
        "--foxglove", metavar="PORT", type=_port, required=True, help="listen at this port; 0: at any; 8765 is usual"
    )
    serve.add_argument("--listen", metavar="ADDRESS", default="127.0.0.1", help="listen at this address (default: %(default)s)")
    serve.add_argument(
        "--unsafe-listen", action="store_true", help="allow an ADDRESS that other machines reach: they can read the board"
    )
    _add_looks(serve)
    serve.set_defaults(function="failover.cli.verbs.board_recordings:serve")
    replay = add_act(acts, "replay", some, "a recording, put back on a board at its pace, with its ages", REPLAY_DESCRIPTION)
    replay.add_argument("files", metavar="FILE", nargs="+", help="of one recording, in their order")
    replay.add_argument("--pace", metavar="X", type=_pace, default=1.0, help="so many times as fast (default: 1)")
    replay.add_argument("--loop", action="store_true", help="again and again until Ctrl-C")
    replay.add_argument(
        "--as", dest="prefix", metavar="PREFIX", help="on any board: as private items PREFIX.ROBOT.ITEM of this robot"
    )
    replay.set_defaults(function="failover.cli.verbs.board_recordings:replay")


def add_choice(room: argparse.ArgumentParser) -> None:
    """Which items."""
    for option, what in (("--items", "of this name: * and ? stand for any characters"), ("--robots", "of this robot, likewise")):
        help_ = f"only items {what}; may be given again"
        room.add_argument(option, metavar="PATTERN", action="append", default=[], help=help_)


def add_rate(room: argparse.ArgumentParser) -> None:
    """How often the board is looked at."""
    room.add_argument(
        "--rate", metavar="HZ", type=_rate, default=100, help="looks at the board in a second, 1 to 1000 (default: %(default)s)"
    )


def _add_looks(room: argparse.ArgumentParser) -> None:
    """How the board and the agents are looked at."""
    add_rate(room)
    room.add_argument("--no-decisions", dest="decisions", action="store_false", help="leave out the agents' decisions")
    room.add_argument("--socket", metavar="PATH", help="the control socket of the agent that is asked for decisions")


def _port(text: str) -> int:
    if not text.isascii() or not text.isdigit() or int(text[:6]) > PORT_MAX:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is no port: a number from 0 to {PORT_MAX}")
    return int(text)


def _span_ms(text: str) -> int:
    return _quantity(quantities.span_ms, text)


def _size(text: str) -> int:
    return _quantity(quantities.size_bytes, text)


def _quantity(read: Callable[[str], int], text: str) -> int:
    try:
        return read(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _rate(text: str) -> int:
    number = whole(text)
    if number > RATE_MAX:
        raise argparse.ArgumentTypeError(f"{text!r} is no number from 1 to {RATE_MAX}")
    return number


def _pace(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not PACE_MIN <= number <= PACE_MAX:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is no number from {PACE_MIN} to {PACE_MAX:g}")
    return number


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

RECORD_DESCRIPTION: Final = """
    Record the board into an MCAP file, which Foxglove, Lichtblick, PlotJuggler and Rerun open: each item of each robot is a
    channel /ROBOT/ITEM, each put a message with value, number and age. The log time is the instant at which this command read the
    value, the publish time that minus its age. Decisions of the agents (takeovers and others) are the channel
    failover/decisions. A value that is replaced between two looks is not recorded; the answer counts them.

    The file grows each second. A recorder that is killed loses the last second at most: replay reads such a file as it is,
    other programs after --recover, which keeps the old file as FILE.before. The library comes with the extra "record":
    pip install 'failover[record]'. From --max-size on, or when the index of a file takes much memory, team-2.mcap is begun;
    each file can be read alone, and replay takes them all.

      failover board record team.mcap
      failover board record team.mcap --items 'ball*' --robots robot2 --for 10min
      failover board record team.mcap --max-size 500MB --keep 10
      failover board record --recover team.mcap
    """

SERVE_DESCRIPTION: Final = """
    Show the board live to programs that speak the Foxglove WebSocket protocol (foxglove.sdk.v1): Foxglove, Lichtblick. Channels
    and messages are those of failover board record. A program that subscribes gets the newest value, then each put; it can put
    nothing. In Foxglove: Open connection, Foxglove WebSocket, ws://localhost:8765. The library comes with the extra "foxglove":
    pip install 'failover[foxglove]'.

    The protocol knows no users and no encryption. So this command listens at this machine alone; from another one use
    ssh -L 8765:localhost:8765 ROBOT.

      failover board serve --foxglove 8765
      failover board serve --foxglove 8765 --items ball --items 'pose*' --rate 20
    """

REPLAY_DESCRIPTION: Final = """
    Put the values of a recording on a board again, each at its time and as old as it was. Without an agent this makes a board
    (--board, else this user's): the robot that recorded is this robot there, the others are its team, and programs that are told
    FAILOVER_BOARD run as they did. On an agent's board nothing is replayed under the names of its items: --as PREFIX makes
    private items PREFIX.ROBOT.ITEM, which are removed at the end.

      failover board replay team.mcap --board /dev/shm/yesterday
      failover board replay team.mcap team-2.mcap --pace 10
      failover board replay team.mcap --items ball --loop --as old
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
