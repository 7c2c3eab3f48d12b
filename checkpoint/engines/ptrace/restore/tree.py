"""Restore a component of several processes: create them in order, restore each like one process, then resume them together.

::

    estate       the first vessel makes the objects that several processes share: open files, files without a name, shared
                 memory, and private memory that is equal since a fork (`restore.forked_memory`)
    births       processes, sessions, groups, in the order of `facts.birth_order`; they inherit the estate, and are vessels too
    ends         zombies end as they had ended, stand-ins without a trace; processes that were stopped are stopped
    each         as `restore.process.ProcessRestore` does it, up to the registers
    registers    of all; no process runs before the state of every process is complete

All are traced from their creation, and end with the tracer (PTRACE_O_EXITKILL) until `RestoredProgram.resume`.

Source: ptrace(2) (PTRACE_O_TRACEFORK), clone(2), wait(2), setsid(2), setpgid(2).
"""

from __future__ import annotations

import contextlib
import itertools
import os
import resource
import signal
import struct
import termios
from collections.abc import Collection, Iterator
from itertools import groupby
from typing import Final

from msgspec.structs import replace

from checkpoint.arch import cpu, stubs
from checkpoint.engine import RestoreOptions
from checkpoint.engines.ptrace.facts import birth_order
from checkpoint.engines.ptrace.facts.birth_order import Birth, End, Join, NewSession, Reaper, Step
from checkpoint.engines.ptrace.restore import (
    forked_memory,
    memory,
    process_state,
    rights,
    shared_files,
    stopped_children,
    threads,
    vdso_syscalls,
)
from checkpoint.engines.ptrace.restore.checks import Brought
from checkpoint.engines.ptrace.restore.forked_memory import Legacy
from checkpoint.engines.ptrace.restore.process import REFUGE_SIZE, Estate, ProcessRestore, options_for
from checkpoint.engines.ptrace.restore.vessel import Vessel, look_at_vessel
from checkpoint.errors import CheckpointError, MismatchError, ProcessGoneError, RestoreError
from checkpoint.linux import abi
from checkpoint.linux.procfs import descendants, procfs
from checkpoint.linux.trace import call_table
from checkpoint.linux.trace.call_table import AREA_SIZE, CallTable, Stub
from checkpoint.linux.trace.threads import Threads
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.model import PageRun, ProcessState, Resource, Snapshot, Vma, Zombie
from checkpoint.pages import page_set
from checkpoint.resources import rebuild, shared_open_file
from checkpoint.resources.events import epoll, pidfd
from checkpoint.resources.files import regular
from checkpoint.resources.ipc import pseudo_terminals, standard_streams
from checkpoint.resources.process import exited_processes, job_control
from checkpoint.resources.restore_context import number_of
from checkpoint.store import member_pages

PTRACE_O_TRACEFORK: Final = 2
WALL: Final = 0x40000000
STOPPED_BY: Final = 0x7F
"""Bits of a wait status that hold the signal that ended a process; 0: it exited."""


class TreeRestore:
    """One restore, from the seizing of the vessel to all processes' own registers."""

    _born_with = 0
    """Flags of clone(2) for all processes."""

    def __init__(self, vessel_pid: int, state: Snapshot, options: RestoreOptions, brought: tuple[Brought, ...]) -> None:
        self._state = state
        views, self._sources = member_pages.apart(state)
        self._views, self._nameless = shared_files.made_once(views)
        self._brought = brought
        self._options = options
        self._first = Tracee(vessel_pid)
        self._born: dict[int, Tracee] = {state.process.pid: self._first}
        self._standins: dict[int, int] = {}
        self._spare = birth_order.spare_pids(state, procfs.pid_max())
        self._restoring: list[ProcessRestore] = []
        self._notes: list[str] = []
        self._legacies: tuple[Legacy, ...] = ()
        self._terminals: dict[int, pseudo_terminals.Controlling] = {}

    def end(self) -> None:
        """Kill all processes; one that was born here is reaped for its parent, which may have ended before."""
        for restoring in self._restoring[1:]:
            restoring.end()
        for tracee in reversed(self._born.values()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(tracee.pid, signal.SIGKILL)
        for restoring in self._restoring[:1]:
            restoring.end()
        for tracee in self._born.values():
            if tracee is not self._first or not self._restoring:  # while it is traced its parent waits for it in vain
                _await_end(tracee)

    def held(self) -> tuple[Threads, ...]:
        """All of them, the first process first, standing still for us."""
        return tuple(restoring.held() for restoring in self._restoring)

    def pids(self) -> list[int]:
        """Theirs, as we see them, the first process first."""
        return [self._born[one.process.pid].pid for one in self._state.processes]

    def notes(self) -> tuple[str, ...]:
        """The differences, each once."""
        return tuple(dict.fromkeys(note for notes in (self._notes, *(one.notes for one in self._restoring)) for note in notes))

    def run(self) -> None:
        """All of it, up to the registers; all processes stand still."""
        vessel = self._begin()
        estate = self._make_estate(vessel, first_told(self._views))
        self._bear_all(estate.base)
        self._restoring = [
            ProcessRestore(self._born[view.process.pid], view, self._options, brought, estate, legacy, source)
            for view, brought, legacy, source in zip(self._views, self._brought, self._legacies, self._sources, strict=True)
        ]
        for restoring in sorted(self._restoring, key=lambda one: not one.has_table_of_parent):  # which that fills last
            restoring.build()
        for restoring in self._restoring:
            restoring.become_program()

    def _begin(self) -> Vessel:
        """Seize the first vessel."""
        first = self._first
        first.seize(options_for(self._state) | PTRACE_O_TRACEFORK)
        first.freeze()
        first.set_signal_mask(abi.ALL_SIGNALS & ~(1 << (signal.SIGTRAP - 1)))
        vessel = look_at_vessel(first.pid)
        self._require_rights(vessel)
        self._registers = first.registers()
        return vessel

    def _bear_all(self, base: int) -> None:
        """Have all processes born, and those end, or be stopped, that had."""
        self._instruction = base + stubs.CALL_LOOP.index(cpu.SYSCALL)
        self._come_to_session()
        self._take_terminal(self._state.process.pid)
        for step in birth_order.steps_of(self._state, descendants.taken_pids(self._first.pid)):
            self._take(step, base)
        self._set_foreground(base)
        for zombie in self._state.zombies:
            self._end_as(zombie, base)
        if stop := job_control.stop_of(self._state.resources):
            stopped_children.stop(self._first, stop[0])
        for member in self._state.members:
            if stop := job_control.stop_of(member.resources):
                self._stop(member.process, *stop)

    def _require_rights(self, vessel: Vessel) -> None:
        """Its processes know each other by their pids, so these must be had.

        Raises:
            MismatchError: they cannot.
        """
        wanted = self._state.process.pid
        count = 1 + len(self._state.members) + len(self._state.zombies)
        if vessel.inner_pid != wanted:
            reason = f"it has {count} processes, and pid {wanted}, by which they know it, is not available"
        elif not vessel.may_choose_executable:
            reason = f"it has {count} processes, which takes the right to choose their pids (CAP_CHECKPOINT_RESTORE)"
        else:
            return
        raise MismatchError(
            f"cannot restore {self._state.component} as pid {vessel.inner_pid}: {reason}; "
            "run it in PIDs of its own (failover run isolates)",
            (reason,),
        )

    # Things that they share

    def _make_estate(self, vessel: Vessel, resources: dict[int, Resource]) -> Estate:
        """Make the things that they share in the first vessel.

        Args:
            resources: the resource of each open file that is shared, by its number.
        """
        mappings, views = procfs.parse_maps(procfs.read_text(self._first.pid, "maps")), self._views
        vmas = [vma for view in views for vma in view.vmas]
        sizes = {key: max(vma.offset + vma.size for vma in group) for key, group in _grouped(vmas, memory.is_anonymous_object)}
        size = AREA_SIZE + REFUGE_SIZE + sum(sizes.values())
        taken = [(line.start, line.end) for line in mappings] + [(vma.start, vma.end) for vma in vmas]
        base = call_table.find_hole(taken, size)
        objects = dict(_grouped(vmas, memory.is_object_mapping))
        numbers = self._numbers(resources, len(objects))
        estate = Estate(
            base=base,
            size=size,
            objects=dict(zip((*objects, *self._nameless), numbers, strict=False)),
            descriptions=dict(zip(resources, numbers, strict=False)),
            anonymous=dict(zip(sizes, _places(base + AREA_SIZE + REFUGE_SIZE, sizes.values()), strict=True)),
        )
        self._terminals = pseudo_terminals.controlling({estate.descriptions[number]: held for number, held in resources.items()})
        stub = Stub(self._first, base)
        image = memory.kernel_pages(mappings)[-1]
        stub.install(vdso_syscalls.instruction_in(self._first.memory, image.start, image.size), AREA_SIZE)
        taken_by_vessel = page_set.extents(PageRun(line.start, line.end) for line in mappings)
        inheritance = forked_memory.of(views, taken_by_vessel, {path for one in self._brought for path in one.run}, self._sources)
        self._legacies = inheritance.legacies
        ended = exited_processes.of(
            [_at(held, estate.descriptions[n]) for n, held in resources.items() if held.kind == pidfd.KIND], ""
        )
        opened, left = threads.open_what_is_left(self._first, self._registers, stub, ended, standard_streams.STANDARD)
        table = CallTable(estate.base, descriptors=opened)
        inheritance.leave(table)
        process_state.raise_limits(table, vessel)
        made = self._open_brought(table, resources) | left  # with our rights, from a place of ours
        if self._options.own_eyes:
            rights.own_eyes(table, self._state.process, vessel)
        for key, size in sizes.items():
            what, place = f"map {size >> 10} KiB of shared memory", estate.anonymous[key]
            flags = abi.MAP_SHARED | abi.MAP_ANONYMOUS | abi.MAP_FIXED_NOREPLACE
            arguments = (place, size, abi.PROT_READ | abi.PROT_WRITE, flags, -1, 0)
            table.call(what, "mmap", *arguments, least=place, most=place)
        made |= {key: memory.make_object(table, vmas) for key, vmas in objects.items()}
        self._make_nameless(table, vessel, estate, made, resources)
        inheritance.leave_files(table)
        if table.end - base > AREA_SIZE:
            raise RestoreError(f"cannot restore: files and memory that its processes share take more than {AREA_SIZE >> 20} MiB")
        self._notes += stub.run(table)
        inheritance.put_in(self._first.memory)
        return estate

    def _numbers(self, resources: Collection[int], count: int) -> Iterator[int]:
        """Descriptors for shared things: above all that any process wants, and that are open while it is made.

        Args:
            count: of objects that are mapped.
        """
        wanted = (one.number for view in self._views for one in rebuild.descriptors_of(view))
        made_first = len(standard_streams.STANDARD) + 2 * len(resources) + count + len(self._nameless)  # at the lowest numbers
        return itertools.count(max(max(wanted, default=2), made_first) + 1)

    def _make_nameless(
        self,
        table: CallTable,
        vessel: Vessel,
        estate: Estate,
        made: dict[memory.Object, int],
        resources: dict[int, Resource],
    ) -> None:
        """Add the calls that make all open files that are shared, at the numbers that the estate says.

        Args:
            made: the objects that are there, each open at some number, and no more there afterwards.
        """
        made = made | {key: shared_files.make(table, held) for key, held in self._nameless.items()}
        for key, number in estate.objects.items():
            table.duplicate(made[key], number, os.O_CLOEXEC)
        kept = [
            Resource(standard_streams.KIND, f"fd {n}", {"descriptors": [[n, 0]], "stream": n, "flags": 0})
            for n in standard_streams.STANDARD
        ]
        told = [_at(held, estate.descriptions[number]) for number, held in resources.items()]
        bag = replace(self._state, resources=(*kept, *told))
        self._notes += rebuild.rebuild_all(table, bag, self._options, vessel.inner_pid, made, vessel.pid)

    def _open_brought(self, table: CallTable, resources: dict[int, Resource]) -> dict[memory.Object, int]:
        """Open files that were brought along and that several processes have open for reading."""
        contents = {path: content for one in self._brought for path, content in one.opened.items()}
        found: dict[memory.Object, int] = {}
        for held in resources.values():
            content = contents.get(str(held.facts.get("path")))
            key = number_of(held.facts.get("device", 0)), number_of(held.facts.get("inode", 0))
            if content is not None and held.kind == regular.KIND and key not in found:
                found[key] = table.open(content, os.O_RDONLY | os.O_CLOEXEC)
        return found

    # Births and ends

    def _come_to_session(self) -> None:
        """Have the first process lead what it led before others are born into it; a vessel may do so from the beginning."""
        process = self._state.process
        if process.sid == process.pid:
            self._try(process.pid, "setsid")
        elif process.pgid == process.pid:
            self._try(process.pid, "setpgid", 0, 0)

    def _take(self, step: Step, base: int) -> None:
        match step:
            case Birth(parent, pid) if pid < 0:
                self._born[pid], self._standins[pid] = self._stand_in(self._born[parent], base)
            case Birth(parent, pid, exit_signal, flags):
                mother, flags = self._born[parent], flags | self._born_with
                self._born[pid] = threads.spawn_process(mother, self._registers, base, pid, exit_signal, flags)
            case NewSession(pid):
                self._call(pid, f"make session {pid}", "setsid")
                self._take_terminal(pid)
            case Join(pid, group):
                self._call(pid, f"have process {pid} join group {group}", "setpgid", 0, group)
            case Reaper(pid, is_one):
                what = f"have process {pid} be given orphans" if is_one else f"have process {pid} be given no more orphans"
                self._call(pid, what, "prctl", abi.PR_SET_CHILD_SUBREAPER, int(is_one))
            case End(parent, pid):
                self._exit(pid, 0)
                self._call(parent, f"take note of the end of {pid}", "wait4", self._standins.pop(pid, pid), 0, WALL, 0)
                del self._born[pid]

    def _stand_in(self, mother: Tracee, base: int) -> tuple[Tracee, int]:
        """A stand-in of any pid, and that pid: processes that are born or restored beside us may have taken some."""
        for pid in self._spare:
            with contextlib.suppress(threads.IdInUseError):
                return threads.spawn_process(mother, self._registers, base, pid, 0, self._born_with), pid
        raise RestoreError(f"cannot restore {self._state.component}: no pid is left for a stand-in of one that has ended")

    def _take_terminal(self, pid: int) -> None:
        """Give a session its controlling terminal; all processes that are born into it from now on have it as well."""
        if found := self._terminals.get(pid):
            with self._opened(pid, found) as slave:
                self._call(pid, f"take the controlling terminal of session {pid}", "ioctl", slave, termios.TIOCSCTTY, 0)

    def _set_foreground(self, base: int) -> None:
        """Say which group is in the foreground of each terminal, now that the groups are there."""
        for pid, found in self._terminals.items():
            if pid in self._born and found.foreground not in (0, pid):
                self._born[pid].memory.write(base + abi.PAGE_SIZE, struct.pack("<i", found.foreground))
                what = f"bring group {found.foreground} to the foreground"
                with self._opened(pid, found) as slave:
                    self._call(pid, what, "ioctl", slave, termios.TIOCSPGRP, base + abi.PAGE_SIZE)

    @contextlib.contextmanager
    def _opened(self, pid: int, found: pseudo_terminals.Controlling) -> Iterator[int]:
        """A descriptor of a terminal, in a process; it may be open nowhere any more."""
        if found.slave is not None:
            yield found.slave
            return
        assert found.master is not None, "a terminal is told of by one of its ends"
        flags = os.O_RDWR | os.O_NOCTTY
        slave = self._call(pid, f"open the terminal of session {pid}", "ioctl", found.master, pseudo_terminals.TIOCGPTPEER, flags)
        yield slave
        self._call(pid, "close a terminal", "close", slave)

    def _call(self, pid: int, what: str, name: str, *arguments: int) -> int:
        result = self._try(pid, name, *arguments)
        if result < 0:
            raise RestoreError(f"cannot {what}: {os.strerror(-result)}")
        return result

    def _try(self, pid: int, name: str, *arguments: int) -> int:
        return call_table.single_call(self._born[pid], self._registers, self._instruction, stubs.SYSTEM_CALLS[name], *arguments)

    def _exit(self, pid: int, status: int) -> None:
        tracee = self._born[pid]
        number = stubs.SYSTEM_CALLS["exit_group"]
        tracee.set_registers(stubs.at_call(self._registers, self._instruction, number, (status,)))
        tracee.cont()
        _await_end(tracee)

    def _stop(self, process: ProcessState, number: int, untold: int) -> None:
        """Stop a process as it was, and have its parent hear what it had been told."""
        tracee, parent = self._born[process.pid], process.ppid
        stopped_children.stop(tracee, number or signal.SIGSTOP)
        if untold != job_control.CLD_STOPPED and parent:
            flags = os.WUNTRACED | os.WNOHANG | WALL
            self._call(parent, f"take note of the stop of {process.pid}", "wait4", process.pid, 0, flags, 0)
        if not number:
            stopped_children.go_on(tracee)

    def _end_as(self, zombie: Zombie, base: int) -> None:
        """End a process as it had ended; its parent does not ask for it before it is what it was."""
        tracee = self._born[zombie.pid]
        tracee.memory.write(base + abi.PAGE_SIZE, zombie.name.encode()[:15] + b"\0")
        self._call(zombie.pid, "set a name", "prctl", abi.PR_SET_NAME, base + abi.PAGE_SIZE)
        number = zombie.status & STOPPED_BY
        if not number:
            self._exit(zombie.pid, zombie.status >> 8)
            return
        resource.prlimit(tracee.pid, resource.RLIMIT_CORE, (0, 0))
        tracee.set_signal_mask(0)
        tracee.set_registers(self._registers)
        os.kill(tracee.pid, number)
        if number != signal.SIGKILL:  # which does not wait for us
            tracee.cont()
        _await_end(tracee)


def _await_end(tracee: Tracee) -> None:
    """Take note of the end of one that we trace: its parent hears of it afterwards. Signals on their way are let through."""
    with contextlib.suppress(ProcessGoneError, CheckpointError):
        while True:
            stop = tracee.wait(call_table.RUN_TIMEOUT_S)
            tracee.cont(stop.signal if stop.is_delivery else 0)


def _grouped(vmas: list[Vma], belongs: object) -> Iterator[tuple[memory.Object, list[Vma]]]:
    """Mappings of a kind, by what they are of."""
    assert callable(belongs)
    found = sorted(filter(belongs, vmas), key=memory.object_of)
    for key, group in groupby(found, key=memory.object_of):
        yield key, list(group)


def _places(begin: int, sizes: object) -> Iterator[int]:
    """Addresses for pieces of these sizes, one after the other."""
    assert hasattr(sizes, "__iter__")
    for size in sizes:
        yield begin
        begin += size


def first_told(views: tuple[Snapshot, ...]) -> dict[int, Resource]:
    """The resource of each open file that several processes have, or that leads from one to another."""
    found: dict[int, Resource] = {}
    for view in views:
        for held in view.resources:
            number = int(str(held.facts.get("description", 0)))
            if number and held.kind != shared_open_file.KIND:
                found.setdefault(number, held)
    return found


def _at(held: Resource, number: int) -> Resource:
    """The same, to be made at one number only; its process tells the owner of its signals, and what it watches."""
    facts = {name: fact for name, fact in held.facts.items() if name not in ("signal", "owner", "locks", "description")}
    if held.kind == epoll.KIND:
        facts["watched"] = []
    return Resource(held.kind, held.name, {**facts, "descriptors": [[number, 1]]})
