"""Replication of a component's state to its standby: the primary's side, and `stored` at the standby, which acknowledges.

Invariants: one snapshot in flight per component (a slower link means fewer snapshots, not longer queues); a position is
acknowledged to the keeper only when it is safe elsewhere, or no other robot is there; a delta counts from the standby's position.
"""

from __future__ import annotations

from checkpoint.model import Position
from failover.core import acts
from failover.core.component import Component, Flight, Turn
from failover.core.election import lease, majority
from failover.core.election.consent import grants, objects
from failover.core.election.pair import supersede
from failover.core.events import (
    Captured,
    CaptureFailed,
    Committed,
    NothingToCapture,
    ShipEnded,
    Stored,
    StoreFailed,
    Unchanged,
    UnderWay,
)
from failover.core.membership import Peer
from failover.core.replication import archived
from failover.core.schedule.slack import LAG_NS_MAX, LAG_PERIODS
from failover.core.types import ENDED, HISTORY_MAX, MS, PEERS_MAX, Config, OnUnsupported, State
from failover.core.wire.messages import NEEDS_BASE, Entry
from failover.core.wire.names import Weight, weight

NS_PER_US = 1_000

_SHOWS = frozenset({State.ABSENT, State.STANDBY, *ENDED})
"""States in which no guard of this robot writes the component's output."""

UNTAKEN_PAUSE = 300
"""Of ``retry_ms``: before a robot that did not take a snapshot may replace a standby once more."""

STILL_SHARE = 10
"""A program stands still for at most one part in so many of its time for its snapshots: where no kernel tells which pages were
written, all of its memory is read meanwhile."""


def choose_standby(component: Component, turn: Turn) -> None:
    """The operator's choice, else one that is not drained, else where it would move back to, else the least loaded living robot.

    Of those the lesser name.

    The operator's choice says nothing where it runs on that very robot. Under ``freeze`` it stays for good.
    """
    if component.standby and _stays(component, turn):
        return
    wanted = component.rules.standby if component.rules.standby != turn.me else ""
    able = [
        peer
        for peer in turn.team.living(turn.now_ns)
        if grants(component, peer, turn.me) and turn.config.keeps(peer.robot) and (not wanted or peer.robot == wanted)
    ]
    if able:

        def placing(peer: Peer) -> tuple[bool, bool, bool, int, Weight]:
            return not turn.config.runs(peer.robot), peer.drained, peer.robot != component.home, peer.load, weight(peer.robot)

        chosen = min(able, key=placing).robot
        if chosen == component.standby:
            return
        component.standby, component.replaced = chosen, ""
        component.due_ns = turn.now_ns
        turn.say(component, f"{component.standby} is its standby")


def may_replace(component: Component, turn: Turn, robot: str) -> bool:
    """Whether this living robot may stand by instead of the present one, which is alive, too.

    Not against the operator's choice, and not under ``freeze`` of a pair, where the standby stays.
    """
    if component.rules.standby not in ("", turn.me, robot) or (component.freezes and not turn.config.by_majority):
        return False
    return turn.config.runs(robot) and grants(component, turn.team.peers[robot], turn.me)


def replace(component: Component, turn: Turn, robot: str) -> None:
    """From now on this robot stands by. The snapshot that is on its way to the other one is called off: the next is a base."""
    flight = component.flight
    if flight is not None and flight.position is not None:
        turn.order(acts.CancelShip(component.name, component.epoch, flight.position, flight.to))
        component.flight = None
    component.replaced, component.standby = component.standby, robot
    component.due_ns = turn.now_ns
    turn.say(component, f"{robot} is its standby, where it would move back to")


def _go_back(component: Component, turn: Turn) -> None:
    """The robot that replaced a standby has not taken the first snapshot: that one stands by again, if it lives."""
    former, component.replaced = component.replaced, ""
    if turn.alive(former):
        turn.say(component, f"{former} is its standby again: {component.standby} did not take a snapshot")
        component.standby, component.due_ns = former, turn.now_ns
        component.return_ns = turn.now_ns + UNTAKEN_PAUSE * turn.config.retry_ms * MS


def _stays(component: Component, turn: Turn) -> bool:
    if turn.is_drained(component.standby) and any(not peer.drained for peer in _robots(component, turn)):
        return component.freezes and not turn.config.by_majority
    if not turn.config.by_majority:
        return turn.alive(component.standby) or component.freezes
    if not turn.alive(component.standby) or objects(component, turn.team.peers[component.standby], turn.me):
        return False
    return turn.config.runs(component.standby) or component.rules.standby == component.standby or not _robots(component, turn)


def _robots(component: Component, turn: Turn) -> list[Peer]:
    """Living robots that could run it: better standbys than a server."""
    living = (peer for peer in turn.team.living(turn.now_ns) if turn.config.runs(peer.robot))
    return [peer for peer in living if grants(component, peer, turn.me)]


def capture(component: Component, turn: Turn, final: bool = False) -> None:
    """Order the next snapshot when it is due and none is in flight."""
    if component.flight is not None or component.unprotected or (turn.now_ns < component.due_ns and not final):
        return
    to = component.standby if turn.alive(component.standby) else ""
    base = component.base_wanted or component.parent is None
    if to:
        entry = _standby_entry(component, turn)
        if entry is None:
            return
        base = base or entry.position != component.parent or bool(entry.flags & NEEDS_BASE)
    component.sequence += 1
    component.flight = Flight(turn.now_ns, turn.now_ns + turn.config.ship_ms * MS, to, final=final)
    lag_ns = 0 if final else min(LAG_PERIODS * _period_ns(component, turn, component.flight), LAG_NS_MAX)
    turn.order(acts.Capture(component.name, component.epoch, base, component.generation, component.sequence, final, lag_ns))


def captured(component: Component, turn: Turn, event: Captured) -> None:
    """The snapshot is in our own store: send it to the standby, or, alone, count from it."""
    flight = component.flight
    if flight is None or flight.position is not None or not _current(component, event.epoch, event.position):
        return
    component.hold(event.position)
    component.still_us = min(component.freeze_us or event.freeze_us, event.freeze_us)
    component.freeze_us, component.degraded, component.awaited = event.freeze_us, "", ""
    if event.parent is not None:  # a base costs more, and there are few
        component.cpu_us, component.cost_us = event.cpu_us, min(component.cpu_us or event.cpu_us, event.cpu_us)
    component.base_wanted = False
    flight.position, flight.parent = event.position, event.parent
    flight.state_ns = max(flight.started_ns - event.age_ns, 0)
    _tell_prune(component, turn)
    to = component.standby if turn.alive(component.standby) else ""
    if not to:
        _checkpoint(component, turn, event.position, is_safe=not turn.config.peers)
        return
    entry = _standby_entry(component, turn)
    fits = event.parent is None or (entry is not None and entry.position == event.parent)
    if not fits or not (turn.config.by_majority or lease.entrust(component, turn, to)) or component.spec is None:
        _give_up(component, turn)
        return
    flight.to = to
    turn.order(
        acts.Ship(component.name, component.epoch, event.position, event.parent, to, component.spec, acknowledged=component.safe)
    )


def unchanged(component: Component, turn: Turn, event: Unchanged) -> None:
    """The newest checkpoint is all there is to know: nothing travels. It grows older, unless the program was looked at."""
    flight = component.flight
    if flight is None or flight.position is not None or (event.epoch, event.sequence) != (component.epoch, component.sequence):
        return
    component.sequence -= 1  # no snapshot bears this number, and so every number that is due for pruning is met
    component.degraded, component.flight, component.took_ns = "", None, 0
    is_theirs = not flight.to or flight.to in component.entrusted
    if event.position != component.acked or not is_theirs:
        component.base_wanted, component.due_ns = True, turn.now_ns
        return
    component.undelivered = ""
    if event.is_current:
        component.acked_ns = max(component.acked_ns, flight.started_ns)
    component.due_ns = max(flight.started_ns + _period_ns(component, turn, flight), turn.now_ns)


def under_way(component: Component, turn: Turn, event: UnderWay) -> None:
    """A capture or a transfer still may take its time: a base of a large program, on a busy machine, takes minutes."""
    if event.epoch != component.epoch:
        return
    for flight in (component.flight, component.archives.get(event.to)):
        if flight is not None and flight.position == event.position and event.to in ("", flight.to):
            flight.until_ns = max(flight.until_ns, turn.now_ns + turn.config.ship_ms * MS)


def capture_failed(component: Component, turn: Turn, event: CaptureFailed) -> None:
    """Skip this one: the program runs on, the last checkpoint stays; say since when it is only that."""
    flight = component.flight
    if flight is None or flight.position is not None or event.epoch != component.epoch:
        return
    _give_up(component, turn)
    component.base_wanted = component.base_wanted or event.needs_base
    if component.degraded != event.message:
        turn.say(component, f"not captured: {event.message}")
    component.degraded = event.message
    if event.unsupported and component.rules.on_unsupported is OnUnsupported.STOP_PROTECTING:
        component.unprotected = True
        turn.say(component, "it is protected no longer: on_unsupported = stop_protecting")


def nothing_to_capture(component: Component, turn: Turn, event: NothingToCapture) -> None:
    """Nothing is wrong: we look again after a while, or as soon as it has committed, perhaps in this moment."""
    flight = component.flight
    if flight is None or flight.position is not None or event.epoch != component.epoch:
        return
    _give_up(component, turn)
    component.degraded, component.awaited = "", event.message
    if flight.is_outdated:
        component.due_ns = turn.now_ns


def committed(component: Component, turn: Turn, event: Committed) -> None:
    """There is something to capture: at once, also after a capture that is under way and may have looked too early."""
    if event.epoch != component.epoch or component.handing is not None:
        return
    component.awaited = ""
    if component.flight is not None:
        component.flight.is_outdated = True
    else:
        component.due_ns = turn.now_ns


def ship_ended(component: Component, turn: Turn, event: ShipEnded) -> None:
    """All bytes are over (the acknowledgement follows soon, or never), or the transfer failed."""
    flight = component.flight
    if flight is None or flight.position != event.position or event.epoch != component.epoch:
        return
    if event.ok:
        flight.until_ns = min(flight.until_ns, turn.now_ns + turn.config.retry_ms * MS)
    else:
        _give_up(component, turn, event.reason)


def acknowledged(component: Component, turn: Turn, sender: str, entry: Entry) -> None:
    """The standby's word on its newest snapshot."""
    flight = component.flight
    if flight is None or flight.position is None or flight.to != sender or not _follows_us(component, turn, entry):
        return
    if entry.position == flight.position:
        if not turn.config.by_majority:
            _checkpoint(component, turn, flight.position, is_safe=True)
    elif entry.flags & NEEDS_BASE and flight.parent is not None:
        turn.order(acts.CancelShip(component.name, component.epoch, flight.position, sender))
        _give_up(component, turn, f"{sender} needs a base")
        component.due_ns = turn.now_ns


def confirm(component: Component, turn: Turn) -> None:
    """Under majority: the standby's position is a checkpoint once a majority has noted that standby.

    The named standby holds all that was acknowledged before: it is named when it has taken the newest snapshot.
    """
    flight = component.flight
    if not turn.config.by_majority or flight is None or flight.position is None or flight.to != component.standby:
        return
    entry = _standby_entry(component, turn)
    if entry is None or entry.position != flight.position or not flight.to:
        return
    if flight.to not in component.entrusted:
        component.entrusted = (flight.to,)
    if majority.noted(component, turn):
        _checkpoint(component, turn, flight.position, is_safe=True)


def overdue(component: Component, turn: Turn) -> None:
    """Give up a snapshot whose standby died or that has been under way for too long."""
    flight = component.flight
    if flight is None:
        return
    lost = bool(flight.to) and flight.position is not None and not turn.alive(flight.to)
    if lost or turn.now_ns >= flight.until_ns:
        if flight.to and flight.position is not None:
            turn.order(acts.CancelShip(component.name, component.epoch, flight.position, flight.to))
        _give_up(component, turn, f"{flight.to or turn.me} did not take it")


def _checkpoint(component: Component, turn: Turn, position: Position, *, is_safe: bool) -> None:
    """The position is a checkpoint: the next delta counts from it. It is safe unless this robot alone holds it."""
    flight = component.flight
    assert flight is not None
    turn.order(acts.Acknowledge(component.name, component.epoch, position, is_safe))
    component.undelivered, component.tries, component.replaced = "", 0, ""
    component.parent = component.acked = position
    if is_safe:
        component.safe = position
    component.trail.append((position, flight.parent))
    component.acked_ns = flight.state_ns
    component.took_ns = turn.now_ns - flight.started_ns if flight.parent is not None else 0
    component.due_ns = max(flight.started_ns + _period_ns(component, turn, flight), turn.now_ns)
    component.flight = None
    if flight.final and component.handing is not None and flight.to == component.handing.to:
        component.handing.yielded = True
        turn.say(component, f"{turn.me} lets {flight.to} claim it")


def _period_ns(component: Component, turn: Turn, flight: Flight) -> int:
    """Between two captures: the operator's period, or seldom: while no standby takes them, or its program bears no more."""
    is_alone = not flight.to or not turn.alive(component.standby)
    wanted_ns = (turn.config.alone_period_ms if is_alone else component.rules.period_ms) * MS
    return max(wanted_ns, least_period_ns(component))


def least_period_ns(component: Component) -> int:
    """Shorter, and the program would stand still for more than its share of the time, or captures would cost more than theirs."""
    return max(STILL_SHARE * component.still_us * NS_PER_US, cost_period_ns(component))


def cost_period_ns(component: Component) -> int:
    """Shorter, and captures would take more processor time than the operator allows."""
    share = component.rules.cpu_share
    return round(component.cost_us * NS_PER_US / share) if share else 0


def _give_up(component: Component, turn: Turn, why: str = "") -> None:
    """Nothing is forgotten: the keeper's next delta counts from the same position. A handover's last delta is not tried twice."""
    if component.handing is not None and component.flight is not None and component.flight.final:
        component.handing.until_ns = turn.now_ns
    component.flight, component.took_ns = None, 0
    component.due_ns = turn.now_ns + turn.config.retry_ms * MS
    if why:
        component.undelivered = why
        turn.say(component, f"a snapshot did not arrive: {why}")
        if component.replaced:
            _go_back(component, turn)


def _standby_entry(component: Component, turn: Turn) -> Entry | None:
    peer = turn.team.peers.get(component.standby)
    entry = peer.entry(component.name) if peer else None
    return entry if entry is not None and _follows_us(component, turn, entry) else None


def _follows_us(component: Component, turn: Turn, entry: Entry) -> bool:
    return (entry.epoch, entry.primary) == (component.epoch, turn.me)


def _current(component: Component, epoch: int, position: Position) -> bool:
    return epoch == component.epoch and (position.generation, position.sequence) == (component.generation, component.sequence)


def _tell_prune(component: Component, turn: Turn) -> None:
    if component.sequence % HISTORY_MAX == 0:
        turn.order(acts.Prune(component.name, component.epoch, component.held[0]))


# The standby's side


def stored(component: Component, turn: Turn, event: Stored) -> None:
    """A snapshot of the primary's is durable here: our next beat acknowledges it. One that came too late is forgotten again."""
    is_overtaken = archived.has_newer(component, event)
    if (event.sender, event.epoch) != component.admitted or component.holding or is_overtaken:
        if event.position not in component.held:
            turn.order(acts.Discard(component.name, component.epoch, event.position))
        return
    supersede(component, turn, event.position)
    component.hold(event.position)
    turn.order(acts.Accept(component.name, component.epoch, event.position))
    component.vouched = (event.acknowledged or component.vouched) if turn.config.by_majority else event.position
    component.bare &= event.sender != component.primary
    component.spec, component.keeps_state, component.stored_ns = event.spec, event.keeps_state, turn.now_ns
    component.try_again()
    component.needs_base, component.unstored = False, ""
    if event.position.sequence % HISTORY_MAX == 0:
        turn.order(acts.Prune(component.name, component.epoch, component.held[0]))


def store_failed(component: Component, turn: Turn, event: StoreFailed) -> None:
    """A snapshot did not fit or could not be written; those that we hold stay."""
    if (event.sender, event.epoch) != component.admitted or component.holding:
        return
    component.needs_base = component.needs_base or event.needs_base
    component.unstored = event.message
    turn.say(component, f"a snapshot from {event.sender} was not stored: {event.message}")


def remember(component: Component, config: Config) -> None:
    """After a restart, two alone: a standby had accepted, or accepts now, the snapshots of the present primacy that it holds."""
    newest = component.held[-1] if component.held else None
    follows = not config.by_majority and component.primary not in ("", config.robot)
    if newest is not None and follows and newest.generation // (PEERS_MAX + 1) == component.epoch:
        component.vouched = newest


def show(component: Component, turn: Turn) -> None:
    """Let readers here see the output up to the newest position that is held here and counts as acknowledged.

    Two alone: the snapshots that a standby has accepted. Under majority the primary says it: members may be about to elect a
    robot that holds less than this one does, and it is the primary that knows when they are not.
    """
    told = component.vouched
    if told is None or told == component.shown or component.state not in _SHOWS:
        return
    due = next((held for held in reversed(component.held) if _is_of_line(held, told)), None)
    if due is not None and due != component.shown:
        component.shown = due
        turn.order(acts.Show(component.name, component.epoch, due))


def _is_of_line(position: Position, told: Position) -> bool:
    """Whether a position is as far as another one of its generation, or earlier."""
    return position.generation == told.generation and position.sequence <= told.sequence
