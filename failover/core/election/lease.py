"""Lease: how long a primary may act, and when it stands still.

Invariant: while another robot may start the component, it runs here only before ``lease_ns``, and the guard knows that instant.

An agent that restarts arranges a longer lease before it ends: each robot that could start the component meanwhile has promised
not to, on its disk, and waits longer than the lease by the margin (`failover.core.membership`). Under ``majority`` that is a
quorum, under ``pair`` every robot entrusted with it and every other one that is not dead. The next agent finds that lease.
"""

from __future__ import annotations

from failover.core import acts
from failover.core.component import Cause, Component, Turn
from failover.core.election import majority
from failover.core.election.consent import grants
from failover.core.types import MS, State

TELL_SHARE = 4
"""The guard is told of a new lease when it is longer by this part of a lease: not for every beat. Less is not worth a thaw."""

ACTING = frozenset({State.PRIMARY, State.STARTING, State.RECOVERING, State.TAKING_OVER, State.HANDING_OVER})
"""It runs here, or is about to: a restore may take longer than a lease, and so may the last snapshot of a handover."""

OUTLASTS_SHARE = 2
"""An agent that restarts ends once this part of its grace is left at least: the promises come within a few beats."""

RACE_SHARE = 16
"""The lease that the guard knows counts as over this part of a lease early: a longer one could reach it too late."""


def watch(component: Component, turn: Turn) -> None:
    """Count the lease anew; hold the component still when it is over, let it go on when it is back."""
    if component.inherited_ns and _own_ns(component, turn) > turn.now_ns + turn.config.lease_ns // 2:
        _give_back(component, turn)
    ran_out = component.told_ns > 0 and turn.now_ns >= component.told_ns - turn.config.lease_ns // RACE_SHARE
    component.lease_ns = counted_ns(component, turn)
    over = on_lease(component, turn) and (ran_out or turn.now_ns >= component.lease_ns)
    if component.state is State.PRIMARY and over:
        component.move(Cause.LEASE_OVER)
        component.stood, component.inherited_ns = True, 0
        turn.order(acts.Freeze(component.name, component.epoch))
        turn.say(component, f"{turn.me} {Cause.LEASE_OVER}")
    if component.state is State.FROZEN and _may_thaw(component, turn):
        component.move(Cause.LEASE_BACK)
        component.told_ns = component.lease_ns
        component.due_ns = turn.now_ns
        turn.order(acts.Thaw(component.name, component.epoch, component.lease_ns))
        turn.say(component, f"{turn.me} lets it run: it may act")
    elif component.state in ACTING and not _has_given_way(component):
        _tell(component, turn)
    if _is_remembered(component, turn) and component.state is State.PRIMARY and _all_agree(component, turn):
        component.stood = component.ordered = False


def forget_former(component: Component, turn: Turn) -> None:
    """A member that was taken out is entrusted with nothing any more, once it cannot act on what it heard.

    Under ``freeze`` the program would stand still for good: taking it out was a person's word that it is lost.
    """
    former = [one for one in component.entrusted if one != turn.me and one not in turn.team.peers and turn.dead(one)]
    if component.holding and former:
        component.entrusted = tuple(one for one in component.entrusted if one not in former)
        turn.say(component, f"{', '.join(former)} has left the team, and is entrusted with it no more")
    if component.holding and component.standby in former:
        component.standby = ""


def may_act(component: Component, turn: Turn) -> bool:
    """Whether a program that is started now may act: by its lease, and by what the robots entrusted with it say."""
    return not on_lease(component, turn) or _may_thaw(component, turn)


def entrust(component: Component, turn: Turn, robot: str) -> bool:
    """Name the robot that may take over; from now on this robot acts on leases. False when it does not hear us now."""
    if robot in component.entrusted:
        return True
    peer = turn.team.peers.get(robot)
    if peer is None or not grants(component, peer, turn.me) or turn.team.lease_ns(robot) <= turn.now_ns:
        return False
    component.entrusted = (*component.entrusted, robot)
    component.lease_ns = component.told_ns = component.inherited_ns = 0
    watch(component, turn)
    return True


def counted_ns(component: Component, turn: Turn) -> int:
    """Until when this robot may act; 0 where no other robot may start the component. A lease granted once stays granted."""
    if not on_lease(component, turn):
        return 0
    own_ns = _own_ns(component, turn)
    if turn.config.by_majority or component.freezes:
        return max(component.lease_ns, own_ns)
    if component.inherited_ns:
        return component.inherited_ns
    return max(own_ns, _promised_ns(component, turn)) if turn.leaving else own_ns


def _own_ns(component: Component, turn: Turn) -> int:
    """The same by the words that peers have said in this life of ours alone."""
    if turn.config.by_majority:
        return majority.granted_ns(component, turn)
    if component.freezes:
        return min(_granted_ns(component, turn, robot) for robot in component.entrusted)
    is_alone = component.inherited_ns > 0 and not _each_agrees(component, turn)
    return 0 if is_alone else turn.now_ns + turn.config.lease_ns


def _give_back(component: Component, turn: Turn) -> None:
    """This life has a lease of its own: the guard forgets the longer one, so that a loss from now on is met as ever."""
    component.inherited_ns = 0
    component.lease_ns = component.told_ns = _own_ns(component, turn)
    turn.order(acts.SetLease(component.name, component.epoch, component.lease_ns, is_asked=True))


def inherit(component: Component, turn: Turn, lease_ns: int) -> bool:
    """Have a program that was found running go on under the lease that its guard has; False where it has none, or needs none."""
    if not on_lease(component, turn) or lease_ns <= turn.now_ns + turn.config.lease_ns // RACE_SHARE:
        return False
    component.lease_ns = component.told_ns = component.inherited_ns = lease_ns
    return True


def borrows(component: Component, turn: Turn) -> bool:
    """Whether its guard may let it act on a lease that an earlier life of this agent arranged."""
    return turn.now_ns < component.borrowed_ns


def outlasts(component: Component, turn: Turn) -> bool:
    """Whether the program may act long enough without this agent, and no robot that hears us starts it meanwhile."""
    enough_ns = turn.now_ns + turn.config.restart_grace_ms * MS // OUTLASTS_SHARE
    if on_lease(component, turn):
        return component.told_ns >= enough_ns
    return all(
        turn.team.lease_ns(peer.robot) >= enough_ns for peer in turn.team.living(turn.now_ns) if turn.config.runs(peer.robot)
    )


def _promised_ns(component: Component, turn: Turn) -> int:
    """Under pair: until when no robot that hears us, or is entrusted with it, takes it over; 0 where one has promised nothing."""
    others = {robot for robot in turn.team.peers if turn.config.runs(robot) and not turn.dead(robot)}
    return min(_granted_ns(component, turn, robot) for robot in others.union(component.entrusted))


def first_ns(component: Component, turn: Turn) -> int:
    """The lease that a program begins with: 0 only where it needs none; one that is over holds it still from the start."""
    return max(counted_ns(component, turn), 1) if on_lease(component, turn) else 0


def on_lease(component: Component, turn: Turn) -> bool:
    """Whether another robot may start the component."""
    return turn.config.quorum > 1 if turn.config.by_majority else bool(component.entrusted)


def _granted_ns(component: Component, turn: Turn, robot: str) -> int:
    peer = turn.team.peers.get(robot)
    return turn.team.lease_ns(robot) if peer is not None and grants(component, peer, turn.me) else 0


def _is_remembered(component: Component, turn: Turn) -> bool:
    """Whether there is something about this copy that counts where two meet again: until all peers have agreed to it."""
    return component.stood or (component.ordered and not turn.config.by_majority)


def _all_agree(component: Component, turn: Turn) -> bool:
    """Whether every peer is heard, and consents: none of them runs another copy."""
    return all(turn.alive(peer.robot) and grants(component, peer, turn.me) for peer in turn.team.peers.values())


def _has_given_way(component: Component) -> bool:
    """Whether another robot may claim the component: this copy, which is held still, needs no lease any more."""
    return component.handing is not None and component.handing.yielded


def _may_thaw(component: Component, turn: Turn) -> bool:
    """Under majority and ``freeze`` a lease; otherwise each robot entrusted agrees by its newest word, or is dead."""
    if component.freezes or turn.config.by_majority:
        return not on_lease(component, turn) or turn.now_ns < component.lease_ns - turn.config.lease_ns // TELL_SHARE
    return _each_agrees(component, turn)


def _each_agrees(component: Component, turn: Turn) -> bool:
    """Whether each robot entrusted with it consents by its newest word, or is dead."""
    return all(turn.dead(robot) or _granted_ns(component, turn, robot) > turn.now_ns for robot in component.entrusted)


def _tell(component: Component, turn: Turn) -> None:
    grown = component.lease_ns - component.told_ns >= turn.config.lease_ns // TELL_SHARE
    if grown or (component.told_ns and not component.lease_ns):
        component.told_ns = component.lease_ns
        turn.order(acts.SetLease(component.name, component.epoch, component.lease_ns))
