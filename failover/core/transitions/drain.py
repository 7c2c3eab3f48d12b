"""Empties a robot before maintenance: what runs there moves to its standbys, one planned move after the other.

A drained robot still votes, and keeps checkpoints for others. It starts nothing anew, and is the last that takes a component
over: where no other robot could, that is better than a component that no robot runs. As soon as another one can, it moves there.
"""

from __future__ import annotations

from failover.core import acts
from failover.core.component import Component, Turn
from failover.core.transitions.failback import PAUSE
from failover.core.types import MS, State


def review(component: Component, turn: Turn) -> None:
    """Ask the standby whether it could run the component, once it has a checkpoint; `failback.inquired` hands it over then.

    Also while a snapshot is under way: the handover waits for it. Where each takes longer than the period, one always is.
    """
    if turn.now_ns < component.drain_ns or hindrance(component, turn):
        return
    component.drain_ns = turn.now_ns + PAUSE * turn.config.retry_ms * MS
    turn.order(acts.Inquire(component.name, component.epoch, component.standby))


def hindrance(component: Component, turn: Turn) -> str:
    """Why a component does not leave this drained robot; "" where it is about to, or is not here."""
    if component.state is not State.PRIMARY:
        return f"it is {component.state}" if component.holding else ""
    if not component.standby or not turn.alive(component.standby):
        return "no other robot that is heard keeps its checkpoints; start one, or failover stop ends it"
    if not turn.config.runs(component.standby):
        return f"{component.standby}, which keeps its checkpoints, runs nothing; start another robot"
    if turn.is_drained(component.standby):
        return f"{component.standby}, which keeps its checkpoints, is drained too; failover undrain {component.standby}"
    if component.acked is None or component.parent is None:
        return f"{component.standby} has no checkpoint of it yet{f': {component.degraded}' if component.degraded else ''}"
    return ""


def note(component: Component, turn: Turn) -> str:
    """For the status of a component that is still at a drained robot; "" elsewhere."""
    if not turn.drained or not component.holding:
        return ""
    why = hindrance(component, turn)
    if not why and component.unfit:
        why = f"{component.standby} could not resume it: {'; '.join(component.unfit)}"
    return (
        f"{turn.me} is drained, and it moves to {component.standby}" if not why else f"{turn.me} is drained, and it stays: {why}"
    )
