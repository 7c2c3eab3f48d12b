"""The guard of one component: ``python -m agent.guard.server SOCKET_PATH``. It is the program's parent and outlives its own.

It owns what must not die with an agent: the program's exit status, the other ends of its output, and the lease that freezes the
program unless the agent renews it. It imports little, locks its memory, and does no tracing and no networking, so that few faults
can end it. If it ends all the same, the program ends with it (PR_SET_PDEATHSIG): a program without a lease must not run.

It listens on SOCKET_PATH (0600) for one agent at a time; a new agent replaces the old one. It ends

* when the agent says `Forget` after the program's end;
* when the program has ended, no agent is there, and the system told the guard to end (SIGTERM: a shutdown);
* when a program that was let go (`LetGo`) ends; at once, if that program is the child of another process;
* when the agent is lost before anything was started, or before a restore was committed, also where that has ended already;
* when no agent ever came, after `FIRST_CALL_S`.
"""

from __future__ import annotations

import contextlib
import functools
import os
import select
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import msgspec

from agent.guard.messages import (
    BeginTask,
    Commit,
    CommitKept,
    CommitSafe,
    Describe,
    Described,
    Done,
    Forget,
    Freeze,
    FrozenByLease,
    Kill,
    Lease,
    LetGo,
    LimitOutput,
    MakeVessel,
    Refused,
    Request,
    Start,
    Started,
    Tell,
    Thaw,
    VesselReady,
    Watch,
    Watching,
)
from agent.guard.program import GuardedProgram, ProgramError
from agent.guard.task_socket import TaskEnd
from agent.system import syscalls, timers
from agent.system.clock import now_ns
from checkpoint.errors import CheckpointError
from checkpoint.keeper.messages import Channel, ChannelError, close_all
from checkpoint.linux.unix_address import address_of
from checkpoint.sentences import in_words

FIRST_CALL_S: Final = 30.0
SEND_TIMEOUT_S: Final = 1.0
"""An agent that does not read for so long is treated as lost; a lease must not wait for it."""

REALTIME_PRIORITY: Final = 2
"""Before keepers that hold a program still, who have the lowest (`checkpoint.linux.realtime_boost`): no lease waits for them."""
_PEER: Final = struct.Struct("3i")


class Guard:
    """The loop and what it was told. One thread; the pump of `GuardedProgram` is the only other one."""

    def __init__(self, listener: socket.socket, path: str, notes: tuple[str, ...]) -> None:
        """
        Args:
            path: where it listens; the listener's own name may be another, see `checkpoint.linux.unix_address`.
        """
        self._listener = listener
        self._path = path
        self._notes = notes
        self._agent: Channel[Any] | None = None
        self._program: GuardedProgram | None = None
        self._keeper: int | None = None
        self._over = False
        self._ends_with_program = False
        self._told_to_end = False
        self._is_unfinished = False
        self._started_at = time.monotonic()
        self._signals = _wake_on_signals()
        self._alarm = timers.Alarm()
        self._answers: dict[type, Callable[[Any, tuple[int, ...]], None]] = {
            Start: self._start,
            BeginTask: self._begin_task,
            MakeVessel: self._make_vessel,
            Watch: self._watch,
            Commit: self._commit,
            Lease: self._lease,
            Freeze: lambda request, _: self._act(lambda program: program.freeze(exposed=request.exposed)),
            Thaw: lambda _, __: self._act(lambda program: program.thaw()),
            CommitSafe: self._commit_safe,
            CommitKept: self._commit_kept,
            LimitOutput: self._limit_output,
            Kill: lambda request, _: self._act(lambda program: program.kill(request.signal)),
            Tell: lambda request, _: self._act(lambda program: program.tell(request.signal, request.value)),
            Describe: lambda _, __: self._reply(
                self._description(), self._program.descriptors() if self._program is not None else ()
            ),
            LetGo: self._let_go,
            Forget: self._forget,
        }

    def run(self) -> None:
        """Serve until there is nothing left to guard."""
        while not self._over:
            ready = self._wait()
            if self._program is not None and self._program.lapse(now_ns()):  # first: a lease does not wait
                self._tell(FrozenByLease())
            for act in ready:
                act()
            self._over |= self._agent is None and self._is_of_no_use()
        if self._program is not None:
            self._program.close()

    def _is_of_no_use(self) -> bool:
        """Whether no agent will ask for what this guard knows."""
        if self._program is None:
            return time.monotonic() > self._started_at + FIRST_CALL_S
        return (self._told_to_end or self._is_unfinished) and self._program.exited is not None

    def _wait(self) -> list[Callable[[], None]]:
        """Sleep until something is to be done, or a deadline passes; returns what is to be done."""
        watched: dict[int, Callable[[], None]] = {self._signals.fileno(): self._heed_signals, self._alarm.fileno(): _wake_up}
        self._alarm.set(self._program.deadline_ns() if self._program is not None else None)
        if self._listener.fileno() >= 0:  # it was not let go
            watched[self._listener.fileno()] = self._accept
        if self._agent is not None:
            watched[self._agent.fileno()] = functools.partial(self._receive, self._agent)
        if self._keeper is not None:
            watched[self._keeper] = self._lose_keeper
        if self._program is not None and self._program.pidfd is not None and self._program.exited is None:
            watched[self._program.pidfd] = self._watched_end
        if self._program is not None and self._program.task is not None and self._program.exited is None:
            watched[self._program.task.fileno()] = functools.partial(self._heed_task, self._program.task)
        poll = select.poll()
        for descriptor in watched:
            poll.register(descriptor, select.POLLIN)
        return [watched[descriptor] for descriptor, _ in poll.poll(self._patience_ms())]

    def _patience_ms(self) -> float | None:
        return FIRST_CALL_S * 1000 if self._program is None and self._agent is None else None

    # --- the agent ---

    def _accept(self) -> None:
        """A new agent takes the old one's place; a stranger is turned away."""
        end, _ = self._listener.accept()
        _, uid, _ = _PEER.unpack(end.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
        if uid not in (0, os.geteuid()):
            end.close()
            return
        if self._agent is not None:
            self._lose_agent()
        if self._over:
            end.close()
            return
        end.settimeout(SEND_TIMEOUT_S)
        self._agent = Channel(end, Request)
        if self._program is not None and self._program.exited is not None:
            self._tell(self._program.exited)

    def _receive(self, agent: Channel[Any]) -> None:
        if agent is not self._agent:  # in this same turn it was found to have gone, or another one came
            return
        try:
            request, descriptors = agent.receive()
        except (ChannelError, TimeoutError):
            self._lose_agent()
            return
        try:
            self._answers[type(request)](request, descriptors)
        except (ProgramError, OSError, CheckpointError) as error:
            self._reply(Refused(_sentence(request, error)))
        finally:
            close_all(tuple(descriptor for descriptor in descriptors if descriptor != self._keeper))

    def _lose_agent(self) -> None:
        """The agent has gone: what was unfinished is undone, what runs goes on."""
        assert self._agent is not None
        self._agent.close()
        self._agent = None
        if self._program is None:
            self._over = True
        else:
            self._undo_unfinished(self._program)

    def _lose_keeper(self) -> None:
        """The pidfd of the keeper says that it has ended in the middle of a restore."""
        self._drop_keeper()
        if self._program is not None:
            self._undo_unfinished(self._program)

    def _undo_unfinished(self, program: GuardedProgram) -> None:
        if not program.committed:
            program.abandon()
            self._is_unfinished = True  # its end is no component's: the next agent must not find it
            self._ends_with_program = self._agent is None  # no agent is left to be told

    def _drop_keeper(self) -> None:
        if self._keeper is not None:
            os.close(self._keeper)
            self._keeper = None

    def _reply(self, message: msgspec.Struct, descriptors: tuple[int, ...] = ()) -> None:
        self._tell(message, descriptors)

    def _tell(self, message: msgspec.Struct, descriptors: tuple[int, ...] = ()) -> None:
        """Send to the agent, if there is one that listens."""
        if self._agent is None:
            return
        try:
            self._agent.send(message, descriptors)
        except ChannelError:
            self._lose_agent()

    # --- what it is asked ---

    def _start(self, request: Start, descriptors: tuple[int, ...]) -> None:
        self._check_free()
        self._program = program = GuardedProgram.start(request, descriptors)
        born = program.born
        self._reply(Started(born.pid, born.inner_pid, born.isolated, self._all_notes()), program.descriptors())

    def _begin_task(self, request: BeginTask, descriptors: tuple[int, ...]) -> None:
        self._reap()  # it may have ended just now
        program = self._guarded()
        program.begin_task(request, descriptors)
        born = program.born
        self._reply(Started(born.pid, born.inner_pid, born.isolated, self._all_notes()), program.descriptors())

    def _make_vessel(self, request: MakeVessel, descriptors: tuple[int, ...]) -> None:
        self._check_free()
        self._program = program = GuardedProgram.make_vessel(request)
        self._keeper = descriptors[0] if descriptors else None
        born = program.born
        self._reply(VesselReady(born.pid, born.inner_pid, born.isolated, self._all_notes()), program.descriptors())

    def _watch(self, request: Watch, descriptors: tuple[int, ...]) -> None:
        self._check_free()
        if len(descriptors) != 1:
            raise ProgramError(f"cannot look after pid {request.pid}: its pidfd must come along")
        self._program = GuardedProgram.watch(request, descriptors[0])
        self._reply(Watching(self._all_notes()))

    def _commit(self, request: Commit, _: tuple[int, ...]) -> None:
        program = self._guarded()
        if request.totals is None:
            program.commit()
            self._drop_keeper()
            self._reply(Done())
            return
        program.commit_copy(request.totals, request.task)
        self._drop_keeper()
        born = program.born
        self._reply(VesselReady(born.pid, born.inner_pid, born.isolated, self._all_notes()), program.descriptors())

    def _commit_safe(self, request: CommitSafe, _: tuple[int, ...]) -> None:
        if self._program is not None and self._program.task is not None and self._program.exited is None:
            self._program.task.tell_safe(request.commit)

    def _commit_kept(self, request: CommitKept, _: tuple[int, ...]) -> None:
        if self._program is not None and self._program.task is not None and self._program.exited is None:
            self._program.task.tell_kept(request.commit)

    def _limit_output(self, request: LimitOutput, _: tuple[int, ...]) -> None:
        if self._program is not None and self._program.pump is not None:
            self._program.pump.limit(request.hold_limit)

    def _lease(self, request: Lease, _: tuple[int, ...]) -> None:
        self._guarded().set_lease(request.until_ns)
        self._reply(Done())

    def _let_go(self, _: LetGo, __: tuple[int, ...]) -> None:
        program = self._guarded()
        program.set_lease(0)
        if program.frozen_by:
            program.thaw()
        program.let_go = self._ends_with_program = True
        self._stop_listening()  # no later agent may find it, and take it for a component
        self._over = program.pidfd is not None or program.exited is not None
        self._reply(Done())

    def _stop_listening(self) -> None:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self._path)
        self._listener.close()

    def _forget(self, _: Forget, __: tuple[int, ...]) -> None:
        if self._program is not None and self._program.exited is None:
            raise ProgramError("the program still runs; stop or release it first")
        self._reply(Done())
        self._over = True

    def _act(self, act: Callable[[GuardedProgram], None]) -> None:
        act(self._guarded())
        self._reply(Done())

    def _guarded(self) -> GuardedProgram:
        if self._program is None:
            raise ProgramError("nothing was started yet")
        return self._program

    def _check_free(self) -> None:
        if self._program is not None:
            raise ProgramError(f"this guard already looks after pid {self._program.born.pid}; a guard serves one program only")

    def _all_notes(self) -> tuple[str, ...]:
        return (*(self._program.notes if self._program else ()), *self._notes)

    def _description(self) -> Described:
        if self._program is not None:
            return self._program.describe(self._notes)
        return Described("", "none", 0, 0, False, False, "", None, (0, 0), 0, "", "", "", self._notes)

    # --- ends ---

    def _heed_signals(self) -> None:
        while numbers := _drain(self._signals):
            self._told_to_end |= signal.SIGTERM in numbers
        self._reap()

    def _reap(self) -> None:
        if self._program is not None and self._program.reap():
            self._announce_end()

    def _watched_end(self) -> None:
        assert self._program is not None
        self._program.watched_end()
        self._announce_end()

    def _heed_task(self, task: TaskEnd) -> None:
        """The program says something about the state that it keeps."""
        if self._program is None or self._program.exited is not None:  # it has ended in this same turn
            return
        for event in task.heed():
            self._tell(event)

    def _announce_end(self) -> None:
        assert self._program is not None and self._program.exited is not None
        self._drop_keeper()
        self._tell(self._program.exited)
        self._over |= self._ends_with_program


def main(arguments: list[str]) -> int:
    """Become a guard; returns its exit status."""
    if len(arguments) != 1:
        print(f"usage: python -m {__package__}.server SOCKET_PATH   (started by failover-agent, not by hand)", file=sys.stderr)
        return 2
    path = arguments[0]
    try:
        listener = _listen(path)
    except OSError as error:
        print(f"guard: cannot listen on {path}: {error.strerror or error}", file=sys.stderr)
        return 1
    try:
        Guard(listener, path, _settle()).run()
    finally:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(path)
    return 0


def _listen(path: str) -> socket.socket:
    """Listen at a path at which no other process listens; 0600 from its first instant."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
    before = os.umask(0o177)
    try:
        with address_of(Path(path)) as address:
            listener.bind(address)
    finally:
        os.umask(before)
    listener.listen()
    return listener


def _settle() -> tuple[str, ...]:
    """Make this process hard to disturb; returns a sentence for each thing that the system did not permit."""
    for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)  # it ends when its program has ended, however the system shuts down
    syscalls.become_subreaper()
    with contextlib.suppress(PermissionError):  # it leads a session already: its parent saw to that
        os.setsid()
    notes = []
    syscalls.small_stacks()
    try:
        syscalls.lock_memory()
    except OSError as error:
        notes.append(f"the guard's memory is not locked, so its lease may be late when memory is short: {error.strerror}")
    try:
        if (priority := syscalls.become_realtime(REALTIME_PRIORITY)) < REALTIME_PRIORITY:
            notes.append(
                f"the guard has real-time priority {priority}, as keepers have while a program stands still, so they may "
                f"delay its lease then: allow {REALTIME_PRIORITY} (LimitRTPRIO, ulimit -r)"
            )
    except OSError as error:
        notes.append(f"the guard has no real-time priority, so its lease may be late on a busy machine: {error.strerror}")
    return tuple(notes)


def _wake_up() -> None:
    """The alarm rang: the loop's next turn looks at the lease."""


def _wake_on_signals() -> socket.socket:
    """A socket that gives the number of each signal that came, one byte each: of SIGCHLD, when a child has ended."""
    inside, outside = socket.socketpair()
    inside.setblocking(False)
    outside.setblocking(False)
    signal.signal(signal.SIGCHLD, lambda *_: None)
    signal.set_wakeup_fd(outside.detach(), warn_on_full_buffer=False)
    return inside


def _drain(end: socket.socket) -> bytes:
    try:
        return end.recv(256)
    except BlockingIOError:
        return b""


def _sentence(request: msgspec.Struct, error: Exception) -> str:
    """What was tried and why not."""
    return f"cannot {_attempt(request)}: {in_words(error)}" if isinstance(error, OSError) else str(error)


def _attempt(request: msgspec.Struct) -> str:
    """What a request wants, in words."""
    match request:
        case Start(argv=argv):
            return f"start {os.fsdecode(argv[0]) if argv else 'a program without a name'}"
        case MakeVessel(component=component):
            return f"make a vessel for {component}"
        case Watch(pid=pid):
            return f"look after pid {pid}"
        case _:
            return f"{type(request).__name__.lower()} the component"


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
