"""Builds what ``failover status`` shows: the core's view and what the worker process knows. Fields: `failover.client.control`."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from msgspec import Struct, field
from msgspec.structs import asdict

from agent.config import Settings
from agent.guard.output_pump import HOLD_LIMIT
from agent.main_loop.messages import Life, MediumView, Told
from agent.system import clock
from agent.worker.control import fencing_status
from agent.worker.network.replication_link import LinkState, PeerConnection
from checkpoint.device_rules import merged, missing
from checkpoint.engine import COOPERATIVE, PTRACE
from failover.core.frames.terms import SlotsView
from failover.core.types import COMMITTED, COORDINATOR, IMMEDIATE, ComponentView, PeerView, Protection, Rule, State, StatusView

if TYPE_CHECKING:  # a witness shows its status too, and has none of these
    from agent.worker.components.statistics import Commits, Figures, Memory, Resumed
    from agent.worker.components.supervisor import Supervisor
    from checkpoint.store.contract import Kept, SnapshotStore

NANOSECONDS_A_MILLISECOND: Final = 1_000_000

STATES: Final[dict[State, str]] = {
    State.CLAIMING: "starting",
    State.STARTING: "starting",
    State.PRIMARY: "running",
    State.FROZEN: "frozen",
    State.HANDING_OVER: "running",
    State.RECOVERING: "restoring",
    State.TAKING_OVER: "restoring",
    State.STOPPING: "ended",
    State.STANDBY: "held",
    State.FINISHED: "ended",
    State.FAILED: "failed",
    State.RELEASED: "released",
    State.ABSENT: "absent",
}
PRIMARY_STATES: Final = frozenset(
    {State.CLAIMING, State.STARTING, State.PRIMARY, State.FROZEN, State.HANDING_OVER, State.RECOVERING, State.TAKING_OVER}
)
AWAITED: Final = "its agent restarts, as it announced; {} replaces it in {:.0f} s, if it is not back by then"
PROMISED: Final = (
    "{0} has promised to wait for it, as {0} itself restarted; {0} replaces it in {1:.0f} s, if it is not back by then"
)

PEER_STATES: Final = {"alive": "live", "unheard": "unknown"}


@cache
def version() -> str:
    """Of the installed package: its record's name tells, and importlib.metadata would take 3 MB for as much."""
    records = (path for place in sys.path for path in Path(place or ".").glob("failover-*.dist-info"))
    return next((path.stem.partition("-")[2] for path in records), "unknown")


class WorkerView(Struct, frozen=True):
    """What the worker knows beside the main loop's answer.

    Attributes:
        supervisors: by component; none at a witness.
        links: the replication link to each peer.
        notices: sentences.
        interfaces: as the status shows them.
        store: None at a witness.
        memory: None at a witness.
        arriving: what of a component is on its way to other robots, as the status shows it.
        sealed: its sealed copies at a witness, as the status shows them; None: there are none.
    """

    links: Mapping[str, PeerConnection]
    notices: list[str]
    interfaces: list[dict[str, object]]
    supervisors: Mapping[str, Supervisor] = field(default_factory=dict)
    store: SnapshotStore | None = None
    memory: Memory | None = None
    arriving: Callable[[str], list[dict[str, Any]]] = lambda _: []
    sealed: Callable[[str], dict[str, Any] | None] = lambda _: None
    items_heard: Callable[[str], int | None] = lambda _: None


def team_view(settings: Settings, life: Life, told: Told, ours: WorkerView) -> dict[str, Any]:
    """The whole picture."""
    view = told.status
    notes = [*life.notes, *ours.notices, *told.troubles]
    beats = told.beats
    return {
        "robot": settings.config.robot,
        "team": settings.team.team,
        "role": settings.me.role,
        "pid": life.main_loop,
        "version": version(),
        "life": life.boot,
        "insecure": settings.config.insecure,
        "realtime": settings.config.realtime and not life.notes,
        "rule": view.rule if view else None,
        "promise": view.promise if view else "not decided yet: the agent is starting",
        "memory": asdict(ours.memory) if ours.memory is not None else None,
        "descriptors": {"main_loop": _descriptors(life.main_loop), "worker": _descriptors(os.getpid())},
        "fencing": fencing_status.sentence(fencing_status.watchdog()),
        "healthy": view.healthy if view else False,
        "drained": view.drained if view else False,
        "notes": notes,
        "reservations": [],
        "links": ours.interfaces,
        "media": [_medium(one) for one in told.media],
        "coordinator": _coordinator(view),
        "peers": [_peer(peer, ours.links.get(peer.robot), told, settings) for peer in _members(view, settings)],
        "far": [_far(name, robot.site, robot.role, ours) for name, robot in settings.far.items()],
        "components": [
            _component(one, ours.supervisors.get(one.name), settings, ours.store)
            | {"arriving": ours.arriving(one.name), "sealed": ours.sealed(one.name)}
            for one in (view.components if view else ())
        ],
        "beats": {
            "sent": beats.sent,
            "heard": beats.heard,
            "unsent": beats.unsent,
            "refused": dict(beats.refused),
            "late_us_max": beats.late_us_max,
            "gap_us_max": beats.gap_us_max,
            "gaps": beats.gaps,
            "items": dict(beats.items),
        },
        "lanes_pid": os.getpid(),
    }


def _descriptors(pid: int) -> int | None:
    """How many a process of this agent has open; None where the system does not tell."""
    try:
        return len(os.listdir(f"/proc/{pid}/fd"))
    except OSError:
        return None


def _coordinator(view: StatusView | None) -> dict[str, Any] | None:
    """etcd, where it has a vote."""
    etcd = next((peer for peer in view.peers if peer.robot == COORDINATOR), None) if view and view.rule == Rule.ETCD else None
    if etcd is None:
        return None
    silent_ms = etcd.silent_ns // NANOSECONDS_A_MILLISECOND if etcd.boot else None
    return {"name": etcd.robot, "state": PEER_STATES.get(etcd.state, etcd.state), "last_heard_ms": silent_ms}


def _members(view: StatusView | None, settings: Settings) -> list[PeerView]:
    """The peers, without those of which one process has heard already that they left."""
    return [peer for peer in view.peers if peer.robot in settings.team.robots] if view else []


def _medium(view: MediumView) -> dict[str, Any]:
    return {
        "link": view.link,
        "cast": view.cast,
        "because": view.because,
        "by_unicast": list(view.by_unicast),
        "period_ms": view.period_ms,
        "no_slots": view.no_slots,
        "bytes": dict(view.bytes),
        "slots": _slots(view.slots) if view.slots is not None else None,
    }


def _slots(view: SlotsView) -> dict[str, Any]:
    peers = [{**asdict(peer), "seen": peer.seen.name.lower(), "hears": list(peer.hears)} for peer in view.peers]
    return {
        **asdict(view),
        "own": str(view.own),
        "members": list(view.members),
        "deaf": list(map(list, view.deaf)),
        "peers": peers,
    }


def _peer(peer: PeerView, link: PeerConnection | None, told: Told, settings: Settings) -> dict[str, Any]:
    awaited_s = peer.awaited_ns / NANOSECONDS_A_MILLISECOND / 1_000
    why = AWAITED if peer.is_asked else PROMISED
    awaited = why.format(settings.config.robot, awaited_s) if peer.awaited_ns else ""
    reason = list(dict.fromkeys(filter(None, (awaited, link.reason if link is not None else "", peer.unread, *peer.refused))))
    return {
        "name": peer.robot,
        "role": settings.team.robots[peer.robot].role,
        "state": PEER_STATES.get(peer.state, peer.state),
        "last_heard_ms": peer.silent_ns // NANOSECONDS_A_MILLISECOND if peer.silent_ns >= 0 else None,
        "hears_us": peer.hears_us,
        "load": peer.load,
        "links": list(peer.links),
        "lane": str(link.state if link is not None else LinkState.DOWN),
        "beats_lost": told.beats.lost.get(peer.robot, 0),
        "doubted": peer.doubted,
        "drained": peer.drained,
        "notes": reason,
    }


def _far(name: str, site: str, role: str, ours: WorkerView) -> dict[str, Any]:
    """A member of another site."""
    link = ours.links.get(name)
    return {
        "name": name,
        "site": site,
        "role": role,
        "lane": str(link.state if link is not None else LinkState.DOWN),
        "items_heard_ms": ours.items_heard(name),
        "notes": [link.reason] if link is not None and link.reason else [],
    }


def _own_notes(view: ComponentView, figures: Figures | None) -> tuple[str, ...]:
    """What this robot's own work on it found out."""
    if figures is None:
        return ()
    return (*figures.notes, *_overdue(view, figures), *figures.hooks.values(), *figures.bringing.values())


def _over_budget(view: ComponentView, figures: Figures | None, settings: Settings) -> tuple[str, ...]:
    """Where its snapshots do not keep to what its operator allows them."""
    budget_ms = settings.component(view.name).freeze_budget_ms
    if figures is None or not budget_ms or view.state not in PRIMARY_STATES:
        return ()
    remark = figures.budget.remark(budget_ms)
    return (remark,) if remark else ()


def _squeezed(view: ComponentView, figures: Figures | None) -> tuple[str, ...]:
    """Which of its tasks a capture delays."""
    if figures is None or view.state not in PRIMARY_STATES:
        return ()
    remark = figures.slack.remark()
    return (remark,) if remark else ()


def _slack(view: ComponentView, figures: Figures | None) -> dict[str, Any] | None:
    """How its captures met the activations of its tasks, at its primary; None: it has no tasks."""
    last = figures.slack.last if figures is not None and view.state in PRIMARY_STATES else None
    if figures is None or last is None:
        return None
    return {
        "task": last.task,
        "captures": figures.slack.captures,
        "squeezed": figures.slack.squeezed,
        "slack_us": last.slack_ns // 1000,
        "freeze_us": last.freeze_ns // 1000,
        "waited_us": last.waited_ns // 1000,
        "began_ns": last.began_ns,
        "ended_ns": last.ended_ns,
    }


def _lacks(view: ComponentView, figures: Figures | None) -> tuple[str, ...] | None:
    """What this robot, a standby, would refuse in a takeover, while there is time to do something about it; None: not known."""
    return figures.lacks if figures is not None and view.state is State.STANDBY else None


def told_lacks(view: ComponentView, supervisor: Supervisor | None, robot: str) -> list[str]:
    """The same for people; what a hook perhaps brings before the program goes on is no refusal yet."""
    if supervisor is None:
        return []
    lacks = _lacks(view, supervisor.figures) or ()
    if supervisor.is_prepared_first:
        return [f"{robot} lacks this now, and the hook before_resume must bring it: {lack}" for lack in lacks]
    return [f"{robot} could not resume it: {lack}" for lack in lacks]


def _contested(view: ComponentView, figures: Figures | None) -> tuple[str, ...]:
    """Which of its files others hold open for writing where it runs: a restore of it would be refused."""
    return figures.contested if figures is not None and view.state in PRIMARY_STATES else ()


def _hung_up_devices(view: ComponentView, figures: Figures | None, settings: Settings) -> tuple[str, ...]:
    """Which devices a standby lacks that the program would find hung up there."""
    if figures is None or view.state is not State.STANDBY:
        return ()
    wanted = {rule.path for rule in figures.devices}
    rules = merged(figures.devices, settings.component(view.name).device_rules())
    optional = (rule for rule in rules if rule.path in wanted and rule.optional)
    return tuple(f"{settings.config.robot} {lack}" for lack in missing(optional))


def _waiting_output(view: ComponentView, waiting: int) -> tuple[str, ...]:
    """What becomes of held output while no checkpoint of it reaches another robot."""
    if not waiting or view.protection is Protection.PROTECTED:
        return ()
    limit = f"at {HOLD_LIMIT >> 20} MiB of a stream the program waits in its next write"
    return (
        f"{waiting} bytes of its output are held back (--output=committed): no other robot holds a checkpoint of them; {limit}",
    )


def _component(
    view: ComponentView, supervisor: Supervisor | None, settings: Settings, store: SnapshotStore | None
) -> dict[str, Any]:
    figures = supervisor.figures if supervisor is not None else None
    running = supervisor.component if supervisor is not None else None
    newest = view.positions[0] if view.positions else None
    engine = running.engine if running is not None else figures.engine if figures is not None else PTRACE
    held = running is not None and running.logs.is_held
    waiting = running.logs.waiting() if running is not None and held else 0
    degraded = view.protection in (Protection.DEGRADED, Protection.STOPPED) and view.state is State.PRIMARY
    return {
        "name": view.name,
        "role": "primary" if view.state in PRIMARY_STATES else "standby" if view.state is State.STANDBY else "none",
        "primary": view.primary,
        "state": "degraded" if degraded else "restarting" if view.restarting else STATES[view.state],
        "protection": str(view.protection),
        "epoch": view.epoch,
        "generation": newest.generation if newest else None,
        "sequence": newest.sequence if newest else None,
        "engine": engine,
        "warm": view.warm if engine == COOPERATIVE else None,
        "cold": view.cold,
        "ready": view.warm if engine != COOPERATIVE and view.standby else None,
        "ready_copy": _ready_copy(view, figures),
        "pid": running.pid if running is not None else None,
        "inner_pid": running.inner_pid if running is not None else None,
        "isolated": running.isolated if running is not None else None,
        "standby": view.standby,
        "standby_sequence": newest.sequence if newest and view.standby else None,
        "lag_ms": view.lag_ns / NANOSECONDS_A_MILLISECOND if view.lag_ns >= 0 else None,
        "took_ms": view.took_ns / NANOSECONDS_A_MILLISECOND if view.took_ns else None,
        "period_ms": view.period_ms,
        **_commits(view, figures),
        "freeze_us": figures.freeze_us if figures else view.freeze_us or None,
        "freeze_us_max": figures.freeze_us_max if figures else None,
        "freeze_budget_missed": figures.budget.missed if figures else 0,
        "slack": _slack(view, figures),
        "snapshot_size": figures.snapshot_size if figures else None,
        "dirty_bytes": figures.dirty_bytes if figures else None,
        "xor_hit_rate": figures.xor_hit_rate if figures else None,
        "snapshots": figures.snapshots if figures else 0,
        "restores": figures.restores if figures else 0,
        "crashes": figures.crashes if figures else 0,
        "outage_ms": figures.outage_ms if figures else None,
        "resumed": _resumed(figures.resumed) if figures and figures.resumed else None,
        "restarts": view.restarted,
        "exit_status": view.status if view.state is State.FINISHED or (view.state is State.FAILED and view.status) else None,
        "kept": _kept(store.kept(view.name) if store is not None else None),
        "unstored": view.unstored,
        "lacks": _lacks(view, figures),
        "contested": list(_contested(view, figures)),
        "prepared_first": supervisor is not None and supervisor.is_prepared_first,
        "promise": view.promise,
        "promise_differs": view.differs,
        "home": view.home,
        "prefer": view.prefer,
        "owner": view.owner,
        "reserved": None,
        "output": COMMITTED if held else IMMEDIATE,
        "output_waiting": waiting,
        "reasons": list(figures.reasons) if figures else [],
        "notes": [
            *view.notes,
            *told_lacks(view, supervisor, settings.config.robot),
            *(f"NOT PROTECTED, a restore of it is refused: {reason}" for reason in _contested(view, figures)),
            *_own_notes(view, figures),
            *_over_budget(view, figures, settings),
            *_squeezed(view, figures),
            *_hung_up_devices(view, figures, settings),
            *_waiting_output(view, waiting),
        ],
    }


def _resumed(resumed: Resumed) -> dict[str, Any]:
    """How it came to run here."""
    return {
        "at": clock.wall_ns(resumed.at_ns) / 1e9,
        "robot": resumed.robot,
        "state_at": resumed.state_at_ns / 1e9,
        "sequence": resumed.position.sequence,
    }


def _ready_copy(view: ComponentView, figures: Figures | None) -> dict[str, Any] | None:
    """Of the ready copy at this robot, where it stands by: its memory, where it stands, or why there is none."""
    if figures is None or view.state is not State.STANDBY or figures.engine == COOPERATIVE:
        return None
    copy = figures.copy
    position = {"generation": copy.position.generation, "sequence": copy.position.sequence} if copy.position else None
    return {"ready": copy.ready, "wanted": copy.wanted, "size": copy.size, "position": position, "why": copy.why}


def _kept(kept: Kept | None) -> dict[str, Any] | None:
    """What this robot's store has of it."""
    if kept is None:
        return None
    now_s = clock.wall_ns(clock.now_ns()) / 1e9
    ages = {"newest_age_s": max(now_s - kept.newest_s, 0.0), "oldest_age_s": max(now_s - kept.oldest_s, 0.0)}
    return {"checkpoints": kept.positions, "older": kept.olds, "size": kept.size, **ages}


def _commits(view: ComponentView, figures: Figures | None) -> dict[str, Any]:
    """Of a program that keeps its state and runs here: how old its newest commit is, and how often it used to commit."""
    commits = _running_commits(view, figures)
    if commits is None:
        return {"commit_age_ms": None, "commit_usual_ms": None, "commit_overdue": False}
    now_ns, usual_ns = clock.now_ns(), commits.usual_ns
    return {
        "commit_age_ms": (now_ns - commits.newest_ns) / NANOSECONDS_A_MILLISECOND,
        "commit_usual_ms": usual_ns / NANOSECONDS_A_MILLISECOND if usual_ns is not None else None,
        "commit_overdue": commits.is_overdue(now_ns),
    }


def _overdue(view: ComponentView, figures: Figures | None) -> list[str]:
    commits, now_ns = _running_commits(view, figures), clock.now_ns()
    return [commits.remark(now_ns)] if commits is not None and commits.is_overdue(now_ns) else []


def _running_commits(view: ComponentView, figures: Figures | None) -> Commits | None:
    runs = view.state in (State.PRIMARY, State.HANDING_OVER)
    return figures.commits if runs and figures is not None and figures.commits.number else None
