"""status: shows the state of the team."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

from failover.cli.connection import connect
from failover.cli.output import render, team_tree
from failover.client.control import Update
from failover.client.health import is_unwell


def status(arguments: argparse.Namespace) -> int:
    """Show the team as a tree; with --watch again and again until Ctrl-C."""
    if arguments.watch:
        return _watch(arguments)
    with connect(arguments) as agent:
        answer = _about(agent.ask("status", team=True), arguments.name)
    _drawing(arguments)(answer)
    return _exit_status(answer, arguments)


def _about(answer: dict[str, Any], name: str | None) -> dict[str, Any]:
    """All of it, or what concerns one component.

    Raises:
        AgentRefusedError: none has this name, or several have it.
    """
    return answer if name is None else answer | {"components": [team_tree.named(answer, name)]}


def _drawing(arguments: argparse.Namespace) -> Callable[[dict[str, Any]], None]:
    if arguments.json:
        return render.as_json
    if arguments.brief:
        return lambda answer: print(render.spoken("\n".join(team_tree.brief(answer))), flush=True)
    if arguments.name is not None:
        return lambda answer: render.table(("", answer["components"][0]["name"]), team_tree.details(answer["components"][0]))
    return render.tree


def _exit_status(answer: dict[str, Any], arguments: argparse.Namespace) -> int:
    is_well = team_tree.is_healthy(answer) if arguments.name is None else not is_unwell(answer["components"][0])
    return 0 if is_well else 1


def _watch(arguments: argparse.Namespace) -> int:
    status = 0
    as_tree = not (arguments.json or arguments.brief or arguments.name)
    with connect(arguments) as agent, render.live_tree() if as_tree else nullcontext(_drawing(arguments)) as draw:
        try:
            for reply in agent.stream("status", watch=True, every_ms=arguments.every_ms, team=True):
                if isinstance(reply, Update):
                    answer = _about(reply.value, arguments.name)
                    status = _exit_status(answer, arguments)
                    draw(answer)
        except KeyboardInterrupt:
            pass
    return status
