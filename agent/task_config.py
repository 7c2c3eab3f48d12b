"""A task that agent.toml declares: a component that the agent starts by itself, at its times."""

from __future__ import annotations

import signal
import sys
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, Literal

from failover.core.types import PERIOD_MS_MAX, RESTARTS_MAX

if TYPE_CHECKING:
    from failover.core.schedule.terms import Declaration

UNTAKEN: Final = ("KILL", "STOP")
"""No program can have a handler for them."""


@dataclass(frozen=True, slots=True)
class TaskConfig:
    """``[tasks."/lab/robot1/controller"]``. Times in milliseconds.

    Attributes:
        command: the program; it takes its times by ``failover.scheduled(NAME)``, `ft_begin`, or ``failover task run``.
        user: whose rights it has; "" for the agent's own.
        directory: an absolute path.
        environment: variables besides PATH, HOME, USER and FAILOVER_SOCKET, or instead of them.
        engine: as of ``failover run``.
        wake: "self": it waits for its activations itself. "signal": it is sent ``wake_signal`` at each of them: it can do no more
            than wait for a signal. CONT: it stops itself to wait (`failover.cli.verbs.task_programs`).
        period_ms: 0: it is started, and is no task of the schedule.
        restart: after which ends the agent starts the program anew, from its beginning; restart_limit: so often inside
            restart_window_s, 0 for as often as need be: see `failover.core.transitions.restarts`.
        phase_ms, deadline_ms, budget_ms, after, overrun, cpus, priority, strict: see `failover.core.schedule.terms.Terms`.
    """

    command: tuple[str, ...] = field(default_factory=tuple)
    user: str = ""
    directory: str = "/"
    environment: dict[str, str] = field(default_factory=dict)
    engine: Literal["auto", "ptrace", "cooperative"] = "auto"
    restart: Literal["always", "on-failure", "never"] = "on-failure"
    restart_limit: int = 5
    restart_window_s: float = 60
    wake: Literal["self", "signal"] = "self"
    wake_signal: str = "CONT"
    period_ms: float = 0
    phase_ms: float = 0
    deadline_ms: float = 0
    budget_ms: float = 0
    after: tuple[str, ...] = field(default_factory=tuple)
    overrun: Literal["skip", "queue", "catch_up"] = "skip"
    cpus: tuple[int, ...] = field(default_factory=tuple)
    priority: int = 0
    strict: bool = False

    def __post_init__(self) -> None:
        """Refuse what no program can be started with.

        Raises:
            ValueError: says what.
        """
        if any("\0" in word for word in (*self.command, self.directory, *self.environment.values())):
            raise ValueError("command, directory or environment holds a zero byte; no program can be given one")
        if not self.directory.startswith("/"):
            raise ValueError(f"directory = {self.directory!r} is not absolute; an agent has no directory of its own")
        if not 0 <= self.restart_limit <= RESTARTS_MAX:
            raise ValueError(f"restart_limit is {self.restart_limit}; at most {RESTARTS_MAX}, and 0 sets no limit")
        if not 1 <= self.restart_window_s <= PERIOD_MS_MAX / 1000:
            raise ValueError(f"restart_window_s is {self.restart_window_s:g}; at least 1 and at most {PERIOD_MS_MAX / 1000:g}")
        if f"SIG{self.wake_signal}" not in signal.Signals.__members__ or self.wake_signal in UNTAKEN:
            raise ValueError(f"wake_signal is {self.wake_signal!r}; give the name of a signal such as CONT, not KILL or STOP")
        if self.wake == "signal" and not self.period_ms:
            raise ValueError('wake = "signal" without period_ms: a program is sent a signal at each activation of its task')
        for name in self.environment:
            if not name or "=" in name:
                raise ValueError(f"environment has a variable {name!r}; a name is not empty and has no '=' in it")

    def argv(self, name: str) -> tuple[str, ...]:
        """The command that is started: its own, or one that wakes it. ``-P``: no module comes from the program's directory."""
        if self.wake == "self":
            return self.command
        return (sys.executable, "-P", "-m", "failover", "task", "run", "--signal", self.wake_signal, name, "--", *self.command)


def declaration(name: str, task: TaskConfig) -> Declaration | None:
    """The task as the schedule is told of it; None: it is none, only a program that is to run.

    Raises:
        ScheduleError: it cannot be; names what.
    """
    if not task.period_ms:
        return None
    from failover.core.schedule.course import Overrun  # here: an agent without tasks does not load them
    from failover.core.schedule.terms import CPUS_MAX, Declaration, Terms, checked, nanoseconds
    from failover.errors import ScheduleError

    if any(not 0 <= one < CPUS_MAX for one in task.cpus):
        raise ScheduleError(f"cpus = {list(task.cpus)}: processors have the numbers 0 to {CPUS_MAX - 1}")
    terms = Terms(
        period_ns=nanoseconds(task.period_ms / 1000, "period_ms"),
        phase_ns=nanoseconds(task.phase_ms / 1000, "phase_ms"),
        deadline_ns=nanoseconds(task.deadline_ms / 1000, "deadline_ms"),
        budget_ns=nanoseconds(task.budget_ms / 1000, "budget_ms"),
        cpus=sum(1 << one for one in set(task.cpus)),
        priority=task.priority,
        overrun=Overrun[task.overrun.upper()],
        strict=task.strict,
    )
    return checked(Declaration(name, terms, task.after))
