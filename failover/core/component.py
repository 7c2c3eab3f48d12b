"""One component on one robot: its state, the table of its states, and the changes that one step may make."""

from __future__ import annotations

import enum
from collections import deque

from msgspec import Struct, field

from checkpoint.model import Position
from failover.core.acts import Act
from failover.core.event_log.decisions import Decision, Facts, Sighting
from failover.core.membership import Membership
from failover.core.types import (
    ENDED,
    EPOCH_MAX,
    HISTORY_MAX,
    HOLDING,
    RESTARTS_MAX,
    SPAN,
    ComponentSpec,
    Config,
    OnLoss,
    Record,
    Resumption,
    Rules,
    State,
    VoteRecord,
    Waiting,
    WhenAlone,
)

LOST_MAX = 8
"""Generations that lost and are remembered; the agent moves their snapshots out of the chain long before."""


NEVER_NS = 1 << 62
"""An instant that does not come."""


EPOCHS_LEFT_MIN = 3
"""An operator's claim leaves one epoch out, and its answer goes above it."""


class Cause(enum.StrEnum):
    """A cause that moves a component from one state to another."""

    CLAIM = "claims it"
    START = "may start it"
    RESTORE = "may restore it"
    RUNS = "runs it"
    LEASE_OVER = "freezes it: its lease is over"
    LEASE_BACK = "is heard again"
    CRASH = "saw it crash"
    RESTART = "starts it anew"
    HAND_OVER = "hands it over"
    CALL_OFF = "calls the handover off"
    OUTBID = "gives its copy up"
    YIELD_CLAIM = "gives its claim up"
    CLEARED = "has cleared its copy away"
    FOLLOW = "keeps its checkpoints"
    CANNOT = "cannot run it"
    FINISH = "records its end"
    FAIL = "records its failure"
    RELEASE = "releases it"


_RUNNING = (State.STARTING, State.TAKING_OVER, State.PRIMARY, State.FROZEN, State.HANDING_OVER, State.RECOVERING)
_RUNS_HERE = (State.PRIMARY, State.FROZEN, State.HANDING_OVER, State.RECOVERING)
_IDLE = (State.ABSENT, State.STANDBY, State.FINISHED, State.FAILED, State.RELEASED)

TABLE: dict[tuple[State, Cause], State] = {
    **{(state, Cause.CLAIM): State.CLAIMING for state in _IDLE},
    (State.CLAIMING, Cause.START): State.STARTING,
    **{(state, Cause.RESTART): State.RECOVERING for state in _RUNNING},
    (State.RECOVERING, Cause.START): State.STARTING,
    (State.CLAIMING, Cause.RESTORE): State.TAKING_OVER,
    (State.CLAIMING, Cause.YIELD_CLAIM): State.STANDBY,
    (State.STARTING, Cause.RUNS): State.PRIMARY,
    (State.TAKING_OVER, Cause.RUNS): State.PRIMARY,
    (State.RECOVERING, Cause.RUNS): State.PRIMARY,
    (State.PRIMARY, Cause.LEASE_OVER): State.FROZEN,
    (State.FROZEN, Cause.LEASE_BACK): State.PRIMARY,
    (State.PRIMARY, Cause.HAND_OVER): State.HANDING_OVER,
    (State.HANDING_OVER, Cause.CALL_OFF): State.FROZEN,
    **{(state, Cause.CRASH): State.RECOVERING for state in _RUNS_HERE},
    (State.STARTING, Cause.CRASH): State.RECOVERING,
    (State.TAKING_OVER, Cause.CRASH): State.RECOVERING,
    **{(state, Cause.OUTBID): State.STOPPING for state in (*_RUNNING, *ENDED)},
    **{(state, Cause.CANNOT): State.STOPPING for state in (State.TAKING_OVER, *_RUNS_HERE)},
    (State.STOPPING, Cause.CLEARED): State.STANDBY,
    **{(state, Cause.FOLLOW): State.STANDBY for state in _IDLE},
    **{(state, Cause.FINISH): State.FINISHED for state in (*_RUNNING, *_IDLE, State.CLAIMING)},
    **{(state, Cause.FAIL): State.FAILED for state in (*_RUNNING, *_IDLE, State.CLAIMING)},
    **{(state, Cause.RELEASE): State.RELEASED for state in (*_RUNNING, *_IDLE, State.CLAIMING)},
}
"""Every arrow there is. No other one happens: ``Component.move`` asserts it."""


class Flight(Struct):
    """The one snapshot that is being taken, shipped or waited for.

    Attributes:
        position: None while it is being taken.
        state_ns: how old its state is counted from: the order, or, where the program commits, its commit.
        to: standby that it goes to; "" for this robot's own store only.
        final: the last delta of a handover.
        is_outdated: the program's first commit came while the snapshot was being taken.
    """

    started_ns: int
    until_ns: int
    to: str = ""
    position: Position | None = None
    parent: Position | None = None
    final: bool = False
    is_outdated: bool = False
    state_ns: int = 0


class Handing(Struct):
    """A handover under way. ``yielded``: the last delta is acknowledged, ``to`` may claim."""

    to: str
    request: int
    until_ns: int
    yielded: bool = False


class Wanted(Struct, frozen=True):
    """The checkpoint that a robot needs to carry out an operator's order; ``giver`` has at least ``position``."""

    request: int
    giver: str
    position: Position
    until_ns: int


class Component(Struct):
    """The facts that one robot knows of one component. The first block survives a restart (``types.Record`` explains it).

    Attributes:
        plan: while claiming: the position to restore, None to start afresh; ``resumption``: why the next process
            goes on from a checkpoint.
        alone_right: while claiming: may go on without the others' consent once they are dead.
        claim_counter: beat of ours that first carried the present epoch.
        generation, sequence: of the next snapshot; ``parent``: newest position that the keeper may count from.
        born: epoch under which the present process was started or restored.
        stood: this copy stood still, or began without a word of the robots that ran it before, since all peers last agreed to it.
        rival_ns: when this copy, which never stopped acting, first heard the present rival; ``told_of_ns``: of it, by others.
        inherited_ns: this life of the agent found it running under a lease: it acts until then, and no longer before this life
            has one of its own; 0: it did not, or it has. borrowed_ns: until when its guard may let it act on such a lease; 0: the
            guard has a shorter one.
        crashed: wait status of a program that died while it was held still; it is resumed when it may act.
        restart_ns: its program has ended, and is started anew at this instant; 0: it is not. restarts: when that was ordered, the
            last times; restarted: how often in this life of the agent. ended_how: the program, or a start that failed.
            said: by the program that has ended. unresumed: restores that failed since it crashed.
        safe: on a primary, the newest position that counts as acknowledged and is not here alone. vouched: on any other member,
            the newest position of which it was told so; ``shown``: the one up to which it lets readers see the output.
        took_ns: from the order of the last delta until it was a checkpoint, 0 if that was none; no other is taken meanwhile.
        freeze_us: how long it stood still for the last snapshot; ``still_us``: the shorter of the last two times.
        cpu_us: processor time that the last delta took; ``cost_us``: the shorter of the last two times.
        due_ns: next capture; ``until_ns``: when the present claim, start or restore is overdue.
        resumed_ns: how old the state is that this primacy began with, as an instant, -1 for a fresh start; time in which the
            program did not run is left out. lost_ns: how much of its work was lost then, at most.
        awaited: why there is nothing to capture, where that is as it should be.
        stored_ns: on a standby, when its newest checkpoint was stored, -1 if it was before this life of the agent.
        ending: an operator stops it; end_signal: with this signal, once it has started; 0: it was sent.
        elects: primaries are elected. free, open: then, what this robot would vote for (``majority.py``).
        ordered: the claim was, by an operator.
        former: the facts known of its namesake before an operator had it started.
        wanted: an operator promoted this robot, and a checkpoint is on its way here.
        remembered_epoch: the one that this life began with.
        seen: highest epoch that any member told of; a claim goes above it. contested_ns: when this copy, which stands still, last
            met another that does, or went above an epoch that only servers and witnesses know.
        behind_ns: since when this robot would claim it, and a server says that it keeps a newer checkpoint; 0: it does not wait.
        trail: the last acknowledged positions and their parents, for servers (`failover.core.replication.servers`).
            archives: on their way there.
        fetched: the position of the newest checkpoint that came from the archive, and when it was put there, by the clock of the
            robot that made it, which may be before this robot's computer started; None: none came.
            lags: the archive has a newer one than this robot. looked_ns: all that the archive had at this instant is in this
            robot's store. freed_ns: since when this robot could take it over, 0: it could not; asked_ns: when it last ordered a
            look into the archive for that. fresh: it has looked since then, and holds a checkpoint. let_go: this robot hears the
            old primary, which does not run it.
        sealed: on a primary, the position of the newest copy in the archive; sealed_ns: when that was taken, -1 if there is none.
        contender: a robot of another site where it was recovered, too, and in which span (`failover.core.election.sites`).
        promise: the sentence that the journal has of it, where it differs from the team's.
        unable: why this robot could not resume it; others may, from the checkpoint here, unless that is ``unusable``: it cannot
            be read, or its program refuses it. tries: how often in a row; retry_ns: this robot claims it no sooner.
        undelivered: why the last snapshot did not become a checkpoint; ``unstored``: on a standby, why it was not stored.
        keeps_state: on a standby: to go on from the newest snapshot is to start the program again.
        waiting: on a standby: the program that was ordered to wait, under ``waiting_epoch``; it is ready (``warm``) or, after
            something went wrong, ``cold`` says what.
        drain_ns: on the primary of a drained robot: when its standby is asked next whether it could go on there.
        return_ns: on a primary: when the robot where it would move back to is asked whether it could go on there; ``unfit``:
            what it lacks; ``back_ns``: since when that robot is heard without a break; ``replaced``: the standby before it, which
            takes its place again unless it takes a snapshot.
    """

    name: str
    epoch: int = 0
    primary: str = ""
    state: State = State.ABSENT
    entrusted: tuple[str, ...] = ()
    trusted: bool = False
    lost: tuple[int, ...] = ()
    status: int = 0
    reason: str = ""
    spec: ComponentSpec | None = None
    claimed: bool = False
    begun: bool = False
    bare: bool = False
    ended: tuple[int, int] = (0, 0)
    void: int = 0
    elsewhere: int = 0

    held: list[Position] = field(default_factory=list)
    autostart: bool = False
    plan: Position | None = None
    resumption: Resumption = Resumption.RESTARTED
    alone_right: bool = False
    claim_counter: int = 0
    request: int = 0
    until_ns: int = 0
    born: int = 0
    stood: bool = False
    rival_ns: int = 0
    told_of_ns: int = 0
    generation: int = 0
    sequence: int = 0
    parent: Position | None = None
    standby: str = ""
    flight: Flight | None = None
    due_ns: int = 0
    base_wanted: bool = False
    acked: Position | None = None
    acked_ns: int = -1
    safe: Position | None = None
    vouched: Position | None = None
    shown: Position | None = None
    took_ns: int = 0
    freeze_us: int = 0
    still_us: int = 0
    cpu_us: int = 0
    cost_us: int = 0
    degraded: str = ""
    awaited: str = ""
    undelivered: str = ""
    unstored: str = ""
    keeps_state: bool = False
    waiting: Waiting | None = None
    waiting_epoch: int = 0
    warm: bool = False
    cold: str = ""
    return_ns: int = 0
    back_ns: int = 0
    replaced: str = ""
    drain_ns: int = 0
    unfit: tuple[str, ...] = ()
    stored_ns: int = -1
    resumed_ns: int = -1
    lost_ns: int = -1
    unprotected: bool = False
    lease_ns: int = 0
    told_ns: int = 0
    inherited_ns: int = 0
    borrowed_ns: int = 0
    crashes: deque[int] = field(default_factory=lambda: deque(maxlen=128))
    crashed: int = 0
    restart_ns: int = 0
    restarts: deque[int] = field(default_factory=lambda: deque(maxlen=RESTARTS_MAX))
    restarted: int = 0
    ended_how: str = ""
    unresumed: int = 0
    said: str = ""
    handing: Handing | None = None
    ending: bool = False
    end_signal: int = 0
    needs_base: bool = False
    admitted: tuple[str, int] = ("", 0)
    unable: str = ""
    unusable: bool = False
    tries: int = 0
    retry_ns: int = 0
    reported: bool = False
    free: bool = False
    open: bool = False
    ordered: bool = False
    former: ComponentSpec | None = None
    wanted: Wanted | None = None
    elects: bool = False
    remembered_epoch: int = 0
    seen: int = 0
    contested_ns: int = 0
    behind_ns: int = 0
    trail: deque[tuple[Position, Position | None]] = field(default_factory=lambda: deque(maxlen=HISTORY_MAX))
    archives: dict[str, Flight] = field(default_factory=dict)
    archived_ns: int = 0
    fetched: tuple[Position, int] | None = None
    lags: bool = False
    looked_ns: int = 0
    freed_ns: int = 0
    asked_ns: int = 0
    fresh: bool = False
    let_go: bool = False
    sealed: Position | None = None
    sealed_ns: int = -1
    contender: tuple[str, int] = ("", 0)
    promise: str = ""

    @property
    def rules(self) -> Rules:
        """The operator's choices, or the defaults until they are known."""
        return self.spec.rules if self.spec else Rules()

    @property
    def home(self) -> str:
        """Where it would move back to: the robot that its operator prefers, else where it was started; "" where unknown."""
        return self.rules.prefer or (self.spec.home if self.spec else "")

    @property
    def freezes(self) -> bool:
        """Whether safety was chosen: no primary acts alone."""
        return self.rules.when_alone is WhenAlone.FREEZE

    @property
    def waits(self) -> bool:
        """Whether a standby keeps the checkpoint for the primary instead of running it."""
        return self.rules.on_loss is OnLoss.HOLD

    @property
    def holding(self) -> bool:
        """Whether this robot says: the primacy is mine."""
        return self.state in HOLDING

    @property
    def is_settled(self) -> bool:
        """Whether its copy is here, or is to be started anew after an end: it goes on above an epoch that came to nothing."""
        return self.state in (State.PRIMARY, State.FROZEN) or self.restart_ns > 0

    @property
    def has_begun(self) -> bool:
        """Whether a checkpoint of it is here, or was ever given away, as far as is known."""
        return self.begun or bool(self.entrusted or self.trusted or self.held)

    @property
    def span(self) -> int:
        """That of its epoch: how often an operator recovered it at another site."""
        return self.epoch // SPAN

    @property
    def is_elsewhere(self) -> bool:
        """Whether another site has it, by the order of an operator."""
        return self.elsewhere > 0 and self.elsewhere == self.span

    @property
    def named(self) -> str:
        """The robot that beats tell of as entrusted."""
        if self.unprotected and self.holding:
            return ""
        if self.holding and not self.elects:
            return self.standby if self.standby in self.entrusted else ""
        return self.entrusted[0] if self.entrusted else ""

    @property
    def is_exhausted(self) -> bool:
        """Whether there is no later epoch that a beat could carry: no robot claims it before its record is mended."""
        return max(self.epoch, self.seen) + EPOCHS_LEFT_MIN >= EPOCH_MAX

    def is_to_hold_all(self, robot: str) -> bool:
        """Whether the others count on a robot to hold all that was acknowledged."""
        return robot in (self.primary, *self.entrusted)

    @property
    def newest(self) -> Position | None:
        """Newest position that this robot holds, also where it cannot resume it now; none where that counts as lost."""
        return self.held[-1] if self.held and not self.unusable else None

    def move(self, cause: Cause) -> None:
        """Follow an arrow of the table."""
        arrow = (self.state, cause)
        assert arrow in TABLE, f"{self.name}: no arrow from {self.state} by {cause.name}"
        self.state = TABLE[arrow]
        if cause is not Cause.RESTART:
            self.restart_ns = 0

    def try_again(self) -> None:
        """What this robot could not resume is not what it would resume now."""
        self.unable, self.unusable, self.tries, self.retry_ns = "", False, 0, 0

    def hold(self, position: Position) -> None:
        """Remember a position that this robot's store can restore."""
        if position not in self.held:
            self.held = [*self.held, position][-HISTORY_MAX:]

    def record(self) -> Record:
        """The facts that must not be forgotten."""
        if self.holding:
            state = State.PRIMARY
        elif self.state is State.STOPPING:
            state = State.STANDBY
        else:
            state = self.state
        return Record(
            self.name,
            self.epoch,
            self.primary,
            state,
            self.entrusted,
            self.trusted,
            self.lost,
            self.status,
            self.reason,
            self.spec,
            self.claimed,
            self.has_begun,
            self.bare,
            self.ended,
            self.void,
            self.elsewhere,
        )

    @classmethod
    def remembered(cls, record: Record) -> Component:
        """The component as the vote record remembers it, before anything is known of its process."""
        return cls(
            record.name,
            record.epoch,
            record.primary,
            record.state,
            record.entrusted,
            record.trusted,
            record.lost,
            record.status,
            record.reason,
            record.spec,
            record.claimed,
            record.begun,
            record.bare,
            record.ended,
            record.void,
            record.elsewhere,
            remembered_epoch=record.epoch,
        )


class Turn(Struct):
    """One step: its instant, the facts that the rules may look at, their orders, and their sentences.

    Attributes:
        before: the vote record as the last step left it.
        late_ns: see `failover.core.event_log.decisions.Facts`.
        leaving: this agent is about to restart. drained: this robot is to run nothing.
        denied: (member, component): since when the member has been saying a word on it that the robot which it names denies.
    """

    now_ns: int
    config: Config
    team: Membership
    next_counter: int
    before: VoteRecord
    late_ns: int
    load: int = 0
    leaving: bool = False
    drained: bool = False
    denied: dict[tuple[str, str], int] = {}
    acts: list[Act] = field(default_factory=list)
    said: list[Decision] = field(default_factory=list)

    @property
    def me(self) -> str:
        """This robot."""
        return self.config.robot

    def order(self, act: Act) -> None:
        """An act, after those ordered before."""
        self.acts.append(act)

    def say(self, component: Component, sentence: str, output_pending: int = -1) -> None:
        """For ``failover why``: a decision about a component, with the facts known now."""
        before = next((record.epoch for record in self.before.records if record.name == component.name), 0)
        checkpoint, age_ns = _newest_checkpoint(component, self.now_ns)
        facts = Facts(
            self.next_counter,
            before,
            component.epoch,
            component.state,
            self.late_ns,
            max(component.lease_ns - self.now_ns, 0) if component.lease_ns else None,
            checkpoint,
            age_ns,
            output_pending,
            self._seen(component.name),
        )
        self.said.append(Decision(self.now_ns, component.name, sentence, facts))

    def say_of_robot(self, sentence: str) -> None:
        """For ``failover why``: something about this robot, or about a peer."""
        facts = Facts(self.next_counter, late_ns=self.late_ns, seen=self._seen(""))
        self.said.append(Decision(self.now_ns, "", sentence, facts))

    def _seen(self, component: str) -> tuple[Sighting, ...]:
        return self.team.sightings(component, self.now_ns)

    def alive(self, robot: str) -> bool:
        """Whether a peer is alive."""
        return self.team.alive(robot, self.now_ns)

    def is_drained(self, robot: str) -> bool:
        """Whether a robot is to run nothing, by its newest word."""
        if robot == self.me:
            return self.drained
        return robot in self.team.peers and self.team.peers[robot].drained

    def gone(self, robot: str) -> bool:
        """Whether a peer cannot act any more on anything that we told it."""
        return self.team.gone(robot, self.now_ns)

    def dead(self, robot: str) -> bool:
        """Whether a peer is dead."""
        return self.team.dead(robot, self.now_ns)


def _newest_checkpoint(component: Component, now_ns: int) -> tuple[int, int]:
    """Number of the checkpoint from which a robot could go on, and its age; see `failover.core.event_log.decisions.Facts`."""
    if component.holding and component.acked is not None:
        return component.acked.sequence, now_ns - component.acked_ns
    held = component.held[-1].sequence if component.held else 0
    if component.holding and component.resumed_ns >= 0:
        return held, now_ns - component.resumed_ns
    return held, now_ns - component.stored_ns if held and component.stored_ns >= 0 else -1
