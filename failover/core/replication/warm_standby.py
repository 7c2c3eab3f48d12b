"""Prepares a takeover at the standby, so that the takeover is one message: the prepared process has done all but its first step.

For a program that keeps its state itself that process is the program, started. For a program that is captured from outside it is
a stopped process with the newest checkpoint's memory (the ready copy). The robot decides which of the two, and whether it can be
had. One process waits per component, at the robot that its primary has entrusted, and nowhere else.

Invariants: nothing waits at a robot that runs the component, or to which its primary ships nothing; the process that waits is the
one that a takeover would start.
"""

from __future__ import annotations

from failover.core import acts
from failover.core.component import Component, Turn
from failover.core.events import Warmed
from failover.core.types import ComponentSpec, State, Waiting
from failover.core.wire.messages import WARM


def review(component: Component, turn: Turn) -> None:
    """Order the program that should wait here, and the end of one that should wait no longer."""
    if component.state is State.CLAIMING:  # the waiting program is about to be used
        return
    if component.holding:  # the order to run it has used the waiting program, or ended it
        _forget(component)
        component.stored_ns = -1
        return
    spec = _wanted(component)
    if spec is None and component.waiting is not None:
        turn.order(acts.Cool(component.name, component.epoch))
        _forget(component)
    elif spec is not None and (waiting := _waiting(component, spec)) != component.waiting:
        _forget(component)
        component.waiting, component.waiting_epoch = waiting, component.epoch
        turn.order(acts.Warm(component.name, component.epoch, spec))


def warmed(component: Component, turn: Turn, event: Warmed) -> None:
    """The program that waits here, or would, is ready now, or is not (any more)."""
    if component.waiting is None or event.epoch != component.waiting_epoch:
        return
    if event.ready and not component.warm:
        turn.say(component, f"its program waits at {turn.me}: a takeover is one message")
    elif event.message and event.message != component.cold:
        turn.say(component, f"its program does not wait at {turn.me}: {event.message}")
    component.warm, component.cold = event.ready, event.message


def is_warm(component: Component, turn: Turn) -> bool:
    """Whether its program waits at its standby, as far as this robot knows."""
    if not component.holding:
        return component.warm
    peer = turn.team.peers.get(component.standby)
    entry = peer.entry(component.name) if peer is not None and turn.alive(component.standby) else None
    return entry is not None and entry.epoch == component.epoch and bool(entry.flags & WARM)


def _wanted(component: Component) -> ComponentSpec | None:
    """The program that should wait here: None where this robot would start none, or may not."""
    stands_by = component.state is State.STANDBY and component.trusted and not component.waits and not component.unable
    is_known = component.keeps_state or component.stored_ns >= 0  # no primary has said whether a program that ran here does
    return component.spec if stands_by and component.newest is not None and is_known else None


def _waiting(component: Component, spec: ComponentSpec) -> Waiting:
    return Waiting(spec.launch, spec.owner, component.keeps_state)


def _forget(component: Component) -> None:
    component.waiting, component.waiting_epoch = None, 0
    component.warm, component.cold = False, ""
