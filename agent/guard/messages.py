"""Messages between agent and guard (docs/internals.md, section 6). Arguments and environment are bytes, as programs' are.

Stream descriptors travel with `Started`, `VesselReady` and `Described`: counters, read end 1, read end 2, log 1, log 2.
"""

from __future__ import annotations

from typing import Literal

import msgspec

from checkpoint.engine import COOPERATIVE, PTRACE
from checkpoint.linux.spawn.inherited_limits import Inheritance
from checkpoint.model import Clocks
from checkpoint.segment.task_messages import Origin


class Message(msgspec.Struct, frozen=True, tag=True):
    """The base of them all: a frozen struct, told apart by its class name."""


class Task(msgspec.Struct, frozen=True):
    """The guard's answer to a program that says that it keeps its state (`checkpoint.segment.task_messages`).

    Attributes:
        engine: as it was asked for; for `Described`.
        warm: it is told nothing before `BeginTask`, its output stays in its pipes until then, and without the agent it ends.
    """

    epoch: int = 0
    origin: Origin | None = None
    engine: str = COOPERATIVE
    warm: bool = False


class Start(Message, frozen=True):
    """Start a program, and be its parent.

    Attributes:
        component: its name; remembered, so that a restarted agent learns whose guard this is.
        environment: each ``NAME=value``.
        isolate: in PID and time namespaces of its own.
        log_directory: where `agent.guard.output_logs.OutputLogs` are.
        cgroup: a cgroup v2 directory to make the component's own cgroup in; "" for the guard's.
        inheritance: whose rights, limits and priorities it gets; None: the guard's.
        task: for a program that may keep its state; with a descriptor, if it has an origin: the state as a segment.
        totals: bytes that it had written to its two streams by then.
        brought: its files that were brought here, shown where its own are missing: (path, content, mode).
    """

    component: str
    argv: tuple[bytes, ...]
    environment: tuple[bytes, ...]
    working_directory: bytes
    umask: int
    isolate: bool
    log_directory: str
    cgroup: str = ""
    inheritance: Inheritance | None = None
    task: Task | None = None
    totals: tuple[int, int] = (0, 0)
    brought: tuple[tuple[str, str, int], ...] = ()


class MakeVessel(Message, frozen=True):
    """Make a vessel for a restore, and be its parent. With the keeper's pidfd: before `Commit`, its end is the vessel's end.

    Attributes:
        inner_pid: the PID that the program knows itself by; 0 for any.
        clocks: as the program read them when its snapshot was taken, ``elapsed_ns`` before ``counted_ns`` on CLOCK_BOOTTIME.
        totals: bytes that the program had written to its two streams; None: of a ready copy, whose logs `Commit` opens.
        user: uid and gid that the program ran as.
        task: for a program that may still say that it keeps its state: its new guard listens where it was told to look.
    """

    component: str
    inner_pid: int
    isolate: bool
    clocks: Clocks
    elapsed_ns: int
    totals: tuple[int, int] | None
    log_directory: str
    cgroup: str = ""
    user: tuple[int, int] | None = None
    task: Task | None = None
    counted_ns: int = 0


class Watch(Message, frozen=True):
    """Look after a process that is another process's child: its end is noticed, its exit status is not known. With its pidfd."""

    component: str
    pid: int


class BeginTask(Message, frozen=True):
    """Have a program begin that was started warm; under the lease given before. With its state as a segment, if it has an origin.

    Attributes:
        totals: bytes that the component had written to its two streams by then; output that waits in its pipes follows them.
    """

    epoch: int
    origin: Origin | None
    totals: tuple[int, int]


class Commit(Message, frozen=True):
    """The vessel has become the component: from here on it outlives agent and keeper. Answer: `Done`.

    Attributes:
        totals: where its output goes on, of a vessel that was made without; the answer is `VesselReady` with its streams.
        task: of the same; see `MakeVessel`.
    """

    totals: tuple[int, int] | None = None
    task: Task | None = None


class Lease(Message, frozen=True):
    """Freeze the component by yourself when CLOCK_BOOTTIME passes ``until_ns``; 0 for no lease. A later one thaws it again."""

    until_ns: int


class Freeze(Message, frozen=True):
    """Hold the component still until `Thaw`.

    Attributes:
        exposed: so that a tracer can make calls in it: by SIGSTOP, also where its cgroup would hold it.
    """

    exposed: bool = False


class Thaw(Message, frozen=True):
    """Let it go on; refused while its lease is over."""


class CommitSafe(Message, frozen=True):
    """A standby holds this commit of a program that keeps its state; told to it. No answer."""

    commit: int


class CommitKept(Message, frozen=True):
    """No robot can stand by, and this robot's disk holds this commit of a program that keeps its state; told to it. No answer."""

    commit: int


class LimitOutput(Message, frozen=True):
    """Let so many bytes of each stream wait to be safe at another robot, then have the program wait; 0: any number. No answer."""

    hold_limit: int


class Kill(Message, frozen=True):
    """Send the program a signal; SIGKILL goes to all processes that it started, too."""

    signal: int


class Tell(Message, frozen=True):
    """Send the program a signal with a value; refused where that would end it, for it has no handler."""

    signal: int
    value: int


class Describe(Message, frozen=True):
    """How does the component stand?"""


class LetGo(Message, frozen=True):
    """Protection ends, the program runs on: no lease any more; the guard keeps its streams, is found no more, ends with it."""


class Forget(Message, frozen=True):
    """The exit status has been noted; the guard may end. Refused while the component lives."""


class Started(Message, frozen=True):
    """The program runs, or will as soon as it is scheduled."""

    pid: int
    inner_pid: int
    isolated: bool
    notes: tuple[str, ...] = ()


class VesselReady(Message, frozen=True):
    """The vessel waits for the keeper."""

    pid: int
    inner_pid: int
    isolated: bool
    notes: tuple[str, ...] = ()


class Watching(Message, frozen=True):
    """The process is there and is looked after."""

    notes: tuple[str, ...] = ()


class Done(Message, frozen=True):
    """The guard has done what the agent asked."""


class Described(Message, frozen=True):
    """How the component stands.

    Attributes:
        state: none: nothing was started yet; vessel: not committed yet; waiting: started warm, and not begun yet.
        frozen_by: who holds it: "" no process, "order" the agent, "lease" the guard.
        exit_status: as wait(2) gives it; None before the end, and for a process that was not our child.
        totals: bytes written to the two streams so far.
        freezes_by: "cgroup" (invisible to the program) or "SIGSTOP".
        blocked: why output is held back, "" if it is not.
        engine: as it was asked for.
        task_pid: of the process that keeps the state, 0 while there is none; keeps: it has made a commit.
        hears_kept: this guard knows `CommitKept`; a guard from before an upgrade hangs up on it, and does not say this.
    """

    component: str
    state: Literal["none", "vessel", "waiting", "running", "frozen", "ended"]
    pid: int
    inner_pid: int
    isolated: bool
    watched: bool
    frozen_by: Literal["", "order", "lease"]
    exit_status: int | None
    totals: tuple[int, int]
    lease_until_ns: int
    log_directory: str
    freezes_by: Literal["", "cgroup", "SIGSTOP"]
    blocked: str
    notes: tuple[str, ...]
    engine: str = PTRACE
    task_pid: int = 0
    keeps: bool = False
    hears_kept: bool = False


class Refused(Message, frozen=True):
    """It was not done; the component is as it was."""

    message: str


class Exited(Message, frozen=True):
    """The component ended; said to every agent that connects, until `Forget`.

    Attributes:
        status: as wait(2) gives it; None for a process that was not our child.
        totals: bytes written to the two streams, complete.
    """

    status: int | None
    totals: tuple[int, int]
    notes: tuple[str, ...] = ()


class FrozenByLease(Message, frozen=True):
    """The lease ran out and the guard froze the component; an event."""


class TaskConnected(Message, frozen=True):
    """A process has said that it keeps the state, and goes on when it is told how; an event. 0: it has gone, and kept nothing."""

    pid: int


class TaskKeeps(Message, frozen=True):
    """It has made its first commit to a segment: a capture finds something there from now on; an event."""

    pid: int


Request = (
    Start
    | BeginTask
    | MakeVessel
    | Watch
    | Commit
    | Lease
    | Freeze
    | Thaw
    | CommitSafe
    | CommitKept
    | LimitOutput
    | Kill
    | Tell
    | Describe
    | LetGo
    | Forget
)
Reply = Started | VesselReady | Watching | Done | Described | Refused
Event = Exited | FrozenByLease | TaskConnected | TaskKeeps
