"""The table ``[alerts]`` of agent.toml: commands that tell an operator, and when they are run."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

from failover.core.alerts import KINDS, Kind

SPAN_S_MAX: Final = 3_600
LIMIT_S_MAX: Final = 300
HOUR_MAX: Final = 1_000


@dataclass(frozen=True, slots=True)
class AlertsConfig:
    """Commands, each a list of words that no shell reads; [] for none. See `failover.core.alerts` and `agent.worker.alerts`.

    Attributes:
        user: whose rights they have; "" for the agent's own, which may not be root then.
        degraded_after_s: how long trouble lasts before it is told; recovered_after_s: how long it has to be well again.
        per_hour: of each component and kind.
        limit_s: seconds that a command may take.
    """

    user: str = ""
    on_takeover: list[str] = field(default_factory=list)
    on_split: list[str] = field(default_factory=list)
    on_degraded: list[str] = field(default_factory=list)
    on_recovered: list[str] = field(default_factory=list)
    degraded_after_s: int = 10
    recovered_after_s: int = 30
    per_hour: int = 12
    limit_s: int = 20

    def command(self, kind: Kind) -> tuple[str, ...]:
        """The words that are run; () for none."""
        return tuple(getattr(self, f"on_{kind}"))

    @property
    def wanted(self) -> bool:
        """Whether an operator is told of anything."""
        return any(map(self.command, KINDS))

    def __post_init__(self) -> None:
        """Refuse what could not be carried out when it matters.

        Raises:
            ValueError: says which key, what is wrong with it, and what to write instead.
        """
        for kind in KINDS:
            words = self.command(kind)
            if words and (not words[0] or any("\0" in word for word in words)):
                raise ValueError(
                    f"on_{kind} begins with an empty word, or holds a zero byte; the first word names the program: "
                    f'on_{kind} = ["/usr/local/bin/tell-operator"]'
                )
        for key, most in (("degraded_after_s", SPAN_S_MAX), ("recovered_after_s", SPAN_S_MAX), ("limit_s", LIMIT_S_MAX)):
            _check_range(key, getattr(self, key), most)
        _check_range("per_hour", self.per_hour, HOUR_MAX)


def _check_range(key: str, value: int, most: int) -> None:
    if not 1 <= value <= most:
        raise ValueError(f"{key} is {value}; it must be at least 1 and at most {most}")
