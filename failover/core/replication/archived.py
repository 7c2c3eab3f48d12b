"""Checkpoints from the archive, for robots that do not hear the primary: with ``rule = "etcd"``, and where members vote.

The worker of such a robot copies the newest checkpoint from the archive into this robot's store, in advance; here is when that
counts. Invariants:

* A robot takes nothing from the archive of a component that it runs, that has ended, or whose primary it hears while etcd is
  bound to that one.
* A checkpoint from there never takes the place of a later one.
* A checkpoint that the store found damaged is held no more: this robot looks into the archive again before it takes over.
* Once etcd would vote for another robot, or the old primary lives and lets go (it may have lost its disk), this robot looks into
  the archive again before it claims the component; once more, if it hears that primary no longer. What was put there before is
  in its store then, and it claims without the wait for the old primary (``fresh``). Where the archive does not answer, that wait
  (``patience_ms``) is the limit. An operator's handover does not go before that look either; a promotion does.
* A robot that had all that was acknowledged, and has lost it with its disk (``bare``), waits for the old primary all the same,
  which may come back with more than the archive has. So does a robot that hears it tell of more.
* A component that ran elsewhere does not begin anew here before the archive has said that it has no copy.
* Where the archive alone tells of a component, and no member of the team, it may have ended, or have been released and run on:
  no robot claims it by itself.

Where members vote without etcd, a copy is for the day on which no robot has a checkpoint any more:

* A robot that held nothing when the copy came is ``bare``: it does not count as one that holds all that was acknowledged, and
  says so (``BARE``). So the robots that may hold more are waited for, as long as `failover.core.election.majority` says.
* It waits for silent servers and witnesses as long: a server may hold more, and both may know that the component has ended.
* A robot that holds all that was acknowledged never waits for the archive.
"""

from __future__ import annotations

from checkpoint.model import Position
from failover.core import acts
from failover.core.component import Cause, Component, Turn
from failover.core.election import majority
from failover.core.election.consent import state_of
from failover.core.election.pair import living_entries
from failover.core.events import Archived, Damaged, Fetched, Looked, Stored
from failover.core.types import ENDED, MS, PEERS_MAX, Config, State
from failover.core.wire.messages import FREE

KEPT = 2
"""Checkpoints from the archive, each a whole one."""

_IDLE = frozenset({State.ABSENT, State.STANDBY})

HEARD_LATELY = 4
"""Loyalties: a standby that heard its primary until then waits for the archive no longer than for one try."""


def fetched(component: Component, turn: Turn, event: Fetched) -> None:
    """A checkpoint of the archive is durable in our store: stand by with it, or forget it again."""
    component.seen, component.looked_ns = max(component.seen, event.epoch), max(component.looked_ns, event.begun_ns)
    if event.position in component.held:
        return
    if not _takes(component, turn, event.position):
        turn.order(acts.Discard(component.name, component.epoch, event.position))
        return
    if component.state is State.ABSENT:
        component.move(Cause.FOLLOW)
    had_none = not component.held
    has_lost = component.bare or (had_none and component.has_begun and component.is_to_hold_all(turn.me))
    component.held = [*component.held, event.position][-KEPT:]
    component.spec, component.keeps_state = event.spec, event.keeps_state
    component.stored_ns = turn.now_ns
    component.fetched = event.position, turn.now_ns - event.age_ns
    component.lags = component.lags and not event.begun_ns
    if turn.config.coordinator:
        component.bare = has_lost and (component.vouched is None or event.position < component.vouched)
    else:
        component.bare = component.bare or had_none
    component.try_again()
    component.unstored = ""
    turn.order(acts.Accept(component.name, component.epoch, event.position))
    turn.order(acts.Prune(component.name, component.epoch, component.held[0]))
    turn.say(component, f"{turn.me} has its checkpoint {event.position.sequence} from the archive")


def remember(component: Component, config: Config) -> None:
    """After a restart, where members vote: what is held of a component that is on no record came from the archive."""
    if config.copies_ms and not config.coordinator and component.epoch == 0 and component.held:
        component.bare = True


def recall(component: Component, turn: Turn) -> None:
    """Others told of a component that was on no record here: what is held of it came from the archive.

    Where the others count on this robot to hold all of it, it has lost that.
    """
    component.bare |= turn.config.copies_ms > 0 and bool(component.held) and component.is_to_hold_all(turn.me)


def has_newer(component: Component, event: Stored) -> bool:
    """Whether a copy from the archive came before an older checkpoint that a server, or a standby, gave back meanwhile."""
    is_given_back = component.bare and event.sender != component.primary
    return is_given_back and component.newest is not None and event.position < component.newest


def damaged(component: Component, turn: Turn, event: Damaged) -> None:
    """It is held here no more: look into the archive, which may have it, before this robot goes on from an older one."""
    if not turn.config.copies_ms or component.state not in _IDLE or event.position not in component.held:
        return
    component.begun = component.has_begun
    component.held = [position for position in component.held if position != event.position]
    if not component.held and component.is_to_hold_all(turn.me):
        component.bare = component.begun
    if gave(component, event.position):
        component.fetched = None
    component.lags, component.looked_ns, component.fresh = True, 0, False
    component.try_again()  # what failed was that checkpoint
    turn.say(component, f"its checkpoint {event.position.sequence} is damaged on the disk of {turn.me}, which takes it again")


def _takes(component: Component, turn: Turn, position: Position) -> bool:
    newest = component.held[-1] if component.held else None
    is_late = position.generation in component.lost or position.generation // (PEERS_MAX + 1) <= component.void
    is_ours_alone = component.state in _IDLE and (component.freed_ns > 0 or not turn.alive(component.primary))
    return is_ours_alone and not is_late and (newest is None or newest < position)


def looked(component: Component, event: Looked) -> None:
    """All that the archive had of this component when that look began is in our store; or it has something newer (``lags``)."""
    if component.name in event.skipped:
        return
    component.lags = component.name in event.behind
    if not component.lags:
        component.looked_ns = max(component.looked_ns, event.begun_ns)


def gave(component: Component, position: Position) -> bool:
    """Whether a checkpoint came from the archive: the time of its file here does not say how old its state is."""
    return component.fetched is not None and component.fetched[0] == position


def archived(component: Component, event: Archived) -> None:
    """A copy of what runs here is in the archive, as it was at that instant or a moment before."""
    if event.epoch == component.epoch and component.holding:
        component.sealed, component.sealed_ns = event.position, event.begun_ns if event.position is not None else -1


def is_alone(component: Component, turn: Turn) -> bool:
    """Whether the archive alone can protect it: no standby of it is heard, and a robot that etcd votes for would look there."""
    return bool(turn.config.coordinator) and turn.config.copies_ms > 0 and component.holding and not turn.alive(component.standby)


def sealed_ns(component: Component) -> int:
    """When the state was taken of which the archive has a copy; -1: it has none of this primacy."""
    is_as_it_was = component.sealed is not None and component.sealed == component.acked
    return max(component.sealed_ns, component.acked_ns) if is_as_it_was else component.sealed_ns


def void(component: Component) -> None:
    """It begins anew after an end: what the archive has of it up to that end is another life of it."""
    if component.state in ENDED:
        component.void = max(component.void, component.epoch)


def review(component: Component, turn: Turn) -> None:
    """Note since when a takeover is possible, and have the archive looked into since then."""
    if component.state is State.CLAIMING:
        return
    had_let_go, component.let_go = component.let_go, turn.alive(component.primary) and not turn.gone(component.primary)
    is_possible = component.let_go or _would_coordinator(component, turn)
    if component.state not in _IDLE or not component.free or not is_possible:
        component.freed_ns, component.fresh = 0, False
        return
    is_lost = had_let_go and not component.let_go  # what it has put there meanwhile is to be found
    component.freed_ns = turn.now_ns if is_lost else component.freed_ns or turn.now_ns
    has_looked = component.looked_ns >= component.freed_ns
    is_sole = not component.bare and majority.is_sole(component, turn, turn.me, component.newest)
    component.fresh = bool(turn.config.coordinator) and has_looked and bool(component.held) and is_sole
    if not has_looked and turn.now_ns >= component.asked_ns + turn.config.retry_ms * MS:
        component.asked_ns = turn.now_ns
        turn.order(acts.Look(component.name, component.epoch))


def _would_coordinator(component: Component, turn: Turn) -> bool:
    """Whether etcd, if it has a vote and is heard, is bound to no primary of the component."""
    if not turn.config.coordinator or not turn.alive(turn.config.coordinator):
        return True
    entry = turn.team.peers[turn.config.coordinator].entry(component.name)
    return entry is None or bool(entry.flags & FREE)


def waits(component: Component, turn: Turn) -> bool:
    """Whether this robot looks into the archive before it claims the component."""
    if not turn.config.copies_ms:
        return False
    if is_told_by_it_alone(component):
        return True
    if not turn.config.coordinator and _holds_all(component, turn):
        return False  # as if there were no archive
    if 0 < component.freed_ns <= component.looked_ns:
        return False
    if component.newest is None and component.epoch > 0:  # our own, of which no checkpoint was ever made, is nowhere else
        return component.primary != turn.me or component.has_begun
    if component.primary == turn.me and is_own(component, turn) and not component.lags:
        return False
    return turn.now_ns < _until_ns(component, turn)


def refuse(component: Component, turn: Turn) -> str:
    """Why an operator's order to resume it here comes too soon; "" if it does not."""
    if not component.freed_ns or is_told_by_it_alone(component) or not waits(component, turn):
        return ""
    left_s = (_until_ns(component, turn) - turn.now_ns) // (1_000 * MS) + 1
    looks = f"{turn.me} asks the archive for a newer checkpoint of {component.name}"
    return f"{looks}, for {left_s} s at most; ask again then, or promote {turn.me}"


def _holds_all(component: Component, turn: Turn) -> bool:
    has_lost = component.bare or component.lags or component.newest is None
    return not has_lost and majority.holds_all(component, turn, turn.me, component.newest)


def awaited(component: Component, turn: Turn) -> list[str]:
    """The servers and witnesses for which a robot with but a copy waits: they may hold more, or know of an end.

    They are silent; or the robot that they name denies their word, perhaps because it has lost its vote record, too.
    """
    since_ns = turn.now_ns - turn.config.patience_ms * MS

    def is_awaited(member: str) -> bool:
        is_silent = not turn.alive(member) and not majority.is_lost(component, turn, member)
        return is_silent or turn.denied.get((member, component.name), since_ns) > since_ns

    return [one for one in sorted({*turn.config.servers, *turn.config.witnesses} - {turn.me}) if is_awaited(one)]


def ended_for(component: Component, turn: Turn) -> str:
    """The server or the witness that says that it has ended; "" for none.

    They end nothing by their word alone. Where no robot remembers the end, an operator says what is to become of the copy.
    """
    for robot, entry in living_entries(component, turn):
        if not turn.config.runs(robot) and state_of(entry) in ENDED and entry.epoch >= component.epoch:
            return robot
    return ""


def may_be_outdated(component: Component, turn: Turn) -> bool:
    """Whether a robot with but a copy of the archive does not go on from it yet, beyond what votes decide."""
    is_copy = turn.config.copies_ms > 0 and component.bare
    return is_copy and bool(awaited(component, turn) or ended_for(component, turn))


def is_told_by_it_alone(component: Component) -> bool:
    """Whether no record, no member and no configuration tells of the component: who ran it last, and how it ended, is unknown."""
    return component.epoch == 0 and bool(component.held) and not component.autostart


def is_own(component: Component, turn: Turn) -> bool:
    """Whether the newest checkpoint here was taken here: of this robot's own primacy."""
    return component.newest is not None and component.newest.generation % (PEERS_MAX + 1) == turn.config.place


def _until_ns(component: Component, turn: Turn) -> int:
    """Until when this robot waits for the archive."""
    peer = turn.team.peers.get(component.primary)
    lately_ns = component.freed_ns - HEARD_LATELY * turn.config.loyalty_ns
    is_standby = turn.me in component.entrusted and peer is not None and peer.boot > 0 and peer.heard_ns >= lately_ns
    limit_ms = turn.config.retry_ms if is_standby and not component.lags else turn.config.patience_ms
    return component.freed_ns + limit_ms * MS
