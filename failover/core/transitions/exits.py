"""Decides the next step when a component's program ended, crashed, or could not be brought to run.

Invariants: an end is a record before any robot or client is told of it; crashes make no endless loop and throw no checkpoint
away.
"""

from __future__ import annotations

from failover.core import acts
from failover.core.component import NEVER_NS, Cause, Component, Turn
from failover.core.election import lease
from failover.core.election.consent import state_of
from failover.core.election.pair import living_entries, refuse_request, restart_line
from failover.core.events import ActFailed, Exited
from failover.core.membership import Peer
from failover.core.transitions import restarts
from failover.core.transitions.restarts import SIGNAL_BITS
from failover.core.types import ENDED, MS, OnCrash, State

TRIES_MAX = 3
"""Takeovers whose program refuses its state here, one after the other, before this robot leaves it alone."""

PAUSES = (1, 10, 10, 60)
"""Of ``retry_ms``, before a takeover that failed is tried again: an obstacle met once may be gone at once."""

UNDECLARED_CURE = "look at its logs, then run it again, or release it to forget it"

_WITH_PROCESS = frozenset({State.STARTING, State.TAKING_OVER, State.PRIMARY, State.FROZEN, State.HANDING_OVER, State.RECOVERING})


def exited(component: Component, turn: Turn, event: Exited) -> None:
    """The program ended: by itself or as asked, that is its end; by a signal, a crash."""
    if component.state not in _WITH_PROCESS or event.epoch < component.born or restarts.waits(component):
        return
    signal, component.said = event.status & SIGNAL_BITS, event.said
    if event.refusal and not component.ending:
        _refused(component, turn, event)
    elif not signal and not component.ending and restarts.is_failure(component, event.status):
        if event.keeps_state and restarts.resumes_first(component):
            crashed(component, turn, event.status)
            return
        _end(component, turn, Cause.FAIL, event.status, f"it ended with {restarts.how(event.status)}")
    elif not signal or component.ending:
        _end(component, turn, Cause.FINISH, event.status, "")
    elif component.rules.on_crash is OnCrash.LEAVE:
        _end(component, turn, Cause.FAIL, event.status, f"it died by signal {signal}; on_crash = leave")
    else:
        crashed(component, turn, event.status)


def end_waiting(component: Component, turn: Turn) -> None:
    """An operator stops a component whose program has ended and would be started anew."""
    component.ending = True
    _end(component, turn, Cause.FINISH, component.status, "")


def _refused(component: Component, turn: Turn, event: Exited) -> None:
    """It did not go on from its checkpoint: a failed takeover; or, where it has made checkpoints already, a crash."""
    if component.acked is None or component.acked.generation != component.generation:
        _end_handover(component, turn, f"{component.name} ended meanwhile")
        component.flight, component.crashed = None, 0
        cannot(component, turn, event.refusal, unusable=True, again=component.tries + 1 < TRIES_MAX)
    else:
        turn.say(component, event.refusal)
        crashed(component, turn, event.status)


def crashed(component: Component, turn: Turn, status: int) -> None:
    """Resume it here; a copy that is held still, once this robot knows that it may act."""
    component.crashed = status if component.state is State.FROZEN else 0
    if not component.crashed:
        _recover(component, turn, status)


def failed(component: Component, turn: Turn, event: ActFailed) -> None:
    """A start or a restore came to nothing."""
    if event.epoch != component.epoch or restarts.waits(component):
        return
    if component.state is State.STARTING:
        told = bool(component.request)
        refuse_request(component, turn, event.message)
        if not told:
            _end(component, turn, Cause.FAIL, 0, event.message)
        elif restarts.is_declared(component):  # the operator who was told decides what is next
            _record(component, turn, Cause.FAIL, 0, event.message)
        else:  # nothing of it is remembered: its name is whose it was before
            component.spec = component.former
            _record(component, turn, Cause.RELEASE, 0, event.message)
    elif component.state is State.RECOVERING:
        _not_resumed(component, turn, event)
    elif component.state is State.TAKING_OVER:
        is_read = event.damaged is None
        cannot(component, turn, event.message, unusable=not is_read, again=is_read)


def cannot(component: Component, turn: Turn, why: str, *, unusable: bool, again: bool) -> None:
    """This robot cannot run it; the checkpoint stays, for another robot or another try.

    Args:
        unusable: the checkpoint cannot be read here, or its program refuses it: it counts as lost here.
        again: this robot tries again after a pause.
    """
    component.unable, component.unusable, component.tries = why, unusable, component.tries + 1
    component.move(Cause.CANNOT)
    component.until_ns = turn.now_ns + turn.config.retry_ms * MS
    pause_ns = PAUSES[min(component.tries, len(PAUSES)) - 1] * turn.config.retry_ms * MS
    component.retry_ns = turn.now_ns + pause_ns if again else NEVER_NS
    turn.order(acts.Stop(component.name, component.epoch))
    refuse_request(component, turn, f"{turn.me} cannot run {component.name}: {why}")
    turn.say(component, f"{turn.me} {Cause.CANNOT}: {why}")


def overdue(component: Component, turn: Turn) -> None:
    """A start or a restore that says nothing has failed; a Stop that says nothing is ordered again."""
    if restarts.waits(component):
        restarts.advance(component, turn)
    if turn.now_ns < component.until_ns:
        return
    if component.state in (State.STARTING, State.TAKING_OVER, State.RECOVERING):
        seconds = turn.config.restore_ms // 1000
        failed(component, turn, ActFailed(component.name, component.epoch, f"it did not answer for {seconds} s"))
    elif component.state is State.STOPPING:
        component.until_ns = turn.now_ns + turn.config.retry_ms * MS
        turn.order(acts.Stop(component.name, component.epoch))


def retry(component: Component, turn: Turn) -> None:
    """Another try of a takeover that failed here."""
    if component.unable and turn.now_ns >= component.retry_ns:
        component.unable, component.unusable = "", False


def report(component: Component, turn: Turn) -> None:
    """Tell waiting clients of the end, once each living robot has it on record too (and a majority), or this robot is alone."""
    if component.state not in ENDED or component.reported or component.primary != turn.me:
        return
    living = turn.team.living(turn.now_ns)
    knows = {peer.robot: _knows_the_end(component, peer) for peer in living}
    agreed = not turn.config.by_majority or 1 + sum(knows.values()) >= turn.config.quorum
    if agreed and all(known for robot, known in knows.items() if turn.config.runs(robot)):
        component.reported = True
        failed_here = component.state is State.FAILED
        turn.order(
            acts.ReportExit(component.name, component.epoch, component.status, bool(living), failed_here, component.reason)
        )


def _knows_the_end(component: Component, peer: Peer) -> bool:
    entry = peer.entry(component.name)
    return entry is not None and state_of(entry) in ENDED


def _recover(component: Component, turn: Turn, status: int) -> None:
    """Resume here: from the newest checkpoint a few times, then from the one before, then not again."""
    window_ns = component.rules.crash_window_ms * MS
    while component.crashes and component.crashes[0] <= turn.now_ns - window_ns:
        component.crashes.popleft()
    component.crashes.append(turn.now_ns)
    component.status, component.unresumed = status, 0
    _resume(component, turn)


def _resume(component: Component, turn: Turn) -> None:
    """From the newest checkpoint, or from the one before where it crashed too often; or there is none, and this is its end."""
    count, rules = len(component.crashes), component.rules
    back = 1 if count <= rules.crash_limit else 2
    if count > rules.crash_limit + 1 or len(component.held) < back:
        crashes = f"{count} crashes in {rules.crash_window_ms // 1000} s"
        why = "no checkpoint to resume it from" if len(component.held) < back else crashes
        how = restarts.how(component.status)
        why = f"it died by {how}; {why}" if restarts.is_declared(component) else f"{why}; {UNDECLARED_CURE}"
        _end(component, turn, Cause.FAIL, component.status, why)
        return
    position = component.held[-back]
    component.move(Cause.CRASH)
    _end_handover(component, turn, f"{component.name} crashed meanwhile and is resumed at {turn.me}")
    restart_line(component, turn)
    component.until_ns = turn.now_ns + turn.config.restore_ms * MS
    component.lease_ns = component.told_ns = lease.first_ns(component, turn)
    resumption, spec = component.resumption, component.spec
    lease_ns, generation = component.lease_ns, component.generation
    turn.order(acts.Restore(component.name, component.epoch, position, spec, lease_ns, resumption, generation))
    again = f"saw it crash, {count} in the window, and resumes it" if not component.unresumed else "tries again to resume it"
    turn.say(component, f"{turn.me} {again} from {position.sequence}")


def _not_resumed(component: Component, turn: Turn, event: ActFailed) -> None:
    """A restore that failed is no crash of the program: the next one is from the same checkpoint, unless that cannot be read.

    The first one follows at once. Then this robot gives it away: another one that holds all that was acknowledged resumes it, or
    this one does after a pause.
    """
    turn.say(component, f"{turn.me} could not resume it: {event.message}")
    component.unresumed += 1
    is_read = event.damaged is None
    if not is_read and not _is_held_elsewhere(component, turn):
        component.held = [position for position in component.held if position != event.damaged]
    elif not is_read or component.unresumed > 1:
        cannot(component, turn, event.message, unusable=not is_read, again=is_read)
        return
    _resume(component, turn)


def _is_held_elsewhere(component: Component, turn: Turn) -> bool:
    """Whether a living robot that may run it holds all that was acknowledged."""
    needed = component.acked or component.newest
    others = (entry.position for robot, entry in living_entries(component, turn) if turn.config.runs(robot))
    return not component.waits and needed is not None and any(position is not None and needed <= position for position in others)


def _end_handover(component: Component, turn: Turn, why: str) -> None:
    if component.handing is not None and component.handing.request:
        turn.order(acts.Answer(component.handing.request, False, why))
    component.handing = None


def _end(component: Component, turn: Turn, cause: Cause, status: int, reason: str) -> None:
    _end_handover(component, turn, f"{component.name} ended meanwhile")
    if restarts.begin(component, turn, cause, status, reason):
        return
    if cause is Cause.FINISH and restarts.is_wanted(component, cause):
        cause, reason = Cause.FAIL, f"it ended with {restarts.how(status)}"
    _record(component, turn, cause, status, reason)


def _record(component: Component, turn: Turn, cause: Cause, status: int, reason: str) -> None:
    """This end is one."""
    if cause is Cause.FAIL:
        reason = "; ".join((reason, *restarts.remarks(component)))
        reason += component.said if restarts.is_declared(component) else ""
    component.move(cause)
    component.status, component.reason = status, reason
    component.flight = None
    component.reported = False
    if reason or cause is Cause.FINISH:
        turn.say(component, f"{turn.me} {cause}: {reason or restarts.how(status)}")
