"""Capture one process of a protected component: enter, stop, inspect and describe it.

`checkpoint.engines.ptrace.capture.session.PtraceSession` has one of these for each process of its component.
"""

from __future__ import annotations

import contextlib
import functools
import operator
from collections.abc import Collection, Iterable, Iterator
from typing import Final

from msgspec import Struct

from checkpoint.arch import extended
from checkpoint.engine import ProtectOrder
from checkpoint.engines.ptrace.capture import eintr_syscalls, enter
from checkpoint.engines.ptrace.capture.at_rest import LastLook
from checkpoint.engines.ptrace.capture.describe_process import process_state, thread_states
from checkpoint.engines.ptrace.capture.enter import Entered
from checkpoint.engines.ptrace.capture.exited_leader import EndedFirst
from checkpoint.engines.ptrace.capture.frozen_process import Onlooker, Standing
from checkpoint.engines.ptrace.capture.memory import MemoryCapture, RunningCopy, SharedPlaces
from checkpoint.engines.ptrace.capture.memory_result import Taken
from checkpoint.engines.ptrace.capture.syscall_restart import Interruptions
from checkpoint.engines.ptrace.facts.file_identity import Identities
from checkpoint.engines.stream_output import Outputs
from checkpoint.errors import CaptureError, CheckpointError, ProcessGoneError, RanOnError
from checkpoint.linux.memory.tracker import NONE, NOT_CARRIED
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.live_thread import SPOKESMEN_MAX, spokesman_of
from checkpoint.linux.procfs.particulars import Particulars
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.linux.procfs.vm_flags import WATCHED, Flags, FlagsReader
from checkpoint.linux.trace.threads import Threads
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.model import Position, ProcessState, Resource, ThreadState, Vma
from checkpoint.resources import refusals
from checkpoint.resources.events import aio
from checkpoint.resources.files import clean_private_pages
from checkpoint.resources.ipc import boards, system_v_memory
from checkpoint.resources.open_file import Opened
from checkpoint.resources.process import (
    audit_login,
    control_groups,
    job_control,
    mlockall,
    parent_death_signals,
    scheduling,
    seccomp,
)
from checkpoint.resources.process.control_groups import Groups
from checkpoint.resources.survey import gather
from checkpoint.runtime.identity_memo import Memo

NOBODY: SharedPlaces = frozenset()
RAN_ON_MAX: Final = 3
"""Attempts at a program on a machine that leaves us no processor."""


class Look(Struct, frozen=True):
    """Everything that one freeze has read of one process; nothing in it needs the process any more."""

    standing: Standing
    taken: Taken

    @property
    def xstate_mask(self) -> int:
        """Which parts of the processor's state any thread uses."""
        readings = (self.standing.place.reading, *(one.reading for one in self.standing.others))
        return functools.reduce(operator.or_, (extended.in_use(reading.xstate) for reading in readings))


class Met(Struct, frozen=True):
    """A process that was found, and may be stopped. A holder that could not let go of the process yet must keep this object.

    Attributes:
        born: when it began, which tells it from a later process with its pid.
    """

    threads: Threads
    interruptions: Interruptions
    born: int

    @classmethod
    def of(cls, pid: int) -> Met:
        """Nothing is touched.

        Raises:
            ProcessGoneError: it has ended.
        """
        interruptions = Interruptions(makes_again=eintr_syscalls.makes_calls_again(pid))
        return cls(Threads(Tracee(pid), interruptions.mend), interruptions, procfs.stat(pid).start_time)

    @classmethod
    def by_its_spokesman(cls, pid: int) -> Met:
        """As `of`, also where the first thread has ended and others live."""
        spokesman = spokesman_of(pid)
        interruptions = Interruptions(makes_again=eintr_syscalls.makes_calls_again(spokesman))
        threads = Threads(Tracee(spokesman), interruptions.mend, process=pid)
        return cls(threads, interruptions, procfs.stat(spokesman).start_time)


class CapturedProcess:
    """One process, followed from the entering to `close`.

    Attributes:
        pid: the id by which we look at it: its own, or its spokesman's, where its first thread has ended.
        ended_first: tells the state of a first thread that has ended; None where it lives.
        slot: see `checkpoint.snapshot.process_tree`.
        born: when it began, which tells it from a later process with its pid.
        is_new: no snapshot tells of it yet.
        detached: device and inode number of shared memory that becomes the component's own copy, see `detach`.
    """

    def __init__(self, threads: Threads, entered: Entered, order: ProtectOrder, slot: int = 0, born: int = 0) -> None:
        self.pid = threads.pid
        self.slot = slot
        self.threads = threads
        self.ended_first = EndedFirst(threads.process, self.pid, threads.leader.memory) if self.pid != threads.process else None
        self.notes = entered.notes
        self.born = born
        self.is_new = True
        self.order = order
        self.onlooker = Onlooker(threads, entered, order.terms.devices)
        try:
            self.memory = MemoryCapture(threads.leader.memory, entered.tracker, entered.pages)
        except BaseException:
            entered.tracker.close()
            raise
        self.identities = Identities(self.pid, order.names or {})
        self.detached: Collection[tuple[int, int]] = frozenset()
        self._flags = FlagsReader(self.pid)
        self._of_mappings = Memo[tuple[str, ...]]()
        self._told_by_mappings = Memo[tuple[tuple[Resource, ...], tuple[Resource, ...]]]()
        self._particulars: Particulars | None = None
        self._is_told = False
        self._look: Look | None = None
        self._settled: Look | None = None
        self._last: LastLook | None = None

    @classmethod
    def entered(cls, met: Met, order: ProtectOrder, slot: int = 0) -> CapturedProcess:
        """Enter a process that runs."""
        try:
            return cls(met.threads, enter.enter(met.threads, met.interruptions), order, slot, met.born)
        except BaseException:
            met.threads.close()
            raise

    @classmethod
    def entered_first(cls, pid: int, order: ProtectOrder) -> CapturedProcess:
        """Enter the first process of a component; by another thread, where its first one has ended, or does so meanwhile."""
        ran_on = 0
        for _ in range(SPOKESMEN_MAX):
            met = Met.by_its_spokesman(pid)
            try:
                return cls.entered(met, order)
            except RanOnError:
                ran_on += 1
                if ran_on == RAN_ON_MAX:
                    raise
            except ProcessGoneError:
                if spokesman_of(pid) == met.threads.pid:
                    raise
        raise CaptureError(f"cannot enter pid {pid}: its threads end while failover examines it; try again")

    def has_lost_its_voice(self) -> bool:
        """Whether the thread by which we look at it has ended, and another one lives that can take its place.

        Where the first thread lives again, a spokesman has executed another program under its process's id.

        Raises:
            ProcessGoneError: all of it has ended.
        """
        return not self._is_there() and spokesman_of(self.threads.process) not in (self.pid, self.threads.process)

    def _is_there(self) -> bool:
        try:
            return procfs.thread_stat(self.threads.process, self.pid).state not in "ZX"  # its id may be a stranger's by now
        except ProcessGoneError:
            return False

    @classmethod
    def entered_standing(cls, met: Met, order: ProtectOrder, slot: int) -> CapturedProcess:
        """Enter one that stands still for us."""
        return cls(met.threads, enter.enter_standing(met.threads, met.interruptions), order, slot, met.born)

    def close(self) -> None:
        """Let go; the process is not changed."""
        self.memory.close()
        self.onlooker.close()
        self.threads.close()
        if self._particulars is not None:
            self._particulars.close()

    def has_rested(self) -> bool:
        """Whether it is as the last look found it, and as was acknowledged; see `checkpoint.engines.ptrace.capture.at_rest`."""
        if (settled := self._settled) is not None:
            self._settled, self._last = None, LastLook.of(self.pid, settled.standing, settled.taken)
        last = self._last
        return last is not None and last.waits_there(self.pid) and self.memory.has_rested(last)

    def settle(self, position: Position) -> None:
        """The last look has become part of the snapshot with this position. Pages that are of no use go: perhaps gigabytes."""
        self.memory.settle(position)
        look, self._look, self._last = self._look, None, None
        self._settled = look if look is not None and LastLook.may_be_of(look.taken) else None
        self.is_new = False

    @property
    def files_kept(self) -> bool:
        """Whether a store keeps its program files by content."""
        return self.order.names is not None

    def is_still(self, born: int) -> bool:
        """Whether a process with our pid is ours."""
        return self.born == born

    # Before the freeze

    def detach(self, objects: Collection[tuple[int, int]]) -> None:
        """Tell of these pieces of shared memory as the component's own, to which no name leads."""
        self.detached = self.identities.detached = objects
        self.memory.detach(objects)

    def prepare(self, *, base: bool) -> None:
        """Look at what is asked again while it stands still; for a base at the files, too, for that takes long."""
        self.onlooker.prepare()
        if base:
            self.memory.refresh()
            self._flags.refresh(self.memory.lines, anew=True)
            self.identities.vmas(self.memory.lines, self._flags.flags, NONE)

    def copy_running(self, *, base: bool, enough: int = 0, copied: RunningCopy | None = None) -> RunningCopy:
        """As `MemoryCapture.copy_running`, with what is prepared before."""
        self._look = None  # of a capture that failed: its pages may be gigabytes
        self.prepare(base=base)
        copied = self.memory.copy_running(base=base, enough=enough, copied=copied)
        if base:  # which takes long: a thread may have confined itself since
            self.onlooker.rights.prepare()
            self.onlooker.tables.prepare()
        return copied

    def rehearse(self) -> None:
        """Ask the questions of `look` that change nothing, and forget the answers.

        So the processor has our code, the kernel's and the page tables in its caches, and need not fetch them while the program
        stands still; between two captures it has done other things.
        """
        self._look = self._settled = self._last = None  # the freeze takes the memory of their pages
        with contextlib.suppress(CheckpointError, OSError):  # `look` reports the cause
            self.onlooker.rehearse()
            self.memory.rehearse()

    # While it stands still

    def look(self, copied: RunningCopy | None, outputs: Outputs | None, *, base: bool, opened: Opened | None = None) -> Look:
        """Everything that needs it to stand still.

        Args:
            copied: None: nothing is, and nothing will be before the look is over (`MemoryCapture.take_unread`).
            opened: see `Onlooker.ask`.

        Raises:
            CaptureError: it does not, in some way; it may at the next attempt.
        """
        place = self.onlooker.place()
        is_awaited = self.memory.has_rings
        if is_awaited:
            aio.await_requests(self.order.component, gather(self.pid) if opened is None else opened)
        taken = self.memory.take(copied, base=base) if copied is not None else self.memory.take_unread()
        if self.memory.has_rings and not is_awaited:
            raise CaptureError(f"cannot capture {self.order.component}: it has just made a ring of asynchronous I/O; try again")
        self._look, self._is_told = Look(self.onlooker.ask(place, outputs, opened), taken), False
        return self._look

    # Afterwards

    def process(self, look: Look) -> ProcessState:
        """The process as a whole."""
        return process_state(look.standing, self.identities, self._facts())

    def groups(self) -> Groups:
        """Where it is in control groups; nothing of one that has ended."""
        with contextlib.suppress(CheckpointError):
            return self._facts().meaning("cgroup", control_groups.groups_in)
        return {}

    def _facts(self) -> Particulars:
        """Facts of /proc that are told when it may run again: asked for once after each look."""
        if self._particulars is None:
            self._particulars = Particulars(self.pid, keeps_files=not self.threads.is_one_of_many)
        if not self._is_told:
            self._particulars.ask()
            self._is_told = True
        return self._particulars

    def thread_states(self, look: Look) -> tuple[ThreadState, ...]:
        """Its threads, the first one first."""
        living = thread_states(look.standing)
        if self.ended_first is None:
            return living
        return (self.ended_first.state(living[0], look.standing.status.tgids[-1], look.taken.lines), *living)

    def mappings(self, look: Look, kin: frozenset[int] = frozenset()) -> tuple[Vma, ...]:
        """Its mappings.

        Args:
            kin: see `Identities`.
        """
        if kin != self.identities.kin:
            self.identities.kin = kin
        return self.identities.vmas(look.taken.lines, self._flags.flags, look.taken.guards)

    def reasons(self, look: Look, kin: Collection[int] = ()) -> tuple[str, ...]:
        """Why the process, as this look found it, cannot be captured."""
        try:
            self._flags.refresh(self.memory.lines)
            lines = look.taken.lines
            of_mappings = self._of_mappings.of(lines, self._flags.flags, make=lambda: self._refused(lines))
            of_process = refusals.refuse_process(
                self.pid,
                look.standing.status,
                kin,
                files_kept=self.files_kept,
                detaches_memory=self.order.terms.detaches_memory,
                lines=lines,
                facts=self._facts(),
            )
            of_rings = aio.refuse(look.standing.opened) if self.memory.has_rings else ()
            return (
                *of_process,
                *of_mappings,
                *of_rings,
            )
        except ProcessGoneError:
            return ()  # the picture was taken before it ended

    def _refused(self, lines: tuple[MapsLine, ...]) -> tuple[str, ...]:
        """Why mappings cannot be captured."""
        reasons = (refusals.refuse_mapping(line, self._foreign_flags(line)) for line in lines)
        return tuple(reason for reason in reasons if reason)

    def known(self, resources: Iterable[Resource]) -> tuple[Resource, ...]:
        """Its open files, by the names that it knows."""
        return tuple(map(self.identities.as_known, resources))

    def stopped(self) -> tuple[Resource, ...]:
        """Whether the first process was stopped at the last look; the process that waits for it is no part of the component."""
        return job_control.describe(0 if self.order.is_guarded else self.threads.leader.stopped_by, 0)

    def unopened(self, look: Look) -> tuple[Resource, ...]:
        """Resources without a descriptor: locks on what it will map, System V shared memory, rights of its threads.

        Raises:
            CaptureError: one of its threads has just changed its rights.
        """
        told, lines = self._flags.flags, look.taken.lines
        locked, of_boards = self._told_by_mappings.of(lines, told, make=lambda: self._of_lines(lines, told))
        return (
            *locked,
            *(system_v_memory.describe(lines, self.detached) if self.memory.has_segments else ()),
            *of_boards,
            *clean_private_pages.describe(look.taken.lines, look.taken.untouched, look.standing.opened),
            *self._limits(look.standing),
            *scheduling.describe(self.pid),
            *parent_death_signals.describe(self._death_signals(look.standing)),
            *audit_login.describe(self._facts()),
            *self.onlooker.tables.describe(),
        )

    def _of_lines(self, lines: tuple[MapsLine, ...], told: Flags) -> tuple[tuple[Resource, ...], tuple[Resource, ...]]:
        """What follows from the mappings and their flags alone: locks on what it will map, boards."""
        ours = [codes for start, codes in told.items() if self.memory.borrowed.holds(start)]
        of_program = (told.get(line.start, ()) for line in lines if line.name not in NOT_CARRIED)
        return mlockall.describe(of_program, ours), boards.describe_mappings(lines)

    def _death_signals(self, standing: Standing) -> Iterator[tuple[int, int]]:
        """By thread, of those besides the first."""
        if self.ended_first is not None:  # another one speaks for it
            yield standing.status.pids[-1], standing.told.parent_death_signal
        yield from ((other.place.inner_tid, other.death_signal) for other in standing.others)

    def _limits(self, standing: Standing) -> tuple[Resource, ...]:
        """The rights of its threads, and what they are confined to.

        Raises:
            CaptureError: one of them has just changed that.
        """
        place, first = standing.place, standing.status.pids
        confined = [other.tracee.pid for other in place.others if other.confinement]
        threads = [(other.inner_tid, other.confinement) for other in place.others]
        return (
            *self.onlooker.rights.describe({*confined, self.pid}),
            *seccomp.describe([(first[-1], place.confinement), *threads]),
        )

    def _foreign_flags(self, line: MapsLine) -> tuple[str, ...]:
        """VmFlags without those that our own write protection sets."""
        return tuple(flag for flag in self._flags.flags.get(line.start, ()) if flag not in WATCHED)
