"""Which components an operator recovered at which site: each robot asks those of other sites, and tells its core.

The question and its answer are an order on the replication link (`agent.worker.network.remote_orders`). What follows from an
answer is decided in `failover.core.election.sites`. A robot asks each other one as soon as that is connected, and again after a
pause: a site that comes back after a cut, or after a loss of power, hears soon that a program of it goes on elsewhere.

Loaded where there are robots of other sites.
"""

from __future__ import annotations

import asyncio
import time
from typing import Any, Final, Literal, Protocol

import msgspec

from agent.config import Settings
from agent.errors import AgentError, RefusedError
from agent.main_loop.messages import Told
from agent.system.crash import end_worker_on_mistake
from agent.worker.network.remote_orders import RECOVERED, Errands
from failover.core.events import Event, Recovered, SitesHeard
from failover.core.types import COMPONENTS_MAX

ASK_S: Final = 2.0
"""Between two questions to one robot."""

LOOK_S: Final = 0.25
"""Between two looks whether a robot that was not heard is connected: a robot that boots waits for its word."""

AGAIN_S: Final = 30.0
"""So often the core is told what has not changed."""

PATIENCE_S: Final = 10.0
"""For an answer on a link that loses packets."""


class Recovery(msgspec.Struct, frozen=True):
    """A component that an operator recovered where the answer comes from; ``primary``: who runs it there, or ended it."""

    component: str
    epoch: int
    primary: str


class Answer(msgspec.Struct, frozen=True):
    """All of them."""

    recovered: tuple[Recovery, ...]


class Lines(Protocol):
    """What of `agent.worker.hub.Switchboard` is needed here."""

    settings: Settings
    errands: Errands

    def hindrance(self, peer: str) -> str: ...

    def tell(self, event: Event) -> None: ...

    async def ask(self, what: Literal["status", "why"]) -> Told: ...


class Recoveries:
    """Both sides: what this robot hears, and what it tells. Lives in the worker's loop.

    The core is told what has changed since the last answer, and all of it now and then: it may not have known the component.
    """

    def __init__(self, lines: Lines) -> None:
        self._lines = lines
        self._asks: dict[str, asyncio.Task[None]] = {}
        self._heard: set[str] = set()
        self._told: dict[str, tuple[float, frozenset[Recovery]]] = {}
        self._is_told = False

    async def run(self) -> None:
        """Ask, as long as this robot lives."""
        try:
            while True:
                self._look()
                await asyncio.sleep(LOOK_S)
        finally:
            for task in self._asks.values():
                task.cancel()

    def _look(self) -> None:
        far = {name: robot.site for name, robot in self._lines.settings.far.items() if robot.role == "robot"}
        for robot, site in far.items():
            task = self._asks.get(robot)
            if (task is None or task.done()) and not self._lines.hindrance(robot):
                self._asks[robot] = asyncio.create_task(self._ask(robot, site))
                self._asks[robot].add_done_callback(end_worker_on_mistake)
        if not self._is_told and self._heard >= set(far.values()):
            self._is_told = True
            self._lines.tell(SitesHeard())

    async def _ask(self, robot: str, site: str) -> None:
        try:
            said = await self._lines.errands.send(robot, RECOVERED, {}, patience_s=PATIENCE_S)
            answer = msgspec.convert(said, Answer)
        except (RefusedError, msgspec.ValidationError):
            pass  # the connection was lost, or its release knows no such question
        else:
            self._tell(robot, site, frozenset(answer.recovered[:COMPONENTS_MAX]))
            self._heard.add(site)
        await asyncio.sleep(ASK_S)

    def _tell(self, robot: str, site: str, said: frozenset[Recovery]) -> None:
        """A robot speaks for the robots of its own site."""
        now_s, (told_s, told) = time.monotonic(), self._told.get(robot, (-AGAIN_S, frozenset()))
        if now_s - told_s >= AGAIN_S:
            told_s, told = now_s, frozenset()
        members = self._lines.settings.team.at_site(site)  # by now
        for one in said - told:
            if {robot, one.primary} <= members.keys():
                self._lines.tell(Recovered(one.component, one.epoch, one.primary))
        self._told[robot] = (told_s, said)

    async def told(self) -> dict[str, Any]:
        """Answer a robot of another site.

        Raises:
            AgentError: the main loop does not answer.
        """
        view = (await self._lines.ask("status")).status
        if view is None or not view.informed:
            raise AgentError("this agent is starting, and has not heard each robot of its site")
        found = (Recovery(one.name, one.epoch, one.primary or view.robot) for one in view.components if one.recovered)
        answer: dict[str, Any] = msgspec.to_builtins(Answer(tuple(found)))
        return answer
