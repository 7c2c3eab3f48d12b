"""Reads the agent's configuration, one TOML file, once into frozen values.

``systemd/agent.toml`` lists every key with its default, commented out; a test keeps the two equal.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final, Literal

from agent.alerts_config import AlertsConfig
from agent.coordinator_config import EXAMPLE, CoordinatorConfig
from agent.errors import ConfigError
from agent.hook_kinds import KINDS, check_told
from agent.task_config import TaskConfig, declaration
from checkpoint.arch import EVERY_LEVEL
from checkpoint.device_rules import RULES_MAX, DeviceRule, checked, rule_from
from checkpoint.engine import contradiction
from checkpoint.sentences import near
from checkpoint.snapshot.carried_files import is_carriable
from failover.config import strict_toml
from failover.config import team as team_directory
from failover.config.quantities import size_bytes, span_ms
from failover.config.store import StoreConfig
from failover.config.team import Robot, Team
from failover.core.types import (
    BEAT_MS_MAX,
    BEATS_IN_LEASE_MIN,
    COMPONENTS_MAX,
    COORDINATOR,
    CPU_SHARES,
    GRACE_MS_MAX,
    PERIOD_MS_MAX,
    is_cpu_share,
)
from failover.core.wire.names import check_component
from failover.errors import FailoverError, NameFormatError

PATIENCE_S_MAX: Final = 86_400
"""A day. An operator who would wait longer can promote instead."""

GRACE_S_MAX: Final = GRACE_MS_MAX // 1_000
KEEP_MAX: Final = 10_000
"""Files of one component; each is asked for its age when the agent starts."""

ETCD_LEASE_MS_MIN, ETCD_LEASE_MS = 1_000, 1_800
"""With the rule etcd: the least, and one whose margin ends with a lease of etcd that lasts for two seconds."""

HOOK_S_MAX: Final = 50
"""The rules give a restore a minute."""


@dataclass(frozen=True, slots=True)
class HooksConfig:
    """This robot's own commands around one component, see `agent.worker.components.hooks`; () for none.

    Attributes:
        before_start: before it begins here.
        before_capture: before a whole snapshot is taken of it here, and before the last one of a handover.
        before_resume, after_resume: before and after it goes on here from a checkpoint.
        limit_s: seconds that each of them may take.
        must_prepare: where before_start or before_resume fails, the program does not run on this robot.
    """

    before_start: tuple[str, ...] = field(default_factory=tuple)
    before_capture: tuple[str, ...] = field(default_factory=tuple)
    before_resume: tuple[str, ...] = field(default_factory=tuple)
    after_resume: tuple[str, ...] = field(default_factory=tuple)
    limit_s: int = 5
    must_prepare: bool = False

    def command(self, occasion: str) -> tuple[str, ...]:
        """The command that the agent runs on an occasion."""
        found: tuple[str, ...] = getattr(self, occasion)
        return found


OVERRUN_S_MAX: Final = 3_600


@dataclass(frozen=True, slots=True)
class DeviceConfig:
    """A rule for a device that needs more than a word.

    Attributes:
        reopen: path that the agent opens on this robot in its place; "" for itself.
        optional: where it is missing the program finds it hung up.
    """

    reopen: str = ""
    optional: bool = False


@dataclass(frozen=True, slots=True)
class ComponentConfig:
    """The operator's settings for one component; ``[components."/lab/robot1/mapper"]``.

    Attributes:
        on_loss: takeover: the standby runs it; hold: the standby keeps its newest checkpoint until the primary is back.
        on_crash: the program died, its robot lives: resume it here from the newest checkpoint, or leave it ended.
        on_unsupported: it turned into something that cannot be captured: keep the last checkpoint, or stop protecting.
        standby: the robot that keeps its snapshots; "" lets the team choose.
        prefer: the robot that should run it; "" for wherever it is.
        snapshot_period_ms, cpu_share: 0 for the agent's own.
        freeze_budget_ms: how long it may stand still for a snapshot here: a longer freeze is given up; 0: as short as can be.
        freeze_overrun_s: when no capture has kept to the budget for so long, one may take longer; 0: none may.
        portable: a level of processors that it must be able to go on at, see `checkpoint.program.cpu_baseline`; true for
            the usual one; "" for the agent's own.
        warm: a program that keeps its state itself is started here in advance, where this robot is its standby, and waits.
        ready_copy: of any other program the newest checkpoint's memory stands ready here, where this robot is its standby and has
            room for it.
        command: a program that keeps its state itself is started here again by this; () for the command line of `failover run`.
        directory: and in this one, an absolute path; "" for that of `failover run`.
        environment: and with these variables besides, or instead.
        hooks: this robot's own commands around it.
        devices: rules for devices that it has open, by path: see `checkpoint.device_rules`.
        connections: reset: its connections with others, of TCP and of unix sockets, end where it goes on; carry: those of TCP go
            along where it is handed over; refuse: it is not captured while it has one.
        bring_data: files that it has open for reading only are brought to its standby, as its program is, when it runs here.
        carry: files and folders that travel with it when it is started here, besides those that `failover run` names.
        carry_limit: the most that they may hold while it runs here.
        carry_at: where they are laid down here, by their path on the other robots; the same path for those not named.
        shared: files and folders that others write to as well: they keep the content that they have here.
        shared_memory: detach: shared memory that others have mapped, too, becomes its own copy where it resumes; refuse: it is
            not captured while it has any.
    """

    on_loss: Literal["takeover", "hold"] = "takeover"
    on_crash: Literal["resume", "leave"] = "resume"
    on_unsupported: Literal["keep_last", "stop_protecting"] = "keep_last"
    standby: str = ""
    prefer: str = ""
    snapshot_period_ms: int = 0
    cpu_share: float = 0
    freeze_budget_ms: float = 0
    freeze_overrun_s: float = 20
    portable: bool | str = ""
    warm: bool = True
    ready_copy: bool = True
    command: tuple[str, ...] = field(default_factory=tuple)
    directory: str = ""
    environment: dict[str, str] = field(default_factory=dict)
    hooks: HooksConfig = field(default_factory=HooksConfig)
    devices: dict[str, DeviceConfig | Literal["reopen", "hook", "optional"]] = field(default_factory=dict)
    connections: Literal["reset", "carry", "refuse"] = "reset"
    bring_data: bool = False
    carry: tuple[str, ...] = field(default_factory=tuple)
    carry_limit: str = "256MB"
    carry_at: dict[str, str] = field(default_factory=dict)
    shared: tuple[str, ...] = field(default_factory=tuple)
    shared_memory: Literal["refuse", "detach"] = "refuse"

    def device_rules(self) -> tuple[DeviceRule, ...]:
        """This robot's own rules for its devices.

        Raises:
            ValueError: one of them names no device.
        """
        return tuple(
            rule_from(path, said) if isinstance(said, str) else checked(DeviceRule(path, "reopen", said.reopen, said.optional))
            for path, said in self.devices.items()
        )


T_TUP_MS_MIN: Final = 5
T_TUP_MS_MAX: Final = 1_000


@dataclass(frozen=True, slots=True)
class MediumConfig:
    """How frames leave over one interface; ``[media.wlan0]``.

    Attributes:
        cast: multicast, broadcast, unicast; auto: the first of them that the other members hear.
        slots: robots take turns, RA-TDMA; auto: on a radio whose rounds the lease allows.
        t_tup_ms: the round, where there are slots; the same at every robot.
    """

    cast: Literal["auto", "multicast", "broadcast", "unicast"] = "auto"
    slots: bool | Literal["auto"] = "auto"
    t_tup_ms: int = 50


@dataclass(frozen=True, slots=True)
class Config:
    """The whole file. Times in milliseconds.

    Attributes:
        robot: this robot's name in the team file; "": the host name, up to its first dot.
        team_directory: see `failover.config.team`.
        state_directory: files that survive a power cut: vote record, snapshots, streams.
        runtime_directory: sockets; gone after a reboot.
        insecure: run without keys: any machine on the network can read memory and start programs.
        group: unix group that may use the control socket besides its owner; "" for no group.
        page_user: the user whose process, the operators' page, may ask for other users of the group; "" for none.
        components_per_user: that a user other than root may have here, those that have ended included.
        beat_ms: period of beats to each peer.
        lease_ms: how long a primary acts without being heard, and how long a standby stays loyal to a silent one.
        patience_s: under the majority rule: how long the robots that hold the newest checkpoint are waited for.
        boot_patience_s: under the pair rule: how long a robot that starts waits for the robots that may run a component.
        restart_grace_s: how long the peers are asked to wait for this agent when it restarts, and the most that it waits for
            theirs; 0: neither.
        rule: how the team decides to replace a silent robot: pair, majority, etcd (a majority in which etcd has a vote), or
            auto: a majority wherever more than two belong.
        when_alone: under the pair rule: while this robot hears no other one, components started here run on, or are held still.
        snapshot_period_ms: between two snapshots of a component; grows by itself when link or standby is slower.
        cpu_share: the most that the captures of a component may take of one core's time; 0 for no limit.
        realtime: ask for SCHED_FIFO and locked memory.
        link_mbit_s: cap on snapshot traffic; 0 for none.
        xor_cache: of this robot, for all components together, run or kept here: memory for pages that deltas are told as
            differences from, and proved by; "": no differences are made here.
        snapshots_over: wired: they never leave over a wireless link; any: over whichever has the bulk address.
        bring: files of programs that this robot lacks, or has in another version, are brought here and kept, by content.
        bring_size: of all that is brought for one component; beyond it its checkpoints are refused.
        portable: a level of processors that programs which are started here must be able to go on at.
        keep_checkpoints: older ones of each component that are kept for people, besides those that the team needs.
        keep_for: spread over this span; older ones go.
        keep_size: of the whole store; beyond it the oldest of those go. "": as much as there is.
        wireless: interfaces that count as wireless though the kernel cannot know: an Ethernet port that leads to a radio.
        media: how frames leave over an interface, by its name.
        alerts: commands that tell an operator.
        store: copies of checkpoints that no robot keeps.
        coordinator: where etcd is, under rule = etcd.
    """

    robot: str = ""
    team_directory: str = "/etc/failover/team"
    state_directory: str = "/var/lib/failover"
    runtime_directory: str = "/run/failover"
    insecure: bool = False
    group: str = ""
    page_user: str = ""
    components_per_user: int = 64
    beat_ms: int = 20
    lease_ms: int = 200
    rule: Literal["auto", "pair", "majority", "etcd"] = "auto"
    when_alone: Literal["run", "freeze"] = "run"
    patience_s: int = 30
    boot_patience_s: int = 60
    restart_grace_s: int = 20
    snapshot_period_ms: int = 100
    cpu_share: float = 0
    realtime: bool = True
    link_mbit_s: int = 0
    xor_cache: str = "64MB"
    snapshots_over: Literal["wired", "any"] = "wired"
    wireless: list[str] = field(default_factory=list)
    media: dict[str, MediumConfig] = field(default_factory=dict)
    bring: bool = True
    bring_size: str = "1GB"
    portable: bool | str = False
    keep_checkpoints: int = 0
    keep_for: str = "7d"
    keep_size: str = ""
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    components: dict[str, ComponentConfig] = field(default_factory=dict)
    tasks: dict[str, TaskConfig] = field(default_factory=dict)
    alerts: AlertsConfig = field(default_factory=AlertsConfig)
    store: StoreConfig = field(default_factory=StoreConfig)
    coordinator: CoordinatorConfig = field(default_factory=CoordinatorConfig)

    @property
    def xor_cache_size(self) -> int:
        """The same in bytes."""
        return size_bytes(self.xor_cache) if self.xor_cache else 0

    def medium(self, interface: str) -> MediumConfig:
        """How frames leave over an interface; the defaults where the file says nothing of it."""
        return self.media.get(interface, MediumConfig())

    def __post_init__(self) -> None:
        """Refuse values that contradict each other.

        Raises:
            ValueError: says which; the reader adds file and line.
        """
        if not 1 <= self.beat_ms <= BEAT_MS_MAX:
            raise ValueError(f"beat_ms is {self.beat_ms}; it must be at least 1 and at most {BEAT_MS_MAX}")
        if self.lease_ms < BEATS_IN_LEASE_MIN * self.beat_ms:
            least = BEATS_IN_LEASE_MIN * self.beat_ms
            raise ValueError(
                f"lease_ms is {self.lease_ms}: one lost beat would count as a death; with beat_ms {self.beat_ms} "
                f"give at least {least}"
            )
        if not 1 <= self.snapshot_period_ms <= PERIOD_MS_MAX:
            raise ValueError(
                f"snapshot_period_ms is {self.snapshot_period_ms}; it must be at least 1 and at most {PERIOD_MS_MAX}"
            )
        if not is_cpu_share(self.cpu_share):
            raise ValueError(f"cpu_share is {self.cpu_share:g}; {CPU_SHARES}; 0: no limit")
        if not 1 <= self.patience_s <= PATIENCE_S_MAX:
            raise ValueError(f"patience_s is {self.patience_s}; it must be at least 1 and at most {PATIENCE_S_MAX}")
        if not 0 <= self.boot_patience_s <= PATIENCE_S_MAX:
            raise ValueError(f"boot_patience_s is {self.boot_patience_s}; it must be at least 0 and at most {PATIENCE_S_MAX}")
        if not 0 <= self.restart_grace_s <= GRACE_S_MAX:
            raise ValueError(f"restart_grace_s is {self.restart_grace_s}; it must be at least 0 and at most {GRACE_S_MAX}")
        if not 1 <= self.components_per_user <= COMPONENTS_MAX:
            raise ValueError(
                f"components_per_user is {self.components_per_user}; it must be at least 1 and at most {COMPONENTS_MAX}"
            )
        if not 0 <= self.keep_checkpoints <= KEEP_MAX:
            raise ValueError(f"keep_checkpoints is {self.keep_checkpoints}; at most {KEEP_MAX}, and 0 keeps none")
        _check_quantity("keep_for", span_ms, self.keep_for)
        _check_quantity("bring_size", size_bytes, self.bring_size)
        if self.xor_cache:
            _check_quantity("xor_cache", size_bytes, self.xor_cache)
        if self.keep_size:
            _check_quantity("keep_size", size_bytes, self.keep_size)
        _check_level(self.portable)
        self._check_media()
        if self.link_mbit_s < 0:
            raise ValueError(f"link_mbit_s is {self.link_mbit_s}; 0 means no cap")

    def _check_media(self) -> None:
        for name, medium in self.media.items():
            if not T_TUP_MS_MIN <= medium.t_tup_ms <= T_TUP_MS_MAX:
                raise ValueError(
                    f"media.{name}.t_tup_ms is {medium.t_tup_ms}; it must be at least {T_TUP_MS_MIN} and at most {T_TUP_MS_MAX}"
                )
            if medium.slots is True and self.lease_ms < BEATS_IN_LEASE_MIN * medium.t_tup_ms:
                raise ValueError(
                    f"lease_ms is {self.lease_ms}: with slots on {name} in rounds of {medium.t_tup_ms} ms give at least "
                    f"{BEATS_IN_LEASE_MIN * medium.t_tup_ms}"
                )


def _check_quantity(key: str, read: Callable[[str], int], text: str) -> None:
    try:
        read(text)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from error


def _check_level(portable: bool | str) -> None:
    if portable not in ("", True, False, *EVERY_LEVEL):
        meant = near(str(portable), EVERY_LEVEL)
        raise ValueError(f"portable is {portable!r}; choose true, false or one of {', '.join(EVERY_LEVEL)}{meant}")


@dataclass(frozen=True, slots=True)
class Settings:
    """Everything an agent is started with: the file, the team, and this robot's secret key ("" when insecure)."""

    path: Path
    config: Config
    team: Team
    secret_key: str

    @property
    def me(self) -> Robot:
        """This robot's own entry."""
        return self.team.robots[self.config.robot]

    @property
    def near(self) -> dict[str, Robot]:
        """The members of this robot's site, itself among them, by name: no decision knows any other member."""
        return self.team.at_site(self.me.site)

    @property
    def peers(self) -> Mapping[str, Robot]:
        """The same without this robot."""
        return {name: robot for name, robot in self.near.items() if name != self.config.robot}

    @property
    def far(self) -> Mapping[str, Robot]:
        """The members of other sites, by name: they are connected to, and have no part in any decision here."""
        return {name: robot for name, robot in self.team.robots.items() if self.is_far(name)}

    def is_far(self, robot: str) -> bool:
        """Whether it is a member, of another site."""
        member = self.team.robots.get(robot)
        return member is not None and member.site != self.me.site

    @property
    def others(self) -> Mapping[str, Robot]:
        """All members of the team but this one, by name."""
        return {name: robot for name, robot in self.team.robots.items() if name != self.config.robot}

    @property
    def former(self) -> dict[str, Robot]:
        """Members that were taken out, by name: they may connect, and are told so."""
        return self.team.former

    def with_robots(self, robots: Mapping[str, Robot]) -> Settings:
        """The same agent in a team of these members."""
        return replace(self, team=replace(self.team, robots=dict(robots)))

    def with_team(self, team: Team) -> Settings:
        """The same agent in the team as it is now; the board stays."""
        return replace(self, team=replace(team, board=self.team.board))

    def with_secret(self, secret: str) -> Settings:
        """The same agent with another key of its own."""
        return replace(self, secret_key=secret)

    def component(self, name: str) -> ComponentConfig:
        """The operator's settings for a component; the defaults where he gave none."""
        return self.config.components.get(name, ComponentConfig())


def load(path: Path) -> Settings:
    """Read the configuration, the team file and the key that it leads to.

    Raises:
        ConfigError: any of them is missing or mistaken; names file and, where it can, line.
    """
    try:
        config = strict_toml.read(path, Config)
        config = config if config.robot else replace(config, robot=os.uname().nodename.partition(".")[0])
        members = team_directory.read(Path(config.team_directory))
        if config.robot not in members.robots:
            known = ", ".join(sorted(members.robots)) or "no member"
            where = Path(config.team_directory) / team_directory.TEAM_FILE
            raise ConfigError(f"{path}: robot {config.robot!r} is not in {where}, which knows {known}; see failover team enrol")
        secret = "" if config.insecure else team_directory.read_secret_key(Path(config.team_directory), config.robot)
    except FailoverError as error:
        raise ConfigError(str(error)) from error
    _check_keys(path, config, members)
    site = members.at_site(members.robots[config.robot].site)
    _check_rule(path, config, members, site)
    _check_components(path, config, site)
    _check_tasks(path, config, members)
    _check_alerts(path, config, members)
    _check_archive(path, config, members)
    return Settings(path, config, members, secret)


def check_team(settings: Settings, team: Team) -> None:
    """Whether this robot's configuration fits a team in which it may soon be.

    Raises:
        ConfigError: it would not start in it; names the line.
    """
    path, config = settings.path, settings.config
    if config.robot not in team.robots:
        return
    _check_keys(path, config, team)
    site = team.at_site(team.robots[config.robot].site)
    _check_rule(path, config, team, site)
    _check_components(path, config, site)
    _check_archive(path, config, team)


def _check_keys(path: Path, config: Config, members: Team) -> None:
    """With keys each member needs one: a single robot without a key would stay shut out for ever, without an explanation."""
    without = sorted(name for name, robot in members.robots.items() if not robot.public_key)
    if without and not config.insecure:
        raise ConfigError(
            f"{path}: {', '.join(without)} in {config.team_directory} have no public key; enrol them with failover team enrol, "
            "or set insecure = true on every robot"
        )


def is_by_pair(rule: str, members: int) -> bool:
    """Whether so many members of a site elect nothing: by the rule that is given, or because they are two at most."""
    return rule == "pair" or (rule == "auto" and members <= 2)


def _check_rule(path: Path, config: Config, members: Team, site: Mapping[str, Robot]) -> None:
    """Servers and witnesses are there to vote; a witness that has a site of its own keeps sealed copies alone."""
    voters = sorted(name for name, member in site.items() if member.role != "robot")
    by_pair = is_by_pair(config.rule, len(site))
    keeps_copies_alone = config.rule == "auto" and [(one.role, bool(one.site)) for one in site.values()] == [("witness", True)]
    if voters and by_pair and not keeps_copies_alone:
        raise ConfigError(f'{path}: {", ".join(voters)} would have no vote; set rule = "majority" on every member of the team')
    if config.rule == "etcd":
        _check_etcd(path, config, members)
    elif config.coordinator.endpoints:
        raise ConfigError(f'{path}: [coordinator] has no effect without rule = "etcd"; set that on every member, or remove it')


def _check_etcd(path: Path, config: Config, members: Team) -> None:
    """etcd's leases count in seconds, and its place among the members is taken by no other."""
    if not config.coordinator.endpoints:
        raise ConfigError(f'{path}: rule = "etcd" needs to know where etcd is; add [coordinator] {EXAMPLE}')
    if config.lease_ms < ETCD_LEASE_MS_MIN:
        raise ConfigError(
            f'{path}: lease_ms is {config.lease_ms}; leases at etcd last for seconds: with rule = "etcd" give at least '
            f"{ETCD_LEASE_MS_MIN}, such as lease_ms = {ETCD_LEASE_MS}"
        )
    if COORDINATOR in members.robots:
        raise ConfigError(
            f'{path}: a member has the name {COORDINATOR}, which means etcd with rule = "etcd"; give it another one'
        )


def _check_components(path: Path, config: Config, site: Mapping[str, Robot]) -> None:
    """Refuse a table for a name that no component can have, or a robot that the team does not know: it would have no effect."""
    for name, component in config.components.items():
        where = f"{path}:{strict_toml.line_of(path.read_text(), ('components', name))}"
        try:
            check_component(name)
        except NameFormatError as error:
            raise ConfigError(f"{where}: {error}") from error
        _check_choice(where, "prefer", component.prefer, site, {"robot"})
        _check_choice(where, "standby", component.standby, site, {"robot", "server"})
        if not 0 <= component.snapshot_period_ms <= PERIOD_MS_MAX:
            raise ConfigError(
                f"{where}: snapshot_period_ms is {component.snapshot_period_ms}; at most {PERIOD_MS_MAX}; 0 means the agent's own"
            )
        if not is_cpu_share(component.cpu_share):
            raise ConfigError(f"{where}: cpu_share is {component.cpu_share:g}; {CPU_SHARES}; 0 means the agent's own")
        if not 0 <= component.freeze_budget_ms <= PERIOD_MS_MAX:
            raise ConfigError(
                f"{where}: freeze_budget_ms is {component.freeze_budget_ms:g}; at most {PERIOD_MS_MAX}; 0: as short as can be"
            )
        if not 0 <= component.freeze_overrun_s <= OVERRUN_S_MAX:
            raise ConfigError(
                f"{where}: freeze_overrun_s is {component.freeze_overrun_s:g}; at most {OVERRUN_S_MAX}; 0: none takes longer"
            )
        try:
            _check_level(component.portable)
        except ValueError as error:
            raise ConfigError(f"{where}: {error}") from error
        _check_command(where, component)
        _check_carry(where, component)
        _check_devices(where, component)


def _check_tasks(path: Path, config: Config, members: Team) -> None:
    """Programs that cannot be started, or have no time at which they could run, are found when the agent starts."""
    for name, task in config.tasks.items():
        where = f"{path}:{strict_toml.line_of(path.read_text(), ('tasks', name))}"
        try:
            check_component(name)
            declaration(name, task)
        except FailoverError as error:
            raise ConfigError(f"{where}: {error}") from error
        if not task.command or not task.command[0]:
            raise ConfigError(f'{where}: command is missing: command = ["/opt/controller", "--fast"]')
        if members.robots[config.robot].role != "robot":
            raise ConfigError(f"{where}: {config.robot} is a {members.robots[config.robot].role}, and runs no programs")
        _check_user(where, task.user)


def _check_alerts(path: Path, config: Config, members: Team) -> None:
    """An operator who would not be told learns it when the agent starts."""
    alerts = config.alerts
    if not alerts.wanted:
        return
    where = f"{path}:{strict_toml.line_of(path.read_text(), ('alerts',))}: alerts"
    if members.robots[config.robot].role == "witness":
        raise ConfigError(f"{where}: {config.robot} is a witness, and holds nothing to tell of; set it on robots and servers")
    if not alerts.user and os.geteuid() == 0:
        raise ConfigError(
            f'{where}: user is missing, and this agent runs as root: name whose rights the commands have, as user = "nobody"'
        )
    _check_user(where, alerts.user)
    if os.geteuid() == 0 and alerts.user and _uid_of(alerts.user) == 0:
        raise ConfigError(
            f'{where}: user = {alerts.user!r} is root: commands have an ordinary user\'s rights, as user = "nobody"'
        )


def _check_archive(path: Path, config: Config, members: Team) -> None:
    """A witness holds nothing to archive, and it alone keeps the copies of others."""
    store, role = config.store, members.robots[config.robot].role
    where = f"{path}:{strict_toml.line_of(path.read_text(), ('store',))}: store"
    if role == "witness" and store.place:
        raise ConfigError(
            f"{where}: {config.robot} is a witness, and has no checkpoints of its own; set s3 or witness on robots or servers"
        )
    if role != "witness" and store.sealed_size:
        raise ConfigError(f"{where}: {config.robot} is a {role}: sealed_size is for a witness, which keeps copies for others")
    if store.witness and (store.witness not in members.robots or members.robots[store.witness].role != "witness"):
        able = ", ".join(sorted(name for name, member in members.robots.items() if member.role == "witness"))
        raise ConfigError(
            f"{where}: witness = {store.witness!r}, which is no witness of the team; "
            + (f"choose among {able}" if able else "failover team invite NAME --role witness adds one")
        )


def _check_user(where: str, user: str) -> None:
    """Raises ConfigError: this agent cannot run anything as that user."""
    try:
        uid = _uid_of(user)
    except KeyError as error:
        raise ConfigError(f"{where}: user = {user!r}: this robot has no such user; see getent passwd") from error
    if uid != os.geteuid() and os.geteuid() != 0:
        raise ConfigError(f"{where}: user = {user!r}: this agent does not run as root: it runs programs of its own user")


def _uid_of(user: str) -> int:
    if not user:
        return os.geteuid()
    from failover.config.accounts import account_of  # here: an agent without tasks and alerts does not load it

    return account_of(user).pw_uid


def _check_choice(where: str, key: str, chosen: str, site: Mapping[str, Robot], roles: set[str]) -> None:
    """A member that only votes, or only keeps checkpoints, cannot be chosen for a task that it never does."""
    if chosen and chosen not in site:
        raise ConfigError(f"{where}: {key} = {chosen!r}: the team knows {', '.join(sorted(site))} at this site")
    if chosen and site[chosen].role not in roles:
        able = ", ".join(sorted(name for name, member in site.items() if member.role in roles)) or "members to enrol"
        what = "runs nothing" if key == "prefer" else "keeps no checkpoints"
        raise ConfigError(f"{where}: {key} = {chosen!r}: it is a {site[chosen].role} and {what}; choose among {able}")


def _check_devices(where: str, component: ComponentConfig) -> None:
    """Refuse a rule that fits no device: it would have no effect."""
    if len(component.devices) > RULES_MAX:
        raise ConfigError(f"{where}: {len(component.devices)} devices; at most {RULES_MAX}")
    try:
        component.device_rules()
    except ValueError as error:
        raise ConfigError(f"{where}: devices: {error}") from error


def _check_carry(where: str, component: ComponentConfig) -> None:
    """A path that names nothing in full would carry something else on another robot."""
    for path in (*component.carry, *component.carry_at, *component.carry_at.values(), *component.shared):
        if not is_carriable(path):
            raise ConfigError(
                f"{where}: carry, carry_at or shared holds {path!r}; name each file or folder by its whole path, without . and .."
            )
    if both := contradiction(component.carry, component.shared):
        raise ConfigError(f"{where}: {both}")
    try:
        size_bytes(component.carry_limit)
    except ValueError as error:
        raise ConfigError(f"{where}: carry_limit: {error}") from error


def _check_command(where: str, component: ComponentConfig) -> None:
    """Find a command that execve(2) would not take now, and not when a robot is lost."""
    if component.command and not component.command[0]:
        raise ConfigError(f"{where}: command begins with an empty word; the first one names the program")
    if component.directory and not component.directory.startswith("/"):
        raise ConfigError(f"{where}: directory = {component.directory!r} is not absolute; an agent has no directory of its own")
    for name in component.environment:
        if not name or "=" in name:
            raise ConfigError(f"{where}: environment has a variable {name!r}; a name is not empty and has no '=' in it")
    for key in KINDS:
        hook = component.hooks.command(key)
        if hook and (not hook[0] or any("\0" in word for word in hook)):
            raise ConfigError(f"{where}: {key} begins with an empty word, or holds a zero byte; the first word names the program")
    try:
        check_told({kind: component.hooks.command(kind) for kind in KINDS})
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from error
    if not 1 <= component.hooks.limit_s <= HOOK_S_MAX:
        raise ConfigError(f"{where}: limit_s of its hooks is {component.hooks.limit_s}; at least 1 and at most {HOOK_S_MAX}")
    if any("\0" in word for word in (*component.command, component.directory, *component.environment.values())):
        raise ConfigError(f"{where}: command, directory or environment holds a zero byte; no program can be given one")
