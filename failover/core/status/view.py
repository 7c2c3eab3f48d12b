"""The content of ``failover status``: one robot's view of the team, and the promise in force in one sentence."""

from __future__ import annotations

from msgspec.structs import replace

from failover.core.component import NEVER_NS, Component, Turn
from failover.core.election import pair, sites
from failover.core.election.consent import state_of
from failover.core.peer_claims import Testimony
from failover.core.replication import archived, standby
from failover.core.replication.warm_standby import is_warm
from failover.core.status import guarantee
from failover.core.transitions import drain, failback, restarts
from failover.core.types import MS, ComponentView, Protection, State, StatusView

NS_PER_S = 10**9
US_PER_MS = 1_000

SLOW_FACTOR = 2
"""Deltas that take so many periods to become checkpoints are told of: fewer are taken, and each carries more."""

STALE_NS = 2 * NS_PER_S
"""An older checkpoint breaks the promise: the protection is degraded while the next one does not arrive."""


COPIES_LATE = 3
"""Periods of the archive: where its copy alone protects a component, an older one degrades the protection."""


def status(components: dict[str, Component], turn: Turn, boot: int, testimony: Testimony) -> StatusView:
    """Everything, as this robot sees it."""
    views = tuple(_component(component, turn) for _, component in sorted(components.items()) if not _is_nothing(component, turn))
    peers = tuple(
        replace(peer, refused=testimony.told(peer.robot, turn.now_ns), doubted=testimony.is_recent(peer.robot, turn.now_ns))
        for peer in turn.team.views(turn.now_ns)
    )
    bad = any(view.protection is Protection.DEGRADED or view.state in (State.FAILED, State.FROZEN) for view in views)
    bad = bad or any(view.cold or view.unstored for view in views) or any(one.is_exhausted for one in components.values())
    bad = bad or bool(turn.team.at_odds(turn.now_ns)) or any(peer.unread or peer.doubted for peer in peers)
    lost = any(peer.state == "dead" for peer in peers)
    informed = all(not turn.team.unheard(peer.robot) or turn.dead(peer.robot) for peer in peers)
    return StatusView(
        turn.me, boot, str(turn.config.rule), guarantee.team(turn), not bad and not lost, peers, views, turn.drained, informed
    )


def _is_nothing(component: Component, turn: Turn) -> bool:
    """Whether it is a name alone: heard of only, or of a start that was refused, whose epoch must not be forgotten.

    What agent.toml declares is more, where it waits for other sites: an operator looks for it.
    """
    if component.state is State.ABSENT:
        return not (component.autostart and turn.config.runs(turn.me) and sites.waits_ns(component, turn))
    return component.state is State.RELEASED and component.spec is None


def _component(component: Component, turn: Turn) -> ComponentView:
    protection = _protection(component, turn)
    acked_ns = archived.sealed_ns(component) if archived.is_alone(component, turn) else component.acked_ns
    lag_ns = turn.now_ns - acked_ns if acked_ns >= 0 and component.holding else -1
    return ComponentView(
        component.name,
        component.state,
        component.epoch,
        component.primary,
        _standby(component, turn),
        protection,
        lag_ns,
        component.freeze_us,
        tuple(reversed(component.held)),
        guarantee.one(component, turn, protection),
        _notes(component, turn),
        component.status,
        component.lease_ns,
        component.rules.period_ms,
        component.spec.home if component.spec else "",
        component.rules.prefer,
        component.spec.owner if component.spec else None,
        is_warm(component, turn),
        component.cold,
        guarantee.differs(component, turn),
        component.unstored if component.state is State.STANDBY else "",
        restarts.waits(component),
        component.restarted,
        component.took_ns,
        sites.is_ours(component, turn),
    )


def _standby(component: Component, turn: Turn) -> str:
    if component.holding:
        return component.standby
    return turn.me if component.state is State.STANDBY and component.held else ""


def _protection(component: Component, turn: Turn) -> Protection:
    if component.unprotected:
        return Protection.STOPPED
    if not component.holding:
        return Protection.NONE
    if component.degraded or _overdue(component, turn):
        return Protection.DEGRADED
    if component.sealed is not None and archived.is_alone(component, turn):
        is_old = turn.now_ns - archived.sealed_ns(component) > COPIES_LATE * turn.config.copies_ms * MS + STALE_NS
        return Protection.DEGRADED if is_old else Protection.PROTECTED
    protected = component.acked is not None and component.standby in component.entrusted and turn.alive(component.standby)
    return Protection.PROTECTED if protected else Protection.NONE


def _archive_notes(component: Component, turn: Turn) -> list[str]:
    """How old what the archive has of it is, at its primary; at a robot that took it from there the same."""
    if archived.is_alone(component, turn):
        if component.sealed is None:
            return ["NOT PROTECTED: no standby of it is heard, and no copy of it is in the archive yet"]
        age_s = (turn.now_ns - archived.sealed_ns(component)) / NS_PER_S
        return [f"no standby of it is heard; its newest copy in the archive is {age_s:.0f} s old"]
    is_idle = component.bare and component.freed_ns > 0
    if not turn.config.copies_ms or component.state is not State.STANDBY or (turn.alive(component.primary) and not is_idle):
        return []
    if not component.held:
        unheard = f"does not hear {component.primary}" if component.primary != turn.me else "has lost what it held"
        return [f"NOT PROTECTED: {turn.me} {unheard}, and no copy of it came from the archive yet"]
    notes = []
    if component.fetched is not None and archived.gave(component, component.held[-1]):
        age_s = (turn.now_ns - component.fetched[1]) / NS_PER_S
        notes.append(f"its checkpoint here came from the archive and is {age_s:.0f} s old")
    if archived.is_told_by_it_alone(component):
        notes.append(
            f"the archive alone tells of it: it may have ended, or run on at a robot that released it; failover handover "
            f"{component.name} resumes it at {turn.me}, failover release {component.name} forgets it"
        )
    elif component.freed_ns and archived.waits(component, turn):
        notes.append(f"{turn.me} looks into the archive before it takes it over")
    elif not turn.config.coordinator and is_idle:
        notes += _copy_waits(component, turn)
    return notes


def _copy_waits(component: Component, turn: Turn) -> list[str]:
    """Why a robot that has but a copy of the archive does not go on from it yet, where members vote."""
    if robot := archived.ended_for(component, turn):
        return [
            f"NOT PROTECTED: {robot} says that it has ended, and no robot remembers that: failover promote {component.name} "
            f"resumes it from its copy at {turn.me}, failover release {component.name} forgets it"
        ]
    robots = () if component.open else {component.primary, *component.entrusted} - {"", turn.me}
    if silent := [*archived.awaited(component, turn), *sorted(one for one in robots if not turn.alive(one))]:
        patience_s = turn.config.patience_ms / 1_000
        return [
            f"NOT PROTECTED: {' and '.join(silent)} may hold more than the archive: {turn.me} waits {patience_s:.0f} s at most; "
            f"start what is off; failover promote {component.name} resumes it from its copy at {turn.me} at once"
        ]
    return []


def _overdue(component: Component, turn: Turn) -> bool:
    """Snapshots are taken and do not become checkpoints; an old loss says nothing while there is nothing to take."""
    limit_ns = max(STALE_NS, 2 * component.rules.period_ms * MS)
    return bool(component.undelivered) and not component.awaited and turn.now_ns - _state_ns(component) > limit_ns


def _slow(component: Component, turn: Turn) -> str:
    """Where deltas take longer than their period allows: how seldom they are taken, and why; "" otherwise."""
    flight = component.flight
    under_way_ns = turn.now_ns - flight.started_ns if flight is not None and flight.parent is not None else 0
    took_ns, least_ns = max(component.took_ns, under_way_ns), standby.least_period_ns(component)
    period_ns = component.rules.period_ms * MS
    if not turn.alive(component.standby) or max(took_ns, least_ns) <= SLOW_FACTOR * period_ns:
        return ""
    why = f"a snapshot takes that long to reach {component.standby}"
    if least_ns > took_ns:
        still_ms, part = component.still_us / US_PER_MS, f"1/{standby.STILL_SHARE}"
        why = f"each capture stops it for {still_ms:.0f} ms, and captures may take {part} of its time"
        if least_ns == standby.cost_period_ns(component):
            share, cost_ms = component.rules.cpu_share, component.cost_us / US_PER_MS
            why = (
                f"each capture takes {cost_ms:.0f} ms of processor time, and captures may take {share:.1%} of a core (cpu_share)"
            )
    return (
        f"captured every {max(took_ns, least_ns) / NS_PER_S:.1f} s instead of every {period_ns / NS_PER_S:.1f} s: {why}; "
        "pages that it writes meanwhile travel once, in the next one"
    )


def _state_ns(component: Component) -> int:
    """When the newest state was captured from which another robot, or this one, could go on; -1 if there is none."""
    return max(component.acked_ns, component.resumed_ns)


def _age(component: Component, turn: Turn) -> str:
    state_ns = _state_ns(component)
    return (
        f"the last checkpoint is {(turn.now_ns - state_ns) / NS_PER_S:.1f} s old"
        if state_ns >= 0
        else "there is no checkpoint yet"
    )


def _ending(component: Component, turn: Turn) -> list[str]:
    """Living peers that are clearing away a copy of their own: a process that waits inside the kernel takes its time to end."""
    entries = ((peer.robot, peer.entry(component.name)) for peer in turn.team.living(turn.now_ns))
    return [robot for robot, entry in entries if entry is not None and state_of(entry) is State.STOPPING]


def _waits_after_boot(component: Component, turn: Turn, left_ns: int) -> str:
    silent = pair.unheard(component, turn)
    waiting = f"waiting: {' and '.join(silent)} may run it and was not heard since {turn.me} started"
    unknown = [robot for robot in silent if robot not in turn.team.peers]
    claims = f"{turn.me} claims it in {left_ns / NS_PER_S:.0f} s"
    if unknown and turn.team.strangers_until_ns() > turn.now_ns:
        waiting += f"; team.toml here does not know {' and '.join(unknown)}, and a robot that it does not know sends to {turn.me}"
        return f"{waiting}: bring the newest team.toml here; {claims} after the last sign of it; failover promote does not wait"
    if unknown:
        waiting += f"; team.toml here does not know {' and '.join(unknown)}: bring the newest one if it is still of the team"
    return f"{waiting}; {claims} (boot_patience_s); failover promote does not wait"


def _unread(turn: Turn) -> str:
    """Which robots live, and only cannot be authenticated."""
    waited_for = [robot for robot in turn.team.peers if turn.team.keeps_waiting(robot, turn.now_ns)]
    told = (f"{robot} lives and cannot be authenticated: {turn.team.unread(robot, turn.now_ns)}" for robot in waited_for)
    return "; ".join(told)


def _unable(component: Component, turn: Turn) -> str:
    left_s = max(component.retry_ns - turn.now_ns, 0) / NS_PER_S
    again = f"; {turn.me} tries again in {left_s:.0f} s" if component.retry_ns < NEVER_NS else ""
    return f"{turn.me} cannot run it: {component.unable}{again}"


def _notes(component: Component, turn: Turn) -> tuple[str, ...]:
    notes = []
    if waiting := restarts.note(component, turn.now_ns):
        notes.append(waiting)
    if component.degraded and component.holding:
        notes.append(f"not captured: {component.degraded}; {_age(component, turn)}")
    elif component.awaited and component.holding:
        notes.append(f"nothing to protect yet: {component.awaited}; {_age(component, turn)}")
    elif component.holding and _overdue(component, turn):
        notes.append(f"snapshots do not arrive: {component.undelivered}; {_age(component, turn)}")
    notes += _archive_notes(component, turn)
    if component.holding and (slow := _slow(component, turn)):
        notes.append(slow)
    if _protection(component, turn) is Protection.NONE and component.holding and (ending := _ending(component, turn)):
        notes.append(f"{' and '.join(ending)} cannot stand by yet: that robot still ends its own copy")
    if component.holding and component.lost_ns >= STALE_NS:
        lost_s = component.lost_ns / NS_PER_S
        notes.append(f"it resumed at {turn.me} from its last checkpoint and lost {lost_s:.1f} s of its work")
    if moving := drain.note(component, turn):
        notes.append(moving)
    if staying := failback.note(component, turn):
        notes.append(staying)
    if component.unstored and component.state is State.STANDBY:
        notes.append(f"a snapshot was not stored at {turn.me}: {component.unstored}")
    if component.state is State.STANDBY and (left_ns := pair.waits_after_boot_ns(component, turn)):
        notes.append(_waits_after_boot(component, turn, left_ns))
    is_idle = component.state in (State.ABSENT, State.STANDBY) and not component.is_elsewhere
    if is_idle and (left_ns := sites.waits_ns(component, turn)):
        begins = "claims" if component.epoch else "starts"
        notes.append(
            f"waiting: an operator may have recovered it at another site, and not every site has answered since {turn.me} started"
            f"; {turn.me} {begins} it in {left_ns / NS_PER_S:.0f} s (boot_patience_s)"
            + ("; failover promote does not wait" if component.epoch else "")
        )
    if contention := sites.contention(component, turn):
        notes.append(contention)
    if component.is_elsewhere:
        notes.append(
            f"an operator recovered it at {component.primary}, of another site, which has it now: no robot of this site runs it "
            f"by itself; {sites.CURE.format(component.name)}"
        )
    if component.state in (State.STANDBY, State.FROZEN) and (unread := _unread(turn)):
        notes.append(f"waiting: {unread}; failover promote does not wait")
    if (
        component.primary
        and component.state is State.STANDBY
        and (left_ns := turn.team.awaited_ns(component.primary, turn.now_ns))
    ):
        is_asked = turn.team.peers[component.primary].is_asked
        why = (
            "restarts, as it announced"
            if is_asked
            else f"is not heard, and {turn.me} has promised to wait when it restarted itself"
        )
        notes.append(f"the agent of {component.primary} {why}: {left_ns / NS_PER_S:.0f} s more it is waited for")
    if component.unprotected:
        notes.append(
            "not protected any more: on_unsupported = stop_protecting; to protect it again: failover release, then protect"
        )
    if component.cold:
        notes.append(f"its program does not wait at {turn.me}, so a takeover would take longer, or fail: {component.cold}")
    if component.unable:
        notes.append(_unable(component, turn))
    if component.state is State.FROZEN:
        who = "no majority" if component.elects else "no robot entrusted with it"
        notes.append(f"held still: {who} hears this robot; it resumes when the peers are back")
    if component.state is State.CLAIMING and turn.now_ns > component.until_ns:
        notes.append("waiting until the other robots agree: when_alone = freeze")
    if spent := pair.exhaustion(component, turn.me):
        notes.append(spent)
    if component.reason:
        notes.append(component.reason)
    return tuple(notes)
