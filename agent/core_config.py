"""Translates the operator's configuration into the core's types; both use the same words."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from msgspec import msgpack
from msgspec.structs import replace

from agent.config import ComponentConfig, Config, Settings, is_by_pair
from agent.task_config import TaskConfig
from checkpoint.device_rules import arrived, merged, travelling
from checkpoint.engine import Carry, Terms
from checkpoint.program import cpu_baseline
from checkpoint.store.retention import Retention
from failover.config.quantities import size_bytes, span_ms
from failover.core import types
from failover.core.types import CARRY, DETACH, REFUSE, Launch, OnCrash, OnLoss, OnUnsupported, Restart, Rule, Rules, WhenAlone

NO_LEVEL: Final = "no"
"""Of ``failover run --portable``: the program may use all features of this processor, also where the operator rules otherwise."""


def node_config(settings: Settings) -> types.Config:
    """The configuration that the node gets when it is made.

    Raises:
        RulesError: the values contradict each other.
    """
    components = tuple(declared(settings, name, task) for name, task in settings.config.tasks.items())
    return replace(team_config(settings), components=components)


def team_config(settings: Settings) -> types.Config:
    """The same without the components that are declared: what a change of the team changes. It asks the system nothing.

    Raises:
        RulesError: the values contradict each other; `agent.config.check_team` finds that before.
    """
    config, rule = settings.config, _rule(settings)
    etcd = (types.COORDINATOR,) if rule is Rule.ETCD else ()
    return types.Config(
        robot=config.robot,
        peers=tuple(sorted((*settings.peers, *etcd))),
        beat_ms=config.beat_ms,
        lease_ms=config.lease_ms,
        rule=rule,
        servers=_members(settings, "server"),
        witnesses=(*_members(settings, "witness"), *etcd),
        patience_ms=config.patience_s * 1_000,
        copies_ms=config.store.s3_every_s * 1_000 if fetches(settings) else 0,
        boot_patience_ms=config.boot_patience_s * 1_000,
        seat=settings.me.seat,
        restart_grace_ms=_grace_ms(config),
        site=settings.me.site,
        far={name: member.site for name, member in sorted(settings.far.items()) if member.role == "robot"},
    )


def fetches(settings: Settings) -> bool:
    """Whether this robot takes checkpoints from the archive, of components whose primary it does not hear."""
    store, rule = settings.config.store, _rule(settings)
    wanted = (rule is Rule.ETCD and bool(store.s3)) or (rule is Rule.MAJORITY and store.resume)
    return wanted and settings.me.role == "robot"


def declared(settings: Settings, name: str, task: TaskConfig) -> types.ComponentSpec:
    """A component that the agent starts by itself, as if ``failover run`` had been told so."""
    from failover.client.control import SOCKET_NAME, SYSTEM_SOCKET  # here: an agent without tasks does not load it

    config, component = settings.config, settings.component(name)
    variables = {"PATH": os.environ.get("PATH", os.defpath)}
    if (socket := Path(config.runtime_directory) / SOCKET_NAME) != SYSTEM_SOCKET:
        variables["FAILOVER_SOCKET"] = str(socket)
    inheritance, owner = b"", os.geteuid()
    if task.user:
        from checkpoint.linux.spawn.inherited_limits import Inheritance  # here: an agent without tasks does not load them
        from failover.config.accounts import account_of

        user = account_of(task.user)
        owner, groups = user.pw_uid, tuple(os.getgrouplist(user.pw_name, user.pw_gid))
        inheritance = msgpack.encode(Inheritance(user.pw_uid, user.pw_gid, groups))
        variables |= {"HOME": user.pw_dir, "USER": user.pw_name, "LOGNAME": user.pw_name}
    level = level_of("", config, component)
    variables = cpu_baseline.environment(variables, level) if level else variables
    launch = Launch(
        task.argv(name),
        tuple({**variables, **task.environment}.items()),
        task.directory,
        engine=task.engine,
        inheritance=inheritance,
        carry=component.carry,
        devices=travelling(component.device_rules()),
        connections=component.connections,
        shared=component.shared,
        shared_memory=component.shared_memory,
    )
    rules = replace(
        rules_for(config, component),
        restart=Restart(task.restart),
        restart_limit=task.restart_limit,
        restart_window_ms=round(task.restart_window_s * 1000),
    )
    return types.ComponentSpec(name, config.robot, launch, rules, owner)


def retention(config: Config) -> Retention:
    """How much the store keeps for people."""
    size_max = size_bytes(config.keep_size) if config.keep_size else 0
    return Retention(config.keep_checkpoints, span_ms(config.keep_for) // 1_000, size_max)


def _grace_ms(config: Config) -> int:
    """None where it would be shorter than the lease, which a restart has anyway."""
    grace_ms = config.restart_grace_s * 1_000
    return grace_ms if grace_ms >= config.lease_ms else 0


def _rule(settings: Settings) -> Rule:
    if settings.config.rule == "auto":
        alone_with_copies = settings.me.role == "witness" and len(settings.near) == 1
        return Rule.PAIR if is_by_pair("auto", len(settings.near)) and not alone_with_copies else Rule.MAJORITY
    return Rule(settings.config.rule)


def _members(settings: Settings, role: str) -> tuple[str, ...]:
    return tuple(sorted(name for name, member in settings.near.items() if member.role == role))


def rules_for(config: Config, component: ComponentConfig) -> Rules:
    """The rules of one component: its own table, the agent's defaults behind it."""
    return Rules(
        period_ms=component.snapshot_period_ms or config.snapshot_period_ms,
        cpu_share=component.cpu_share or config.cpu_share,
        on_loss=OnLoss(component.on_loss),
        on_crash=OnCrash(component.on_crash),
        when_alone=WhenAlone(config.when_alone),
        on_unsupported=OnUnsupported(component.on_unsupported),
        prefer=component.prefer,
        standby=component.standby,
    )


def level_of(wanted: str, config: Config, component: ComponentConfig) -> str:
    """The level of processors that a program is started for; "" for that of this processor.

    A level of another kind of processor means the usual one of this kind: a mixed team has the same words everywhere.

    Args:
        wanted: of ``failover run``: a level, "no", or "" for the setting of this robot's operator.
    """
    said: bool | str = wanted or (config.portable if component.portable == "" else component.portable)
    if isinstance(said, bool):
        return cpu_baseline.DEFAULT if said else ""
    if said in ("", NO_LEVEL):
        return ""
    return said if said in cpu_baseline.LEVELS else cpu_baseline.DEFAULT


def terms_here(launch: Launch | None, component: ComponentConfig) -> Terms:
    """The terms on which a component comes back on this robot: those that travel with it, and this robot's own in their place.

    Its snapshots say which files it carries.
    """
    carry = Carry(size_max=size_bytes(component.carry_limit), places=tuple(component.carry_at.items()))
    budget_ns, overrun_ns = round(component.freeze_budget_ms * 1_000_000), round(component.freeze_overrun_s * 1_000_000_000)
    own = Terms(
        carry,
        component.device_rules(),
        freeze_budget_ns=budget_ns,
        freeze_overrun_ns=overrun_ns,
        shared=component.shared,
        detaches_memory=(component if launch is None else launch).shared_memory == DETACH,
    )
    if launch is None:
        return own
    return replace(
        own,
        devices=merged(arrived(launch.devices), component.device_rules()),
        connections=launch.connections == CARRY,
        refuses_connections=launch.connections == REFUSE,
        shared=tuple(dict.fromkeys((*launch.shared, *component.shared))),
    )


def begun_on(launch: Launch, component: ComponentConfig) -> Terms:
    """The terms on which a component begins here."""
    terms = terms_here(launch, component)
    return replace(terms, carry=replace(terms.carry, paths=launch.carry))


def started_here(launch: Launch, component: ComponentConfig) -> Launch:
    """How this robot starts a program again that was first started on another: its own command line, if it has one."""
    return replace(
        launch,
        argv=component.command or launch.argv,
        directory=component.directory or launch.directory,
        environment=tuple({**dict(launch.environment), **component.environment}.items()),
    )
