"""Restore one process: turn a waiting vessel, or a child of one, into a process of the base.

::

    seize, stand in a hole       the tracer owns the vessel, which dies with it; loop and tables lie where neither has a mapping
    first table                  its own mappings go, the vdso moves, everything the program had is mapped
    pages                        written from outside
    second table                 protections, descriptors, marks, signals
    threads                      each created with its own id, and a table of its own (`restore.threads`); descriptors are shared
    third table                  timers, rights, file locks, watches
    registers                    SIGTRAP's action, the area unmapped by the vdso's own syscall instruction, then the program's own

Source: ptrace(2), prctl(2), vdso(7); kernel/sys.c for PR_SET_MM_MAP.
"""

from __future__ import annotations

import os
import signal
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
from msgspec import Struct, field
from msgspec.structs import replace

from checkpoint.arch import extended, stubs
from checkpoint.engine import RestoreOptions
from checkpoint.engines.ptrace.facts import prctl_state
from checkpoint.engines.ptrace.restore import (
    checks,
    mapping_kinds,
    process_state,
    rights,
    signals,
    stopped_children,
    timers,
    vdso_syscalls,
)
from checkpoint.engines.ptrace.restore import memory as restored_memory
from checkpoint.engines.ptrace.restore import threads as restored_threads
from checkpoint.engines.ptrace.restore import vdso as restored_vdso
from checkpoint.engines.ptrace.restore.checks import Brought
from checkpoint.engines.ptrace.restore.forked_memory import Legacy
from checkpoint.engines.ptrace.restore.signals import pending_traps
from checkpoint.engines.ptrace.restore.vdso_syscalls import VdsoCalls
from checkpoint.engines.ptrace.restore.vessel import Vessel, look_at_vessel
from checkpoint.errors import MismatchError, RestoreError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.spawn import cpuid, vdso
from checkpoint.linux.trace import call_table
from checkpoint.linux.trace.call_table import AREA_SIZE, CallTable, Stub
from checkpoint.linux.trace.threads import Threads
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.model import Credentials, PageRun, Snapshot, ThreadState, Vma
from checkpoint.pages import page_set
from checkpoint.pages.page_set import Words
from checkpoint.pages.source import PageSource
from checkpoint.program import epoch_variable
from checkpoint.resources.events import aio, pidfd
from checkpoint.resources.events.aio import Ring
from checkpoint.resources.files import clean_private_pages, regular
from checkpoint.resources.ipc import system_v_memory
from checkpoint.resources.ipc.system_v_memory import Segments
from checkpoint.resources.process import (
    audit_login,
    exited_processes,
    job_control,
    mlockall,
    parent_death_signals,
    scheduling,
    seccomp,
    shared_with_parent,
    unshared_threads,
)
from checkpoint.resources.process.exited_processes import Departed
from checkpoint.resources.rebuild import deleted_directory, open_here, rebuild_all, rebuild_last
from checkpoint.resources.restore_context import number_of
from checkpoint.runtime import parallel
from checkpoint.snapshot import credentials as snapshot_credentials

OPTIONS: Final = abi.PTRACE_O_EXITKILL | abi.PTRACE_O_TRACESYSGOOD | abi.PTRACE_O_TRACEEXEC | abi.PTRACE_O_TRACECLONE

NOBODY_YET: Final = 0
ROBUST_HEAD: Final = struct.Struct("<QqQ")
"""struct robust_list_head (linux/futex.h): first entry (the head itself when there is none), offset, entry being taken."""
RSEQ_SECTION_OFFSET: Final = 8
"""Offset of rseq_cs in struct rseq (linux/rseq.h)."""
REFUGE_SIZE: Final = 1 << 20
"""Bytes beside the area where vdso and its data stay while their old and new places are cleared."""


class Estate(Struct, frozen=True):
    """The things that a process of a component of several finds at its birth, and shares with others (`tree`).

    Attributes:
        base, size: the stretch of addresses that is ours in all of them; the stub lies at its beginning.
        descriptions: open files by their number in the snapshot: a descriptor of each.
        objects: files without a name, by (device, inode): a descriptor of each.
        anonymous: shared memory without a file, by the same: its address.
        segments: System V shared memory, which the first process makes.
    """

    base: int
    size: int
    descriptions: Mapping[int, int]
    objects: Mapping[tuple[int, int], int]
    anonymous: Mapping[tuple[int, int], int]
    segments: Segments = field(default_factory=Segments)


def options_for(state: Snapshot) -> int:
    """The options with which a vessel is traced; its children are traced with the same."""
    confined = any(seccomp.is_confined(one.resources) for one in state.processes)
    return OPTIONS | (abi.PTRACE_O_SUSPEND_SECCOMP if confined else 0)


class LaterTables(Struct, frozen=True):
    """The calls after the pages: descriptors, marks, signals; those after the threads' birth; and each thread's own."""

    state: CallTable
    rights: CallTable
    threads: list[CallTable]

    @property
    def all(self) -> tuple[CallTable, ...]:
        return (self.state, self.rights, *self.threads)


class ProcessRestore:
    """The restore of one process, from the seizing of its vessel to the program's own registers.

    Attributes:
        has_table_of_parent: it shares its table of descriptors with its parent, which fills it.

    Args:
        state: of this process alone.
        estate: None for a component of one process.
        legacy: the memory that it has in common with others.
        source: of its pages, where ``state`` has them without their bytes.
    """

    def __init__(
        self,
        tracee: Tracee,
        state: Snapshot,
        options: RestoreOptions,
        brought: Brought,
        estate: Estate | None = None,
        legacy: Legacy = restored_memory.NOTHING,
        source: PageSource | None = None,
    ) -> None:
        self._source = source
        self.has_table_of_parent = bool(shared_with_parent.flags_of(state.resources) & shared_with_parent.CLONE_FILES)
        self._state = shared_with_parent.without_descriptors(state) if self.has_table_of_parent else state
        self._legacy = legacy
        self._brought = brought
        self._executable: int | None = None
        self._options = options
        self._estate = estate
        self._thread = state.threads[0]
        self._filters_of_all = seccomp.of_all(state.resources, [thread.tid for thread in state.threads])
        shared = restored_memory.extents_shared(state.vmas, options.terms)
        self._untouched = page_set.union(clean_private_pages.of(state.resources), shared)
        self._tracee = tracee
        self._others: list[tuple[Tracee, ThreadState]] = []
        self.notes: list[str] = []
        self._objects: dict[tuple[int, int], int] = {}
        self._foreign: tuple[Vma, ...] = ()
        self._segments = estate.segments if estate else system_v_memory.Segments()
        self._own_functions: tuple[vdso.Function, ...] = ()
        self._rings: list[Ring | None] = []
        self._ended: tuple[Departed, ...] = ()

    def end(self) -> None:
        """Kill what will be no program."""
        restored_threads.end(self._tracee, [tracee for tracee, _ in self._others])
        self._segments.undo()

    def held(self) -> Threads:
        """Its threads, standing still for us."""
        threads = Threads(self._tracee)
        threads.adopt(tuple(tracee for tracee, _ in self._others))
        threads.hold()
        return threads

    def prepare(self) -> None:
        """Seize a vessel that waits by itself."""
        tracee = self._tracee
        tracee.seize(options_for(self._state))
        tracee.freeze()
        tracee.set_signal_mask(abi.ALL_SIGNALS & ~(1 << (signal.SIGTRAP - 1)))
        if stop := job_control.stop_of(self._state.resources):
            stopped_children.stop(tracee, stop[0])

    def build(self) -> None:
        """Everything but the registers."""
        tracee = self._tracee
        vessel = look_at_vessel(tracee.pid)
        self._require_identity(vessel)
        if not vessel.may_choose_executable:
            self._execute_program()
        self._own_xstate = tracee.xstate()
        self._start_registers = tracee.registers()
        mappings = procfs.parse_maps(procfs.read_text(tracee.pid, "maps"))
        if self._estate is not None:
            mappings = tuple(line for line in mappings if not self._is_estate(line))
        self._adapt(mappings)
        self._build_and_run(vessel, mappings)

    def _execute_program(self) -> None:
        """Have the vessel execute the program's own file, so that /proc/PID/exe is right without a right to set it."""
        path = self._state.process.executable.path
        vdso_syscalls.execute(self._tracee, self._brought.run.get(path, path))

    def _is_estate(self, line: procfs.MapsLine) -> bool:
        assert self._estate is not None
        return self._estate.base <= line.start < self._estate.base + self._estate.size

    def _adapt(self, mappings: tuple[procfs.MapsLine, ...]) -> None:
        """Have a program of another kernel use this one's vdso."""
        ours = restored_memory.kernel_pages(mappings)
        if restored_vdso.fits(self._state, ours):
            return
        image = self._tracee.memory.read(ours[-1].start, ours[-1].size)
        self._state, self._foreign = restored_vdso.with_own_image(self._state)
        self._own_functions = vdso.functions(image)

    def _require_identity(self, vessel: Vessel) -> None:
        """A program of several threads knows their ids; so does one that holds robust or priority-inheriting locks."""
        if vessel.inner_pid == self._state.process.pid:
            return
        if len(self._state.threads) > 1:
            count, wanted = len(self._state.threads), self._state.process.pid
            reason = f"it has {count} threads, and pid {wanted}, by which they know it, is not available"
            raise MismatchError(
                f"cannot restore {self._state.component} as pid {vessel.inner_pid}: {reason}; "
                "free that pid, or run it in PIDs of its own (failover run isolates)",
                (reason,),
            )
        head = self._thread.robust_list[0]
        listed = self._content_at(head, ROBUST_HEAD.size) if head else None
        if listed is None:
            return
        first, _, acquiring = ROBUST_HEAD.unpack(listed)
        if first != head or acquiring:
            raise MismatchError(
                f"cannot restore {self._state.component} as pid {vessel.inner_pid}: it holds a lock that names its own pid "
                f"{self._state.process.pid}; "
                "free that pid, or run it in PIDs of its own (failover run isolates)",
                (f"pid {self._state.process.pid} is not available, and a lock that the program holds names it",),
            )

    def _build_and_run(self, vessel: Vessel, mappings: tuple[procfs.MapsLine, ...]) -> None:
        base = self._choose_place(mappings)
        first = self._mappings_table(CallTable(base, descriptors=self._inherited()), vessel, mappings, base + AREA_SIZE)
        opened = CallTable(base, descriptors=set(first.descriptors))
        given = self._estate.descriptions if self._estate else {}
        of_its_own = [held for held in self._state.resources if number_of(held.facts.get("description", 0)) not in given]
        self._ended = exited_processes.of(of_its_own, self._state.process.working_directory)
        for one in self._ended:
            self._objects |= one.open(opened, NOBODY_YET)
        later = self._later_tables(base, set(opened.descriptors), vessel)
        self._rings = aio.slots(aio.rings_of(self._state.vmas, self._content_at))
        made, moves = CallTable(base), CallTable(base, descriptors=set(first.descriptors))
        aio.make(made, self._rings)
        aio.move(moves, self._rings, [0] * len(self._rings))
        self._lay_stub(base, mappings, self._size_of((first, made, moves, opened, *later.all)))
        self._lay_out(first)
        self._complete(later)

    def _carried(self) -> Sequence[PageRun] | Words:
        """The pages with content: their mappings must be writable until it is there."""
        return self._state.runs

    def _choose_place(self, mappings: tuple[procfs.MapsLine, ...]) -> int:
        """Where the stub and its tables may lie; what the program shares by no name is made."""
        state = self._state
        taken = [(line.start, line.end) for line in mappings] + [(vma.start, vma.end) for vma in state.vmas]
        self._segments.make(state.resources)
        shared_size = sum(restored_memory.anonymous_sizes(state.vmas).values())
        return self._estate.base if self._estate else call_table.find_hole(taken, AREA_SIZE + REFUGE_SIZE + shared_size)

    def _later_tables(self, base: int, descriptors: set[int], vessel: Vessel) -> LaterTables:
        """Everything that comes after the pages.

        Args:
            descriptors: that are open by then.
        """
        second = self._state_table(CallTable(base, descriptors=descriptors), vessel)
        third = self._rights_table(CallTable(base, descriptors=set(second.descriptors)), vessel)
        tables = [self._thread_table(CallTable(base), thread, vessel) for thread in self._state.threads[1:]]
        return LaterTables(second, third, tables)

    def _size_of(self, tables: Sequence[CallTable]) -> int:
        size = max(table.end - table.base for table in tables)
        if size > AREA_SIZE:
            raise RestoreError(
                f"cannot restore: its {len(self._state.vmas)} mappings need {size >> 20} MiB of calls; the limit is 64 MiB"
            )
        return size

    def _lay_stub(self, base: int, mappings: tuple[procfs.MapsLine, ...], size: int) -> None:
        self._stub = Stub(self._tracee, base)
        image = restored_memory.kernel_pages(mappings)[-1]
        if self._estate is None:
            self._stub.install(vdso_syscalls.instruction_in(self._tracee.memory, image.start, image.size), size)
        self._area_size = self._estate.size if self._estate else size

    def _lay_out(self, first: CallTable) -> None:
        """The program's mappings and its pages."""
        self.notes += self._stub.run(first)
        self._segments.attached()
        self.notes += self._segments.notes
        if self._rings:
            self._make_rings(self._stub, self._rings, first.descriptors)
        restored_threads.open_what_is_left(self._tracee, self._start_registers, self._stub, self._ended, first.descriptors)
        threads = parallel.thread_count()
        memory, state = self._tracee.memory, self._state
        if self._source is not None:
            restored_memory.fill_from(memory, state, self._source, self._legacy, self._untouched, threads)
        else:
            restored_memory.fill(memory, state, self._legacy, self._untouched, threads)

    def _complete(self, later: LaterTables) -> None:
        """Everything but mappings and pages, which are there."""
        tracee, state = self._tracee, self._state
        if self._own_functions:
            self._leave_old_vdso()
            tracee.memory.write_each(restored_vdso.jumps(state, self._content_at, self._vdso, self._own_functions))
        if self._options.epoch:
            layout = state.process.layout
            epoch_variable.renew(tracee.memory, layout.env_start, layout.env_end, self._options.epoch)
        self.notes += self._stub.run(later.state)
        self._start_threads(self._stub.base, later.threads)
        self.notes += self._stub.run(later.rights)
        _write_oom_score(tracee.pid, state.process.oom_score_adj, self.notes)
        _write_coredump_filter(tracee.pid, state.process.coredump_filter, self.notes)

    def _make_rings(self, stub: Stub, rings: list[Ring | None], descriptors: set[int]) -> None:
        """Have the kernel make rings of asynchronous I/O; it alone chooses where, so that a second table moves them."""
        made, moves = (CallTable(stub.base, descriptors=set(descriptors)) for _ in range(2))
        answers = aio.make(made, rings)
        stub.run(made)
        aio.move(moves, rings, [int.from_bytes(self._tracee.memory.read(answer, 8), "little") for answer in answers])
        stub.run(moves)

    def _inherited(self) -> set[int]:
        """Descriptors that the vessel has."""
        shared = {*self._estate.descriptions.values(), *self._estate.objects.values()} if self._estate else set()
        return {0, 1, 2} | shared

    def _leave_old_vdso(self) -> None:
        """Lead each thread that stands in the middle of another kernel's vdso out of it."""
        if not self._foreign:
            return
        threads = restored_vdso.led_out(self._tracee, self._calls_of_vdso(), self._foreign, self._state.threads)
        self._state = replace(self._state, threads=threads)
        self._thread = threads[0]

    def _mappings_table(self, table: CallTable, vessel: Vessel, mappings: tuple[procfs.MapsLine, ...], refuge: int) -> CallTable:
        vmas, runs = self._state.vmas, self._carried()
        process_state.raise_limits(table, vessel)
        brought = self._open_brought(table)  # with our rights, from a place of ours
        if self._options.own_eyes:
            rights.own_eyes(table, self._state.process, vessel)
        self._make_directories(table)
        if self._estate is not None:
            process_state.begin_member(table)
        restored_memory.clear(table, mappings, self._legacy)
        ours, theirs = restored_memory.kernel_pages(mappings), restored_memory.kernel_pages_of(vmas)
        self._vdso = restored_memory.move_kernel_pages(table, ours, theirs, refuge)
        self._vdso_size = ours[-1].size
        mapping_kinds.allocate_keys(table, mapping_kinds.keys_of(self._state))
        self.notes += mapping_kinds.ordinary_by_now(vmas)
        attached = [vma for vma in vmas if system_v_memory.is_segment(vma)]
        system_v_memory.attach(table, attached, self._segments.ids, system_v_memory.sizes_of(self._state.resources))
        sizes = {} if self._estate else restored_memory.anonymous_sizes(vmas)
        ours_alone = restored_memory.map_anonymous(table, sizes, refuge + REFUGE_SIZE)
        objects, anonymous = (self._estate.objects, self._estate.anonymous) if self._estate else ({}, ours_alone)
        present = restored_memory.Present(objects, anonymous, self._legacy)
        self._objects |= restored_memory.map_program(table, vmas, runs, brought, present, self._untouched)
        self._objects |= objects
        for key, place in ours_alone.items():
            table.call("unmap shared memory, which is mapped elsewhere now", "munmap", place, sizes[key])
        self._executable = brought.pop(self._state.process.executable.path, None)
        for descriptor in brought.values():
            table.close(descriptor)
        return table

    def _make_directories(self, table: CallTable) -> None:
        """Make the directories that lead to its working directory."""
        process_state.make_directories(table, checks.missing_directories(self._state))

    def _open_brought(self, table: CallTable) -> dict[str, int]:
        """Open files that were brought along: descriptors of those to run, by path; those only read join the nameless objects."""
        flags = os.O_RDONLY | os.O_CLOEXEC
        run = {path: table.open(content, flags) for path, content in self._brought.run.items()}
        for held in self._state.resources:
            content = self._brought.opened.get(str(held.facts.get("path")))
            key = number_of(held.facts.get("device", 0)), number_of(held.facts.get("inode", 0))
            if content is not None and held.kind == regular.KIND and key not in self._objects:
                self._objects[key] = table.open(content, flags)
        elsewhere = sorted({**self._brought.run, **self._brought.opened})
        self.notes += [f"{path} is not this machine's: the program resumes with its brought copy" for path in elsewhere]
        return run

    def _state_table(self, table: CallTable, vessel: Vessel) -> CallTable:
        process, thread = self._state.process, self._thread
        restored_memory.settle(table, self._state.vmas, self._carried())
        process_state.memory_layout(
            table, process, with_executable=vessel.may_choose_executable, brought=self._executable
        )  # before the program's own descriptors take their numbers
        ours = rights.our_eyes(table, process, vessel, self._options)  # its own file of /proc is root's by now
        self.notes += audit_login.rebuild(table, self._state.resources, vessel.pid, ours)
        if self.has_table_of_parent:
            for number in set(self._objects.values()) - self._inherited():
                table.close(number)
        else:
            self._rebuild_descriptors(table, vessel)
        signals.signal_actions(table, process.signal_actions)
        process_state.thread_marks(table, thread)
        process_state.enter_directory(table, process.working_directory, deleted_directory(self._state))
        process_state.surroundings(table, process)
        both = set(self._state.machine.features) & set(cpuid.features())
        for feature, name, arguments in extended.PERMISSIONS:
            if feature in both:
                table.attempt("", name, *arguments)  # it may have asked for that
        seccomp.install(table, self._filters_of_all, process.credentials)  # all threads are born with them
        return table

    def _rebuild_descriptors(self, table: CallTable, vessel: Vessel) -> None:
        given = self._estate.descriptions if self._estate else None
        self.notes += rebuild_all(table, self._state, self._options, vessel.inner_pid, self._objects, vessel.pid, given)

    def _rights_table(self, table: CallTable, vessel: Vessel) -> CallTable:
        """The calls after the birth of the threads, since that birth takes a right."""
        state, thread, elapsed_ns = self._state, self._thread, self._options.elapsed_ns
        process = state.process
        mlockall.rebuild(table, state.resources)  # which takes a right, or a limit
        process_state.scheduling(table, thread, vessel)
        scheduling.rebuild(table, state.resources, thread.tid, bool(thread.policy & os.SCHED_RESET_ON_FORK))
        self.notes += process_state.limits(table, process, vessel)
        process_state.enter_root(table, process, vessel)
        self._confine(table, thread, process.credentials)
        self.notes += rights.adopt(table, process, vessel, ordinary=self._options.own_eyes)
        signals.pending_signals(table, process, vessel.inner_pid)
        signals.pending_of_thread(table, process, thread, vessel.inner_pid, vessel.inner_pid)
        timers.posix_timers(table, process, state.threads, vessel, elapsed_ns)
        timers.interval_timers(table, process.interval_timers, elapsed_ns)
        process_state.last_marks(table, process)
        rebuild_last(table, self._state, vessel.inner_pid)
        prctl_state.set_again(table, process.switches)
        return table

    def _thread_table(self, table: CallTable, thread: ThreadState, vessel: Vessel) -> CallTable:
        """The calls that each thread must make for itself; its notes about rights are those of the first."""
        process = self._state.process
        credentials = snapshot_credentials.of_thread(self._state.resources, thread.tid, process.credentials)
        process_state.thread_marks(table, thread)
        process_state.scheduling(table, thread, vessel, f" for thread {thread.tid} ({thread.name})")
        scheduling.rebuild(table, self._state.resources, thread.tid, bool(thread.policy & os.SCHED_RESET_ON_FORK))
        unshared_threads.enter(table, self._state.resources, thread.tid)
        unshared_threads.part(table, self._state.resources, thread.tid, open_here(self._state))
        self._confine(table, thread, credentials)
        rights.adopt(table, replace(process, credentials=credentials), vessel, ordinary=self._options.own_eyes)
        parent_death_signals.rebuild(table, self._state.resources, thread.tid)
        signals.pending_of_thread(table, process, thread, vessel.inner_pid, thread.tid)
        prctl_state.set_again(table, [switch for switch in process.switches if switch[0] in prctl_state.OF_THREADS])
        return table

    def _confine(self, table: CallTable, thread: ThreadState, credentials: Credentials) -> None:
        """Before it gives up its rights; suspended until it runs."""
        found = seccomp.of_thread(self._state.resources, thread.tid)
        seccomp.confine(table, found, len(self._filters_of_all), credentials)

    def _start_threads(self, base: int, tables: list[CallTable]) -> None:
        """Give birth to the other threads, and have each make the calls of its table."""
        for thread in self._state.threads[1:]:
            born = restored_threads.spawn(self._tracee, self._start_registers, base, thread.tid)
            self._others.append((born, thread))
        if self._others and not self.has_table_of_parent:
            table = CallTable(base, descriptors=set(open_here(self._state)))
            pidfd.settle(table, self._state.resources)
            self._stub.run(table)
        for (tracee, _), table in zip(self._others, tables, strict=True):
            self.notes += Stub(tracee, base).run(table)

    def become_program(self) -> None:
        """SIGTRAP's action, our area gone, then the program's own registers and masks."""
        tracee, calls, place = self._tracee, self._calls_of_vdso(), self._stub.base + abi.PAGE_SIZE
        action = signals.trap_action(self._state.process.signal_actions)
        tracee.memory.write(place, signals.packed_action(action))
        calls.make("rt_sigaction", signal.SIGTRAP, place, 0, abi.SIGSET_SIZE)
        self._queue_traps(calls, place)
        for start, end in self._ours().tolist():
            calls.make("munmap", start, end - start)
        for one, thread in ((tracee, self._thread), *self._others):
            self._take_place(one, thread)

    def _ours(self) -> Words:
        """The ranges to unmap at the end: not this kernel's vdso, where that stays in the refuge beside the area."""
        base, size = self._stub.base, -(-self._area_size // abi.PAGE_SIZE) * abi.PAGE_SIZE
        all_of_it = np.array([[base, base + size]], np.uint64)
        if not self._own_functions:
            return all_of_it
        return page_set.difference(all_of_it, np.array([[base + AREA_SIZE, base + AREA_SIZE + REFUGE_SIZE]], np.uint64))

    def _calls_of_vdso(self) -> VdsoCalls:
        return VdsoCalls(self._tracee, self._start_registers, self._vdso, self._vdso_size)

    def _queue_traps(self, calls: VdsoCalls, place: int) -> None:
        """Queue each pending SIGTRAP, from the thread that it waits for; blocked, it disturbs none of the calls to come.

        Args:
            place: of ours still, for a siginfo.
        """
        state = self._state
        inner_pid = procfs.status(self._tracee.pid).pids[-1]
        for one, thread in ((self._tracee, self._thread), *self._others):
            tid = inner_pid if one is self._tracee else thread.tid
            traps = pending_traps(state.process, thread.pending)
            queued: list[tuple[str, tuple[int, ...], bytes]] = [("rt_tgsigqueueinfo", (inner_pid, tid), trap) for trap in traps]
            if one is self._tracee:
                traps = pending_traps(state.process, state.process.pending)
                queued += [("rt_sigqueueinfo", (inner_pid,), trap) for trap in traps]
            if queued:
                one.set_signal_mask(abi.ALL_SIGNALS)
            for name, whom, siginfo in queued:
                self._tracee.memory.write(place, siginfo)
                calls.make(name, *whom, signal.SIGTRAP, place, by=one)

    def _take_place(self, tracee: Tracee, thread: ThreadState) -> None:
        """Give a thread its registers and mask; it stands in a stop that it can be let go from."""
        self._restore_rseq_section(thread)
        theirs, ours = checks.xstate_layouts(self._state)
        tracee.set_xstate(extended.fitted(thread.registers["xstate"], theirs, ours, self._own_xstate))
        tracee.interrupt()  # a signal that comes from now on finds the thread where the kernel decides about interrupted calls
        tracee.cont()
        tracee.wait(call_table.RUN_TIMEOUT_S)
        tracee.set_registers(stubs.in_interrupted_call(thread.registers["prstatus"], thread.interrupted))
        tracee.set_signal_mask(thread.signal_mask)

    def _restore_rseq_section(self, thread: ThreadState) -> None:
        """Point again to the critical section that the thread may stand in: registering forgot it, the kernel aborts it."""
        rseq = thread.rseq
        if rseq is None:
            return
        pointer = self._content_at(rseq.address + RSEQ_SECTION_OFFSET, 8)
        if pointer is not None and any(pointer):
            self._tracee.memory.write(rseq.address + RSEQ_SECTION_OFFSET, pointer)

    def _content_at(self, address: int, size: int) -> bytes | None:
        """Bytes of the program's memory as it was captured; None where no page is carried."""
        if self._source is not None:
            return self._source.content_at(address, size)
        return restored_memory.content_at(self._state, address, size)


def _write_oom_score(pid: int, score: int, notes: list[str]) -> None:
    if int(procfs.read_bytes(pid, "oom_score_adj")) == score:
        return
    try:
        Path(f"/proc/{pid}/oom_score_adj").write_bytes(str(score).encode())
    except PermissionError:
        notes.append(f"oom_score_adj {score} is not kept: lowering it needs CAP_SYS_RESOURCE")


def _write_coredump_filter(pid: int, wanted: int, notes: list[str]) -> None:
    if wanted < 0:
        return
    try:
        Path(f"/proc/{pid}/coredump_filter").write_bytes(hex(wanted).encode())
    except OSError as error:
        notes.append(f"the choice of mappings in a core dump is not kept: {error.strerror}")
