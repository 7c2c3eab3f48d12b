"""An operator's order that this robot runs a component now, although the rules still wait; and its risks.

Under ``pair`` the order stands for the consent of robots that are not heard: it brings a component back to life that
``on_loss = hold`` or ``when_alone = freeze`` holds still. Its epoch is above any that they could have opened meanwhile. Under
``majority`` it stands for the wait for robots that may hold a newer checkpoint; a majority must vote for it all the same.
"""

from __future__ import annotations

from checkpoint.model import Position
from failover.core import acts
from failover.core.component import Component, Turn, Wanted
from failover.core.election import majority, sites
from failover.core.election.pair import claim, exhaustion, living_entries, renew, vacant
from failover.core.events import Promote
from failover.core.replication.servers import offer
from failover.core.transitions import restarts
from failover.core.types import MS, State

SKIPPED_EPOCHS = 1
"""Epochs left out under ``pair``: a silent robot that claims it too takes the next one, and no token is ever used by both."""

_IDLE = frozenset({State.ABSENT, State.STANDBY})
_ENDED_WELL = frozenset({State.FINISHED, State.RELEASED})


def obey(component: Component, turn: Turn, command: Promote) -> None:
    """Carry the order out, or say what it would do, or why it cannot be done."""
    refusal = _on_its_way(component) or _refusal(component, turn)
    if refusal:
        turn.order(acts.Answer(command.request, False, f"cannot promote {turn.me} for {component.name}: {refusal}"))
    elif command.is_trial:
        turn.order(acts.Answer(command.request, True, _loss(component, turn), risks(component, turn)))
    elif component.state is State.CLAIMING:
        _go_on_with_the_claim(component, turn, command.request)
    elif _stands_here(component):
        _let_it_go_on(component, turn, command.request)
    elif component.newest is None:
        _want(component, turn, command.request)
    else:
        _claim(component, turn, command.request)


def advance(component: Component, turn: Turn) -> None:
    """A checkpoint was sent for, to carry out an order: it is here, or will not come any more."""
    wanted = component.wanted
    assert wanted is not None
    came = component.newest is not None and component.newest >= wanted.position
    if came and not _refusal(component, turn):
        component.wanted = None
        _claim(component, turn, wanted.request)
    elif why := _in_vain(component, turn, wanted):
        component.wanted = None
        sentence = f"cannot promote {turn.me} for {component.name}: its checkpoint was to come from {wanted.giver}: {why}"
        turn.order(acts.Answer(wanted.request, False, sentence))


def risks(component: Component, turn: Turn) -> tuple[str, ...]:
    """Why an operator should think before the order: copies that may act elsewhere, newer checkpoints that would be lost."""
    doubts = [] if turn.config.by_majority else [_double(turn, robot) for robot in _may_act(component, turn)]
    newer = _newer(component, turn)
    if newer:
        doubts.append(f"a newer checkpoint may be at {' or '.join(newer)}; the work that only that one holds is lost")
    return tuple(doubts)


def _refusal(component: Component, turn: Turn) -> str:
    me, name = turn.me, component.name
    if not turn.config.runs(me):
        return f"{me} runs nothing; name a robot with --robot"
    if turn.drained:
        return f"{me} is drained; failover undrain {me} first, or name another robot"
    if spent := exhaustion(component, me):
        return spent
    if component.state in _ENDED_WELL:
        return f"it is {component.state}; failover run starts it anew"
    is_here = component.state is State.CLAIMING or _stands_here(component)
    waits = is_here and not turn.config.by_majority
    if (component.holding and not waits) or component.state is State.STOPPING:
        return f"here it is {component.state}"
    if not is_here and _best(component, turn) is None:
        return f"neither {me} nor a robot that it hears holds a checkpoint of it" + (
            f": {component.unable}" if component.unable else ""
        )
    if not vacant(component, turn, is_ordered=True):
        return _why_not_vacant(component, turn)
    if turn.config.by_majority:
        return _no_majority(component, turn)
    if component.flight is not None and component.flight.position is None:
        return f"the agent is taking a snapshot of {name}; try again"
    return ""


def _why_not_vacant(component: Component, turn: Turn) -> str:
    if component.is_elsewhere:
        return f"an operator recovered it at {component.primary}, of another site; {sites.CURE.format(component.name)}"
    if component.primary and turn.alive(component.primary):
        return f"{component.primary} lives and has it; ask there"
    if left_ns := turn.team.awaited_ns(component.primary, turn.now_ns):
        promised = f"{turn.me} has promised to wait for it, and its program may act until then"
        return f"{_away(turn, component.primary)}; {promised}: ask again in {_seconds(left_ns)}"
    awaited = {robot: left_ns for robot in turn.team.peers if (left_ns := turn.team.awaited_ns(robot, turn.now_ns))}
    if awaited:
        robot, left_ns = max(awaited.items(), key=lambda one: one[1])
        return f"{_away(turn, robot)}, and {turn.me} has promised to wait for it: ask again in {_seconds(left_ns)}"
    return f"some robots are neither heard nor silent for {_loyalty(turn)} ms yet"


def _away(turn: Turn, robot: str) -> str:
    return f"the agent of {robot} restarts" if turn.team.peers[robot].is_asked else f"{robot} is not heard"


def _seconds(left_ns: int) -> str:
    return f"{left_ns // (1_000 * MS) + 1} s"


def _stands_here(component: Component) -> bool:
    """Whether its copy here, frozen or ended, waits for the word of another robot."""
    return component.state is State.FROZEN or restarts.waits(component)


def _no_majority(component: Component, turn: Turn) -> str:
    heard, voters = 1 + len(turn.team.living(turn.now_ns)), len(turn.config.peers) + 1
    if heard < turn.config.quorum:
        return f"of {voters} that vote {turn.me} hears {heard} and needs {turn.config.quorum}; start the others"
    return "" if majority.is_free(component, turn) else f"{component.primary} was heard until just now; try again"


def _best(component: Component, turn: Turn) -> tuple[str, Position] | None:
    """The checkpoint that this robot would go on from, and its place: its own, else the newest that another one would send."""
    if component.newest is not None:
        return turn.me, component.newest
    return offer(component, turn, is_ordered=True) if component.state in _IDLE else None


def _on_its_way(component: Component) -> str:
    wanted = component.wanted
    return f"its checkpoint is on the way from {wanted.giver}, for an order given before; wait for it" if wanted else ""


def _want(component: Component, turn: Turn, request: int) -> None:
    """Have the newest checkpoint sent here first; the claim follows when it is stored."""
    best = offer(component, turn, is_ordered=True)
    assert best is not None
    component.unstored = ""
    component.wanted = Wanted(request, *best, turn.now_ns + turn.config.ship_ms * MS)
    turn.say(component, f"{turn.me} sends to {best[0]} for its checkpoint: an operator promoted {turn.me}")


def _in_vain(component: Component, turn: Turn, wanted: Wanted) -> str:
    """Why the checkpoint is waited for no longer; "" while it may still come."""
    if component.state not in _IDLE:
        return f"here it is {component.state} now"
    if component.unstored:
        return f"it could not be stored: {component.unstored}"
    if not turn.alive(wanted.giver):
        return f"{wanted.giver} is not heard any more; try again"
    return "it did not come in time; try again" if turn.now_ns >= wanted.until_ns else ""


def _claim(component: Component, turn: Turn, request: int) -> None:
    component.request = request
    if not turn.config.by_majority:
        component.seen = max(component.epoch, component.seen) + SKIPPED_EPOCHS
    claim(component, turn, component.newest, "an operator promoted it")
    component.ordered = True
    component.alone_right, component.claimed = True, False


def _go_on_with_the_claim(component: Component, turn: Turn, request: int) -> None:
    """It waits for the consent of robots that are silent: the operator gives it."""
    component.request = component.request or request
    component.alone_right, component.claimed, component.ordered = True, False, True
    turn.say(component, f"{turn.me} continues its claim without the others: an operator promoted it")
    if component.request != request:
        turn.order(acts.Answer(request, True, f"{component.name} resumes at {turn.me}"))


def _let_it_go_on(component: Component, turn: Turn, request: int) -> None:
    """The copy that stands still here goes on, under an epoch in which no other robot may take it over."""
    component.entrusted, component.standby, component.ordered = (), "", True
    renew(component, turn, max(component.epoch, component.seen) + SKIPPED_EPOCHS)
    turn.say(component, f"{turn.me} does not wait for the others: an operator promoted it")
    turn.order(acts.Answer(request, True, f"{component.name} resumes at {turn.me}"))


def _may_act(component: Component, turn: Turn) -> list[str]:
    """Silent robots that might run it, or begin to, while it runs here."""
    silent = [robot for robot in turn.config.peers if turn.config.runs(robot) and not turn.alive(robot)]
    return [robot for robot in silent if not _stands_still(component, robot)]


def _stands_still(component: Component, robot: str) -> bool:
    """A primary that has entrusted this robot acts on a lease from here, where safety was chosen."""
    return component.freezes and component.trusted and component.primary == robot


def _double(turn: Turn, robot: str) -> str:
    silent_s = (turn.now_ns - turn.team.peers[robot].heard_ns) / (1_000 * MS)
    unread = turn.team.unread(robot, turn.now_ns)
    how = f"lives and cannot be authenticated ({unread}):" if unread else f"has not been heard for {silent_s:.0f} s; if it lives"
    return (
        f"{robot} {how} it may run it too, until they hear each other; then the copy of {turn.me} continues, "
        f"and {robot} keeps its state aside"
    )


def _newer(component: Component, turn: Turn) -> list[str]:
    best = _best(component, turn)
    if component.holding or best is None:
        return []
    keeper, newest = best
    seen = [robot for robot, entry in living_entries(component, turn) if entry.position is not None and newest < entry.position]
    if seen or not turn.config.by_majority or majority.holds_all(component, turn, keeper, newest):
        return seen
    return [robot for robot in dict.fromkeys((*component.entrusted, component.primary)) if robot not in ("", turn.me, keeper)]


def _loss(component: Component, turn: Turn) -> str:
    where = f"{component.name} would resume at {turn.me}"
    if component.state is State.FROZEN:
        return f"{where}, where it is frozen"
    if restarts.waits(component):
        return f"{where}, where it waits to be started anew"
    best = _best(component, turn)
    if component.state is State.CLAIMING:
        best = (turn.me, component.plan) if component.plan else None
    if best is None:
        return f"{where} from the beginning"
    keeper, position = best
    if keeper != turn.me:
        return f"{where} from checkpoint {position.sequence}, which {keeper} keeps and sends first; the work since then is lost"
    age = f", {(turn.now_ns - component.stored_ns) / (1_000 * MS):.1f} s old" if component.stored_ns >= 0 else ""
    return f"{where} from checkpoint {position.sequence}{age}; the work since then is lost"


def _loyalty(turn: Turn) -> int:
    return turn.config.loyalty_ns // MS
