"""Terms of the rules: the values for a component, for a robot's memory, for its status. Frozen values only.

Instants are integer nanoseconds of this machine's own clock (suffix ``_ns``); two machines' clocks are never compared.
Events of a node are in `failover.core.events`, its orders in `failover.core.acts`, the messages between robots in
`failover.core.wire.messages`.
"""

from __future__ import annotations

import enum
import functools

from msgspec import Struct, field

from checkpoint.model import Position
from failover.core.wire.names import weight
from failover.errors import RulesError

MS = 1_000_000
"""Nanoseconds in a millisecond."""


class OnLoss(enum.StrEnum):
    """What the standby does when the primary's robot is lost."""

    TAKEOVER = "takeover"
    HOLD = "hold"


class OnCrash(enum.StrEnum):
    """What happens when the program dies by a signal while its robot lives."""

    RESUME = "resume"
    LEAVE = "leave"


class Restart(enum.StrEnum):
    """Which ends of its program a declared component is started anew after, from its beginning.

    A failure is any end but exit status 0: another exit status, or a signal after which it is not resumed from a checkpoint.
    """

    ALWAYS = "always"
    ON_FAILURE = "on-failure"
    NEVER = "never"
    UNDECLARED = ""
    """No agent.toml declares it, an operator started it: its end is an end, whatever its exit status."""


class WhenAlone(enum.StrEnum):
    """What a primary does when it hears no other robot: go on (available), or stand still (safe)."""

    RUN = "run"
    FREEZE = "freeze"


class Rule(enum.StrEnum):
    """How a silent primary is replaced: by each robot that hears it no longer, or by the majority of all that vote.

    ``etcd``: by a majority in which etcd has a vote, as the member `COORDINATOR`.
    """

    PAIR = "pair"
    MAJORITY = "majority"
    ETCD = "etcd"


COORDINATOR = "etcd"
"""Under the rule ``etcd``: the witness of that name is etcd, see `failover.core.election.coordinator`."""


class OnUnsupported(enum.StrEnum):
    """What becomes of the protection when the program turns into something that cannot be captured."""

    KEEP_LAST = "keep_last"
    STOP_PROTECTING = "stop_protecting"


class State(enum.StrEnum):
    """Where one component stands on one robot. The arrows between them are `failover.core.component.TABLE`."""

    ABSENT = "absent"
    CLAIMING = "claiming"
    STARTING = "starting"
    PRIMARY = "primary"
    FROZEN = "frozen"
    HANDING_OVER = "handing over"
    RECOVERING = "recovering"
    TAKING_OVER = "taking over"
    STOPPING = "stopping"
    STANDBY = "standby"
    FINISHED = "finished"
    FAILED = "failed"
    RELEASED = "released"


class Resumption(enum.StrEnum):
    """Why a program goes on from a checkpoint, in the words that it is told (``checkpoint/segment/TASK.md``).

    It is told how the copy before it ended, not where the checkpoint was made: that may have been here all the same.
    """

    RESTARTED = "restarted"
    TAKEN_OVER = "taken over"
    HANDED_OVER = "handed over"


HOLDING = frozenset(
    {
        State.CLAIMING,
        State.STARTING,
        State.PRIMARY,
        State.FROZEN,
        State.HANDING_OVER,
        State.RECOVERING,
        State.TAKING_OVER,
    }
)
"""The states in which a robot says: the primacy of this epoch is mine."""

ENDED = frozenset({State.FINISHED, State.FAILED, State.RELEASED})
"""The states that are a record: no robot runs the component until an operator says so."""


class Protection(enum.StrEnum):
    """How well a primary's component is protected right now."""

    NONE = "none"
    PROTECTED = "protected"
    DEGRADED = "degraded"
    STOPPED = "stopped"


IMMEDIATE = "immediate"
"""Output is shown as it is written: after a takeover, the output since the checkpoint is written again."""

COMMITTED = "committed"
"""Output is shown once another robot holds a checkpoint that contains it."""


RESET = "reset"
"""Connections with others, of TCP and of unix sockets, end wherever the program goes on."""

CARRY = "carry"
"""Those of TCP are taken along where it goes on from the state in which it stood still for good: by a handover, a failback."""

REFUSE = "refuse"
"""A program that has such a connection is not captured."""


REFUSE = "refuse"
"""A program with shared memory that other processes have mapped, too, is not captured."""

DETACH = "detach"
"""Where it resumes, that memory is a copy of its own."""


class Launch(Struct, frozen=True):
    """How a program begins. The rules carry it and never look inside.

    Attributes:
        argv: empty for a program that was taken under protection by its pid.
        environment: (name, value) pairs.
        pid: of a running program to protect (``failover protect``), 0 otherwise; means something on its home robot only.
        isolate: PID and time namespaces of its own.
        hooks: (occasion, command) pairs that came with the program and are run as its user, see `agent.worker.components.hooks`.
        output: `IMMEDIATE` or `COMMITTED`: when its output is shown.
        inheritance: whose rights, limits and priorities it gets, packed (`checkpoint.linux.spawn.inherited_limits`); b"": the
            agent's own.
        carry: files and folders that travel with it, as absolute paths.
        devices: (path, rule) of devices that it has open, where a robot has no rule of its own; see `checkpoint.device_rules`.
        connections: `RESET`, `CARRY` or `REFUSE`: what becomes of its connections with others.
        shared: files and folders that others write to as well, as absolute paths: they keep the content that each robot has.
        shared_memory: `REFUSE` or `DETACH`: what becomes of shared memory that other processes have mapped, too.
    """

    argv: tuple[str, ...] = ()
    environment: tuple[tuple[str, str], ...] = ()
    directory: str = "/"
    umask: int = 0o022
    pid: int = 0
    isolate: bool = True
    engine: str = "ptrace"
    terminal: bool = False
    inheritance: bytes = b""
    output: str = IMMEDIATE
    hooks: tuple[tuple[str, tuple[str, ...]], ...] = ()
    carry: tuple[str, ...] = ()
    devices: tuple[tuple[str, str], ...] = ()
    connections: str = RESET
    shared: tuple[str, ...] = ()
    shared_memory: str = REFUSE


CPU_SHARE_MIN = 0.001
"""Of a core: a delta of 10 ms is then taken each ten seconds."""
CPU_SHARES = f"it lies between {CPU_SHARE_MIN:g} and 1, which is a whole core"


def is_cpu_share(value: float) -> bool:
    """Whether it can be ``Rules.cpu_share``."""
    return value == 0 or CPU_SHARE_MIN <= value <= 1


class Rules(Struct, frozen=True):
    """The operator's choices for one component.

    Attributes:
        period_ms: between two captures while a standby keeps up.
        cpu_share: the most that captures may take of the processor time of one core; 0: as much as ``period_ms`` asks for.
        crash_limit: resumptions from the newest checkpoint inside ``crash_window_ms``; the next one goes one checkpoint back,
            the one after that is not made: the component has failed.
        prefer: robot that should run it whenever it can; "" leaves it where it runs.
        standby: robot that should protect it; "" lets the primary choose.
        restart: the ends of a declared component after which it is started anew, ``restart_limit`` times (0: as often as need be)
            inside ``restart_window_ms``; then it has failed.
    """

    period_ms: int = 100
    cpu_share: float = 0.0
    on_loss: OnLoss = OnLoss.TAKEOVER
    on_crash: OnCrash = OnCrash.RESUME
    crash_limit: int = 3
    crash_window_ms: int = 60_000
    when_alone: WhenAlone = WhenAlone.RUN
    on_unsupported: OnUnsupported = OnUnsupported.KEEP_LAST
    prefer: str = ""
    standby: str = ""
    restart: Restart = Restart.UNDECLARED
    restart_limit: int = 5
    restart_window_ms: int = 60_000

    def __post_init__(self) -> None:
        if not 0 <= self.restart_limit <= RESTARTS_MAX:
            raise RulesError(f"restart_limit = {self.restart_limit}: choose between 0 (no limit) and {RESTARTS_MAX}")
        if not 1_000 <= self.restart_window_ms <= PERIOD_MS_MAX:
            raise RulesError(f"restart_window_ms = {self.restart_window_ms}: the window lies between 1 s and an hour")
        if not 1 <= self.period_ms <= PERIOD_MS_MAX:
            raise RulesError(f"period_ms = {self.period_ms}: a capture period lies between 1 ms and an hour")
        if not is_cpu_share(self.cpu_share):
            raise RulesError(f"cpu_share = {self.cpu_share:g}: {CPU_SHARES}; 0: no limit")
        if not 0 <= self.crash_limit <= 100:
            raise RulesError(f"crash_limit = {self.crash_limit}: choose between 0 and 100")


class ComponentSpec(Struct, frozen=True):
    """One supervised program: its name, where it belongs, how it begins, and by which rules it lives.

    Attributes:
        name: a path such as ``/lab/robot1/mapper``, see ``names.py``.
        home: robot where it was started.
        owner: uid of the user who may give orders about it and read its output, besides root; on every robot the same user.
    """

    name: str
    home: str = ""
    launch: Launch = field(default_factory=Launch)
    rules: Rules = field(default_factory=Rules)
    owner: int = 0


class Waiting(Struct, frozen=True):
    """The program that was started in advance: another command line, or another owner, is another program.

    Attributes:
        keeps_state: it is the program, started; else its memory. One that is captured from outside may come to keep its state.
    """

    launch: Launch
    owner: int
    keeps_state: bool


class Config(Struct, frozen=True, dict=True):
    """The configuration that one robot's node gets when it is made.

    Attributes:
        robot: own name.
        peers: the other members of the team: robots, servers and witnesses.
        components: to be run from the start wherever no robot runs them yet (the same list may stand on every robot).
        beat_ms: between two beats.
        lease_ms: how long a primary may act without being heard; also the silence after which a primary may be replaced,
            stretched by the margin.
        margin_ms_min, margin_percent: the standby waits longer than the lease by the larger of the two (drift, freeze time).
        alone_period_ms: between captures kept on this robot only, while there is no standby.
        retry_ms: before another try of a capture that failed, or of a standby that did not answer.
        handover_ms: a planned move that takes longer is called off.
        grace_ms: after its own start a robot waits that long for peers that it has not heard yet (keys are handed over first).
        ship_ms: a snapshot that is taken or sent, and of which nothing was heard for that long, is given up.
        restore_ms: a restore or start that says nothing for that long has failed.
        rule: by which primaries are replaced.
        servers: members, perhaps this one, that keep checkpoints and vote, and run nothing.
        witnesses: members, perhaps this one, that only vote.
        patience_ms: under majority, how long the robots that hold all that was acknowledged are waited for before another goes
            on from an older checkpoint.
        copies_ms: between two copies of a component to the archive, from which robots go on that do not hear its primary; 0: no
            robot does.
        archive_ms: between two whole checkpoints for a server that does not keep up with the deltas.
        boot_patience_ms: under pair, how long after its own start a robot waits for the robots that ran a component last, or that
            may have taken it over since, before it claims the component without having heard them.
        seat: this robot's number in the team, which no other member has, and which stays while members come and go; -1: by the
            order of names.
        restart_grace_ms: how long the peers are asked to wait for this agent when it restarts, and the most that it waits for
            one of theirs; 0: neither.
        site: the name of this robot's site. far: robots of other sites, which are no peers, and their sites.
    """

    robot: str
    peers: tuple[str, ...] = ()
    components: tuple[ComponentSpec, ...] = ()
    beat_ms: int = 20
    lease_ms: int = 150
    margin_ms_min: int = 20
    margin_percent: int = 10
    alone_period_ms: int = 1_000
    retry_ms: int = 1_000
    handover_ms: int = 10_000
    grace_ms: int = 3_000
    ship_ms: int = 120_000
    restore_ms: int = 60_000
    rule: Rule = Rule.PAIR
    servers: tuple[str, ...] = ()
    witnesses: tuple[str, ...] = ()
    patience_ms: int = 30_000
    copies_ms: int = 0
    archive_ms: int = 10_000
    boot_patience_ms: int = 0
    seat: int = -1
    restart_grace_ms: int = 0
    site: str = ""
    far: dict[str, str] = {}

    def __post_init__(self) -> None:
        if self.restart_grace_ms and not self.lease_ms <= self.restart_grace_ms <= GRACE_MS_MAX:
            raise RulesError(
                f"restart_grace_ms = {self.restart_grace_ms}: choose 0, for none, or between lease_ms ({self.lease_ms}) and "
                f"{GRACE_MS_MAX}"
            )
        if not 1 <= self.beat_ms <= BEAT_MS_MAX:
            raise RulesError(f"beat_ms = {self.beat_ms}: beats lie between 1 ms and 10 s apart")
        if self.lease_ms < BEATS_IN_LEASE_MIN * self.beat_ms:
            raise RulesError(
                f"lease_ms = {self.lease_ms} with beat_ms = {self.beat_ms}: a lease shorter than {BEATS_IN_LEASE_MIN} beats "
                f"would end with one lost packet; set lease_ms to {BEATS_IN_LEASE_MIN * self.beat_ms} or more"
            )
        if self.margin_percent < 2 or self.margin_ms_min < 1:
            raise RulesError("margin_percent must be at least 2 and margin_ms_min at least 1: clocks drift, freezing takes time")
        if self.robot in self.peers:
            raise RulesError(f"robot {self.robot!r} is listed among its own peers; remove it there")
        if self.coordinator and self.coordinator not in self.witnesses:
            raise RulesError(f"rule = {self.rule} needs the witness {COORDINATOR}, which is etcd; no other member has that name")
        if len(self.peers) > PEERS_MAX:
            raise RulesError(f"{len(self.peers)} peers: at most {PEERS_MAX} robots share a team")
        if not self.by_majority and (self.servers or self.witnesses):
            raise RulesError("rule = pair with a server or a witness: they vote, so choose rule = majority")
        strangers = {*self.servers, *self.witnesses} - {self.robot, *self.peers}
        if strangers or set(self.servers) & set(self.witnesses):
            raise RulesError(f"servers {self.servers} and witnesses {self.witnesses}: each a member of the team, with one role")

    @functools.cached_property
    def by_majority(self) -> bool:
        """Whether primaries are elected."""
        return self.rule is not Rule.PAIR

    @functools.cached_property
    def coordinator(self) -> str:
        """The member that is etcd; "" where it has no vote."""
        return COORDINATOR if self.rule is Rule.ETCD else ""

    @functools.cached_property
    def place(self) -> int:
        """By which this robot's generations are unlike any other's."""
        return self.seat if self.seat >= 0 else sorted((self.robot, *self.peers), key=weight).index(self.robot)

    @functools.cached_property
    def quorum(self) -> int:
        """How many members, oneself among them, are a majority."""
        return (len(self.peers) + 1) // 2 + 1

    def runs(self, robot: str) -> bool:
        """Whether this member runs components."""
        return robot not in self.servers and robot not in self.witnesses

    def keeps(self, robot: str) -> bool:
        """Whether this member keeps checkpoints."""
        return robot not in self.witnesses

    @functools.cached_property
    def beat_ns(self) -> int:
        """Between two beats."""
        return self.beat_ms * MS

    @functools.cached_property
    def lease_ns(self) -> int:
        """How long a primary may act after a beat that was heard."""
        return self.lease_ms * MS

    @functools.cached_property
    def loyalty_ns(self) -> int:
        """Silence after which a peer counts as dead: the lease and the margin."""
        return self.lease_ns + max(self.margin_ms_min * MS, self.lease_ns * self.margin_percent // 100)

    @functools.cached_property
    def loyalty_ns_max(self) -> int:
        """The same for a peer whose beats come late: see `failover.core.membership.Membership.loyal_until_ns`."""
        return max(self.loyalty_ns, 2 * self.lease_ns)

    def awaited_ns(self, grace_ms: int) -> int:
        """Silence after which a robot that asked for so much grace is replaced: stretched as the loyalty stretches the lease."""
        return grace_ms * MS * self.loyalty_ns // self.lease_ns

    @functools.cached_property
    def grace_ns(self) -> int:
        """How long a peer that was never heard in this life may be on its way; never less than the loyalty."""
        return max(self.grace_ms * MS, self.loyalty_ns)


SPAN = 1 << 16
"""Epochs between two recoveries of a component at another site; the site that was lost has claimed fewer since its last copy."""

EPOCH_MAX = 1 << 40
"""No epoch is as large as this: its beats would be malformed to all."""

EPOCH_SAID_MAX = EPOCH_MAX - (1 << 30)
"""The words of others raise no epoch above this: from there on a robot could claim each second for 34 years."""

GRACE_MS_MAX = 120_000
"""No robot waits longer for an agent that restarts: its programs have no standby that would take over meanwhile."""

BEAT_MS_MAX = 10_000
PERIOD_MS_MAX = 3_600_000

RESTARTS_MAX = 100
"""Starts of one component inside its window that are counted."""

BEATS_IN_LEASE_MIN = 4
"""Three beats may be lost in a row before a robot acts on it."""

PEERS_MAX = 63
"""Robots besides oneself; their echoes must fit a frame."""

COMPONENTS_MAX = 1_024
"""Components that one node follows; a peer that announces more is not believed."""

HISTORY_MAX = 8
"""Restorable positions that are remembered per component."""


class Record(Struct, frozen=True):
    """The facts that one robot must not forget about one component.

    Attributes:
        epoch: the highest that was seen or claimed; only grows.
        primary: robot whose primacy of ``epoch`` this robot accepts: itself, a peer, or "" (no robot's).
        state: PRIMARY while this robot holds the primacy, STANDBY, ABSENT, or one of the records FINISHED, FAILED, RELEASED.
        entrusted: robots that may take over if they stop hearing the primary: they hold all that it has acknowledged. A primary
            acts on leases while there are any (under majority always); a follower remembers what its primary told (majority).
        trusted: the primary of ``epoch`` has entrusted this robot.
        lost: generations of this robot's own that lost against another primary; never resumed from.
        status: exit status (waitpid's) of a finished component.
        reason: why it failed.
        claimed: this robot's claim of ``epoch`` needs consent that it did not have yet.
        begun: there is a checkpoint of it, or there was one when this robot heard last: it is not to begin anew.
        bare: this robot has lost its checkpoints, and others may hold more than it took from elsewhere since, such as an archive.
        ended: generation and sequence of the last snapshot of the program before, since when another one was started anew.
        void: epoch of an end after which it began anew: the archive's copies up to that one are of another life of it.
        elsewhere: the span of epochs in which an operator recovered it at another site; negative once it was released here.
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

    @property
    def is_elsewhere(self) -> bool:
        """Whether another site has it, by the order of an operator."""
        return self.elsewhere > 0 and self.elsewhere == self.epoch // SPAN


class Awaited(Struct, frozen=True):
    """A promise not to replace a robot whose agent restarts.

    Attributes:
        boot: life of its agent that was promised it.
        ms: for so long, and its margin: since its newest beat that asked, and again since a start of ours.
        is_asked: it has asked for that; else our agent restarts, or did, and that robot acts on our word.
    """

    robot: str
    boot: int
    ms: int
    is_asked: bool = True


class VoteRecord(Struct, frozen=True):
    """All that a robot's rules must not forget: durable before any message that depends on it leaves."""

    records: tuple[Record, ...] = ()
    awaited: tuple[Awaited, ...] = ()
    drained: bool = False


class Held(Struct, frozen=True):
    """Restorable positions that this robot's own store holds of one component, oldest first (at most ``HISTORY_MAX`` count).

    Attributes:
        keeps_state: to go on from the newest one is to start the program again, which keeps its state itself.
    """

    component: str
    positions: tuple[Position, ...]
    keeps_state: bool = False


class Found(Struct, frozen=True):
    """A component whose guard was found alive when the agent started.

    Attributes:
        epoch: under which it was started or last restored, as the guard remembers.
        running: its program is there (perhaps frozen by its guard); False once it has ended.
        status: waitpid's status, when it has ended.
        lease_ns: until when its guard lets it act; 0: it is held still, or has no lease.
    """

    component: str
    epoch: int
    running: bool
    status: int = 0
    lease_ns: int = 0


class PeerView(Struct, frozen=True):
    """One peer as this robot sees it: ``state`` is alive, suspect, restarting, dead, unheard; ``silent_ns`` since its last beat.

    ``unread``: why what comes from it cannot be authenticated, if something of that kind came lately. ``refused``: what it said
    beyond what it may say, a sentence for each reason; ``doubted``: some of it lately. ``awaited_ns``: for how long it is not
    replaced, because its agent announced that it comes back; 0: it did not, or that is over. ``drained``: it is to run nothing.
    ``is_asked``: it has asked to be waited for; else our own agent has restarted, and promised it.
    """

    robot: str
    state: str
    boot: int
    silent_ns: int
    hears_us: bool
    load: int
    links: tuple[str, ...] = ()
    unread: str = ""
    refused: tuple[str, ...] = ()
    doubted: bool = False
    awaited_ns: int = 0
    drained: bool = False
    is_asked: bool = True


class ComponentView(Struct, frozen=True):
    """One component as this robot sees it, for ``failover status``.

    Attributes:
        primary, standby: robots; "" where there is none that we know of.
        lag_ns: age of the newest checkpoint, -1 if there is none or this robot cannot know.
        positions: newest acknowledged position first.
        notes: sentences: why it is degraded, waiting or failed.
        lease_until_ns: of this robot's clock; 0 acts without a lease.
        owner: uid; None where this robot has heard no more of it than its name.
        warm: its program waits at its standby, started already: only one that keeps its state itself can.
        cold: why it does not wait here, where it should and something went wrong.
        differs: its promise is another than the team's.
        unstored: why the last snapshot that came here was not stored.
        restarting: its program has ended, and is started anew after a pause; restarted: so often in this life of the agent.
        took_ns: from the order of the newest delta until it was a checkpoint; 0: there was none.
        recovered: an operator recovered it at this site, where it is, will be or ended: other sites are told.
    """

    name: str
    state: State
    epoch: int
    primary: str
    standby: str
    protection: Protection
    lag_ns: int
    freeze_us: int
    positions: tuple[Position, ...]
    promise: str
    notes: tuple[str, ...] = ()
    status: int = 0
    lease_until_ns: int = 0
    period_ms: int = 0
    home: str = ""
    prefer: str = ""
    owner: int | None = None
    warm: bool = False
    cold: str = ""
    differs: bool = False
    unstored: str = ""
    restarting: bool = False
    restarted: int = 0
    took_ns: int = 0
    recovered: bool = False


class StatusView(Struct, frozen=True):
    """Everything ``failover status`` shows, seen from one robot. ``healthy`` is False when anything failed or is degraded.

    Attributes:
        drained: an operator has drained this robot.
        informed: in this life it has heard each robot of its site that does not count as dead.
    """

    robot: str
    boot: int
    rule: str
    promise: str
    healthy: bool
    peers: tuple[PeerView, ...]
    components: tuple[ComponentView, ...]
    drained: bool = False
    informed: bool = True
