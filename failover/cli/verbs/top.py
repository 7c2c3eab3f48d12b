"""top: the team on one screen, live, with its orders."""

from __future__ import annotations

import argparse
import importlib.util
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from failover.cli.connection import connect
from failover.cli.output import task_tree
from failover.cli.verbs.tasks import uses_of
from failover.cli.verbs.why import paragraph, told_of_robots
from failover.client.control import Update
from failover.client.process_use import Meter
from failover.errors import ScheduleError, ScreenError
from failover.schedule.overview import Seen, open_schedule, overview, owners

if TYPE_CHECKING:
    from failover.cli.output.top_screen import Picture


def top(arguments: argparse.Namespace) -> int:
    """Show the screen until it is left.

    Raises:
        ScreenError: there is no terminal, or its library is missing.
        NoAgentError: no agent answers; later ones are waited for.
    """
    if importlib.util.find_spec("textual") is None:
        cure = "pip install 'failover[tui]'; failover status --watch does without"
        raise ScreenError(f"failover top needs textual, not installed here: {cure}")
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise ScreenError("failover top needs a terminal; elsewhere: failover status --watch, or failover status --json")
    connect(arguments).close()
    from failover.cli.output import top_screen  # here: it takes a quarter of a second to load

    top_screen.run(AgentSource(arguments))
    return 0


class AgentSource:
    """What the screen shows, from the agent of this robot and its schedule."""

    def __init__(self, arguments: argparse.Namespace) -> None:
        self._arguments = arguments

    def pictures(self) -> Iterator[Picture]:
        """One after the other, until the agent goes away."""
        from failover.cli.output.top_screen import Picture

        meter = Meter()
        with connect(self._arguments) as agent:
            for reply in agent.stream("status", watch=True, every_ms=self._arguments.every_ms, team=True):
                if isinstance(reply, Update):
                    status = reply.value
                    uses = uses_of(agent.peer_pid, status, meter)
                    seen, whose = _tasks(status)
                    yield Picture(status, task_tree.robots(str(status["robot"]), seen, status, whose, uses))

    def story(self, component: str) -> str:
        """What was decided about it, the newest first."""
        with connect(self._arguments) as agent:
            answer = agent.ask("why", name=component)
        told = [paragraph(line) for line in reversed(answer["story"])] or ["no decisions yet"]
        return "\n\n".join((*told[:STORY_MAX], told_of_robots(answer.get("robots") or ())))

    def order(self, verb: str, component: str, epoch: int) -> str:
        """Give an order; what came of it."""
        with connect(self._arguments) as agent:
            answer = agent.ask(verb, name=component, epoch=epoch)
        if verb == "stop":
            return f"{component} has ended"
        return str(answer["sentence"]) if not answer.get("moved", True) else f"{component} runs on {answer['to']} now"


STORY_MAX = 100
"""Decisions that are shown: the last ones."""


def _tasks(status: dict[str, Any]) -> tuple[list[Seen], dict[str, str]]:
    """The tasks of this robot, and which component runs each; none where there is no schedule."""
    try:
        file = open_schedule()
    except ScheduleError:
        return [], {}
    try:
        seen = overview(file)
        return seen, dict(owners(file, seen, status))
    finally:
        file.close()
