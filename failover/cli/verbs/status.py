"""status: shows the state of the team."""

from __future__ import annotations

import argparse

from failover.cli.connection import connect
from failover.cli.output import render, team_tree
from failover.client.control import Update


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
    return 0 if team_tree.is_healthy(answer) else 1


def _watch(arguments: argparse.Namespace) -> int:
    healthy = True
    with connect(arguments) as agent, render.live_tree() as draw:
        try:
            for reply in agent.stream("status", watch=True, every_ms=arguments.every_ms, team=True):
                if isinstance(reply, Update):
                    healthy = team_tree.is_healthy(reply.value)
                    (render.as_json if arguments.json else draw)(reply.value)
        except KeyboardInterrupt:
            pass
    return 0 if healthy else 1
