"""status and why: what the team does, and the story of its decisions."""

from __future__ import annotations

import argparse
from datetime import datetime

from failover.cli import picture, render
from failover.cli.agent import connect
from failover.client.control import Update

COLUMNS = ("at", "robot", "component", "did")
"""Of one line of the story, as the agent names them."""


def status(arguments: argparse.Namespace) -> int:
    """Show the team as a tree; with --watch again and again until Ctrl-C."""
    if arguments.watch:
        return _watch(arguments)
    with connect(arguments) as agent:
        answer = agent.ask("status", team=True)
    if arguments.json:
        render.as_json(answer)
    else:
        render.tree(answer)
    return 0 if picture.is_healthy(answer) else 1


def _watch(arguments: argparse.Namespace) -> int:
    healthy = True
    with connect(arguments) as agent, render.live_tree() as draw:
        try:
            for reply in agent.stream("status", watch=True, every_ms=arguments.every_ms, team=True):
                if isinstance(reply, Update):
                    healthy = picture.is_healthy(reply.value)
                    (render.as_json if arguments.json else draw)(reply.value)
        except KeyboardInterrupt:
            pass
    return 0 if healthy else 1


def why(arguments: argparse.Namespace) -> int:
    """Tell what was seen, by whom, when, and what was done about it."""
    with connect(arguments) as agent:
        answer = agent.ask("why", name=arguments.name or "")
    if arguments.json:
        render.as_json(answer)
        return 0
    lines = [(clock(entry.get("at")), *(str(entry.get(key) or "") for key in COLUMNS[1:])) for entry in answer["story"]]
    if lines:
        render.table(("when", "robot", "component", "what was seen and done"), lines)
    else:
        print("no decisions yet" + (f" about {arguments.name}" if arguments.name else ""))
    return 0


def clock(at: object) -> str:
    """An instant (seconds since 1970) as this machine's wall clock shows it, to the millisecond."""
    return datetime.fromtimestamp(at).astimezone().strftime("%H:%M:%S.%f")[:-3] if isinstance(at, int | float) else str(at or "")
