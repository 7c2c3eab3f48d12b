"""The planned move: freeze the program, ship the last delta, let the other robot claim. No step is computed twice.

This is the half of the primary. `failover.core.replication.standby` says that it yields once the last delta is acknowledged; the
other robot reads that (``Entry.yields_to``) and claims in `failover.core.election.pair.follow`, under both rules.
"""

from __future__ import annotations

from failover.core import acts
from failover.core.component import Cause, Component, Handing, Turn
from failover.core.election import majority, sites
from failover.core.election.pair import claim, exhaustion, renew, vacant
from failover.core.election.votes import step_down
from failover.core.replication import archived, standby
from failover.core.types import MS, State


def begin(component: Component, turn: Turn, to: str, request: int) -> None:
    """Start a handover, or say why not. ``request`` 0: no client waits for an answer."""
    target = to or component.standby
    refusal = _refusal(component, turn, target)
    if refusal:
        _answer(turn, request, False, refusal)
        return
    component.move(Cause.HAND_OVER)
    component.handing = Handing(target, request, turn.now_ns + turn.config.handover_ms * MS)
    turn.say(component, f"{turn.me} begins to hand it over to {target}")


def resume_here(component: Component, turn: Turn, request: int) -> None:
    """By order: run a component that no robot runs, from the checkpoint held here, unless another may have a newer one."""
    if component.newest is None:
        _answer(turn, request, False, f"{turn.me} holds no checkpoint of {component.name}")
    elif not turn.config.runs(turn.me):
        _answer(turn, request, False, f"{turn.me} runs nothing; ask at a robot")
    elif turn.drained:
        _answer(turn, request, False, f"{turn.me} is drained; failover undrain {turn.me} first, or ask at another robot")
    elif component.is_exhausted:
        _answer(turn, request, False, exhaustion(component, turn.me))
    elif not vacant(component, turn) or (turn.config.by_majority and not majority.is_free(component, turn)):
        cure = f", of another site; {sites.CURE.format(component.name)}" if component.is_elsewhere else "; ask there"
        _answer(turn, request, False, f"{component.name} belongs to {component.primary}{cure}")
    elif component.elects and not majority.may_claim(component, turn, component.newest):
        where = " or ".join(one for one in (*component.entrusted, component.primary) if one)
        refusal = f"a newer checkpoint of {component.name} may be at {where}; start it, or promote {turn.me}"
        _answer(turn, request, False, refusal)
    elif too_soon := archived.refuse(component, turn):
        _answer(turn, request, False, too_soon)
    else:
        component.request = request
        claim(component, turn, component.newest, "an operator asked for it")


def advance(component: Component, turn: Turn) -> None:
    """The next step of a handover: last delta, then the word; or call it off."""
    handing = component.handing
    if handing is None or component.state is not State.HANDING_OVER:
        return
    if handing.yielded and turn.config.by_majority:
        if turn.dead(handing.to) or turn.now_ns >= handing.until_ns:
            _answer(turn, handing.request, False, f"{handing.to} did not take {component.name}; it is claimed anew")
            step_down(component, turn)
    elif turn.now_ns >= handing.until_ns or _has_gone(component, turn, handing):
        _call_off(component, turn, handing)
    elif not handing.yielded:
        standby.capture(component, turn, final=True)


def _has_gone(component: Component, turn: Turn, handing: Handing) -> bool:
    """Whether nothing is to be waited for: once it may have claimed, a silent robot counts as gone only where silence decides."""
    if not handing.yielded:
        return not turn.alive(handing.to)
    return turn.dead(handing.to) and not component.freezes


def _call_off(component: Component, turn: Turn, handing: Handing) -> None:
    """Back to running; if the other may have claimed, under an epoch above its claim and with its consent."""
    if handing.yielded:
        renew(component, turn, component.epoch + 1)
    component.move(Cause.CALL_OFF)
    component.stood = True
    component.handing = None
    if component.flight is not None and component.flight.position is None:
        component.flight.final = False  # it is being taken still, and no second one may be at once
    else:
        component.flight = None
    turn.order(acts.Freeze(component.name, component.epoch))
    why = component.degraded or component.awaited or component.undelivered or f"{handing.to} did not take it in time"
    sentence = f"{component.name} stays at {turn.me}: {why}; order it again when status says protected"
    _answer(turn, handing.request, False, sentence)
    turn.say(component, f"the handover to {handing.to} is called off")


def _refusal(component: Component, turn: Turn, target: str) -> str:
    if component.state is not State.PRIMARY:
        return f"{component.name} is {component.state} at {turn.me}; only a running primary can be moved"
    if target == turn.me:
        return f"{component.name} runs at {turn.me} already"
    if not target:
        return f"{component.name} runs at {turn.me} and has no standby to go to; wait until it has one"
    if not turn.config.runs(target):
        return f"cannot move {component.name} to {target}: it runs nothing; name a robot"
    if turn.is_drained(target):
        return f"{target} is drained; failover undrain {target} lets it run components again"
    if target not in turn.config.peers:
        return f"cannot move {component.name} to {target!r}: the team knows {', '.join((turn.me, *turn.config.peers))}"
    if target != component.standby or not turn.alive(target):
        return f"{target} is not its living standby; set standby = {target!r} in its rules and wait until it is protected there"
    if component.acked is None or component.parent is None:
        return f"{target} has no checkpoint of {component.name} yet; try again when status says protected"
    return ""


def _answer(turn: Turn, request: int, ok: bool, sentence: str) -> None:
    if request:
        turn.order(acts.Answer(request, ok, sentence))
