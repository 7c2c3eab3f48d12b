"""The program that a guard looks after: its start, its freezes, its lease, and its end.

====================  ==================================================================================================
state                 arrows out of it
====================  ==================================================================================================
``vessel``            `commit` → running; `abandon` (agent or keeper lost) → ended
``waiting``           `begin_task` → running; `abandon` (agent lost) → ended; it ends → ended
``running``           `freeze` or a lease that runs out → frozen; it ends → ended
``frozen``            `thaw`, or a new lease after the old one froze it → running; SIGKILL → ended
``ended``             none: the status is kept until it is forgotten
====================  ==================================================================================================

Invariant: while a lease is over, a committed program is frozen, whichever requests arrive.
"""

from __future__ import annotations

import os
import secrets
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal

import msgspec
from msgspec import Struct, field
from msgspec.structs import replace

from agent.guard import freezer as freezing
from agent.guard.freezer import Freezer
from agent.guard.messages import BeginTask, Described, Exited, MakeVessel, Start, Task, Watch
from agent.guard.output_logs import STREAMS, OutputLogs
from agent.guard.output_pump import Pump
from agent.guard.task_socket import TaskEnd, name_told_to
from agent.system.clock import now_ns
from agent.system.syscalls import queue_signal
from checkpoint.engine import PTRACE
from checkpoint.errors import ProbeError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.spawn.file_overlay import BroughtFile
from checkpoint.linux.spawn.vessel import Birth, Born, spawn_program, spawn_vessel
from checkpoint.segment.task_messages import VARIABLE
from checkpoint.sentences import in_words

DRAIN_S: Final = 2.0
"""How long the end of a program waits for its last output to be written; a full disk must not hide the end."""

NO_TRIM: Final = "its logs grow without bound: their filesystem cannot give the beginning of a file back"
UNFINISHED: Final = "the restore was not finished: agent or keeper ended before it was committed"
NOBODY_LEFT: Final = "it waited for its agent's order to begin, and that agent has ended"
WATCHED: Final = "failover did not start it: its exit status will not be known, its output is not kept"


class ProgramError(Exception):
    """The order does not fit the state; says why and what to do."""


class GuardedProgram(Struct):
    """One program, alive or ended. Made by `start`, `make_vessel` or `watch`."""

    component: str
    born: Born
    freezer: Freezer
    log_directory: str = ""
    pump: Pump | None = None
    pidfd: int | None = None
    committed: bool = True
    warm: bool = False
    let_go: bool = False
    frozen_by: Literal["", "order", "lease"] = ""
    lease_until_ns: int = 0
    exited: Exited | None = None
    notes: list[str] = field(default_factory=list)
    task: TaskEnd | None = None
    engine: str = PTRACE
    """As it was asked for."""
    offered: MakeVessel | None = None
    """The message from which a restored program learns its state, once it says that it keeps one."""

    # --- birth ---

    @classmethod
    def start(cls, order: Start, segment: tuple[int, ...] = ()) -> GuardedProgram:
        """Start a program.

        Args:
            segment: the state that it goes on with, if it keeps one and has one.

        Raises:
            OSError: it cannot be executed, or its logs cannot be written; nothing is left of it.
        """
        argv = [os.fsdecode(argument) for argument in order.argv]
        environment = dict(os.fsdecode(item).split("=", 1) for item in order.environment if b"=" in item)
        directory = os.fsdecode(order.working_directory)

        environment.pop(VARIABLE, None)  # of the process that gave the order: it may be a component itself
        task = _task_end(order, segment) if order.task is not None else None

        def give_birth(birth: Birth) -> Born:
            named = environment if task is None else environment | task.environment
            return spawn_program(argv, named, directory, order.umask, birth)

        kept = order.inheritance
        user = (kept.uid, kept.gid) if kept is not None else None
        waits = order.task is not None and order.task.warm
        totals = None if waits else order.totals
        brought = tuple(BroughtFile(*file) for file in order.brought)
        birth = Birth(isolate=order.isolate, inheritance=kept, brought=brought)
        program = cls._bear(order, totals, birth, give_birth, user, task)
        program.warm, program.committed = waits, not waits
        program.engine = order.task.engine if order.task is not None else PTRACE
        return program

    @classmethod
    def make_vessel(cls, order: MakeVessel) -> GuardedProgram:
        """Make a vessel for a restore; uncommitted.

        Raises:
            RestoreError, OSError: it could not be made; nothing is left of it.
        """
        birth = Birth(order.inner_pid, order.isolate, order.clocks, order.elapsed_ns, counted_ns=order.counted_ns)
        program = cls._bear(order, order.totals, birth, spawn_vessel, order.user)
        program.committed = False
        program.offered, program.engine = order, order.task.engine if order.task is not None else PTRACE
        return program

    @classmethod
    def watch(cls, order: Watch, pidfd: int) -> GuardedProgram:
        """Look after a process that is another one's child.

        Args:
            pidfd: of it; stays the caller's.

        Raises:
            ProcessLookupError: it has ended; another process may have its number by now.
        """
        signal.pidfd_send_signal(pidfd, 0)
        pidfd = os.dup(pidfd)
        hold = freezing.SignalFreezer()
        hold.add(order.pid, pidfd)
        notes = [WATCHED, "the guard freezes it by SIGSTOP, which it can notice: it keeps the cgroup that it was started in"]
        return cls(order.component, Born(order.pid, _inner_pid(order.pid)), hold, pidfd=pidfd, notes=notes)

    @classmethod
    def _bear(
        cls,
        order: Start | MakeVessel,
        totals: tuple[int, int] | None,
        birth: Birth,
        act: Callable[[Birth], Born],
        user: tuple[int, int] | None,
        task: TaskEnd | None = None,
    ) -> GuardedProgram:
        """Logs, pipes and a freezer first; the process last, into all of them.

        Args:
            totals: bytes that it had written by then; None: it waits, and its output stays in its pipes.
            user: uid and gid that the pipes shall belong to, so that the program can open /dev/stdout; None: ours.
        """
        pump = Pump()
        if totals is not None:
            _open(pump, order.log_directory, totals)
        if user is not None and os.geteuid() == 0:
            for stream in STREAMS:
                os.fchown(pump.write_ends[stream], *user)
        hold, notes = freezing.choose(order.cgroup, f"{freezing.CGROUP_PREFIX}{secrets.token_hex(8)}")
        try:
            ends = pump.write_ends
            if task is not None:
                task.flows_into(pump.counters.descriptor, (ends[1], ends[2]))
            with open(os.devnull, "rb") as nothing, hold.birthplace():
                born = act(replace(birth, stdio=(nothing.fileno(), ends[1], ends[2])))
        except BaseException:
            hold.close()
            if task is not None:
                task.close()
            raise
        hold.add(born.pid)
        pump.born()
        if pump.is_open:
            pump.begin()
        program = cls(order.component, born, hold, order.log_directory, pump, notes=[*notes, *born.notes], task=task)
        program.note_logs()
        return program

    def descriptors(self) -> tuple[int, ...]:
        """The descriptors of the streams that the keeper needs: counters, two read ends, two logs. They stay ours."""
        if self.pump is None or not self.pump.is_open:
            return ()
        reads = [self.pump.read_ends[stream] for stream in STREAMS]
        logs = [self.pump.logs.descriptor(stream) for stream in STREAMS]
        return (self.pump.counters.descriptor, *reads, *logs)

    def note_logs(self) -> None:
        """Note if the filesystem of the logs cannot give old bytes back."""
        if self.pump is not None and self.pump.is_open and not self.pump.logs.trims:
            self.notes.append(NO_TRIM)

    def begin_task(self, order: BeginTask, segment: tuple[int, ...]) -> None:
        """Have a program begin that waits for it, under the lease that it was given before; from here on it outlives the agent.

        Raises:
            ProgramError: it does not wait, or has ended in the meantime.
            OSError: its logs cannot be written; it waits as before.
        """
        self._check_alive("have it begin")
        if self.committed or not self.warm:
            raise ProgramError("cannot begin it: the guard has started it to run at once, and it runs")
        assert self.task is not None and self.pump is not None, "what is warm was born so"
        _open(self.pump, self.log_directory, order.totals)
        self.note_logs()
        self.commit()  # with its lease over it is frozen now, before it hears anything
        self.pump.begin()
        self.task.begin(order.epoch, order.origin, *segment[:1])

    # --- holding still ---

    def commit(self) -> None:
        """The vessel is the component now.

        Raises:
            ProgramError: it has ended in the meantime.
        """
        self._check_alive("commit to it")
        self.committed = True
        self._listen_again()
        self.lapse(now_ns())

    def commit_copy(self, totals: tuple[int, int], task: Task | None) -> None:
        """The vessel was a ready copy, and is the component now: its output goes on in the logs from ``totals`` on.

        Raises:
            ProgramError: it has ended in the meantime, or its logs are open already.
            OSError: they cannot be written; nothing has changed.
        """
        self._check_alive("commit to it")
        if self.offered is None or self.pump is None or self.pump.is_open:
            raise ProgramError("cannot commit to it as to a ready copy: its logs are open already")
        _open(self.pump, self.log_directory, totals)
        self.note_logs()
        self.offered = msgspec.structs.replace(self.offered, task=task)
        self.engine = task.engine if task is not None else PTRACE
        self.commit()
        self.pump.begin()

    def _listen_again(self) -> None:
        """A program that was restored before it said that it keeps its state looks for its guard where the last one listened."""
        if self.offered is None or self.offered.task is None or self.pump is None or not (name := name_told_to(self.born.pid)):
            return
        try:
            task = TaskEnd(self.component, self.offered.user[0] if self.offered.user is not None else os.geteuid(), name)
        except OSError as error:
            self.notes.append(f"it cannot report that it keeps its state: the guard cannot listen at {name}: {error.strerror}")
            return
        first, second = (self.pump.read_ends[stream] for stream in STREAMS)
        task.flows_into(self.pump.counters.descriptor, (first, second))
        task.begin(self.offered.task.epoch, self.offered.task.origin)
        self.task = task

    def freeze(self, by: Literal["order", "lease"] = "order", *, exposed: bool = False) -> None:
        """Hold it; a thread that is deep in the kernel stands as soon as it leaves it.

        Args:
            exposed: a tracer may look into it, see `Freezer.expose`.

        Raises:
            ProgramError: it has ended.
        """
        self._check_alive("freeze it")
        self.freezer.freeze()
        if exposed:
            self.freezer.expose()
        self.frozen_by = by

    def thaw(self) -> None:
        """Let it go on.

        Raises:
            ProgramError: it has ended, or its lease is over.
        """
        self._check_alive("thaw it")
        if self._lease_is_over(now_ns()):
            raise ProgramError("cannot thaw it: its lease is over, another robot may run it; give it a new lease first")
        self.freezer.thaw()
        self.frozen_by = ""

    def set_lease(self, until_ns: int) -> None:
        """Take a new lease; a program that the old one froze goes on. A program frozen by order stays so."""
        self.lease_until_ns = until_ns
        if self.frozen_by == "lease" and self.exited is None and not self._lease_is_over(now_ns()):
            self.thaw()

    def lapse(self, now_ns: int) -> bool:
        """Freeze it if its lease is over by now; returns whether this did it."""
        held = not self.committed or self.frozen_by
        if held or self.exited is not None or not self._lease_is_over(now_ns):
            return False
        self.freeze("lease")
        return True

    def deadline_ns(self) -> int | None:
        """When `lapse` has something to do, on CLOCK_BOOTTIME."""
        pending = self.lease_until_ns and self.committed and not self.frozen_by and self.exited is None
        return self.lease_until_ns if pending else None

    def _lease_is_over(self, now_ns: int) -> bool:
        return 0 < self.lease_until_ns <= now_ns

    # --- the end ---

    def kill(self, number: int) -> None:
        """Send a signal; SIGKILL goes to everything that it started, too. A process that has ended gets none."""
        if self.exited is not None:
            return
        try:
            if self.pidfd is not None:
                signal.pidfd_send_signal(self.pidfd, number)
            elif number == signal.SIGKILL:
                self.freezer.kill()
            else:
                os.kill(self.born.pid, number)
        except ProcessLookupError:
            pass

    def tell(self, number: int, value: int) -> None:
        """Send a signal with a value.

        Raises:
            ProgramError: it would end by it, has ended, or cannot be told.
        """
        try:
            fields = procfs.parse_fields(procfs.read_text(self.born.pid, "status"))
            if not (int(fields["SigCgt"], 16) | int(fields["SigBlk"], 16)) >> (number - 1) & 1:
                raise ProgramError(
                    f"it neither handles nor blocks {signal.Signals(number).name}, which may end it: the guard does not send it"
                )
            queue_signal(self.born.pid, number, value)
        except (OSError, ProbeError) as error:
            raise ProgramError(f"the guard cannot send it {signal.Signals(number).name}: {in_words(error)}") from error

    def abandon(self) -> None:
        """Agent or keeper are gone before it was the component: nothing of it stays."""
        self.notes.append(NOBODY_LEFT if self.warm else UNFINISHED)
        self.committed = True
        self.kill(signal.SIGKILL)

    def reap(self) -> bool:
        """Take the status of each process that has ended, orphans too; True if the program has just ended."""
        just_ended = False
        while (reaped := _reap_one()) is not None:
            pid, status = reaped
            if pid == self.born.pid and self.pidfd is None:
                self._end(status)
                just_ended = True
        return just_ended

    def watched_end(self) -> None:
        """The pidfd of a program that is not our child says that it has ended."""
        self._end(None)

    def _end(self, status: int | None) -> None:
        """Its leftovers end with it, unless it was let go; then its last output is written, then the end is known."""
        if not self.let_go and self.pidfd is None:
            self.freezer.kill()
        if self.pump is not None and not self.pump.is_open:
            self.notes.extend([said] if (said := self.pump.last_line()) else [])
        elif self.pump is not None and not self.pump.drain(DRAIN_S):
            self.notes.append("its last output may be incomplete: " + (self.pump.blocked or "another process still writes to it"))
        if self.task is not None:
            self.task.close()
        self.frozen_by = ""
        self.exited = Exited(status, self.totals(), tuple(self.notes))

    def close(self) -> None:
        """Remove what this object has made outside this process."""
        self.freezer.close()

    # --- telling ---

    def totals(self) -> tuple[int, int]:
        """Bytes taken from the two streams so far."""
        return self.pump.counters.totals() if self.pump is not None else (0, 0)

    def state(self) -> Literal["vessel", "waiting", "running", "frozen", "ended"]:
        """The state of the table above."""
        if self.exited is not None:
            return "ended"
        if not self.committed:
            return "waiting" if self.warm else "vessel"
        return "frozen" if self.frozen_by else "running"

    def describe(self, more_notes: tuple[str, ...]) -> Described:
        """All of it, for `Described`."""
        return Described(
            component=self.component,
            state=self.state(),
            pid=self.born.pid,
            inner_pid=self.born.inner_pid,
            isolated=self.born.isolated,
            watched=self.pidfd is not None,
            frozen_by=self.frozen_by,
            exit_status=self.exited.status if self.exited else None,
            totals=self.totals(),
            lease_until_ns=self.lease_until_ns,
            log_directory=self.log_directory,
            freezes_by=self.freezer.kind,
            blocked=self.pump.blocked if self.pump is not None else "",
            notes=(*self.notes, *more_notes),
            engine=self.engine,
            task_pid=self.task.pid if self.task is not None else 0,
            keeps=self.task is not None and self.task.keeps,
            hears_kept=True,
        )

    def _check_alive(self, what: str) -> None:
        if self.exited is not None:
            raise ProgramError(f"cannot {what}: the program has ended; ask for its status, then forget it")


def _task_end(order: Start, segment: tuple[int, ...]) -> TaskEnd:
    """The socket of a program that may keep its state, which begins as soon as it says that it does."""
    assert order.task is not None
    task = TaskEnd(order.component, order.inheritance.uid if order.inheritance is not None else os.geteuid())
    if not order.task.warm:
        task.begin(order.task.epoch, order.task.origin, *segment[:1])
    return task


def _open(pump: Pump, log_directory: str, totals: tuple[int, int]) -> None:
    """Have the output go on in the logs from ``totals`` on; the logs lose all bytes beyond."""
    logs = OutputLogs(Path(log_directory))
    logs.truncate(totals)
    pump.open(logs, totals)


def _reap_one() -> tuple[int, int] | None:
    """One child that has ended, as (PID, status); None when there is none now."""
    try:
        pid, status = os.waitpid(-1, os.WNOHANG)
    except ChildProcessError:
        return None
    return (pid, status) if pid else None


def _inner_pid(pid: int) -> int:
    """The PID that the process knows itself by: the innermost of NSpid in /proc/PID/status."""
    try:
        with open(f"/proc/{pid}/status", encoding="utf-8", errors="replace") as file:
            for line in file:
                if line.startswith("NSpid:"):
                    return int(line.split()[-1])
    except (FileNotFoundError, ProcessLookupError):
        pass
    return pid
