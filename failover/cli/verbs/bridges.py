"""bridge zenoh: a process between the team and programs of another middleware."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING, Final

from failover.cli.arguments.bridges import USUAL
from failover.cli.connection import connect
from failover.cli.ending import ended_by_signals
from failover.cli.output import render
from failover.cli.verbs.board import board_there
from failover.cli.verbs.board_recordings import chosen, note
from failover.errors import BridgeError, LostAgentError, NoAgentError
from failover.recording.follower import Follower
from failover.recording.foxglove_server import check_address
from failover.recording.stream import Stream

if TYPE_CHECKING:
    from failover.drivers.proxy import Proxy

NO_TEAM: Final = "failover"
_ENDPOINT: Final = re.compile(r"(?P<protocol>[a-z-]+)/\[?(?P<host>[^\[\]/]+?)\]?:(?P<port>[0-9]{1,5})(?P<more>[?#].*)?")


def zenoh(arguments: argparse.Namespace) -> int:
    """Bridge until Ctrl-C or SIGTERM.

    Raises:
        BridgeError: no session comes about; names the endpoint and the cure.
        RecordingError: it would listen for other machines.
    """
    from failover.bridges.zenoh_bridge import Ends, ZenohBridge

    is_usual = not (arguments.connect or arguments.listen or arguments.config)
    ends = Ends(tuple(arguments.connect), (USUAL,) if is_usual else tuple(arguments.listen), arguments.config)
    for endpoint in ends.connect:
        _host(endpoint)
    for endpoint in ends.listen:
        check_address(_host(endpoint), arguments.unsafe_listen)
    prefix = arguments.prefix or _team(arguments)
    with board_there(arguments) as board:
        follower = Follower(board, chosen(arguments), note)
        with ZenohBridge(prefix, ends, follower, _open_proxy if arguments.calls else None) as bridge:
            places = [*ends.connect, *ends.listen] or [ends.config]
            if arguments.json:
                render.as_json({"prefix": prefix, "robot": board.robot, "endpoints": places, "calls": arguments.calls})
            else:
                print(f"the board of {board.robot} is at {prefix}/ROBOT/ITEM, {', '.join(places)}, until Ctrl-C", flush=True)
            stream = Stream(board, follower, bridge)
            with ended_by_signals(stream.end):
                stream.run(arguments.rate, None, each_look=bridge.fulfil)
    return 0


def _host(endpoint: str) -> str:
    found = _ENDPOINT.fullmatch(endpoint)
    if found is None:
        raise BridgeError(f"{endpoint[:60]!r} is no endpoint of zenoh: write PROTOCOL/ADDRESS:PORT, {USUAL}")
    return found["host"]


def _team(arguments: argparse.Namespace) -> str:
    try:
        with connect(arguments) as agent:
            return str(agent.ask("status")["team"])
    except (NoAgentError, LostAgentError):
        return NO_TEAM


def _open_proxy(name: str) -> Proxy:
    from failover.drivers.proxy import proxy

    return proxy(name)
