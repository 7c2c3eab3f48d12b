"""Capture the processes of a component besides the first: freeze all of them together, then capture each like the first one.

How the capture misses no process (each step is a race):

1. Parents are stopped before their children are listed; a stopped process creates no child. Listing and stopping repeat until
   every listed process is stopped or has ended, so that no process appears or ends any more.
2. A parent that waits for a child of vfork(2) does not stop before the child has executed its program. The child is not stopped
   yet and continues. If the child takes long, the capture starts again.
3. A child that is found for the first time is entered while it is stopped. A child that has executed another program since is
   entered again.
4. A child that ends before it is stopped stays a zombie: its parent is stopped and cannot wait for it.
5. A child may end, or execute another program, as soon as it resumes. The facts about a child that is in no snapshot yet are
   looked up before it resumes, because many children live only for a moment. A child that has been there longer is described
   after it resumes; if it is gone by then, the capture starts again.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import operator
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Final, NoReturn

from msgspec import Struct, field
from msgspec.structs import replace

from checkpoint.engines.ptrace.capture.memory import RunningCopy, SharedPlaces
from checkpoint.engines.ptrace.capture.process import NOBODY, CapturedProcess, Look, Met
from checkpoint.engines.ptrace.facts import birth_order
from checkpoint.engines.ptrace.facts.persistent_reasons import lasting
from checkpoint.errors import CaptureError, CheckpointError, ProbeError, ProcessGoneError, UnsupportedError
from checkpoint.linux import abi
from checkpoint.linux.procfs import descendants, procfs
from checkpoint.linux.procfs.descendants import Kinship
from checkpoint.linux.procfs.procfs import Stat, Status
from checkpoint.linux.trace.threads import Threads
from checkpoint.model import Member, Position, ProcessState, Resource, ThreadState, Vma, Zombie
from checkpoint.resources import other_holders, refusals, shared_descriptions
from checkpoint.resources.ipc import standard_streams
from checkpoint.resources.open_file import Held, Owners, Surroundings
from checkpoint.resources.process import job_control, refused_threads, shared_with_parent, thread_credentials
from checkpoint.resources.process.control_groups import Groups
from checkpoint.resources.survey import gather
from checkpoint.resources.survey import look as sorted_into_kinds
from checkpoint.snapshot import process_tree

ENDING_S: Final = 0.2
"""How long a process that is about to end may take."""
QUIET_LISTINGS: Final = 2
"""Listings in a row without a new process that are believed: one may omit a process whose sibling ends (fs/proc/array.c)."""
NAMESPACES: Final = ("pid", "mnt", "user", "net", "ipc", "uts", "cgroup", "time")


class MovedError(CaptureError):
    """Processes came, went or executed something in the middle of a capture: another one may succeed."""


class SeenProcess(Struct, frozen=True):
    """One process besides the first, and all that is said of it."""

    captured: CapturedProcess
    look: Look
    process: ProcessState
    threads: tuple[ThreadState, ...]
    vmas: tuple[Vma, ...]
    held: Held
    unopened: tuple[Resource, ...]
    reasons: tuple[str, ...]

    @property
    def status(self) -> Status:
        """Its /proc/PID/status."""
        return self.look.standing.status

    @property
    def stat(self) -> Stat:
        """Its /proc/PID/stat."""
        return self.look.standing.stat


class SeenOthers(Struct):
    """The result of one freeze, of all processes besides the first.

    Attributes:
        opened: the open files of every process, the first one's included.
        taken: the look at each.
        later: those that are still to be described, by `describe`.
    """

    opened: shared_descriptions.OpenedByAll
    ended: tuple[tuple[Status, Stat], ...]
    taken: list[tuple[CapturedProcess, Look]] = field(default_factory=list)
    processes: list[SeenProcess] = field(default_factory=list)
    later: list[tuple[CapturedProcess, Callable[[SeenOthers], SeenProcess]]] = field(default_factory=list)

    @property
    def pids(self) -> frozenset[int]:
        """The pids of all processes, the first one included, as we see them."""
        return frozenset(self.opened)

    @property
    def xstate_mask(self) -> int:
        """Which parts of the processor's state any of them uses."""
        return functools.reduce(operator.or_, (look.xstate_mask for _, look in self.taken), 0)

    def describe(self) -> None:
        """Tell the rest; they may run.

        Raises:
            MovedError: one is not what it was any more.
        """
        for process, tell in self.later:
            try:
                with _gone_if_ended(process.pid):
                    self.processes.append(tell(self))
                if not process.onlooker.is_entered():
                    raise MovedError(f"process {process.pid} has executed another program; capture it again")
            except ProcessGoneError as error:
                raise MovedError(f"process {process.pid} ended while failover captured it; capture it again") from error
        self.later.clear()

    def looks(self) -> list[tuple[CapturedProcess, Look]]:
        """The look at each."""
        return self.taken

    def resources(self) -> tuple[Resource, ...]:
        """The open files of all of them."""
        return tuple(held for seen in self.processes for held in seen.held.resources)

    def _inner(self, first: Look) -> dict[int, int]:
        """Their pids as they see them, by those that we see."""
        statuses = [first.standing.status, *(seen.status for seen in self.processes)]
        return {status.pids[0]: status.pids[-1] for status in statuses}

    def _by_slot(self) -> list[SeenProcess]:
        return sorted(self.processes, key=lambda seen: seen.captured.slot)

    def groups(self) -> dict[int, Groups]:
        """Where they are in control groups, by their pids as we see them, in the order of `members`."""
        return {seen.captured.pid: seen.captured.groups() for seen in self._by_slot()}

    def members(self, first: Look) -> tuple[Member, ...]:
        """All of them."""
        inner = self._inner(first)
        continued = {look.standing.told.continued_child for look in (first, *(seen.look for seen in self.processes))}
        return tuple(
            Member(
                slot=seen.captured.slot,
                exit_signal=seen.stat.exit_signal,
                process=replace(seen.process, ppid=inner.get(seen.stat.ppid, 0)),
                threads=seen.threads,
                vmas=seen.vmas,
                resources=(*seen.captured.known(seen.held.resources), *seen.unopened, *_going_on(seen, continued)),
            )
            for seen in self._by_slot()
        )

    def zombies(self, first: Look) -> tuple[Zombie, ...]:
        """The processes that have ended."""
        inner = self._inner(first)
        return tuple(
            Zombie(
                name=stat.name,
                pid=status.pids[-1],
                ppid=inner.get(stat.ppid, 0),
                pgid=status.pgids[-1],
                sid=status.sids[-1],
                status=stat.exit_code,
                exit_signal=stat.exit_signal,
            )
            for status, stat in self.ended
        )

    def reasons(self, first: Look) -> tuple[str, ...]:
        """Why the component cannot be captured because of them."""
        found = [reason for seen in self.processes for reason in seen.reasons]
        status = first.standing.status
        found += birth_order.refuse(status, self.members(first), self.zombies(first), descendants.taken_pids(status.pids[0]))
        return tuple(dict.fromkeys(found))


def _going_on(seen: SeenProcess, continued: Collection[int]) -> tuple[Resource, ...]:
    """The resource for a process that has continued while its parent has not been told so.

    Args:
        continued: the children of which that is known, as the component sees them.
    """
    is_stopped = job_control.stop_of(seen.unopened) is not None
    return (job_control.going_on(),) if seen.status.pids[-1] in continued and not is_stopped else ()


class CapturedTree:
    """Follows them from capture to capture."""

    def __init__(self, first: CapturedProcess, kin: Kinship) -> None:
        self._first = first
        self._kin = kin
        self._known: dict[int, CapturedProcess] = {}
        self._copied: dict[int, RunningCopy] = {}
        self._standing: dict[int, Threads] = {}
        self._met: dict[int, Met] = {}
        self._ended: list[int] = []

    def close(self) -> None:
        """Let go of all."""
        self._kin.close()
        for process in self._known.values():
            process.close()
        for met in self._met.values():
            met.threads.close()
        self._known.clear()
        self._met.clear()

    def follow(self, first: CapturedProcess) -> None:
        """Use a new object for the first process, which was entered anew."""
        self._first = first
        for process in self._known.values():
            process.memory.buffer, process.memory.budget = first.memory.buffer, first.memory.budget

    def processes(self) -> tuple[CapturedProcess, ...]:
        """The processes that are followed."""
        return tuple(self._known.values())

    def others(self) -> list[int]:
        """All processes besides the first one, as the kernel has them now, zombies included."""
        return self._kin.others()

    def acknowledge(self, position: Position) -> None:
        """See ``checkpoint.engine.Session.acknowledge``."""
        for process in self._known.values():
            process.memory.acknowledge(position)

    # Before the freeze

    def admit(self, *, held: bool) -> None:
        """Enter those that have come, and forget those that have gone."""
        if held:
            return
        others = self._kin.others()
        for pid in [pid for pid, known in self._known.items() if pid not in others or not _is_same(known)]:
            self._forget(pid)
        for pid in [pid for pid in self._met if pid not in others]:
            self._met.pop(pid).threads.close()
        self._first.threads.is_one_of_many = bool(others)
        if not others:
            return
        other_holders.look_around()
        for pid in others:
            if pid not in self._known:
                with contextlib.suppress(ProcessGoneError), _gone_if_ended(pid):
                    self._enter(pid)

    def _enter(self, pid: int) -> None:
        status = procfs.status(pid)
        if status.state in "ZX" or _shares_memory(pid, status.ppid):
            return  # it has ended, or has still to execute its program (vfork), and our pages there are its parent's
        if reasons := lasting(lambda: self._refusals(pid)):
            self._refuse(reasons)
        try:
            process = CapturedProcess.entered(self._meet(pid), self._first.order, self._free_slot())
        except ProcessGoneError:
            raise
        except CaptureError as error:
            raise MovedError(str(error)) from error
        self._add(process)

    def _refusals(self, pid: int) -> tuple[str, ...]:
        """Why one cannot be entered."""
        status = procfs.status(pid)
        found = [
            *thread_credentials.refuse(pid, self._first.order.terms.owner),
            *refused_threads.refuse_shared_memory(pid, status),
            *refusals.refuse_entering(pid, status, files_kept=self._first.files_kept),
        ]
        return tuple(f"its process {pid} ({status.name}): {why}" for why in found)

    def _refuse(self, reasons: tuple[str, ...]) -> NoReturn:
        raise UnsupportedError(f"cannot capture pid {self._first.pid}: {'; '.join(reasons)}", reasons)

    def _meet(self, pid: int) -> Met:
        """A process that is not followed yet: the same as at an attempt that failed, for it may not be let go of yet.

        Raises:
            ProcessGoneError: it has ended.
        """
        met = self._met.get(pid)
        if met is None or met.born != procfs.stat(pid).start_time:
            if met is not None:
                self._met.pop(pid).threads.close()
            met = self._met[pid] = Met.of(pid)
            met.threads.is_one_of_many = True
        return met

    def _add(self, process: CapturedProcess) -> None:
        process.threads.is_one_of_many = True
        process.memory.buffer, process.memory.budget = self._first.memory.buffer, self._first.memory.budget
        process.detach(self._first.detached)
        self._known[process.pid] = process

    def _forget(self, pid: int) -> None:
        self._copied.pop(pid, None)
        self._known.pop(pid).close()

    def _free_slot(self) -> int:
        taken = {process.slot for process in self._known.values()}
        slot = next(slot for slot in itertools.count(1) if slot not in taken)
        if slot >= process_tree.SLOT_LIMIT:
            reason = f"it has more than {process_tree.SLOT_LIMIT} processes, which is the limit"
            self._refuse((reason,))
        return slot

    def copy_running(self, *, base: bool, enough: int, again: bool) -> None:
        """As `MemoryCapture.copy_running`, with as many pages left of each of them.

        Args:
            again: go on with the copy that was made for a failed freeze.
        """
        before, self._copied = self._copied if again else {}, {}
        for pid, process in tuple(self._known.items()):
            try:
                with _gone_if_ended(pid):
                    is_base = base or process.memory.acknowledged is None
                    self._copied[pid] = process.copy_running(base=is_base, enough=enough, copied=before.get(pid))
            except CaptureError as error:
                if not _is_another(process, error):
                    raise MovedError(str(error)) from error
                self._forget(pid)

    # The freeze

    def stand_still(self) -> bool:
        """Stop all other processes, now that the first one stands; answers whether there are any.

        Raises:
            MovedError: one of them does not stop.
        """
        first = self._first.threads
        followed = self._standing or self._known  # one may have become an orphan since: a glance does not find it
        if not followed and not self._kin.has_others([first.pid, *(tracee.pid for tracee in first.others)]):
            return False
        ended = set(self._ended)
        quiet = 0
        while quiet < QUIET_LISTINGS:
            self._first.memory.budget.require()
            fresh = [pid for pid in self._kin.others() if pid not in self._standing and pid not in ended]
            quiet = 0 if fresh else quiet + 1
            for pid in fresh:
                if not self._stop(pid):
                    ended.add(pid)
                    _end_of(pid)
        self._ended = sorted(ended)
        return bool(self._standing or self._ended)

    def _stop(self, pid: int) -> bool:
        """Stop one; whether it has not ended."""
        known = self._known.get(pid)
        try:
            threads = known.threads if known else self._meet(pid).threads
        except ProcessGoneError:
            return False
        threads.is_one_of_many = True
        threads.patience_ns = self._first.memory.budget.left_ns()
        try:
            threads.freeze()
        except ProcessGoneError:
            return False
        except ProbeError as error:
            if _has_ended(pid):
                return False
            raise CaptureError(str(error)) from error
        except CaptureError as error:
            raise MovedError(str(error)) from error
        self._standing[pid] = threads
        return True

    def thaw(self) -> None:
        """Let all processes go."""
        standing, self._standing = self._standing, {}
        self._ended = []
        for threads in standing.values():
            threads.thaw()

    def hold(self) -> None:
        """Leave them standing."""
        for threads in self._standing.values():
            threads.hold()

    # While they stand

    def begin_look(self) -> SeenOthers:
        """The open files of all, and the processes that have ended."""
        pids = [self._first.pid, *self._standing]
        try:
            opened = shared_descriptions.together({pid: gather(pid, owners=self._owners_of(pid)) for pid in pids})
            ended = tuple(found for pid in self._ended if (found := _end_of(pid)) is not None)
        except ProcessGoneError as error:
            raise MovedError(str(error)) from error
        return SeenOthers(opened, ended)

    def _owners_of(self, pid: int) -> Owners | None:
        """The known owners of a process's files' signals; None of a process that was never looked at."""
        known = self._first if pid == self._first.pid else self._known.get(pid)
        return known.onlooker.owners if known else None

    def look(self, seen: SeenOthers, first: Look, surroundings: Surroundings, *, base: bool) -> None:
        """Everything that needs them to stand still.

        Args:
            first: the look at the first process.
            surroundings: of that.
        """
        outside = standard_streams.of_first(first.standing.opened, surroundings)
        around = replace(surroundings, pipes={**outside, **surroundings.pipes}, is_first=False)
        told = NOBODY | self._first.memory.shared_places()
        is_held = self._first.order.is_guarded and bool(self._first.threads.leader.stopped_by)
        for pid, threads in self._standing.items():
            process = self._known.get(pid)
            try:
                with _gone_if_ended(pid):
                    look, process = self._look_at(process, threads, seen, told, base=base)
                    told |= process.memory.shared_places()
                    stopped_by = 0 if is_held else threads.leader.stopped_by
                    seen.taken.append((process, look))
                    tell = functools.partial(_told_of, process, look, around, stopped_by)  # not of `seen`, which holds it
                    if process.is_new:
                        seen.processes.append(tell(seen))
                    else:
                        seen.later.append((process, tell))
            except ProcessGoneError as error:
                raise MovedError(f"process {pid} ended in the middle of a capture; capture it again") from error

    def _look_at(
        self,
        process: CapturedProcess | None,
        threads: Threads,
        seen: SeenOthers,
        told: SharedPlaces,
        *,
        base: bool,
    ) -> tuple[Look, CapturedProcess]:
        """Look at one, entering it if it is new, or has executed another program."""
        pid = threads.pid
        if process is not None and pid in self._copied:
            try:
                process.memory.leave_out(told)
                is_base = base or process.memory.acknowledged is None  # a delta may be of a position that has not heard of it
                return process.look(self._copied[pid], None, base=is_base, opened=seen.opened[pid]), process
            except CaptureError as error:
                if not _is_another(process, error):
                    raise
                self._forget(pid)
        elif process is not None:
            self._forget(pid)
        if reasons := self._refusals(pid):
            self._refuse(reasons)
        met = self._met.get(pid) or replace(Met.of(pid), threads=threads)
        self._first.memory.budget.require(procfs.status(pid).resident_size)
        process = CapturedProcess.entered_standing(met, self._first.order, self._free_slot())
        self._add(process)
        copied = process.copy_running(base=True)
        process.memory.leave_out(told)
        return process.look(copied, None, base=True, opened=seen.opened[pid]), process


def _is_another(process: CapturedProcess, error: CaptureError) -> bool:
    """Whether a failure says that it has ended, or executed another program since it was entered, perhaps right then."""
    return isinstance(error, ProcessGoneError) or not process.onlooker.is_entered()


def _is_same(known: CapturedProcess) -> bool:
    try:
        return known.is_still(procfs.stat(known.pid).start_time)
    except CheckpointError:
        return False


@contextlib.contextmanager
def _gone_if_ended(pid: int) -> Iterator[None]:
    """Turn any error about a process that has ended into its end."""
    try:
        yield
    except (CheckpointError, FileNotFoundError, ProcessLookupError) as error:
        if isinstance(error, OSError) or _has_ended(pid):
            raise ProcessGoneError(f"process {pid} has ended") from error
        raise


def _shares_memory(pid: int, parent: int) -> bool:
    """Whether a process has not its own memory yet.

    Raises:
        UnsupportedError: this kernel does not tell.
    """
    if abi.kcmp(pid, pid, abi.KCMP_VM) is None:
        reason = "it has child processes, and this kernel does not tell what they share: boot one with CONFIG_KCMP"
        raise UnsupportedError(f"cannot capture pid {pid}: {reason}", (reason,))
    return parent > 1 and abi.kcmp(pid, parent, abi.KCMP_VM) == 0


def _has_ended(pid: int) -> bool:
    """Whether a process has ended, or is about to: its memory goes first."""
    try:
        stat = procfs.stat(pid)
        return stat.state in "ZX" or bool(stat.flags & procfs.PF_EXITING)
    except CheckpointError:
        return True


def _end_of(pid: int) -> tuple[Status, Stat] | None:
    """How a process has ended, once it has; None when its parent, which is not of the component, has taken note.

    Raises:
        MovedError: it takes too long.
        UnsupportedError: its first thread has ended, and others live on.
    """
    deadline = time.monotonic() + ENDING_S
    while True:
        try:
            status, stat = procfs.status(pid), procfs.stat(pid)
        except ProcessGoneError:
            return None
        if stat.state == "Z" and status.threads <= 1:
            return status, stat
        if time.monotonic() > deadline:
            named = f"its process {pid} ({status.name})"
            if reasons := tuple(f"{named}: {why}" for why in refused_threads.refuse_ended_first(status)):
                raise UnsupportedError(f"cannot capture pid {pid}: {'; '.join(reasons)}", reasons)
            raise MovedError(f"process {pid} takes long to end; capture it again")
        time.sleep(0.0005)


def _told_of(process: CapturedProcess, look: Look, around: Surroundings, stopped_by: int, seen: SeenOthers) -> SeenProcess:
    """All that is said of a process.

    Args:
        stopped_by: the signal that had stopped it, by itself, before we did; 0: it ran.
    """
    held = sorted_into_kinds(look.standing.opened, around)
    named = f"its process {process.pid} ({look.standing.status.name})"
    shared = _joint(look, seen)
    unopened = process.unopened(look)
    refused = shared_with_parent.refuse(shared, process.pid, unopened)
    reasons = [*held.reasons, *process.reasons(look, seen.pids), *refused, *_of_namespaces(process.pid, seen)]
    return SeenProcess(
        captured=process,
        look=look,
        process=process.process(look),
        threads=process.thread_states(look),
        vmas=process.mappings(look, seen.pids),
        held=held,
        unopened=(*unopened, *shared, *job_control.describe(stopped_by, look.standing.stat.exit_code)),
        reasons=tuple(f"{named}: {reason}" for reason in reasons),
    )


def _joint(look: Look, seen: SeenOthers) -> tuple[Resource, ...]:
    """The things that one shares with its parent, if that is one of them."""
    status = look.standing.status
    return shared_with_parent.describe(status.pids[0], status.ppid) if status.ppid in seen.pids else ()


def _of_namespaces(pid: int, seen: SeenOthers) -> Iterable[str]:
    """Namespaces of its own, which its parent has not."""
    first = next(iter(seen.opened))
    for kind in NAMESPACES:
        if _namespace(pid, kind) != _namespace(first, kind):
            yield f"it lives in a {kind} namespace of its own, which is not kept yet"


def _namespace(pid: int, kind: str) -> str:
    try:
        return os.readlink(f"/proc/{pid}/ns/{kind}")
    except FileNotFoundError:
        return ""
