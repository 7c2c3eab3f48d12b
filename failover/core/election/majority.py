"""The rule ``majority``: robots, servers and witnesses elect each primary. Here: which member is free to vote, and for whom.

* *One vote an epoch.* Naming a robot as the primary of an epoch is the vote. It is on the disk before the member says it, and the
  member never gives it to a second robot in that epoch.
* *Loyalty.* A member votes for another robot than the primary it follows only when it is free: the primary is silent for a lease
  and a margin, says itself that it runs nothing, or gives way. A primary acts on leases that a majority has granted by echoes.
  Any two majorities share a member, and that member voted only after the lease it had granted was over: so there are never two
  valid leases.
* *Pre-vote.* Members say in heartbeats whether they are free. No robot claims before a majority is free: a robot that is cut off
  raises no epoch. A robot whose copy is held still, without a lease, says so, too: it gives that copy up to a claim by which
  nothing is lost (`failover.core.election.votes`). Its followers stay bound: they may have granted it a part of a lease.
* *Nothing acknowledged is lost.* A primary acknowledges a standby's position once a majority has noted that standby. Members vote
  for robots that hold as much; for others only when those were out of reach for ``patience_ms``, or by an operator's order.
* *The robot with a valid lease is the primary.* It answers a later epoch that was claimed in vain by one above that. A robot
  without one gives its copy up to an elected one, and to a later epoch's that holds as much; otherwise it contends for votes.
"""

from __future__ import annotations

from collections.abc import Iterator

from checkpoint.model import Position
from failover.core.component import Component, Turn
from failover.core.election.consent import grants, kept, state_of
from failover.core.membership import Peer
from failover.core.types import ENDED, HOLDING, MS, State
from failover.core.wire.messages import FREE, FRESH, OPEN, ORDERED, STARTS, Entry

_BOUND = HOLDING | {State.STOPPING}
"""States in which the robot's copy may still be there."""


def look(component: Component, turn: Turn) -> None:
    """Note how this member would vote now; its next beat says so."""
    component.free = is_free(component, turn)
    component.open = component.free and _all_gone(component, turn)
    component.free |= component.state is State.FROZEN and not leased(component, turn)


def is_free(component: Component, turn: Turn) -> bool:
    """Whether this member is bound to no primary of the component."""
    if component.state in _BOUND:
        return False
    primary = component.primary
    if primary == turn.me:
        return True
    peer = turn.team.peers.get(primary)
    if peer is None:
        return turn.dead(primary) and turn.team.rested(turn.now_ns)
    if turn.gone(primary):
        return True
    if turn.team.is_owed(primary, turn.now_ns):
        return False
    entry = peer.entry(component.name)
    if entry is not None:
        return turn.alive(primary) and state_of(entry) not in _BOUND
    return turn.alive(primary) and peer.complete and turn.now_ns >= peer.since_ns + turn.config.loyalty_ns


def may_follow(component: Component, turn: Turn, sender: str, entry: Entry) -> bool:
    """Whether to vote for the sender, which holds the primacy of its epoch or claims it."""
    if entry.epoch == component.epoch and component.primary == turn.me:
        return elected(component, turn, sender, entry.epoch)  # our own claim of it came to nothing
    if entry.epoch == component.epoch and component.primary not in ("", sender):
        return False
    bound = not (is_free(component, turn) or sender == component.primary or _gives_way(component, turn, sender))
    if bound:
        return elected(component, turn, sender, entry.epoch)
    is_fresh = bool(entry.flags & FRESH) and is_sole(component, turn, sender, entry.position)
    return bool(entry.flags & ORDERED) or is_fresh or eligible(component, turn, sender, entry.position)


def is_sole(component: Component, turn: Turn, robot: str, position: Position | None) -> bool:
    """Whether no robot but a primary that is not heard may hold more than this one has, from the archive."""
    theirs = _position_at(component, turn, component.primary)
    has_less = theirs is not None and (position is None or position < theirs)
    return not has_less and not set(component.entrusted) - {robot}


def may_record_end(component: Component, turn: Turn, entry: Entry) -> bool:
    """Whether to believe a member that says the component has ended: as one would follow the robot that ended it."""
    ender = entry.primary
    if ender == component.primary or not component.primary or is_free(component, turn):
        return True
    implied = ender != turn.me and not turn.alive(ender)  # the vote that it had from itself, which it cannot tell
    return elected(component, turn, ender, entry.epoch, implied)


def eligible(component: Component, turn: Turn, robot: str, position: Position | None) -> bool:
    """Whether nothing that was acknowledged is lost if this robot goes on from ``position``."""
    return component.open or component.state in ENDED or holds_all(component, turn, robot, position)


def elected(component: Component, turn: Turn, robot: str, epoch: int, implied: int = 0) -> bool:
    """Whether a majority of the others names that robot, none of them with a copy of its own: its election is a fact.

    Args:
        implied: votes of members that cannot tell them.
    """
    words = (entry for _, entry in _words(component, turn) if state_of(entry) is not State.STOPPING)
    return implied + sum((entry.epoch, entry.primary) == (epoch, robot) for entry in words) >= turn.config.quorum


def won(component: Component, turn: Turn) -> bool:
    """Whether a majority has voted for our claim, and heard that we make it."""
    heard = (peer for peer in turn.team.peers.values() if peer.echoed >= component.claim_counter)
    return 1 + sum(grants(component, peer, turn.me) for peer in heard) >= turn.config.quorum


def may_claim(component: Component, turn: Turn, position: Position | None) -> bool:
    """The pre-vote: a majority is free, and would have this robot go on from ``position``."""
    if not component.free or not (component.open or component.fresh or holds_all(component, turn, turn.me, position)):
        return False
    willing = 1 + sum(_would(component, turn, peer, position) for peer in turn.team.living(turn.now_ns))
    return willing >= turn.config.quorum


def noted(component: Component, turn: Turn) -> bool:
    """Whether a majority has noted the standby that this primary has named."""
    known = sum(
        (entry.epoch, entry.primary, entry.standby) == (component.epoch, turn.me, component.named)
        for _, entry in _words(component, turn)
    )
    return bool(component.named) and 1 + known >= turn.config.quorum


def granted_ns(component: Component, turn: Turn) -> int:
    """Until when a majority lets this primary act; 0 while it has none."""
    grants_ns = sorted(
        (turn.team.lease_ns(peer.robot) if grants(component, peer, turn.me) else 0 for peer in turn.team.peers.values()),
        reverse=True,
    )
    others = turn.config.quorum - 1
    return grants_ns[others - 1] if others else 0


def leased(component: Component, turn: Turn) -> bool:
    """Whether this robot's right to act is beyond doubt at this instant."""
    if not component.holding or component.state is State.CLAIMING:
        return False
    return turn.config.quorum == 1 or turn.now_ns < component.lease_ns


def starters(component: Component, turn: Turn) -> Iterator[str]:
    """The living robots that would start it from the beginning."""
    for peer in turn.team.living(turn.now_ns):
        entry = peer.entry(component.name)
        if entry is not None and entry.flags & STARTS and not peer.drained:
            yield peer.robot


def _sure(component: Component, turn: Turn) -> tuple[str, ...]:
    """The robots that hold all that was acknowledged: the primary and those it has entrusted; this one not, if it has lost it."""
    lost = turn.me if component.bare else ""
    return tuple(robot for robot in (component.primary, *component.entrusted) if robot not in ("", lost))


def holds_all(component: Component, turn: Turn, robot: str, position: Position | None) -> bool:
    """Whether a robot is one of those, or has at least as much as one of them."""
    return _covers(component, turn, _sure(component, turn), robot, position)


def _covers(component: Component, turn: Turn, sure: tuple[str, ...], robot: str, position: Position | None) -> bool:
    if not sure or robot in sure:
        return True
    theirs = (_position_at(component, turn, one) for one in sure)
    return position is not None and any(one is not None and one <= position for one in theirs)


def _position_at(component: Component, turn: Turn, robot: str) -> Position | None:
    """The position from which a living robot says that it can restore, if it has lost nothing."""
    if robot == turn.me:
        return None if component.bare else component.newest
    peer = turn.team.peers.get(robot)
    entry = peer.entry(component.name) if peer is not None and turn.alive(robot) else None
    return kept(entry) if entry is not None else None


def _all_gone(component: Component, turn: Turn) -> bool:
    """Whether the robots that hold all that was acknowledged were waited for long enough, or are back without it."""
    return all(is_lost(component, turn, robot) for robot in _sure(component, turn))


def is_lost(component: Component, turn: Turn, robot: str) -> bool:
    """Whether a member was waited for long enough, or is back without what it held."""
    if robot == turn.me:
        return component.bare or component.newest is None
    peer = turn.team.peers.get(robot)
    if peer is None:
        return True
    if not turn.alive(robot):
        return turn.now_ns >= peer.heard_ns + turn.config.patience_ms * MS
    entry = peer.entry(component.name)
    if entry is None:
        return peer.complete
    return kept(entry) is None and state_of(entry) not in _BOUND


def _would(component: Component, turn: Turn, peer: Peer, position: Position | None) -> bool:
    """Whether a peer would vote for us, by its own notes; one that does not know the component is bound to no robot."""
    entry = peer.entry(component.name)
    if entry is None:
        return peer.complete
    sure = tuple(robot for robot in (entry.primary, entry.standby) if robot)
    is_sure = component.fresh or _covers(component, turn, sure, turn.me, position)
    return bool(entry.flags & OPEN) or (bool(entry.flags & FREE) and is_sure)


def _gives_way(component: Component, turn: Turn, robot: str) -> bool:
    """Whether our primary hands it over to that robot."""
    peer = turn.team.peers.get(component.primary)
    entry = peer.entry(component.name) if peer is not None else None
    return entry is not None and entry.epoch == component.epoch and entry.yields_to == robot


def _words(component: Component, turn: Turn) -> Iterator[tuple[str, Entry]]:
    for peer in turn.team.peers.values():
        entry = peer.entry(component.name)
        if entry is not None:
            yield peer.robot, entry
