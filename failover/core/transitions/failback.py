"""Returns a component by itself to the robot that its operator prefers: asks that robot first whether it could run it.

A handover that the other robot can only refuse would hold the program still for nothing, again and again.
That robot, or the one where the component was started, stands by again some time after it is back.
"""

from __future__ import annotations

from typing import Final

from failover.core import acts
from failover.core.component import Component, Turn
from failover.core.events import Inquired
from failover.core.replication import standby
from failover.core.transitions import handover
from failover.core.types import MS, State

PAUSE: Final = 10
"""Of ``retry_ms``: how long a component stays before it goes back, a robot must be back to stand by, and between two tries."""

UNFIT_PAUSE: Final = 30
"""Of ``retry_ms``: before a robot that lacks something is asked again. It looks as often by itself, so the cure is soon seen."""


def review(component: Component, turn: Turn) -> None:
    """Ask the robot where it would move back to, some time after it began to run here: a handover waits for a snapshot under way.

    Where another robot stands by, the first answer makes that one the standby. Only to a preferred robot it returns by itself.
    """
    home, pause_ns = component.home, PAUSE * turn.config.retry_ms * MS
    if home in ("", turn.me) or turn.is_drained(home) or not turn.alive(home):
        component.back_ns = 0
        return
    component.back_ns = component.back_ns or turn.now_ns
    if turn.now_ns < component.return_ns:
        return
    if home == component.standby:
        is_due = bool(component.rules.prefer)
    else:
        is_due = turn.now_ns >= component.back_ns + pause_ns and standby.may_replace(component, turn, home)
    if component.acked is not None and is_due:
        component.return_ns = turn.now_ns + pause_ns
        turn.order(acts.Inquire(component.name, component.epoch, home))


def inquired(component: Component, turn: Turn, event: Inquired) -> None:
    """The robot has answered: go there, or wait and say why."""
    wanted = component.standby if turn.drained else component.home
    if component.state is not State.PRIMARY or (event.epoch, event.to) != (component.epoch, wanted):
        return
    if event.lacks:
        component.return_ns = component.drain_ns = turn.now_ns + UNFIT_PAUSE * turn.config.retry_ms * MS
        if event.lacks != component.unfit:
            how = "move" if turn.drained else "return"
            turn.say(component, f"it does not {how} to {event.to}, which could not resume it: {'; '.join(event.lacks)}")
    component.unfit = event.lacks
    if event.lacks:
        return
    if event.to != component.standby:
        if event.has_said and turn.alive(event.to) and standby.may_replace(component, turn, event.to):
            standby.replace(component, turn, event.to)
    elif turn.drained or component.rules.prefer:
        handover.begin(component, turn, event.to, 0)


def note(component: Component, turn: Turn) -> str:
    """Why it has not returned, for the status; "" where there is nothing to say."""
    prefer = component.rules.prefer
    if component.state is not State.PRIMARY or not component.unfit or not prefer or turn.drained:
        return ""
    return f"its return waits: {prefer} could not resume it: {'; '.join(component.unfit)}"
