"""Takes a real program through capture, death and restore inside the calling process: base of the tracee tests.

A `Program` writes its output to files in a directory of its own, reads nothing, and is our child, before and after. Each step
of a snapshot on its way to another robot happens here too: it is encoded, decoded and folded.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, TypeVar

import pytest

from checkpoint.device_rules import DeviceRule
from checkpoint.engine import CaptureOrder, ProtectOrder, RestoreOptions, Session, Terms
from checkpoint.engines.registry import engine_named
from checkpoint.errors import CaptureError, CheckpointError, ProcessGoneError
from checkpoint.linux import abi
from checkpoint.linux.procfs.descendants import children
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.linux.signal_wakeup import waking
from checkpoint.linux.spawn.namespaces import prctl
from checkpoint.linux.spawn.vessel import Birth, Born, discard, spawn_program, spawn_vessel
from checkpoint.model import Snapshot
from checkpoint.snapshot import format
from checkpoint.store import chain
from checkpoint.store.base_on_disk import StoredBase, stored_base

ENGINE = engine_named("ptrace")
LIVES = 3
"""After so many restores in a row nothing may differ."""

PATIENCE_S = 60.0
"""How long anything awaited here may take; generous, because the machine may be busy with other tests."""

PR_SET_DUMPABLE = 4

CANNOT = 77
"""Exit status of a tracee that this machine does not let set its stage."""


Answer = TypeVar("Answer")


class EndedError(AssertionError):
    """A program ended although something was still expected of it."""


@dataclass
class Program:
    """A running program, fresh or restored.

    Attributes:
        directory: its working directory, with its output in ``out`` and ``err``.
        status: how it ended, as `os.waitstatus_to_exitcode` says; None while it is not reaped.
    """

    born: Born
    directory: Path
    status: int | None = None

    @property
    def pid(self) -> int:
        """As this process sees it."""
        return self.born.pid

    @property
    def output(self) -> str:
        """All that it has written to its standard output so far."""
        return (self.directory / "out").read_text(errors="replace")

    @property
    def complaints(self) -> str:
        """All that it has written to its standard error so far."""
        return (self.directory / "err").read_text(errors="replace")

    def poll(self) -> int | None:
        """Its exit code if it has ended, negative for a signal.

        Where we trace it a stop is told, once, to whoever waits for ends only: it is looked first what there is to take note of.
        """
        if self.status is None:
            found = os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT)
            if found is not None and found.si_code in abi.ENDS:
                self.status = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self.status

    def wait_until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for something that the program brings about while it lives."""
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            if self.poll() is not None and not condition():
                raise EndedError(f"ended with {self.status} before {what}:\n{self.output[-2000:]}{self.complaints[-2000:]}")
            if time.monotonic() > deadline:
                raise AssertionError(f"did not see {what} in {PATIENCE_S:.0f} s:\n{self.output[-2000:]}{self.complaints[-2000:]}")
            time.sleep(0.002)

    def wait_for_line(self, line: str) -> None:
        """Wait for one whole line of standard output."""
        self.wait_until(lambda: f"{line}\n" in self.output, f"the line {line!r}")

    def wait_for_output(self, size: int) -> None:
        """Wait until standard output holds more than ``size`` bytes."""
        self.wait_until(lambda: (self.directory / "out").stat().st_size > size, f"more than {size} bytes of output")

    def tell(self) -> None:
        """Make the go file that a tracee waits for."""
        (self.directory / "go").touch()

    def finish(self) -> int:
        """Wait for its end by itself; the exit code."""
        with contextlib.suppress(EndedError):
            self.wait_until(lambda: self.poll() is not None, "its end")
        self._reap_first_process()
        assert self.status is not None
        return self.status

    def kill(self) -> None:
        """End it as a power cut does, and reap it."""
        if self.status is None:
            os.kill(self.pid, signal.SIGKILL)
            self.status = os.waitstatus_to_exitcode(_reaped(self.pid))
        self._reap_first_process()

    def _reap_first_process(self) -> None:
        if self.born.init_pid:
            with contextlib.suppress(ChildProcessError):  # reaped already
                _reaped(self.born.init_pid)


def _reaped(pid: int) -> int:
    """Wait for the end of a child of ours; its wait status.

    A session of ours that holds what must end first takes note of that in a handler, so signals must reach us meanwhile.
    """
    with contextlib.suppress(ProcessLookupError), waking() as await_readable:
        end = os.pidfd_open(pid)
        try:
            await_readable(end)
        finally:
            os.close(end)
    return os.waitpid(pid, 0)[1]


def start(argv: Sequence[str | Path], directory: Path, *, env: Mapping[str, str] | None = None, isolate: bool = False) -> Program:
    """Start a program afresh in ``directory``, under its full path, with standard input from /dev/null."""
    with _stdio(directory) as stdio:
        birth = Birth(isolate=isolate, stdio=stdio, die_with_parent=False)
        words = [str(word) for word in argv]
        return Program(spawn_program(words, dict(os.environ if env is None else env), directory, 0o022, birth), directory)


def start_tracee(program: Path, directory: Path, *arguments: str, isolate: bool = False) -> Program:
    """Start a tracee and wait until it is ready; skips the test where the tracee says that it cannot.

    It looks for the go file by its relative name, so that it finds it as whatever user it has become.
    """
    directory.chmod(0o755)
    tracee = start([program, "go", *arguments], directory, isolate=isolate)
    try:
        tracee.wait_for_line("ready")
    except EndedError:
        if tracee.status == CANNOT:
            pytest.skip(tracee.output.strip())
        raise
    except BaseException:
        tracee.kill()
        raise
    return tracee


def everybody_below(pid: int) -> list[int]:
    """Everybody whom a process has given birth to, and they, parents before children."""
    found = children(pid)
    for one in found:
        found += children(one)
    return found


def expect_ok(tracee: Program) -> None:
    """Let a tracee that was told finish, and show what it found to differ."""
    status = tracee.finish()
    assert (status, tracee.output.splitlines()[-1:]) == (0, ["ok"]), f"status {status}\n{tracee.output}{tracee.complaints}"


def another_thread(pid: int) -> int:
    """A thread of a process besides its first one, if there is one. Ids wrap around, so the first may have the greatest."""
    return max((tid for tid in thread_ids(pid) if tid != pid), default=pid)


@contextlib.contextmanager
def ended(program: Program) -> Iterator[Program]:
    """Kill a program at the end of the body if it has not ended by then."""
    try:
        yield program
    finally:
        program.kill()


@contextlib.contextmanager
def protected(program: Program, component: str = "/test/tracee", devices: tuple[DeviceRule, ...] = ()) -> Iterator[Session]:
    """Hold a program under protection for the body."""
    session = at_last(lambda: ENGINE.protect(program.pid, ProtectOrder(component, terms=Terms(devices=devices))))
    try:
        yield session
    finally:
        session.close()


def transported(snapshot: Snapshot) -> Snapshot:
    """The same snapshot after its way through bytes."""
    return format.decode(format.encode_bytes(snapshot))


def captured(program: Program) -> Snapshot:
    """One base; the program runs on."""
    with protected(program) as session:
        return transported(captured_at_last(session, CaptureOrder()))


def captured_at_last(session: Session, order: CaptureOrder) -> Snapshot:
    """A capture that is made again where a busy machine left us no processor in time: it says so, and harms nothing."""
    return at_last(lambda: session.capture(order))


def at_last(act: Callable[[], Answer]) -> Answer:
    """What an act answers that is made again while the machine is too busy for it."""
    deadline = time.monotonic() + PATIENCE_S
    while True:
        try:
            return act()
        except ProcessGoneError:
            raise
        except CaptureError:
            if time.monotonic() > deadline:
                raise


def captured_and_killed(program: Program, devices: tuple[DeviceRule, ...] = ()) -> Snapshot:
    """One base, then the power cut. What the program wrote in between must be undone by the restore."""
    with protected(program, devices=devices) as session:
        snapshot = transported(captured_at_last(session, CaptureOrder()))
        program.kill()
    return snapshot


def written_and_killed(program: Program, file: Path) -> None:
    """One base, straight from its memory to a file while it stands still, then its end: as `failover capture` does it."""
    with protected(program) as session, open(file, "wb", buffering=0) as target:
        base = at_last(lambda: session.capture_standing(CaptureOrder(hold=True)))
        if isinstance(base, Snapshot):  # of several processes
            format.encode(base, target)
        else:
            base.write(target, threads=2)
        program.kill()


def restored_from(file: Path, directory: Path) -> Program:
    """Bring such a base back, straight from its file."""
    with stored_base(file) as base:
        return restored(base, directory)


def restored(
    state: Snapshot | Sequence[Snapshot] | StoredBase,
    directory: Path,
    *,
    keep_pid: bool = True,
    accept_changed: tuple[str, ...] = (),
    contents: Path | str = "",
    own_eyes: bool = False,
    devices: tuple[DeviceRule, ...] = (),
    isolate: bool = False,
    shared: tuple[str, ...] = (),
    epoch: int = 0,
) -> Program:
    """Bring a base, or a base with its deltas, back as a child of ours and let it run."""
    base = state if isinstance(state, Snapshot | StoredBase) else chain.fold(state) if len(state) > 1 else state[0]
    outline = base if isinstance(base, Snapshot) else base.outline
    elapsed_ns = max(time.time_ns() - outline.clocks.realtime_ns, 0)
    with _stdio(directory) as stdio:
        isolate = isolate or outline.process.isolated
        clocks = outline.clocks if isolate else None
        inner_pid = outline.process.pid if keep_pid else 0
        born = spawn_vessel(Birth(inner_pid=inner_pid, isolate=isolate, clocks=clocks, elapsed_ns=elapsed_ns, stdio=stdio))
    try:
        terms = Terms(devices=devices, shared=shared)
        options = RestoreOptions(elapsed_ns, accept_changed, own_eyes, epoch, contents=str(contents), terms=terms)
        program = ENGINE.restore(born.pid, base, options)
        program.resume()
    except BaseException:
        discard(born)
        raise
    return Program(born, directory)


def copied(program: Program, directory: Path) -> Program:
    """It is captured while it runs, is killed, and comes back from a snapshot in memory."""
    return restored(captured_and_killed(program), directory)


def straight(program: Program, directory: Path) -> Program:
    """It stands still for good, and its pages go from its memory to a file, and back from there."""
    with tempfile.TemporaryDirectory() as place:  # not beside what it may look for
        written_and_killed(program, Path(place) / "base")
        return restored_from(Path(place) / "base", directory)


def expect_three_lives(tracee: Program, directory: Path) -> None:
    """Capture, kill and restore a tracee three times, each time captured twice, and have it say what differs.

    One of the times it goes straight into a file, and comes straight from there.
    """
    for life in range(LIVES):
        with ended(tracee):
            captured(tracee)
            again = straight if life == LIVES // 2 else copied
            tracee = again(tracee, directory)
    with ended(tracee):
        captured(tracee)
        tracee.tell()
        expect_ok(tracee)


NOBODY = 65534


def as_nobody(act: Callable[[], str]) -> str:
    """Run ``act`` in a child of ours that is an ordinary user; what it returned, or the error that it ended with."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read_end)
        _answer_as_nobody(act, write_end)
    os.close(write_end)
    with os.fdopen(read_end) as answer:
        text = answer.read()
    os.waitpid(child, 0)
    return text


def _answer_as_nobody(act: Callable[[], str], write_end: int) -> NoReturn:
    text = "it broke: see the captured standard error"
    try:
        os.setgroups([])
        os.setresgid(NOBODY, NOBODY, NOBODY)
        os.setresuid(NOBODY, NOBODY, NOBODY)
        prctl(PR_SET_DUMPABLE, 1)  # the change of user made our own /proc/self unreadable for us
        text = act()
    except (AssertionError, CheckpointError, OSError) as error:
        text = f"{type(error).__name__}: {error}"
    finally:
        os.write(write_end, text.encode())
        os._exit(0)


@contextlib.contextmanager
def _stdio(directory: Path) -> Iterator[tuple[int, int, int]]:
    """Standard input from nowhere, standard output and error into files of the directory."""
    null = os.open("/dev/null", os.O_RDONLY)
    streams = [os.open(directory / name, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644) for name in ("out", "err")]
    try:
        yield null, streams[0], streams[1]
    finally:
        for descriptor in (null, *streams):
            os.close(descriptor)


@contextlib.contextmanager
def covered(place: Path) -> Iterator[None]:
    """Mount something over a directory, for the body."""
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "covers", place], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", place], check=True)


def calls_of(pid: int) -> set[str]:
    """The numbers of the system calls that its threads stand in."""
    return {(task / "syscall").read_text().split()[0] for task in Path(f"/proc/{pid}/task").iterdir()}
