"""Requests of an operator to the robot where the component runs. The act Answer answers each request, once."""

from __future__ import annotations

from msgspec.structs import replace

from failover.core import acts
from failover.core.component import Cause, Component, Turn
from failover.core.election import majority
from failover.core.election.pair import claim, drop, exhaustion, vacant
from failover.core.events import Command, Failback, Handover, Prefer, Promote, Release, Run, Stop
from failover.core.replication import archived
from failover.core.transitions import exits, handover, promotion, restarts
from failover.core.types import ENDED, MS, State

_RUNNING = frozenset({State.PRIMARY, State.FROZEN})


def obey(component: Component, turn: Turn, command: Command) -> None:
    """Carry out one command, or say why not."""
    if refusal := _why_not_by(component, command) or _why_stale(component, command):
        turn.order(acts.Answer(command.request, False, refusal))
        return
    match command:
        case Run():
            _run(component, turn, command)
        case Release():
            _release(component, turn, command)
        case Stop():
            _stop(component, turn, command)
        case Prefer():
            _prefer(component, turn, command)
        case Handover():
            if component.state in (State.STANDBY, State.FAILED) and command.to in ("", turn.me):
                handover.resume_here(component, turn, command.request)
            else:
                handover.begin(component, turn, command.to, command.request)
        case Promote():
            promotion.obey(component, turn, command)
        case Failback():
            _fail_back(component, turn, command)


def _why_not_by(component: Component, command: Command) -> str:
    """The agent let a user ask by the owner of that instant; another user may have taken the name since."""
    is_new = isinstance(command, Run) and component.state in (State.RELEASED, State.ABSENT)
    if command.by is None or component.spec is None or is_new or component.spec.owner == command.by:
        return ""
    return f"{component.name} belongs to uid {component.spec.owner}; uid {command.by} may give it no orders: nothing was done"


def _why_stale(component: Component, command: Command) -> str:
    """The component has moved since the user looked at it: what was right for the epoch seen may be wrong now."""
    if isinstance(command, Run) or command.decided in (0, component.epoch):
        return ""
    where = f", at {component.primary}" if component.primary else ""
    return (
        f"{component.name} has changed since this order was decided: epoch {command.decided} then, {component.epoch} "
        f"now{where}; look at it, and give the order again; nothing was done"
    )


def _run(component: Component, turn: Turn, command: Run) -> None:
    refusal = _why_not_run(component, turn, "protect" if command.spec.launch.pid else "run")
    if refusal:
        turn.order(acts.Answer(command.request, False, refusal))
        return
    archived.void(component)
    drop(component, turn, "an operator runs it anew")
    component.former = component.spec
    component.spec = replace(command.spec, home=command.spec.home or turn.me)
    component.request, component.acked, component.acked_ns = command.request, None, -1
    component.crashes.clear()
    component.restarts.clear()
    claim(component, turn, None, "an operator asked for it")


def _why_not_run(component: Component, turn: Turn, verb: str) -> str:
    name = component.name
    if not turn.config.runs(turn.me):
        return f"cannot {verb} {name}: {turn.me} runs nothing; ask at a robot"
    if turn.drained:
        return f"cannot {verb} {name}: {turn.me} is drained; failover undrain {turn.me} first, or ask at another robot"
    if spent := exhaustion(component, turn.me):
        return f"cannot {verb} {name}: {spent}"
    heard, voters = 1 + len(turn.team.living(turn.now_ns)), len(turn.config.peers) + 1
    if turn.config.by_majority and (heard < turn.config.quorum or not majority.is_free(component, turn)):
        if heard >= turn.config.quorum and not turn.team.rested(turn.now_ns):
            return (
                f"cannot {verb} {name}: {turn.me} has just started and may be bound by its earlier votes; ask again in a moment"
            )
        votes = f"of {voters} that vote {turn.me} hears {heard} and needs {turn.config.quorum}"
        return f"cannot {verb} {name}: {votes}; start the others"
    if component.holding or component.state is State.STOPPING:
        how = "it runs here" if component.state is State.PRIMARY else f"here it is {component.state}"
        how = "it is started anew in a moment" if restarts.waits(component) else how
        return f"cannot {verb} {name}: {how}; failover stop or release it first, or choose another name"
    if left_ns := turn.team.awaited_ns(component.primary, turn.now_ns):
        again_s = left_ns // (1_000 * MS) + 1
        how = "its agent restarts" if turn.team.peers[component.primary].is_asked else "it is not heard"
        return f"cannot {verb} {name}: {component.primary} has it, and {how}; ask again in {again_s} s"
    if component.is_elsewhere:
        there = component.primary
        return f"cannot {verb} {name}: {there}, of another site, has it; choose another name, or failover release {name} first"
    for peer in turn.team.living(turn.now_ns):
        entry = peer.entry(name)
        if entry is not None and not vacant(component, turn) and component.state not in ENDED:
            return f"cannot {verb} {name}: {peer.robot} has it, epoch {entry.epoch}; choose another name, or stop it there"
    if component.held and component.state not in ENDED:
        return f"cannot {verb} {name}: a checkpoint of it waits here; failover handover {name} resumes it, release forgets it"
    return ""


def _release(component: Component, turn: Turn, command: Release) -> None:
    if not turn.config.runs(turn.me):
        turn.order(
            acts.Answer(command.request, False, f"cannot release {component.name}: {turn.me} runs nothing; ask at a robot")
        )
        return
    if component.state in _RUNNING:
        turn.order(acts.LetGo(component.name, component.epoch))
    elif restarts.waits(component):
        pass  # its program is cleared away already
    elif component.holding or component.state is State.STOPPING or not _may_be_forgotten(component, turn):
        _elsewhere(component, turn, command.request, "release")
        return
    waited = "released: its program had ended, and is not started anew"
    runs_on = waited if restarts.waits(component) else "released: it runs on, unprotected"
    component.reason = "" if component.state in ENDED else runs_on
    component.move(Cause.RELEASE)
    component.primary, component.elsewhere = turn.me, -abs(component.elsewhere)
    component.flight = None
    drop(component, turn, "an operator released it")
    turn.order(acts.Answer(command.request, True, f"{component.name} is protected no longer"))
    turn.say(component, f"{turn.me} {Cause.RELEASE}: an operator asked for it")


def _may_be_forgotten(component: Component, turn: Turn) -> bool:
    return component.state in ENDED or component.is_elsewhere or vacant(component, turn)


def _stop(component: Component, turn: Turn, command: Stop) -> None:
    if restarts.waits(component):
        exits.end_waiting(component, turn)
        turn.order(acts.Answer(command.request, True, f"{component.name} is not started anew"))
        return
    if component.state is State.STARTING:
        component.ending, component.end_signal = True, command.signal
        sentence = f"signal {command.signal} is sent to {component.name} once it has started"
        turn.order(acts.Answer(command.request, True, sentence))
        return
    if component.state not in _RUNNING:
        _elsewhere(component, turn, command.request, "stop")
        return
    component.ending = True
    turn.order(acts.End(component.name, component.epoch, command.signal))
    turn.order(acts.Answer(command.request, True, f"signal {command.signal} sent to {component.name}"))


def _prefer(component: Component, turn: Turn, command: Prefer) -> None:
    known = ("", *(robot for robot in (turn.me, *turn.config.peers) if turn.config.runs(robot)))
    if command.robot not in known:
        refusal = f"cannot prefer {command.robot!r}: the team knows {', '.join(known[1:])}"
        turn.order(acts.Answer(command.request, False, refusal))
    elif component.state not in _RUNNING or component.spec is None:
        _elsewhere(component, turn, command.request, "prefer a robot for")
    else:
        component.spec = replace(component.spec, rules=replace(component.spec.rules, prefer=command.robot))
        component.return_ns, component.unfit = turn.now_ns, ()
        turn.order(acts.Answer(command.request, True, f"{component.name} prefers {command.robot or 'to stay where it is'}"))


def _fail_back(component: Component, turn: Turn, command: Failback) -> None:
    home = component.home
    if home and command.to not in ("", home):
        refusal = f"{component.name} would move to {home} now, and not to {command.to}; look at it, and give the order again"
        turn.order(acts.Answer(command.request, False, f"{refusal}; nothing was done"))
    elif home == turn.me and component.state in _RUNNING:
        why = "its preferred robot" if component.rules.prefer else "where it was started"
        turn.order(acts.Answer(command.request, True, f"{component.name} runs at {home} already, {why}"))
    elif not home:
        refusal = (
            f"{component.name} prefers no robot, and {turn.me} does not know where it was started; "
            f"failover handover {component.name} --to ROBOT moves it"
        )
        turn.order(acts.Answer(command.request, False, refusal))
    else:
        handover.begin(component, turn, home, command.request)


def _elsewhere(component: Component, turn: Turn, request: int, verb: str) -> None:
    name, cure = component.name, ""
    if component.state in ENDED:
        cure = "; failover run starts it anew"
    elif component.primary not in ("", turn.me):
        cure = f"; ask at {component.primary}, which runs it"
    elif component.unable:
        cure = f", and {turn.me} could not resume it; failover handover {name} tries again, failover release {name} forgets it"
    turn.order(acts.Answer(request, False, f"cannot {verb} {name}: here it is {component.state}{cure}"))
