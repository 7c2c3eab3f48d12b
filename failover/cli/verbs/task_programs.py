"""task run, task run-once, wait-activation: programs that know nothing of the schedule, at their times."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import Final

from msgspec.structs import replace

from failover.boards import boottime
from failover.cli.output import render
from failover.cli.verbs.tasks import parsed, terms_of
from failover.core.schedule.activation import Tick
from failover.core.schedule.terms import Declaration, Kind, Terms, nanoseconds
from failover.errors import ScheduleError
from failover.schedule.task import ScheduledTask

VARIABLE: Final = "FAILOVER_ACTIVATION_FD"
"""Of a program that `run` has started with ``--loop``: its end of a socket of sequenced packets. It sends a packet when it wants
the next activation, and receives one: number, instant at which it was due, lateness (ns), activations missed before it. The end
of the socket: there is none."""
PACKET_SIZE: Final = 256
READY_POLL_S: Final = 0.01
READY_LOOKS: Final = 3
"""Looks in a row, and the time between two, that must say that a program has its handler: a shell that forks blocks signals."""
KILLED: Final = 128
"""Added to a signal's number, as shells do."""


class _ProgramEnded(Exception):
    """The program of a loop, while its task waits."""


def _split(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Settings, which come first and have an equals sign; the command.

    Raises:
        ScheduleError: there is no command.
    """
    place = next((place for place, word in enumerate(words) if "=" not in word), len(words))
    if place == len(words):
        raise ScheduleError("there is no command: failover task run TASK period_ms=1000 -- COMMAND")
    return list(words[:place]), list(words[place:])


def run(arguments: argparse.Namespace) -> int:
    """Run a command at each activation of a task; with --loop or --signal start it once, and let it ask, or send it a signal."""
    settings, command = _split(arguments.words)
    fields, after, _ = parsed(settings)
    terms = terms_of(fields) if settings else Terms()
    with _running(arguments, terms, after or ()) as task:
        if arguments.signal:
            return _signalled(task, command, arguments.signal)
        return _looped(task, command) if arguments.loop else _each(task, command)


def run_once(arguments: argparse.Namespace) -> int:
    """Run a command once, at an instant and after other tasks; its exit status."""
    settings, command = _split(arguments.words)
    fields, after, _ = parsed(settings)
    at_ns = boottime.machine_ns() + nanoseconds(arguments.in_ms / 1000, "--in-ms")
    terms = replace(Terms(), **{**fields, "kind": Kind.ONE_SHOT, "at_ns": at_ns})
    with _running(arguments, terms, after or ()) as task:
        return _each(task, command)


@contextlib.contextmanager
def _running(arguments: argparse.Namespace, terms: Terms, after: tuple[str, ...]) -> Iterator[ScheduledTask]:
    """The task, as this process runs it; SIGTERM ends it as the end of the body does."""
    before = signal.signal(signal.SIGTERM, _leave)
    try:
        place = Path(arguments.board) if arguments.board else None
        with ScheduledTask(Declaration(arguments.task, terms, after), place, "failover") as task:
            for note in task.notes:
                print(note, file=sys.stderr)
            yield task
    finally:
        signal.signal(signal.SIGTERM, before)


class _Leave:
    """What SIGTERM does: it ends this command. While a process starts it waits: the process would be left alone."""

    def __init__(self) -> None:
        self._starts = False
        self._waits = 0

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if not self._starts:
            sys.exit(KILLED + number)
        self._waits = number

    def hold(self) -> None:
        """A process starts."""
        self._starts = True

    def release(self) -> None:
        """It has started: the signal that came meanwhile does what it does."""
        self._starts, waits, self._waits = False, self._waits, 0
        if waits:
            sys.exit(KILLED + waits)


_leave: Final = _Leave()


@contextlib.contextmanager
def _started(command: Sequence[str], **options: object) -> Iterator[subprocess.Popen[bytes]]:
    """A process of the command; told to end if the body is left before it has.

    Raises:
        ScheduleError: it cannot be started.
    """
    _leave.hold()
    try:
        process = subprocess.Popen(command, **options)  # type: ignore[call-overload]
    except OSError as error:
        _leave.release()
        raise ScheduleError(f"cannot run {command[0]}: {error.strerror}") from error
    try:
        _leave.release()
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            process.send_signal(signal.SIGCONT)  # one that has stopped takes no other signal
            process.wait()


def _status(process: subprocess.Popen[bytes]) -> int:
    status = process.wait()
    return status if status >= 0 else KILLED - status


def _each(task: ScheduledTask, command: Sequence[str]) -> int:
    """Run a command at each activation; the exit status of the last one."""
    status = 0
    for tick in task:
        with _started(command) as process:
            status = _status(process)
        if status:
            print(f"{task.name}: {command[0]} ended with status {status} at activation {tick.number}", file=sys.stderr)
    return status


def _looped(task: ScheduledTask, command: Sequence[str]) -> int:
    """Run a command that asks for each activation; its exit status."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        with _started(command, pass_fds=(theirs.fileno(),), env={**os.environ, VARIABLE: str(theirs.fileno())}) as process:
            theirs.close()
            with contextlib.suppress(_ProgramEnded, BrokenPipeError, ConnectionResetError):
                with _woken_by_its_end(process):
                    while process.poll() is None and ours.recv(PACKET_SIZE) and (tick := task.wait_activation()) is not None:
                        ours.send(_told(tick).encode())
            task.end()
            ours.close()
            return _status(process)
    finally:
        ours.close()
        theirs.close()


def _signalled(task: ScheduledTask, command: Sequence[str], number: int) -> int:
    """Run a command once and send it a signal at each activation; its exit status, 0 where the task comes to an end first.

    With SIGCONT an activation ends when the program stops itself again; with any other signal, of which a program shows no end,
    when it has been sent.
    """
    with _started(command) as process:
        try:
            with _woken_by_its_end(process):
                _wait_until_stopped(process) if number == signal.SIGCONT else _wait_until_taken(process, number)
                while task.wait_activation() is not None:
                    os.kill(process.pid, number)
                    if number == signal.SIGCONT:
                        _wait_until_stopped(process)
                    task.end()
                return 0
        except _ProgramEnded:
            task.end()
            return _status(process)


@contextlib.contextmanager
def _woken_by_its_end(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """A task may sleep for long: the body is left by `_ProgramEnded` when its program ends."""

    def notice(number: int, frame: FrameType | None) -> None:
        if _has_ended(process):
            raise _ProgramEnded

    before = signal.signal(signal.SIGCHLD, notice)
    try:
        if _has_ended(process):
            raise _ProgramEnded
        yield
    finally:
        signal.signal(signal.SIGCHLD, before)


def _has_ended(process: subprocess.Popen[bytes]) -> bool:
    """Whether it has; its exit status stays for `Popen`."""
    try:
        return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None
    except ChildProcessError:
        return True


def _wait_until_stopped(process: subprocess.Popen[bytes]) -> None:
    """Until it has stopped itself: it waits for SIGCONT. Source: waitid(2)."""
    found = os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WEXITED | os.WNOWAIT)
    if found is None or found.si_code != os.CLD_STOPPED:
        raise _ProgramEnded
    os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOHANG)


def _wait_until_taken(process: subprocess.Popen[bytes], number: int) -> None:
    """Until it has a handler for the signal, or blocks or ignores it: the first one would end it before.

    Source: proc_pid_status(5).
    """
    looks = 0
    while looks < READY_LOOKS:
        lines = dict(line.split(":", 1) for line in Path(f"/proc/{process.pid}/status").read_text().splitlines() if ":" in line)
        is_taken = any(int(lines[key], 16) >> (number - 1) & 1 for key in ("SigBlk", "SigIgn", "SigCgt"))
        looks = looks + 1 if is_taken else 0
        time.sleep(READY_POLL_S)


def _told(tick: Tick) -> str:
    return f"{tick.number} {tick.due_ns} {tick.late_ns} {tick.missed}"


def wait_activation(arguments: argparse.Namespace) -> int:
    """In a program that `run` has started with --loop: wait for its next activation. Exit status 1: there is none."""
    named = os.environ.get(VARIABLE, "")
    try:
        link = socket.socket(fileno=int(named))
    except (ValueError, OSError):
        raise ScheduleError(
            f"no task runs this program ({VARIABLE} is {named!r}): "
            "start it with failover task run --loop TASK period_ms=1000 -- COMMAND"
        ) from None
    try:
        link.send(b"next")
        told = link.recv(PACKET_SIZE)
    except (BrokenPipeError, ConnectionResetError):
        return 1
    if told and arguments.json:
        numbers = (int(word) for word in told.split())
        render.as_json(dict(zip(("number", "due_ns", "late_ns", "missed"), numbers, strict=True)))
    elif told and not arguments.quiet:
        print(told.decode())
    return 0 if told else 1
