"""Create a process that becomes a program: a *vessel* for a restore, or a program that is started afresh.

A vessel runs a few bytes of our own that wait for ever; `checkpoint.engines.ptrace.restore.restore` turns it into the program.
The guard and the keeper use this module; it needs no ptrace. The caller has one thread, which must not wait for "any child"
meanwhile.

::

    caller ── midwife          makes the namespaces, then ends (reaped here)
       ├───── first process    PID 1 of the new PID namespace: reaps orphans, ends as soon as the program has ended
       └───── vessel           the caller's own child, with the wanted PID inside

The caller reaps the vessel first, then the first process (``Born.init_pid``), which may have to wait for it.

Races, in the order of their steps:

1. The caller dies before the child has asked for PR_SET_PDEATHSIG: the child writes to the report pipe afterwards; EPIPE ends it.
2. The midwife or the vessel dies before the first process knows which process to watch: its pipe reports end of file, and it
   ends.
3. The caller dies later: PR_SET_PDEATHSIG ends the vessel, and the first process watches the vessel. A restore that is complete
   takes PR_SET_PDEATHSIG back (it sets the program's own).
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import json
import os
import signal
import termios
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final, NoReturn

from msgspec import Struct

from checkpoint.arch import stubs
from checkpoint.errors import ProbeError, ProcessGoneError, RestoreError
from checkpoint.linux.child_reaper import bury
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.linux.spawn import namespaces, not_executed
from checkpoint.linux.spawn.file_overlay import BroughtFile, User, show
from checkpoint.linux.spawn.inherited_limits import Inheritance, take_on
from checkpoint.model import Clocks
from checkpoint.sentences import in_words

_MFD_CLOEXEC_EXEC: Final = 0x1 | 0x10
_MFD_CLOEXEC: Final = 0x1
_WATCHED: Final = 3
"""The descriptor that the first process's program watches; see ``stubs.WATCH``."""

_REPORT_LIMIT: Final = 65536
"""Bytes of all reports of one birth; a few hundred are usual."""

_REST_S: Final = 0.001
"""The pause before we look again whether a killed process has ended."""


class Birth(Struct, frozen=True):
    """How a process is to come into the world.

    Attributes:
        inner_pid: the PID it is to see as its own; 0: any. When it cannot be had, a note says so.
        isolate: give it PIDs, mounts and /proc of its own.
        clocks: the reading its monotonic and boot time are to go on from; None: this machine's clocks are right for it.
        elapsed_ns: time since that reading, as it was at ``counted_ns`` on CLOCK_BOOTTIME; 0: as it is now.
        stdio: our descriptors that become its 0, 1 and 2; all others are closed.
        own_session: make it the leader of a session, with standard input as its terminal if that is one and no session has it.
        die_with_parent: SIGKILL it when the calling thread ends.
        inheritance: whose rights, limits and priorities it gets; None: ours. A vessel keeps the right that a restore takes.
        brought: files of the program that are to be there; they are shown to it where its own are missing.
    """

    inner_pid: int = 0
    isolate: bool = False
    clocks: Clocks | None = None
    elapsed_ns: int = 0
    stdio: tuple[int, int, int] = (0, 1, 2)
    own_session: bool = True
    die_with_parent: bool = True
    inheritance: Inheritance | None = None
    brought: tuple[BroughtFile, ...] = ()
    counted_ns: int = 0


class Born(Struct, frozen=True):
    """A process that has just been born.

    Attributes:
        pid: as the caller sees it; its own child.
        inner_pid: as the process itself sees it.
        init_pid: the first process of its PID namespace, a child of the caller too, to be reaped after it; 0: none.
        isolated: it has PIDs of its own.
        notes: a sentence for each thing that was wanted and is not had.
    """

    pid: int
    inner_pid: int
    init_pid: int = 0
    isolated: bool = False
    notes: tuple[str, ...] = ()


def spawn_vessel(birth: Birth) -> Born:
    """Start a vessel; it waits for a restorer when this returns.

    Raises:
        RestoreError: it could not be born; nothing is left of it.
    """
    try:
        return _give_birth(birth, lambda: _become_vessel(), keep_right=True)
    except OSError as error:
        raise RestoreError(f"cannot start a process to restore into: {in_words(error)}") from error


def spawn_program(argv: Sequence[str], env: Mapping[str, str], cwd: str | os.PathLike[str], umask: int, birth: Birth) -> Born:
    """Start a program afresh; it has been executed when this returns.

    Raises:
        OSError: it cannot be executed (its errno), or not be born.
    """

    def become_program() -> NoReturn:
        os.chdir(cwd)
        os.umask(umask)
        try:
            os.execvpe(argv[0], list(argv), dict(env))
        except OSError as error:
            raise not_executed.explained(error, argv[0], env.get("PATH", os.defpath)) from error

    return _give_birth(birth, become_program, keep_right=False)


def discard(born: Born) -> None:
    """End a vessel that is not wanted any more, or a program, and reap what belongs to it."""
    with contextlib.suppress(ProcessLookupError):
        os.kill(born.pid, signal.SIGKILL)
    for pid in (born.pid, born.init_pid):
        if pid:
            _reap(pid)


# --- The caller ------------------------------------------------------------------------------------------------------


class _Lines(Struct, frozen=True):
    """Our end of the pipe on which all children at a birth report; it ends when the last of them has executed or ended."""

    descriptor: int

    def say(self, **facts: object) -> None:
        """Send one report; a caller that is gone ends us with SIGPIPE or BrokenPipeError."""
        os.write(self.descriptor, json.dumps(facts).encode() + b"\n")

    def fail(self, error: OSError) -> None:
        """Report what went wrong in the way that the caller raises it again."""
        named = [os.fsdecode(error.filename)] if isinstance(error.filename, str | bytes) else []
        self.say(error=[error.errno or errno.EIO, error.strerror or str(error), *named])


def _give_birth(birth: Birth, become: Callable[[], NoReturn], *, keep_right: bool) -> Born:
    read_end, write_end = os.pipe()
    try:
        midwife = os.fork()
        if midwife == 0:
            os.close(read_end)
            _end_after(_attend, _Lines(write_end), birth, become, keep_right)
        os.close(write_end)
        reports = _read_reports(read_end)
        os.waitpid(midwife, 0)
    finally:
        os.close(read_end)
    facts: dict[str, object] = {}
    for report in reports:
        facts |= report
    return _born_or_raise(facts)


def _read_reports(read_end: int) -> list[dict[str, object]]:
    text = b""
    while len(text) < _REPORT_LIMIT and (chunk := os.read(read_end, _REPORT_LIMIT)):
        text += chunk
    return [json.loads(line) for line in text.splitlines()]


def _born_or_raise(facts: dict[str, object]) -> Born:
    known = {name: facts[name] for name in ("pid", "inner_pid", "init_pid", "isolated") if name in facts}
    notes = facts.get("notes", [])
    assert isinstance(notes, list)
    if "error" not in facts and {"pid", "inner_pid"} <= set(known):
        return Born(notes=tuple(notes), **known)  # type: ignore[arg-type]  # written by ourselves, a few lines below
    for name in ("pid", "init_pid"):
        if known.get(name):
            _reap_killed(int(str(known[name])))
    error = facts.get("error", [errno.ECHILD, "it ended before it was ready"])
    assert isinstance(error, list)
    raise OSError(*error)


def _reap_killed(pid: int) -> None:
    os.kill(pid, signal.SIGKILL)
    _reap(pid)


def _reap(pid: int) -> None:
    """Wait for the end of a child that has been told to end.

    The kernel keeps a thread that we trace until we take note of its end, and the process until its last other thread is gone.
    """
    with contextlib.suppress(ChildProcessError):  # not ours to reap: another thread or a subreaper did
        while os.waitpid(pid, os.WNOHANG) == (0, 0):
            with contextlib.suppress(ProcessGoneError):
                for tid in thread_ids(pid):
                    if tid != pid:
                        bury(tid)
            time.sleep(_REST_S)


# --- The midwife -----------------------------------------------------------------------------------------------------


def _attend(lines: _Lines, birth: Birth, become: Callable[[], NoReturn], keep_right: bool) -> None:
    """Make the namespaces, then the first process, then the child itself, both as children of our parent."""
    entered = namespaces.enter(pids=birth.isolate, clocks=birth.clocks is not None)
    notes = list(entered.notes)
    if entered.clocks and birth.clocks is not None:
        since_ns = time.clock_gettime_ns(time.CLOCK_BOOTTIME) - birth.counted_ns if birth.counted_ns else 0
        namespaces.set_clocks(birth.clocks, birth.elapsed_ns + since_ns)
    watch_read, watch_write = os.pipe()
    ready_read, ready_write = os.pipe()
    if entered.pids:
        init_pid = namespaces.sibling()
        if init_pid == 0:
            os.close(watch_write)
            os.close(ready_read)
            own_terminals = not any(os.isatty(stream) for stream in birth.stdio)  # whose name must go on leading to it
            _end_after(_become_first_process, lines, watch_read, ready_write, own_terminals)
        lines.say(init_pid=init_pid)
        os.close(ready_write)
        notes += json.loads(os.read(ready_read, _REPORT_LIMIT) or b"[]")
    pid, note = _sibling_with_pid(birth.inner_pid)
    if pid == 0:
        _end_after(_grow_up, lines, birth, watch_write, become, keep_right, entered)
    lines.say(pid=pid, isolated=entered.pids, notes=notes + note)


def _sibling_with_pid(wanted: int) -> tuple[int, list[str]]:
    try:
        return namespaces.sibling(wanted), []
    except OSError as error:
        if not wanted or error.errno not in (errno.EEXIST, errno.EPERM, errno.EINVAL):
            raise
        reason = _why_taken(wanted) if error.errno == errno.EEXIST else "that needs CAP_CHECKPOINT_RESTORE"
        return namespaces.sibling(), [f"new PID: {wanted} is not available, {reason}"]


def _why_taken(pid: int) -> str:
    """Why a PID is in use; names the process that can free it, where there is one."""
    with contextlib.suppress(ProbeError, ProcessGoneError):
        found = procfs.status(pid)
        if found.state == "Z":
            return f"it has ended, but its parent, pid {found.ppid}, has not waited for it yet (wait(2))"
    return "it is in use"


def _end_after(act: Callable[..., object], lines: _Lines, *arguments: object) -> NoReturn:
    """Run a child's part and end: report any error, and run nothing more of the caller's Python in the child."""
    status = 1
    try:
        act(lines, *arguments)
        status = 0
    except OSError as error:
        with contextlib.suppress(OSError):  # the caller is gone: the error has no reader
            lines.fail(error)
    finally:
        os._exit(status)


# --- The children ----------------------------------------------------------------------------------------------------


def _become_first_process(lines: _Lines, watch_read: int, ready_write: int, own_terminals: bool) -> None:
    """PID 1 of the namespace: mount /proc and terminals, learn which process to watch, then only poll its pidfd."""
    null = os.open("/dev/null", os.O_RDWR)
    _keep_only((lines.descriptor, watch_read, ready_write), null)  # before the checks look for holders of the program's files
    notes = []
    try:
        namespaces.mount_proc()
    except OSError as error:
        notes.append(f"/proc shows the machine's processes, not only the program's: {in_words(error)}")
    if own_terminals:
        with contextlib.suppress(OSError):  # then they get numbers among the machine's, and a restore says when one differs
            namespaces.mount_terminals()
    os.write(ready_write, json.dumps(notes).encode())
    watched = os.read(watch_read, 32)
    if not watched:
        return
    pidfd = fcntl.fcntl(os.pidfd_open(int(watched)), fcntl.F_DUPFD_CLOEXEC, _WATCHED + 1)
    os.chdir("/")
    os.close(lines.descriptor)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # orphans that come to us are reaped by the kernel
    code = fcntl.fcntl(_executable(stubs.WATCH), fcntl.F_DUPFD_CLOEXEC, _WATCHED + 1)
    os.dup2(pidfd, _WATCHED)
    namespaces.close_others_on_exec(_WATCHED + 1)
    os.execve(code, ["failover-init"], {})


def _keep_only(kept: tuple[int, ...], null: int) -> None:
    """Close what came from the caller, whose files may be the program's; the three streams become ``null``."""
    for stream in range(3):
        os.dup2(null, stream)
    edges = (2, *sorted(kept), os.sysconf("SC_OPEN_MAX"))
    for low, high in itertools.pairwise(edges):
        os.closerange(low + 1, high)


def _grow_up(
    lines: _Lines, birth: Birth, watch_write: int, become: Callable[[], NoReturn], keep_right: bool, entered: namespaces.Entered
) -> None:
    """The child's own part, up to the execve that ends it."""
    kept = birth.inheritance
    user = User(kept.uid, kept.gid, kept.groups) if kept else User(os.geteuid(), os.getegid())
    show(birth.brought, user, own_mounts=entered.pids)
    with contextlib.suppress(OSError):  # only kernels with Yama know this; the others let our keeper in anyway
        namespaces.prctl(namespaces.PR_SET_PTRACER, -1)
    if keep_right and entered.user:
        namespaces.keep_restore_right()
    if birth.own_session:
        os.setsid()
    _take_stdio(birth.stdio)
    if birth.own_session and os.isatty(0):
        with contextlib.suppress(PermissionError):  # it belongs to the session of a user that restores by hand, and stays so
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    _forget_signals()
    namespaces.close_others_on_exec(3)
    if birth.inheritance is not None:
        take_on(birth.inheritance, restorable=keep_right)
    if birth.die_with_parent:
        namespaces.prctl(namespaces.PR_SET_PDEATHSIG, signal.SIGKILL)  # after a change of user, which takes it back
    lines.say(inner_pid=os.getpid())  # race 1
    with contextlib.suppress(BrokenPipeError):  # no process watches: there is no namespace of its own
        os.write(watch_write, str(os.getpid()).encode())
    become()


def _take_stdio(stdio: tuple[int, int, int]) -> None:
    """Move three of our descriptors to 0, 1 and 2, whose order may be any now."""
    copies = [fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, 3) for descriptor in stdio]
    for target, copy in enumerate(copies):
        os.dup2(copy, target)


def _forget_signals() -> None:
    """Undo what the caller's Python set: ignored signals and the mask would outlive the execve."""
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
        with contextlib.suppress(OSError):  # the two that the C library keeps for itself
            signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())


def _become_vessel() -> NoReturn:
    os.execve(_executable(stubs.WAIT), ["failover-vessel"], {})


def _executable(code: bytes) -> int:
    """A memory file that holds a program of ours."""
    try:
        descriptor = os.memfd_create("failover", _MFD_CLOEXEC_EXEC)
    except OSError as error:
        if error.errno != errno.EINVAL:  # before Linux 6.3 there is no MFD_EXEC, and no need for it
            raise
        descriptor = os.memfd_create("failover", _MFD_CLOEXEC)
    os.write(descriptor, stubs.program(code))
    return descriptor


def elapsed_since(clocks: Clocks) -> int:
    """Nanoseconds of wall-clock time since a reading, never below zero: two machines' wall clocks may disagree."""
    return max(time.clock_gettime_ns(time.CLOCK_REALTIME) - clocks.realtime_ns, 0)
