"""Replication to servers: besides its standby, a primary sends each server the checkpoints that it has acknowledged.

Invariants: a server gets acknowledged positions only, in their order; one snapshot at a time is on its way to each server. A
server that does not keep up gets a whole checkpoint instead of the deltas, at most every ``archive_ms``.
"""

from __future__ import annotations

from checkpoint.model import Position
from failover.core import acts
from failover.core.component import Component, Flight, Turn
from failover.core.election import majority
from failover.core.election.consent import grants, state_of
from failover.core.election.pair import admit, living_entries, placing, vacant
from failover.core.events import ShipEnded
from failover.core.membership import Peer
from failover.core.types import MS, PEERS_MAX, State
from failover.core.wire.messages import HOLDS, UNABLE, WANTS, Entry

GIVEN_AWAY_TRIES = 2
"""After so many takeovers that failed here a robot sends the checkpoint to another one."""

_IDLE = (State.ABSENT, State.STANDBY)


def advance(component: Component, turn: Turn) -> None:
    """Do what is due for each server of a running primary."""
    for server in turn.config.servers:
        peer = turn.team.peers.get(server)
        if peer is not None and server != component.standby:
            _advance_one(component, turn, peer)


def ship_ended(component: Component, turn: Turn, event: ShipEnded) -> None:
    """The bytes are over, or did not arrive; the server's beats decide."""
    flight = component.archives.get(event.to)
    if flight is None or flight.position != event.position or event.epoch != component.epoch:
        return
    pause_ns = turn.now_ns + turn.config.retry_ms * MS
    flight.until_ns = min(flight.until_ns, pause_ns)


def _advance_one(component: Component, turn: Turn, peer: Peer) -> None:
    flight = component.archives.get(peer.robot)
    entry = peer.entry(component.name)
    if flight is not None:
        arrived = entry is not None and entry.position == flight.position
        if not arrived and turn.now_ns < flight.until_ns and turn.alive(peer.robot):
            return
        if not arrived and flight.position is not None:
            turn.order(acts.CancelShip(component.name, component.epoch, flight.position, peer.robot))
        del component.archives[peer.robot]
    if entry is not None and component.acked and turn.alive(peer.robot) and grants(component, peer, turn.me):
        _send(component, turn, peer.robot, entry.position)


def _send(component: Component, turn: Turn, server: str, has: Position | None) -> None:
    following = next((one for one, parent in component.trail if has is not None and parent == has), None)
    whole = following is None
    position = component.acked if whole else following
    if position is None or position == has or position not in component.held or component.spec is None:
        return
    if whole and turn.now_ns < component.archived_ns:
        return
    if whole:
        component.archived_ns = turn.now_ns + turn.config.archive_ms * MS
    component.archives[server] = Flight(turn.now_ns, turn.now_ns + turn.config.ship_ms * MS, server, position, has)
    parent = None if whole else has
    turn.order(
        acts.Ship(component.name, component.epoch, position, parent, server, component.spec, whole, acknowledged=component.safe)
    )


# The way back


def give_back(component: Component, turn: Turn) -> None:
    """Send the checkpoint of this server, or (``on_loss = hold``) this standby, to the robot that is to run it."""
    flight, mine = component.flight, component.newest
    if flight is not None and (turn.now_ns >= flight.until_ns or not turn.alive(flight.to)):
        component.flight = flight = None
    if flight is not None or mine is None or component.spec is None or turn.now_ns < component.due_ns:
        return  # also after a refusal: the other side's words and its acts may differ for a moment
    heir = _heir(component, turn)
    if heir and turn.alive(heir) and _lacks(component, turn.team.peers[heir], mine):
        component.flight = Flight(turn.now_ns, turn.now_ns + turn.config.ship_ms * MS, heir, mine)
        turn.order(
            acts.Ship(component.name, component.epoch, mine, None, heir, component.spec, whole=True, acknowledged=component.shown)
        )
        turn.say(component, f"{turn.me} gives its checkpoint back to {heir}")


def _heir(component: Component, turn: Turn) -> str:
    """The robot that is to run it: the one that an operator chose, else its primary.

    A server, and a robot that could not resume it, turn to others, too, and wait for robots that may hold something newer.
    """
    chosen = next((robot for robot, entry in living_entries(component, turn) if entry.flags & WANTS), "")
    if chosen:
        return chosen
    is_able = not component.unable or component.tries < GIVEN_AWAY_TRIES
    if turn.config.runs(turn.me) and (component.waits or is_able):
        return component.primary if component.waits else ""
    if not vacant(component, turn) or not _is_sure(component, turn):
        return ""
    able = [peer for peer in turn.team.living(turn.now_ns) if turn.config.runs(peer.robot)]
    able = [peer for peer in able if _is_able(component, peer) and (peer.robot == component.primary or not component.waits)]
    order = sorted(able, key=lambda peer: (peer.robot != component.primary, placing(component, turn, peer.robot)))
    return order[0].robot if order else ""


def _is_sure(component: Component, turn: Turn) -> bool:
    """Whether no silent robot may hold a newer checkpoint; of the pair's rule a robot need not know."""
    if turn.config.runs(turn.me) and not turn.config.by_majority:
        return True
    return component.free and (component.open or majority.holds_all(component, turn, turn.me, component.newest))


def _is_able(component: Component, peer: Peer) -> bool:
    entry = peer.entry(component.name)
    return entry is None or not entry.flags & UNABLE


def _lacks(component: Component, peer: Peer, mine: Position) -> bool:
    entry = peer.entry(component.name)
    if entry is None:
        return peer.complete
    later = entry.epoch > component.epoch
    return not later and state_of(entry) in _IDLE and (entry.position is None or entry.position < mine)


def admit_a_return(component: Component, turn: Turn) -> None:
    """The checkpoint that a server, or (``on_loss = hold``) the standby, kept for us may come back; or one an operator wants."""
    if not turn.config.runs(turn.me) or not vacant(component, turn):
        return
    best = offer(component, turn, is_ordered=component.wanted is not None)
    if best is not None and (component.newest is None or component.newest < best[1]):
        admit(component, turn, best[0], best[1].generation // (PEERS_MAX + 1))


def offer(component: Component, turn: Turn, *, is_ordered: bool) -> tuple[str, Position] | None:
    """The newest checkpoint that a living member would send us: the member, and the position. ``is_ordered``: by an operator."""
    offers = [
        (entry.position, turn.config.runs(robot), robot)
        for robot, entry in living_entries(component, turn)
        if entry.position is not None and _returns(component, turn, robot, entry, is_ordered=is_ordered)
    ]
    best = max(offers, default=None)
    return (best[2], best[0]) if best else None


def _returns(component: Component, turn: Turn, robot: str, entry: Entry, *, is_ordered: bool) -> bool:
    if state_of(entry) not in _IDLE:
        return False
    if is_ordered or not turn.config.runs(robot):
        return True
    is_kept_for_us = bool(entry.flags & HOLDS) and entry.primary == turn.me and entry.epoch == component.epoch
    return is_kept_for_us or bool(entry.flags & UNABLE)
