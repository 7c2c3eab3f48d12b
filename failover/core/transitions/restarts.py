"""Starts a declared component anew after its program has ended: whether, after which pause, and how often.

Invariants: the primacy is held during the pause, so a robot that is lost meanwhile is replaced as ever; these rules start no
program that an operator stopped; they look at ``restart_limit`` before each start.
"""

from __future__ import annotations

from failover.core import acts
from failover.core.component import Cause, Component, Turn
from failover.core.election import lease
from failover.core.election.pair import restart_line
from failover.core.types import MS, OnCrash, Restart, State

PAUSE_MS = 100
"""Before the first start of a window; each further one waits twice as long:"""
PAUSE_MS_MAX = 10_000

CAUSES = {Restart.ALWAYS: (Cause.FINISH, Cause.FAIL), Restart.ON_FAILURE: (Cause.FAIL,)}
"""Of the record that an end would make; no other ``restart`` starts anything anew."""

SIGNAL_BITS = 0x7F
"""Of a wait status: the signal that ended the program, 0 for none."""


def how(status: int) -> str:
    """How a program ended, from its wait status."""
    return f"signal {status & SIGNAL_BITS}" if status & SIGNAL_BITS else f"exit status {status >> 8}"


def is_declared(component: Component) -> bool:
    """Whether an agent.toml declares it."""
    return component.rules.restart is not Restart.UNDECLARED


def is_failure(component: Component, status: int) -> bool:
    """Whether this end of a declared component is a failure: any but exit status 0. The end of any other program is its own."""
    return is_declared(component) and status != 0


def resumes_first(component: Component) -> bool:
    """Whether a program that keeps its state itself, and failed, first goes on from that state, as after a crash."""
    rules = component.rules
    return rules.restart in (Restart.ALWAYS, Restart.ON_FAILURE) and rules.on_crash is OnCrash.RESUME and bool(component.held)


def is_wanted(component: Component, cause: Cause) -> bool:
    """Whether its rules want another start after such an end, if the limit allows it; a protected program has no command."""
    spec, ends = component.spec, CAUSES.get(component.rules.restart, ())
    return cause in ends and not component.ending and spec is not None and not spec.launch.pid


def begin(component: Component, turn: Turn, cause: Cause, status: int, why: str) -> bool:
    """Wait to start it anew, where its rules want that; False: this end is one.

    Args:
        cause: FINISH or FAIL: of the record that is made otherwise.
        why: "" where the status says all.
    """
    if not is_wanted(component, cause):
        return False
    _forget_old(component, turn)
    if not _may_once_more(component):
        return False
    pause_ms = min(PAUSE_MS << min(len(component.restarts), 16), PAUSE_MS_MAX)
    component.restarts.append(turn.now_ns)
    component.restarted += 1
    component.move(Cause.RESTART)
    component.restart_ns = turn.now_ns + pause_ms * MS
    component.status, component.reason = status, ""
    component.crashes.clear()
    component.ended = (component.generation, component.sequence)
    component.held = []  # of the program that has ended: a crash of the next one resumes from none of them. The store keeps them.
    component.acked, component.acked_ns, component.crashed = None, -1, 0
    component.resumed_ns = component.lost_ns = -1
    component.degraded = component.awaited = component.undelivered = ""
    component.unprotected = False
    restart_line(component, turn)
    turn.order(acts.Stop(component.name, component.epoch))
    component.ended_how = why or f"it ended with {how(status)}"
    turn.say(component, f"{turn.me} {Cause.RESTART} in {pause_ms / 1000:g} s: {component.ended_how}{component.said}")
    return True


def advance(component: Component, turn: Turn) -> None:
    """The pause is over, and this robot may act: start it."""
    if turn.now_ns < component.restart_ns or not lease.may_act(component, turn):
        return
    assert component.spec is not None, f"{component.name}: waits for a start, and it is not known what to start"
    component.restart_ns, component.said = 0, ""
    component.until_ns = turn.now_ns + turn.config.restore_ms * MS
    component.move(Cause.START)
    component.lease_ns = component.told_ns = lease.first_ns(component, turn)
    turn.order(acts.Start(component.name, component.epoch, component.spec, component.lease_ns, component.generation))


def remarks(component: Component) -> tuple[str, ...]:
    """For the record of the failure of a declared component, after the reason: how often it was started anew, and the cure."""
    rules, name = component.rules, component.name
    if not is_declared(component):
        return ()
    cure = f"failover logs {name} shows its output, failover start {name} starts it"
    if rules.restart is Restart.NEVER or _may_once_more(component):
        return (cure,)
    window_s = rules.restart_window_ms / 1000
    return (f"it was started anew {len(component.restarts)} times in {window_s:g} s, as often as restart_limit allows", cure)


def note(component: Component, now_ns: int) -> str:
    """For the status: that it waits, for how long, and for which time in its window; "" where it does not."""
    if not component.restart_ns:
        return ""
    rules, left_s = component.rules, (component.restart_ns - now_ns) / 10**9
    heard = "a majority hears" if component.elects else "another robot hears"
    when = f"in {left_s:.1f} s" if left_s > 0 else f"as soon as {heard} this one"
    limit = f" of {rules.restart_limit}" if rules.restart_limit else ""
    which = f"start {len(component.restarts)}{limit} in {rules.restart_window_ms / 1000:g} s"
    return f"{component.ended_how}; it is started anew {when}, {which}; failover stop ends that{component.said}"


def _may_once_more(component: Component) -> bool:
    limit = component.rules.restart_limit
    return not limit or len(component.restarts) < limit


def _forget_old(component: Component, turn: Turn) -> None:
    window_ns = component.rules.restart_window_ms * MS
    while component.restarts and component.restarts[0] <= turn.now_ns - window_ns:
        component.restarts.popleft()


def waits(component: Component) -> bool:
    """Whether its program has ended and is to be started."""
    return component.state is State.RECOVERING and component.restart_ns > 0
