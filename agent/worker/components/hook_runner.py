"""Decides when a component's hooks run, whose commands they are, and what they are told."""

from __future__ import annotations

import asyncio
import signal
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from agent.errors import AgentError
from agent.hook_kinds import Kind, signal_in
from agent.system import clock
from agent.worker.components import hooks
from agent.worker.components.context import Surroundings, program_of
from agent.worker.components.hooks import Hook, Occasion
from agent.worker.components.statistics import Figures
from checkpoint.snapshot import format
from failover.core import acts, events
from failover.core.event_log.decisions import SAID
from failover.core.types import ComponentSpec

CAPTURE_PAUSE_S: Final = 10
"""Between two runs of before_capture: a whole snapshot that cannot be taken is tried again every second."""

CAPTURE_LIMIT_S: Final = 5.0
"""How long before_capture may take, also where limit_s allows more: a handover has ten seconds in all, and acknowledgements,
deltas and stops of the component wait behind it."""


class Occasions(Struct):
    """The occasions of one component. Its figures hold the complaints of a hook; ``failover why`` tells how each run went."""

    name: str
    around: Surroundings
    figures: Figures
    _spec: ComponentSpec | None = None
    """Of the program that runs here."""
    _prepared_ns: int = field(default=-CAPTURE_PAUSE_S * 10**9)
    """When before_capture began last."""

    async def before_start(self, act: acts.Start) -> None:
        """Run the hook that is due before it begins here.

        Raises:
            AgentError: it failed, and the program must not run here without it.
        """
        await self._prepare("before_start", act.spec, self._occasion(act, hooks.STARTED))

    async def before_capture(self, act: acts.Capture, pid: int) -> None:
        """Run the hook that is due before a whole snapshot, or the last one of a handover; the program runs on meanwhile.

        The agent takes the snapshot even when the hook fails: a snapshot of an unprepared program is better than none.
        """
        pause_ns = CAPTURE_PAUSE_S * 10**9
        if not self._hook("before_capture", self._spec).command:
            return
        if act.hold or (act.base and clock.now_ns() - self._prepared_ns >= pause_ns):
            self._prepared_ns = clock.now_ns()
            await self._run("before_capture", self._spec, replace(self._occasion(act, hooks.CAPTURED), pid=pid))

    async def before_resume(self, act: acts.Restore, newest: int, age_ns: int) -> Occasion | None:
        """Run the hook that is due before it goes on here. Return why it does; None without a hook for it here.

        Args:
            newest: descriptor of the newest snapshot, which is so old.

        Raises:
            AgentError: it failed, and the program must not run here without it.
        """
        self.runs_here(act.spec)
        if not (self._hook("before_resume", act.spec).command or self._hook("after_resume", act.spec).command):
            return None
        source = (await asyncio.to_thread(format.read_outline, newest)).machine.robot
        occasion = self._occasion(act, act.why, source, age_ns)
        await self._prepare("before_resume", act.spec, occasion)
        return occasion

    def prepares(self, spec: ComponentSpec | None) -> bool:
        """Whether this robot is got ready before it goes on here: an address is taken over, a device attached."""
        return bool(self._hook("before_resume", spec).command)

    def told_by(self, act: acts.Restore) -> tuple[int, int] | None:
        """The signal by which the program itself is told that it goes on here, and its value; None where a command is run."""
        number = _signal_in(self._hook("after_resume", act.spec).command)
        return (number, act.generation) if number else None

    def told(self, number: int, failure: str) -> None:
        """How it went to tell the program by a signal, which has gone on."""
        self.figures.hooks.pop("after_resume", None)
        name = signal.Signals(number).name
        if failure:
            self.figures.hooks["after_resume"] = f"after_resume (signal:{name}) failed on {self.around.places.robot}: {failure}"
        said = self.figures.hooks.get("after_resume") or f"after_resume: it got {name} before its next instruction"
        self.around.tell(events.Noticed(self.name, said))

    async def after_resume(self, spec: ComponentSpec | None, occasion: Occasion, pid: int) -> None:
        """Run the hook that is due once it has gone on here."""
        if _signal_in(self._hook("after_resume", spec).command):
            return
        await self._run("after_resume", spec, replace(occasion, pid=pid))

    def runs_here(self, spec: ComponentSpec | None) -> None:
        """From now on this is the program that captures are of."""
        self._spec = spec

    def _occasion(self, act: acts.Start | acts.Capture | acts.Restore, why: str, source: str = "", age_ns: int = 0) -> Occasion:
        return Occasion(self.name, self.around.places.robot, act.epoch, act.generation, why, source, age_ns)

    def _hook(self, kind: Kind, spec: ComponentSpec | None) -> Hook:
        """This robot's own command for the occasion, else the one that came with the program, with its user's rights."""
        here = self.around.here(self.name).hooks
        limit_s = min(here.limit_s, CAPTURE_LIMIT_S) if kind == "before_capture" else here.limit_s
        if spec is None or here.command(kind):
            return Hook(here.command(kind), limit_s)
        return Hook(dict(spec.launch.hooks).get(kind, ()), limit_s, program_of(spec.launch).inheritance)

    async def _prepare(self, kind: Kind, spec: ComponentSpec | None, occasion: Occasion) -> None:
        """Run one without which the program perhaps must not run here.

        Raises:
            AgentError: that is so, and it failed.
        """
        failure = await self._run(kind, spec, occasion)
        if failure and self.around.here(self.name).hooks.must_prepare:
            raise AgentError(f"{self.name} does not run here unprepared: {failure}")

    async def _run(self, kind: Kind, spec: ComponentSpec | None, occasion: Occasion) -> str:
        """Run one, where there is one; why it failed, "" if it did not."""
        hook = self._hook(kind, spec)
        self.figures.hooks.pop(kind, None)
        if not hook.command:
            return ""
        began_ns = clock.now_ns()
        outcome = await self.around.hooks.run(kind, hook, occasion)
        if outcome.failure:
            self.figures.hooks[kind] = outcome.failure + ("; the checkpoint was taken without it" * (kind == "before_capture"))
        said = f"{SAID}{outcome.last_line}" if outcome.last_line else ""
        took_ms = (clock.now_ns() - began_ns) / 1e6
        told = outcome.failure or f"{kind} ({' '.join(hook.command)}) ended well after {took_ms:.0f} ms"
        self.around.tell(events.Noticed(self.name, told + said))
        return outcome.failure


def _signal_in(command: tuple[str, ...]) -> int:
    """Of a command that may have come from another robot: a wrong signal name is found out when it is run."""
    try:
        return signal_in(command)
    except ValueError:
        return 0
