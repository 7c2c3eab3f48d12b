"""Decides when an operator is told that a component was taken over, ran twice, is degraded, or has recovered.

Takeovers and splits are told when they happen, trouble when it has lasted: `Terms.degraded_after_ns` in all, without a pause of
`Terms.recovered_after_ns` between. So a component that flaps is told of once, and once again when it stays well. Of each
component and kind no more than `Terms.hour_max` are told within an hour; the next one says how many were left out.

The robot that runs a component tells of it, and of one that no robot runs the first, by name, of those that hold it: `teller`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Mapping
from typing import Final, Literal, get_args

from msgspec import Struct, field

from failover.core.event_log.decisions import Decision
from failover.core.status.observations import COUNTS_AS_DEAD
from failover.core.wire.names import weight

Kind = Literal["takeover", "split", "degraded", "recovered"]
KINDS: Final[tuple[Kind, ...]] = get_args(Kind)

HOUR_NS: Final = 3600 * 10**9

LOOK_NS_MAX: Final = 10 * 10**9
"""Between two looks; what passed beyond it (a machine slept) says nothing of how a component stood."""

NEAR_NS: Final = 10 * 10**9
"""A silence before it that a robot told of is why it claimed a component."""

REASON_MAX: Final = 1_000
"""Characters."""

OVER: Final = "it has ended, or is protected no longer"
"""Why trouble is over that did not end by itself."""


class Terms(Struct, frozen=True):
    """What an operator has set."""

    degraded_after_ns: int
    recovered_after_ns: int
    hour_max: int


class Alert(Struct, frozen=True):
    """What is told, once.

    Attributes:
        left_out: alerts of this kind about this component that were not told since the one before.
    """

    kind: Kind
    component: str
    epoch: int
    reason: str
    left_out: int = 0


class Sight(Struct, frozen=True):
    """How a component stands. ``trouble``: why it is degraded; "" while it is well. ``is_over``: nothing is to be protected."""

    epoch: int
    trouble: str = ""
    is_over: bool = False


class Trouble(Struct):
    """Of one component.

    Attributes:
        reason: the last one, or the one that was told.
        bad_ns: how long it lasted in all; ``well_ns``: how long it has been well since.
        is_told: an operator knows.
    """

    epoch: int
    reason: str
    bad_ns: int = 0
    well_ns: int = 0
    is_told: bool = False


class Watch(Struct):
    """What one robot has seen and told.

    Attributes:
        troubles: component → what an operator was told of, or may be told of, and that is not over.
    """

    terms: Terms
    troubles: dict[str, Trouble] = field(default_factory=dict)
    _looked_ns: int = 0
    _told_ns: dict[tuple[Kind, str], deque[int]] = field(default_factory=dict)
    _left_out: dict[tuple[Kind, str], int] = field(default_factory=dict)

    def happened(self, kind: Kind, component: str, epoch: int, reason: str, now_ns: int) -> Alert | None:
        """A takeover or a split; None where it is not told, because too many were."""
        if not self._may_tell(kind, component, now_ns):
            key = kind, component
            self._left_out[key] = self._left_out.get(key, 0) + 1
            return None
        return self._alert(kind, component, epoch, reason, now_ns)

    def look(self, sights: Mapping[str, Sight], now_ns: int) -> list[Alert]:
        """What is to be told now. A component that is not among the sights is as it was."""
        passed_ns, self._looked_ns = min(now_ns - (self._looked_ns or now_ns), LOOK_NS_MAX), now_ns
        told = []
        for component, sight in sights.items():
            trouble = self.troubles.get(component)
            if sight.trouble and not sight.is_over:
                told += self._bad(component, sight, passed_ns if trouble is not None else 0, now_ns)
            elif trouble is not None:
                told += self._well(component, sight, trouble, passed_ns, now_ns)
        return told

    def _bad(self, component: str, sight: Sight, passed_ns: int, now_ns: int) -> list[Alert]:
        trouble = self.troubles.setdefault(component, Trouble(sight.epoch, sight.trouble))
        trouble.well_ns = 0
        if not trouble.is_told:
            trouble.epoch, trouble.reason = sight.epoch, sight.trouble
        trouble.bad_ns += passed_ns
        lasted = trouble.bad_ns >= self.terms.degraded_after_ns
        if trouble.is_told or not lasted or not self._may_tell("degraded", component, now_ns):
            return []
        trouble.is_told = True
        return [self._alert("degraded", component, sight.epoch, sight.trouble, now_ns)]

    def _well(self, component: str, sight: Sight, trouble: Trouble, passed_ns: int, now_ns: int) -> list[Alert]:
        trouble.well_ns += passed_ns
        if trouble.well_ns < self.terms.recovered_after_ns and not sight.is_over:
            return []
        del self.troubles[component]
        if not trouble.is_told:
            return []
        reason = OVER if sight.is_over else f"it is protected again; before: {trouble.reason}"
        return [self._alert("recovered", component, sight.epoch, reason, now_ns)]

    def _may_tell(self, kind: Kind, component: str, now_ns: int) -> bool:
        told = self._told_ns.get((kind, component), ())
        return sum(now_ns - at_ns < HOUR_NS for at_ns in told) < self.terms.hour_max

    def _alert(self, kind: Kind, component: str, epoch: int, reason: str, now_ns: int) -> Alert:
        key = kind, component
        self._told_ns.setdefault(key, deque(maxlen=self.terms.hour_max)).append(now_ns)
        return Alert(kind, component, epoch, reason, self._left_out.pop(key, 0))


def teller(primary: str, holders: Iterable[str], knowing: Iterable[str], living: Collection[str]) -> str:
    """The robot that tells of a component's trouble; "" where no robot can.

    Args:
        primary: the robot that runs it as far as is known; "" for none.
        holders: robots that hold its checkpoints and wait; ``knowing``: all that have answered and know it.
        living: members that do not count as dead.
    """
    if primary in living:
        return primary
    able = sorted(set(holders) or set(knowing), key=weight)
    return able[0] if able else ""


def why_taken_over(decisions: Iterable[Decision], component: str, epoch: int) -> str:
    """The reason of a takeover, from this robot's own decisions, oldest first; "" where they do not tell."""
    told: list[str] = []
    silent: Decision | None = None
    for decision in decisions:
        if not decision.component and decision.sentence.endswith(COUNTS_AS_DEAD):
            silent = decision
        elif decision.component == component and decision.facts.epoch == epoch:
            if not told and silent is not None and 0 <= decision.at_ns - silent.at_ns <= NEAR_NS:
                told.append(silent.sentence)
            told.append(decision.sentence)
    return "; ".join(told)[:REASON_MAX]
