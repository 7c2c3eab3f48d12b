"""When the operator's commands are run for a component, whose they are, and what they are told."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from agent import hooks
from agent.errors import AgentError
from agent.figures import Figures
from agent.hooks import Hook, Kind, Occasion
from agent.surroundings import Surroundings, program_of
from checkpoint import format
from failover.core import acts
from failover.core.types import ComponentSpec


@dataclass(frozen=True, slots=True)
class Occasions:
    """Of one component. What a hook had to complain of stands in its figures."""

    name: str
    around: Surroundings
    figures: Figures

    async def before_start(self, act: acts.Start) -> None:
        """Run what is to be run before it begins here.

        Raises:
            AgentError: it failed, and the program must not run here without it.
        """
        await self._run("before_start", act.spec, self._occasion(act.epoch, hooks.STARTED))

    async def before_resume(self, act: acts.Restore, newest: int, age_ns: int) -> Occasion | None:
        """Run what this robot's operator wants before it goes on here; why it does, where anybody is to be told.

        Args:
            newest: descriptor of the newest snapshot, which is so old.

        Raises:
            AgentError: it failed, and the program must not run here without it.
        """
        here = self.around.here(self.name)
        if not (here.before_start or here.on_resume or (act.spec is not None and act.spec.launch.on_resume)):
            return None
        source = (await asyncio.to_thread(format.read_outline, newest)).machine.robot
        occasion = self._occasion(act.epoch, act.why, source, age_ns)
        await self._run("before_start", act.spec, occasion)
        return occasion

    async def resumed(self, spec: ComponentSpec | None, occasion: Occasion) -> None:
        """Run what is to be run once it has gone on here."""
        await self._run("on_resume", spec, occasion)

    def _occasion(self, epoch: int, why: str, source: str = "", age_ns: int = 0) -> Occasion:
        return Occasion(self.name, self.around.places.robot, epoch, why, source, age_ns)

    async def _run(self, kind: Kind, spec: ComponentSpec | None, occasion: Occasion) -> None:
        """Run this robot's own command for the occasion, else the one that came with the program.

        Raises:
            AgentError: it failed, and the program must not run here without it.
        """
        here = self.around.here(self.name)
        hook = Hook(here.before_start if kind == "before_start" else here.on_resume, here.hook_s)
        if kind == "on_resume" and not hook.command and spec is not None:
            hook = Hook(spec.launch.on_resume, here.hook_s, program_of(spec.launch).inheritance)
        self.figures.hook = await self.around.hooks.run(kind, hook, occasion)
        if self.figures.hook and kind == "before_start" and here.must_prepare:
            raise AgentError(f"{self.name} does not run here unprepared: {self.figures.hook}")
