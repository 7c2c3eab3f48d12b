"""Configurations of simulated teams."""

from __future__ import annotations

from msgspec.structs import replace

from failover.core.types import COORDINATOR, ComponentSpec, Config, Rule


def pair(
    components: tuple[ComponentSpec, ...] = (), names: tuple[str, ...] = ("robot1", "robot2"), boot_patience_ms: int = 0
) -> list[Config]:
    """Configurations of a small team, with times that make a minute of life cheap to simulate."""
    plain = Config(names[0], (), components, 25, 150, 20, 10, 300, 200, 2_000, 400, 3_000, 2_000)
    plain = replace(plain, boot_patience_ms=boot_patience_ms)
    return [replace(plain, robot=name, peers=tuple(other for other in names if other != name)) for name in names]


def elective(
    robots: int,
    components: tuple[ComponentSpec, ...] = (),
    servers: int = 0,
    witnesses: int = 0,
    patience_ms: int = 60_000,
    lease_ms: int = 150,
) -> list[Config]:
    """Configurations of a team that votes."""
    kinds = {"robot": robots, "server": servers, "witness": witnesses}
    names = {kind: tuple(f"{kind}{number + 1}" for number in range(count)) for kind, count in kinds.items()}
    return [
        replace(
            config,
            rule=Rule.MAJORITY,
            servers=names["server"],
            witnesses=names["witness"],
            patience_ms=patience_ms,
            lease_ms=lease_ms,
            margin_percent=12,
            archive_ms=500,
            components=components if config.robot in names["robot"] else (),
        )
        for config in pair(components, sum(names.values(), ()))
    ]


def coordinated(robots: int, components: tuple[ComponentSpec, ...] = (), lease_ms: int = 150) -> list[Config]:
    """Configurations of robots that vote together with etcd."""
    return ruled(Rule.ETCD, elective(robots, components, lease_ms=lease_ms))


def with_copies(configs: list[Config], copies_ms: int) -> list[Config]:
    """The same team, whose robots go on from copies in an archive; the other members know nothing of it."""
    return [replace(config, copies_ms=copies_ms if config.runs(config.robot) else 0) for config in configs]


def ruled(rule: Rule, configs: list[Config]) -> list[Config]:
    """The same robots, deciding by that rule; by the rule ``etcd`` with etcd among them."""
    if rule is not Rule.ETCD:
        return [replace(config, rule=rule) for config in configs]
    return [replace(config, rule=rule, peers=(*config.peers, COORDINATOR), witnesses=(COORDINATOR,)) for config in configs]
