"""Figures of one component for ``failover status``, beside the core's own view: counts, times and reasons."""

from __future__ import annotations

from collections import deque
from typing import Final

from msgspec import Struct, field

from agent.worker.components.component import Captured
from checkpoint.device_rules import DeviceRule, rules_of
from checkpoint.engine import PTRACE
from checkpoint.keeper.messages import Slack
from checkpoint.model import Position, Snapshot
from checkpoint.store.digest_cache import KnownDigest
from failover.core.schedule.slack import remark
from failover.core.types import ComponentSpec

REASONS_TOLD: Final = 3
"""Of the reasons why it cannot be captured, in one sentence of the core; ``status --json`` has them all."""


GAPS_KEPT: Final = 64
"""Of the commits that were captured last; the longest interval is a program's usual one."""
SILENT_TIMES: Final = 10
"""A program whose newest commit is so many times older than it is used to has stopped committing, it seems…"""
SILENT_NS_MIN: Final = 2 * 10**9
"""…but not sooner than this;"""
SILENT_NS_AT_FIRST: Final = 10 * 10**9
"""nor sooner than this, where it has made one commit only."""


class Commits(Struct):
    """When a program that keeps its state commits, as far as captures show it.

    Attributes:
        number: of the newest one, 0 before the first; at ``newest_ns``, on this robot's clock.
    """

    number: int = 0
    newest_ns: int = 0
    _gaps_ns: deque[int] = field(default_factory=lambda: deque(maxlen=GAPS_KEPT))

    def note(self, number: int, at_ns: int) -> None:
        """A capture has found this commit."""
        if 0 < self.number < number:  # one that was started again begins with 1
            self._gaps_ns.append((at_ns - self.newest_ns) // (number - self.number))
        self.number, self.newest_ns = number, at_ns

    @property
    def usual_ns(self) -> int | None:
        """The longest time that lay between two of the last commits; None where there were not two."""
        return max(self._gaps_ns) if self._gaps_ns else None

    def is_overdue(self, now_ns: int) -> bool:
        """Whether the newest is much older than it used to become."""
        usual_ns = self.usual_ns
        limit_ns = SILENT_NS_AT_FIRST if usual_ns is None else max(SILENT_TIMES * usual_ns, SILENT_NS_MIN)
        return self.number > 0 and now_ns - self.newest_ns > limit_ns

    def remark(self, now_ns: int) -> str:
        """A sentence on a program that is overdue, for a user who looks at ``failover status`` for the first time."""
        used = "its only one" if self.usual_ns is None else f"before that there was one every {seconds(self.usual_ns)}"
        return (
            f"last commit {seconds(now_ns - self.newest_ns)} ago, {used}: it commits no more, or it hangs; "
            "if its robot is lost now, it resumes from that commit"
        )


NOT_WANTED: Final = "agent.toml says ready_copy = false"
"""Why there is no ready copy, where that is as it should be."""


class CopyFigures(Struct, frozen=True):
    """Of the ready copy at a standby.

    Attributes:
        size: bytes of memory that it takes.
        why: there is none.
        wanted: by this robot's operator.
    """

    ready: bool = False
    size: int = 0
    position: Position | None = None
    why: str = ""
    wanted: bool = True


class Budget(Struct):
    """How snapshots of one component kept to its `freeze_budget_ms`.

    Attributes:
        kept, missed: snapshots.
        last_us, last_bytes: the last one that missed it: how long the program stood still, and how much was copied meanwhile.
    """

    kept: int = 0
    missed: int = 0
    last_us: int = 0
    last_bytes: int = 0

    def note(self, captured: Captured, budget_ms: float) -> None:
        """Count one."""
        if captured.freeze_us <= budget_ms * 1_000:
            self.kept += 1
        else:
            self.missed += 1
            self.last_us, self.last_bytes = captured.freeze_us, captured.frozen_bytes

    def remark(self, budget_ms: float) -> str:
        """A sentence on the captures that missed it; "" if none did."""
        if not self.missed:
            return ""
        return (
            f"it stood still for longer than its freeze_budget_ms of {budget_ms:g} in {self.missed} of {self.missed + self.kept} "
            f"snapshots, last for {self.last_us / 1_000:.1f} ms, in which {self.last_bytes / 1e6:.1f} MB were copied"
        )


class SlackFigures(Struct):
    """How captures of one component met the activations of its tasks.

    Attributes:
        captures: of those that were to wait for the end of an activation; ``squeezed``: that delayed the next one all the same.
        last: the newest one; ``every_ns``: from the one before to it, 0: there was none.
    """

    captures: int = 0
    squeezed: int = 0
    last: Slack | None = None
    every_ns: int = 0

    def note(self, slack: Slack | None) -> None:
        """Count one; None: it met none."""
        if slack is None:
            self.last = None
            return
        self.captures += 1
        self.squeezed += slack.is_squeezed
        self.every_ns = slack.began_ns - self.last.began_ns if self.last is not None else 0
        self.last = slack

    def remark(self) -> str:
        """A sentence on a task that the last capture delayed; "" if it delayed none."""
        last = self.last
        if last is None or not last.is_squeezed:
            return ""
        return remark(last.task, last.period_ns, last.slack_ns, last.freeze_ns, self.every_ns or last.waited_ns)


class Memory(Struct, frozen=True):
    """Bytes of private memory of this robot's agent.

    Attributes:
        agent: of the main loop and the worker; ``keepers``: of those that follow a component here.
        remembered: of both, for pages that deltas are told from, and proved by; ``remembered_max``: its bound, xor_cache.
    """

    agent: int
    keepers: int
    remembered: int
    remembered_max: int


class Resumed(Struct, frozen=True):
    """How a component came to run here.

    Attributes:
        at_ns: when its program acted here first, by our clock.
        robot: whose checkpoint it resumed from; state_at_ns: when that was taken, by that robot's calendar, since 1970.
    """

    at_ns: int
    robot: str
    state_at_ns: int
    position: Position


class Figures(Struct):
    """The figures that ``failover status`` shows of one component on this robot; None where one is not known."""

    snapshots: int = 0
    restores: int = 0
    crashes: int = 0
    freeze_us: int | None = None
    freeze_us_max: int | None = None
    budget: Budget = field(default_factory=Budget)
    slack: SlackFigures = field(default_factory=SlackFigures)
    snapshot_size: int | None = None
    dirty_bytes: int | None = None
    written_bytes: int = 0
    """Of the pages of all deltas that were taken here; ``known_bytes``: of those whose last content was in the cache."""
    known_bytes: int = 0
    newest: Position | None = None
    exit_status: int | None = None
    outage_ms: float | None = None
    resumed: Resumed | None = None
    reasons: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    spec: ComponentSpec | None = None
    """Of a standby: as its primary told it with the newest snapshot."""
    lacks: tuple[str, ...] | None = None
    """Of a standby: needs of the program that this robot does not meet (`prerequisites`); None: it has not looked yet."""
    contested: tuple[str, ...] = ()
    """Of a primary: which of its files others hold open for writing, so that a restore would be refused (`prerequisites`)."""
    digests: tuple[KnownDigest, ...] = ()
    """Of files that were read for that."""
    devices: tuple[DeviceRule, ...] = ()
    """Of those that it has open, as the newest snapshot from its primary tells."""
    hooks: dict[str, str] = field(default_factory=dict)
    """By occasion: the complaint of the last run of a hook."""
    bringing: dict[str, str] = field(default_factory=dict)
    """By robot: how far its files are on their way there."""
    engine: str = PTRACE
    commits: Commits = field(default_factory=Commits)
    copy: CopyFigures = field(default_factory=CopyFigures)

    @property
    def xor_hit_rate(self) -> float | None:
        """Which part of the bytes in deltas could be told as a difference; None before the first one."""
        return self.known_bytes / self.written_bytes if self.written_bytes else None

    def captured(self, captured: Captured, budget_ms: float = 0) -> None:
        """Count one snapshot that was taken here; ``budget_ms``: the component's `freeze_budget_ms`."""
        if budget_ms:
            self.budget.note(captured, budget_ms)
        self.slack.note(captured.slack)
        self.snapshots += 1
        self.freeze_us = captured.freeze_us
        self.freeze_us_max = max(self.freeze_us_max or 0, captured.freeze_us)
        self.snapshot_size, self.dirty_bytes = captured.size, captured.dirty_bytes
        if captured.parent is not None:
            self.written_bytes += captured.dirty_bytes
            self.known_bytes += captured.known_bytes
        self.newest = captured.position
        self.notes = captured.notes

    def stored(self, snapshot: Snapshot, size: int, spec: ComponentSpec) -> None:
        """Count one snapshot that came from the primary."""
        self.snapshots += 1
        self.spec = spec
        self.devices = rules_of(snapshot.resources)
        self.newest, self.snapshot_size, self.engine = snapshot.position, size, snapshot.engine


def seconds(duration_ns: int) -> str:
    """A duration as people say it: 0.012 s, 1.5 s, 14 s."""
    value = duration_ns / 1e9
    return f"{value:.0f} s" if value >= 10 else f"{value:.1f} s" if value >= 0.1 else f"{value:.3f} s"


def shortened(reasons: tuple[str, ...]) -> str:
    """The first reasons as one sentence, and how many there are besides."""
    more = len(reasons) - REASONS_TOLD
    return "; ".join(reasons[:REASONS_TOLD]) + (f"; and {more} more" if more > 0 else "")
