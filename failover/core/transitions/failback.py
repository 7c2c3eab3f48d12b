"""Returns a component by itself to the robot that its operator prefers: asks that robot first whether it could run it.

A handover that the other robot can only refuse would hold the program still for nothing, again and again.
"""

from __future__ import annotations

from typing import Final

from failover.core import acts
from failover.core.component import Component, Turn
from failover.core.events import Inquired
from failover.core.transitions import handover
from failover.core.types import MS, State

PAUSE: Final = 10
"""Of ``retry_ms``: how long a component stays before it goes back, and between two tries."""

UNFIT_PAUSE: Final = 30
"""Of ``retry_ms``: before a robot that lacks something is asked again. It looks as often by itself, so the cure is soon seen."""


def review(component: Component, turn: Turn) -> None:
    """Ask the preferred robot, once it keeps up and some time has passed; the handover waits for a snapshot under way."""
    prefer = component.rules.prefer
    if prefer in ("", turn.me) or prefer != component.standby or turn.now_ns < component.return_ns or turn.is_drained(prefer):
        return
    if component.acked is not None and turn.alive(prefer):
        component.return_ns = turn.now_ns + PAUSE * turn.config.retry_ms * MS
        turn.order(acts.Inquire(component.name, component.epoch, prefer))


def inquired(component: Component, turn: Turn, event: Inquired) -> None:
    """The robot has answered: go there, or wait and say why."""
    wanted = component.standby if turn.drained else component.rules.prefer
    if component.state is not State.PRIMARY or (event.epoch, event.to) != (component.epoch, wanted):
        return
    if event.lacks:
        component.return_ns = component.drain_ns = turn.now_ns + UNFIT_PAUSE * turn.config.retry_ms * MS
        if event.lacks != component.unfit:
            how = "move" if turn.drained else "return"
            turn.say(component, f"it does not {how} to {event.to}, which could not resume it: {'; '.join(event.lacks)}")
    component.unfit = event.lacks
    if not event.lacks:
        handover.begin(component, turn, event.to, 0)


def note(component: Component) -> str:
    """Why it has not returned, for the status; "" where there is nothing to say."""
    prefer = component.rules.prefer
    if component.state is not State.PRIMARY or not component.unfit or prefer != component.standby:
        return ""
    return f"its return waits: {prefer} could not resume it: {'; '.join(component.unfit)}"
