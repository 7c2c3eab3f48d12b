"""Decides which robot runs a component: claims, consent, and the consequences of another robot's word. `votes` shares half of it.

A primacy is an epoch and the robot that all robots which know of it name as its primary. The rules:

* A robot claims a *vacant* component: no living robot holds it, and every robot is either heard or dead.
* A robot that has just started does not claim a component that another robot ran last, or was entrusted with, and of which it has
  heard no word yet, for ``boot_patience_ms``.
* Of two copies that meet again, the one that never stopped acting continues, above the other's epoch.
* Naming the claimant at its epoch is consent; hearing a claim raises the hearer's own epoch before it answers.
* Of two claims the higher epoch wins; at the same epoch the one that acts already, then the lesser name W.
* Under ``when_alone = freeze`` a robot starts a component only with every robot's consent, or with the *right to act alone*: it
  was entrusted by the primary that has gone silent, or it was the primary itself and had entrusted no robot. One robot has that
  right.

The rule ``majority`` (`failover.core.election.votes`) shares `vacant`, `claim`, `begin` and `follow`.
"""

from __future__ import annotations

from checkpoint.model import Position
from failover.core import acts
from failover.core.component import LOST_MAX, Cause, Component, Turn
from failover.core.election import lease
from failover.core.election.consent import grants, state_of
from failover.core.membership import Peer
from failover.core.types import ENDED, EPOCH_MAX, HOLDING, MS, PEERS_MAX, Resumption, State
from failover.core.wire.messages import BEGUN, HOLDS, ORDERED, SAFE, STOOD, UNABLE, UNPROTECTED, Entry
from failover.core.wire.names import Weight, weight

ACTS_FULLY = 2
_ACTS = {State.CLAIMING: 0, State.FROZEN: 1}
"""At one epoch: a claim yields to a copy that stands still, and that one to a copy that acts."""

_RUNS_HERE = frozenset({State.PRIMARY, State.FROZEN, State.HANDING_OVER})
_END_CAUSES = {State.FINISHED: Cause.FINISH, State.FAILED: Cause.FAIL, State.RELEASED: Cause.RELEASE}


# Claiming


def consider(component: Component, turn: Turn) -> None:
    """Claim the component if it is vacant and this robot is the one to run it."""
    if component.state not in (State.ABSENT, State.STANDBY) or turn.now_ns < component.retry_ns or not vacant(component, turn):
        return
    if component.is_exhausted or component.unable or not turn.config.runs(turn.me) or waits_after_boot_ns(component, turn):
        return
    entries = living_entries(component, turn)
    best = max((position for _, entry in entries if (position := entry.position)), default=None)
    mine = component.newest
    if component.waits and component.held:
        chosen = component.primary == turn.me and mine is not None and (best is None or best <= mine)
    elif mine is None:
        chosen = best is None and may_start_afresh(component, turn)
    else:
        chosen = best is None or best < mine or (best == mine and first_of_equals(component, turn, entries, mine))
    if chosen and _may_go_on(component, turn):
        claim(component, turn, mine, "no robot runs it")


def unheard(component: Component, turn: Turn) -> tuple[str, ...]:
    """Under pair: the robots that ran it last, or may have taken it over since, of which there was no word in this life of ours.

    They may be well: the network of a robot that boots often comes later than its agent. If no robot is known to have run it,
    any robot may.
    """
    if turn.config.by_majority:
        return ()
    last = (component.primary,) if component.primary else turn.team.peers
    theirs = dict.fromkeys((*last, *component.entrusted))
    return tuple(robot for robot in theirs if robot != turn.me and turn.team.unheard(robot))


def _begins_in_the_dark(component: Component, turn: Turn) -> bool:
    """Whether no robot is known to have run it, or one that may run it has said nothing in this life of ours."""
    return not turn.config.by_majority and (not component.primary or bool(unheard(component, turn)))


def exhaustion(component: Component, me: str) -> str:
    """Why no robot can claim it, for an operator; "" where there are epochs left."""
    if not component.is_exhausted:
        return ""
    epoch = max(component.epoch, component.seen)
    return (
        f"no epoch is left above {epoch}, which {me} has on record; failover-agent mend {component.name} --epoch N, at each "
        "member with such a record, sets it right (docs/bad-input.md)"
    )


def waits_after_boot_ns(component: Component, turn: Turn) -> int:
    """For how long this robot waits for them still before it claims the component; 0: not any more."""
    absent = unheard(component, turn)
    if not absent:
        return 0
    left_ns = turn.config.boot_patience_ms * MS - turn.team.lived_ns(turn.now_ns)
    if not component.primary or any(robot not in turn.team.peers for robot in absent):
        # A robot that knocks may be that one: our team file may be old.
        left_ns = max(left_ns, turn.team.strangers_until_ns() - turn.now_ns)
    return max(left_ns, 0)


def vacant(component: Component, turn: Turn, *, is_ordered: bool = False) -> bool:
    """No living member holds it or knows its end, and each member is heard or dead (or its agent restarts: `_is_passed_over`).

    A server or a witness repeats an end that it has heard of: its word, or its silence, counts until a majority knows of none.

    Args:
        is_ordered: an operator says so of robots whose packets cannot be authenticated.
    """
    is_doubtful = False
    if component.is_elsewhere:
        return False
    if component.primary not in ("", turn.me) and component.primary not in turn.team.peers and not turn.dead(component.primary):
        return False  # it was taken out of the team, and may act until the lease that it had here is over
    for robot, peer in turn.team.peers.items():
        if turn.gone(robot) or (is_ordered and turn.team.keeps_waiting(robot, turn.now_ns)):
            continue
        if not turn.alive(robot):
            if _is_passed_over(component, turn, peer):
                continue
            return False
        if robot == component.primary and turn.team.is_owed(robot, turn.now_ns):
            return False
        if not _is_free_of(component, robot, peer):
            if turn.config.runs(robot):
                return False
            is_doubtful = True
    return not is_doubtful or _is_not_ended(component, turn)


def _is_passed_over(component: Component, turn: Turn, peer: Peer) -> bool:
    """Whether votes decide without a robot whose agent restarts: its last word is that it has nothing to do with the component.

    Were it the primary all the same, the majority that elected it would be bound to it. Only a majority can do without it so:
    under pair each robot is waited for. So is one that may hold the newest checkpoint, until it is dead.
    """
    robot = peer.robot
    if not turn.config.by_majority or component.is_to_hold_all(robot):
        return False
    return turn.team.awaited_ns(robot, turn.now_ns) > 0 and _is_free_of(component, robot, peer)


def _is_free_of(component: Component, robot: str, peer: Peer) -> bool:
    """Whether a peer that lives neither holds the component nor knows its end, by its fresh word."""
    entry = peer.entry(component.name)
    return peer.complete if entry is None else not _takes(component, robot, entry)


def _is_not_ended(component: Component, turn: Turn) -> bool:
    """Whether a majority knows of no end: none was acknowledged then, for that takes a majority."""
    free = (turn.alive(robot) and _is_free_of(component, robot, peer) for robot, peer in turn.team.peers.items())
    return (component.state not in ENDED) + sum(free) >= turn.config.quorum


def _takes(component: Component, robot: str, entry: Entry) -> bool:
    """Whether this word says that a robot holds the component, or that it has ended."""
    state = state_of(entry)
    if state in (State.FROZEN, State.RECOVERING) and component.elects and component.primary != robot:
        return False  # it contends for the primacy with a copy that does not act: votes decide
    return state in HOLDING or (state in ENDED and entry.epoch >= component.epoch)


def claim(component: Component, turn: Turn, plan: Position | None, why: str, *, is_planned: bool = False) -> None:
    """Open a new epoch as its primary-to-be. The vote record holds it before another robot hears of it."""
    component.alone_right = not component.freezes or _right_to_act_alone(component, turn)
    component.claimed = not component.alone_right
    component.begun, component.bare, component.ended = component.has_begun, False, (0, 0)
    component.stood, component.rival_ns = _begins_in_the_dark(component, turn), 0
    component.move(Cause.CLAIM)
    component.epoch = max(component.epoch, component.seen) + 1
    component.resumption = _resumption(component, turn, is_planned=is_planned)
    component.primary = turn.me
    component.entrusted, component.trusted, component.standby = (), False, ""
    component.plan = plan
    component.claim_counter = turn.next_counter
    component.until_ns = turn.now_ns + turn.config.loyalty_ns
    component.unprotected, component.needs_base = False, False
    component.degraded = component.awaited = ""
    component.undelivered = component.unstored = ""
    component.acked, component.acked_ns, component.resumed_ns, component.lost_ns = None, -1, -1, -1
    component.safe = component.vouched = component.shown = component.sealed = None
    component.sealed_ns = -1
    component.handing, component.reported = None, False
    component.ending, component.end_signal = False, 0
    component.ordered = False
    component.crashed, component.reason = 0, ""
    component.unable, component.unusable, component.retry_ns = "", False, 0
    component.lease_ns = component.told_ns = component.inherited_ns = 0
    component.took_ns = component.freeze_us = component.still_us = 0
    component.cpu_us = component.cost_us = 0
    admit(component, turn, "")
    open_line(component, turn)
    start = "its newest checkpoint" if plan else "the beginning"
    turn.say(component, f"{turn.me} claims epoch {component.epoch}, to run it from {start}: {why}")


def _resumption(component: Component, turn: Turn, *, is_planned: bool) -> Resumption:
    """What has become of the copy before ours; it was our own, unless another robot is known to have run it last."""
    if is_planned:
        return Resumption.HANDED_OVER
    return component.resumption if component.primary in ("", turn.me) else Resumption.TAKEN_OVER


def advance(component: Component, turn: Turn) -> None:
    """A claim: go on once it is granted, or once no robot is left whose consent is needed."""
    if _consented(component, turn):
        entrust_holder(component, turn)
        begin(component, turn)


def begin(component: Component, turn: Turn) -> None:
    """The claim is granted: start the program, or restore it."""
    component.claimed, component.behind_ns = False, 0
    component.until_ns = turn.now_ns + turn.config.restore_ms * MS
    component.born = component.epoch
    lease_ns = lease.first_ns(component, turn)
    if component.plan is None:
        assert component.spec is not None, f"{component.name}: claimed without knowing what to start"
        component.begun = False
        component.move(Cause.START)
        turn.order(acts.Start(component.name, component.epoch, component.spec, lease_ns, generation_of(component, turn)))
    else:
        component.move(Cause.RESTORE)
        plan, why = component.plan, component.resumption
        generation = generation_of(component, turn)
        turn.order(acts.Restore(component.name, component.epoch, plan, component.spec, lease_ns, why, generation))
    component.lease_ns = component.told_ns = lease_ns


def entrust_holder(component: Component, turn: Turn) -> None:
    """A peer that agreed and still holds an older checkpoint may use it should this robot die before the next one."""
    for peer in sorted(turn.team.living(turn.now_ns), key=lambda peer: weight(peer.robot)):
        entry = peer.entry(component.name)
        if not component.standby and entry and entry.position and grants(component, peer, turn.me):
            component.standby = peer.robot
            component.entrusted = (peer.robot,)


def generation_of(component: Component, turn: Turn) -> int:
    """Of this robot's primacy under the component's epoch."""
    return component.epoch * (PEERS_MAX + 1) + turn.config.place


def open_line(component: Component, turn: Turn) -> None:
    """A new generation, unlike any other robot's: the next snapshot is a base. An agent that came back goes on counting."""
    component.generation = generation_of(component, turn)
    last = component.ended[1] if component.ended[0] == component.generation else 0
    component.sequence = max((held.sequence for held in component.held if held.generation == component.generation), default=last)
    restart_line(component, turn)


def restart_line(component: Component, turn: Turn) -> None:
    """The program is another process now: the next snapshot is a base, and no number is used twice."""
    component.parent = component.flight = None
    component.trail.clear()
    component.archives.clear()
    component.base_wanted = True
    component.due_ns = turn.now_ns


def renew(component: Component, turn: Turn, above: int) -> None:
    """The running primary goes on under an epoch above one that came to nothing; a capture under way is waited for."""
    if (component.flight is not None and component.flight.position is None) or above + 1 >= EPOCH_MAX:
        return
    component.epoch = above + 1
    component.handing = None
    open_line(component, turn)
    turn.say(component, f"{turn.me} continues under epoch {component.epoch}: epoch {above} was claimed, and no robot runs it")


def _consented(component: Component, turn: Turn) -> bool:
    overdue = turn.now_ns >= component.until_ns
    for robot, peer in turn.team.peers.items():
        if turn.dead(robot) or (component.ordered and turn.team.keeps_waiting(robot, turn.now_ns)):
            if not component.alone_right:
                return False
        elif not (peer.echoed >= component.claim_counter and grants(component, peer, turn.me)) and (
            component.freezes or not overdue
        ):
            return False
    return True


def living_entries(component: Component, turn: Turn) -> list[tuple[str, Entry]]:
    found = ((peer.robot, peer.entry(component.name)) for peer in turn.team.living(turn.now_ns))
    return [(robot, entry) for robot, entry in found if entry is not None]


def may_start_afresh(component: Component, turn: Turn) -> bool:
    """Configured to run here, not drained, and no checkpoint of it was ever given away or is here, perhaps an unusable one.

    Checkpoints known before a claim of our own in vain, or before the loss of a disk, still count; but where all robots are back
    and have none, all checkpoints are lost.
    """
    is_new = not component.has_begun or _is_nowhere(component, turn)
    return component.autostart and component.spec is not None and is_new and not turn.drained


def _is_nowhere(component: Component, turn: Turn) -> bool:
    """Whether every member of the team is heard, and none has a checkpoint of it."""
    return not component.held and all(_has_none(component, turn, robot, peer) for robot, peer in turn.team.peers.items())


def _has_none(component: Component, turn: Turn, robot: str, peer: Peer) -> bool:
    entry = peer.entry(component.name)
    return turn.alive(robot) and (peer.complete if entry is None else entry.position is None)


def first_of_equals(component: Component, turn: Turn, entries: list[tuple[str, Entry]], mine: Position) -> bool:
    able = [(robot, entry) for robot, entry in entries if turn.config.runs(robot) and not entry.flags & UNABLE]
    rivals = [robot for robot, entry in able if entry.position == mine]
    own = placing(component, turn, turn.me)
    return all(own < placing(component, turn, robot) for robot in rivals)


def placing(component: Component, turn: Turn, robot: str) -> tuple[bool, bool, int, Weight]:
    """Of robots that could run it equally well the least of these does: not drained, preferred, least loaded, lesser name."""
    load = turn.load if robot == turn.me else turn.team.peers[robot].load
    return turn.is_drained(robot), robot != component.rules.prefer, load, weight(robot)


def _right_to_act_alone(component: Component, turn: Turn) -> bool:
    if component.primary == turn.me:
        return component.epoch > 0 and not component.entrusted and not component.claimed
    return component.trusted and turn.dead(component.primary)


def _may_go_on(component: Component, turn: Turn) -> bool:
    """Under ``freeze``, with a robot out of reach, only the robot that has the right to act alone."""
    somebody_gone = any(turn.dead(robot) for robot in turn.team.peers)
    return not component.freezes or not somebody_gone or _right_to_act_alone(component, turn)


# Hearing


def heard(component: Component, turn: Turn, sender: str, entry: Entry) -> None:
    """Take in another robot's word about this component."""
    theirs = state_of(entry)
    if theirs in HOLDING:
        _heard_holder(component, turn, sender, entry, theirs)
    elif theirs in ENDED and entry.epoch >= component.epoch:
        heard_end(component, turn, sender, entry, theirs)
    elif entry.epoch > component.epoch or _is_taken(component, sender, entry):
        _heard_later_epoch(component, turn, sender, entry)


def _is_taken(component: Component, sender: str, entry: Entry) -> bool:
    """Whether the sender, back without a copy, has run the component under the epoch that we claim."""
    ours = component.state is State.CLAIMING and entry.epoch == component.epoch
    return ours and component.freezes and entry.primary == sender


def _heard_holder(component: Component, turn: Turn, sender: str, entry: Entry, theirs: State) -> None:
    if component.holding:
        if _outlasts(component, entry):
            _outlast(component, turn, sender, entry, theirs)
        elif stronger(component, turn, sender, entry, theirs):
            lose(component, turn, sender, entry)
        return
    if entry.epoch < component.epoch or (component.state in ENDED and entry.epoch == component.epoch):
        return
    if entry.epoch > component.epoch or component.primary != sender:
        if not _may_switch(component, turn, sender, entry):
            return
        accept(component, turn, sender, entry.epoch)
    follow(component, turn, sender, entry)


def clear_away(component: Component, turn: Turn, epoch: int) -> None:
    """Have the agent end the copy that is here, or its remains, before this robot stands by."""
    component.move(Cause.OUTBID)
    component.until_ns = turn.now_ns + turn.config.retry_ms * MS
    turn.order(acts.Stop(component.name, epoch))


def follow(component: Component, turn: Turn, sender: str, entry: Entry) -> None:
    """The accepted primary's word: keep its checkpoints, and claim the component when it gives way to us."""
    if component.state in ENDED:
        drop(component, turn, f"{sender} runs it anew")
        clear_away(component, turn, component.epoch)  # a copy that ended here, and whose end was not agreed, may be left
    if component.state is not State.STANDBY and component.state is not State.STOPPING:
        component.move(Cause.FOLLOW)
    component.trusted = entry.standby == turn.me and turn.config.runs(turn.me)
    admit(component, turn, sender)
    if entry.flags & SAFE and entry.position is not None:
        component.vouched = entry.position
        component.bare = component.bare and component.newest != entry.position
    if entry.flags & UNPROTECTED:
        drop(component, turn, f"{sender} protects it no longer")
    if entry.yields_to == turn.me and component.state is State.STANDBY and component.newest == entry.position:
        claim(component, turn, component.newest, f"{sender} hands it over", is_planned=True)


def stronger(component: Component, turn: Turn, sender: str, entry: Entry, theirs: State) -> bool:
    """Whether their hold on the component beats ours: the later epoch, then the one that acts, then the lesser name."""
    their_claim = (entry.epoch, _ACTS.get(theirs, ACTS_FULLY))
    our_claim = (component.epoch, _ACTS.get(component.state, ACTS_FULLY))
    return their_claim > our_claim or (their_claim == our_claim and weight(sender) < weight(turn.me))


def _outlasts(component: Component, entry: Entry) -> bool:
    """Of two copies that met again: whether ours stays, though the other one's epoch may be later.

    An operator's order stands: the copy that was promoted stays. Without an order the one does that never stopped acting.
    """
    if component.state is not State.PRIMARY or entry.flags & ORDERED:
        return False
    return component.ordered or _never_stopped(component, entry)


def _never_stopped(component: Component, entry: Entry) -> bool:
    """Whether ours acted all the time, and the other one stood still, or began from a checkpoint of it meanwhile."""
    return not component.stood and (bool(entry.flags & STOOD) or 0 < component.born < entry.born)


def _outlast(component: Component, turn: Turn, sender: str, entry: Entry, theirs: State) -> None:
    """Go on above the other's epoch, so that the least work is lost; where that robot does not hear us, give up to it as ever."""
    if entry.epoch < component.epoch:
        return  # it will hear of ours
    if turn.team.hears_us(sender, turn.now_ns):
        component.rival_ns = 0
        ours = "was promoted by an operator" if component.ordered else "never stopped acting"
        turn.say(component, f"{turn.me} keeps its copy, which {ours}; the one of {sender} began in epoch {entry.born}")
        renew(component, turn, entry.epoch)
        return
    patience_ns = turn.team.patience_ns(sender)
    component.rival_ns = _waiting_since_ns(component.rival_ns, patience_ns, turn)
    if turn.now_ns >= component.rival_ns + patience_ns and stronger(component, turn, sender, entry, theirs):
        lose(component, turn, sender, entry)


def _waiting_since_ns(since_ns: int, patience_ns: int, turn: Turn) -> int:
    """Since when something is waited for: a wait that was over for as long as it may last was for another cause."""
    return turn.now_ns if turn.now_ns >= since_ns + 2 * patience_ns else since_ns


def _may_switch(component: Component, turn: Turn, sender: str, entry: Entry) -> bool:
    """One consent an epoch, except that the lesser name's claim overtakes; none to an epoch that we have used (``freeze``)."""
    if entry.epoch > component.epoch or not component.primary:
        return True
    if component.primary == turn.me:
        return component.claimed or not component.freezes
    if turn.dead(component.primary):
        return True
    return weight(sender) < weight(component.primary)


def accept(component: Component, turn: Turn, primary: str, epoch: int) -> None:
    component.begun = component.has_begun
    component.bare = component.bare and component.elects and bool(component.held)  # it is as old as it was
    component.epoch, component.primary = epoch, primary
    component.elsewhere = -abs(component.elsewhere)
    component.entrusted, component.trusted = (), False
    component.ordered = component.claimed = False
    component.try_again()
    component.needs_base = False
    turn.say(component, f"{turn.me} accepts {primary} as primary of epoch {epoch}")


def lose(component: Component, turn: Turn, winner: str, entry: Entry) -> None:
    """Our primacy is over: keep our copy's state aside, stop it, and follow."""
    handing = component.handing
    tidy = handing is not None and handing.yielded and winner == handing.to
    if handing is not None and handing.request:
        turn.order(acts.Answer(handing.request, tidy, f"{winner} {'takes' if tidy else 'has claimed'} {component.name}"))
    if component.state is State.CLAIMING:
        component.move(Cause.YIELD_CLAIM)
        refuse_request(component, turn, f"{winner} runs {component.name} already")
    else:
        if component.state in _RUNS_HERE and not tidy:
            reason = f"{winner} holds epoch {entry.epoch}, this copy had epoch {component.epoch}"
            turn.order(acts.KeepAside(component.name, component.epoch, reason))
            turn.say(component, f"{turn.me} hears that its copy is stale: {reason}; it keeps that state aside")
        clear_away(component, turn, entry.epoch)
    component.handing = component.flight = None
    component.standby, component.lease_ns, component.told_ns = "", 0, 0
    component.inherited_ns = component.crashed = 0
    _forget_lines_since(component, turn, entry)
    accept(component, turn, winner, entry.epoch)
    component.trusted = entry.standby == turn.me
    admit(component, turn, winner)


def _forget_lines_since(component: Component, turn: Turn, entry: Entry) -> None:
    """The winner's copy was there before ours: no robot resumes from our primacy's captures, which are not in its past."""
    if turn.config.by_majority or not 0 < entry.born < component.epoch < entry.epoch:
        return
    beaten = tuple(sorted({held.generation for held in component.held if held.generation // (PEERS_MAX + 1) > entry.born}))
    if beaten:
        component.held = [held for held in component.held if held.generation not in beaten]
        component.lost = (*component.lost, *beaten)[-LOST_MAX:]
        turn.order(acts.Forget(component.name, entry.epoch, beaten))


def refuse_request(component: Component, turn: Turn, sentence: str) -> None:
    """Answer the client that waits for this component to start."""
    if component.request:
        turn.order(acts.Answer(component.request, False, sentence))
        component.request = 0


def heard_of_checkpoints(component: Component, entry: Entry) -> None:
    """Of a component of which this robot has no checkpoint, perhaps since it has a new disk: whether there was one."""
    if entry.flags & BEGUN and entry.epoch >= component.epoch and component.state in (State.ABSENT, State.STANDBY):
        component.begun = True


def heard_end(component: Component, turn: Turn, sender: str, entry: Entry, theirs: State) -> None:
    """Record an end that a robot tells of; a copy that acted all the time goes on above it. Servers and witnesses end nothing.

    etcd has each end from the robot where it was, and keeps it.
    """
    if not turn.config.runs(sender) and sender != turn.config.coordinator:
        return
    if component.holding:
        if entry.epoch > component.epoch and _acted_all_along(component, turn):
            _go_on_above_the_end(component, turn, sender, entry)
        elif entry.epoch > component.epoch:
            lose(component, turn, sender, entry)
        return
    forgotten = theirs is State.RELEASED and component.state is not State.RELEASED
    if component.state is State.STOPPING or (component.state in ENDED and entry.epoch == component.epoch and not forgotten):
        return
    component.epoch, component.primary, component.status = entry.epoch, entry.primary, entry.status
    component.elsewhere = -abs(component.elsewhere)
    component.entrusted, component.trusted = (), False
    component.reason = f"as {sender} says" if theirs is State.FAILED else ""
    component.move(_END_CAUSES[theirs])
    if theirs is State.RELEASED:
        drop(component, turn, f"{sender} released it")
    turn.say(component, f"{turn.me} records that it is {theirs}, as {sender} says")


def _acted_all_along(component: Component, turn: Turn) -> bool:
    """Under pair: the copy that ended elsewhere was then another one, begun from a checkpoint of ours."""
    return component.state is State.PRIMARY and not component.stood and not turn.config.by_majority


def _go_on_above_the_end(component: Component, turn: Turn, sender: str, entry: Entry) -> None:
    """As soon as the other robot hears us: until then it would not follow."""
    if turn.team.hears_us(sender, turn.now_ns):
        turn.say(
            component, f"{turn.me} keeps its copy, which never stopped acting; {sender} tells of an end in epoch {entry.epoch}"
        )
        renew(component, turn, entry.epoch)


def _awaits_its_word(component: Component, turn: Turn, rival: str) -> bool:
    """Whether ours may be the copy that stays: then the other one's own robot is heard first, if its word may be on its way."""
    may_stay = component.state is State.PRIMARY and (component.ordered or not component.stood)
    if not may_stay or turn.config.by_majority or component.freezes or rival not in turn.team.peers:
        return False
    component.told_of_ns = _waiting_since_ns(component.told_of_ns, turn.config.grace_ns, turn)
    return turn.now_ns < component.told_of_ns + turn.config.grace_ns


def _heard_later_epoch(component: Component, turn: Turn, sender: str, entry: Entry) -> None:
    """A member that does not run it knows a later epoch than ours."""
    elsewhere = entry.primary not in ("", turn.me, sender)
    if component.state is State.CLAIMING:
        component.epoch = entry.epoch + 1
        component.claim_counter = turn.next_counter
        component.until_ns = turn.now_ns + turn.config.loyalty_ns
        open_line(component, turn)
    elif component.holding and elsewhere:
        if not _awaits_its_word(component, turn, entry.primary):
            lose(component, turn, entry.primary, entry)
    elif component.is_settled:
        renew(component, turn, entry.epoch)
    elif not component.holding:
        component.epoch, component.trusted = entry.epoch, False
        component.primary, component.elsewhere = entry.primary, -abs(component.elsewhere)
        if entry.primary == turn.me:
            component.entrusted = (sender,)
        if component.state is State.ABSENT and entry.flags & HOLDS:
            component.move(Cause.FOLLOW)
        if component.state in ENDED:
            component.move(Cause.FOLLOW)


def admit(component: Component, turn: Turn, sender: str, epoch: int | None = None) -> None:
    """Take snapshots from this robot, of the present epoch (or of that one), and from no other; "": from no robot at all."""
    wanted = (sender, component.epoch if epoch is None else epoch)
    if component.admitted != wanted and turn.config.keeps(turn.me):
        component.admitted = wanted
        turn.order(acts.Admit(component.name, wanted[1], sender))


def drop(component: Component, turn: Turn, why: str) -> None:
    """Forget the checkpoints that this robot keeps."""
    component.begun = False
    if not component.held:
        return
    component.held.clear()
    component.vouched = component.shown = None
    turn.order(acts.Drop(component.name, component.epoch))
    turn.say(component, f"{turn.me} forgets its checkpoints: {why}")


def supersede(component: Component, turn: Turn, position: Position) -> None:
    """A position of the winning line is here: later ones of lines that lost are never resumed from."""
    beaten = tuple(sorted({held.generation for held in component.held if held.generation > position.generation}))
    if beaten:
        component.held = [held for held in component.held if held.generation not in beaten]
        component.lost = (*component.lost, *beaten)[-LOST_MAX:]
        turn.order(acts.Forget(component.name, component.epoch, beaten))
