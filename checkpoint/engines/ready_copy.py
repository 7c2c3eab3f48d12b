"""The ready copy: a vessel that has a program's mappings and memory already, kept current delta by delta.

::

    lay        a base: the vessel is seized, everything is mapped and filled; there it stands still
    advance    a delta, verified whole before: it is torn from here; mappings, then pages; whole again
    finish     descriptors, threads, timers, rights, registers, as in any restore: nothing that grows with memory

Nothing of the program runs before `RestoredProgram.resume`: the vessel stands in a stop of ours, and dies with us
(PTRACE_O_EXITKILL), so that what was cut off in the middle of a delta is not left behind. An error in the middle leaves it
*torn*, and all further use is refused: it is to be ended, and laid again from the chain.

Nothing is folded: each position of a store was proved when it was stored. Pages go from the decoded snapshot into the vessel.

What is not covered (`hindrances`) comes back from its chain, as ever.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Final

from checkpoint import carried, chain, differences, pages, room
from checkpoint.differences import Rows
from checkpoint.engine import RestoreOptions, pid_taken
from checkpoint.engines import restore_checks, restore_kinds, restore_memory, restore_process, restore_vdso
from checkpoint.engines.copy_mappings import Change
from checkpoint.engines.ptrace_restore import RSEQ_SECTION_OFFSET, ProcessRestore, RestoredProgram, look_at_vessel, options_for
from checkpoint.engines.restore_checks import Brought
from checkpoint.errors import ChainError, CheckpointError, MismatchError, RestoreError, UnsupportedError
from checkpoint.linux import procfs, vm_flags
from checkpoint.linux.abi import PAGE_SIZE, PROT_WRITE
from checkpoint.linux.call_table import AREA_SIZE, CallTable
from checkpoint.linux.tracee import Tracee
from checkpoint.model import Fact, Position, Snapshot, ThreadState, Vma
from checkpoint.pages import Words
from checkpoint.resources import aio_rings, carried_connections, departed, seccomp, system_v_memory, untouched
from checkpoint.resources.rebuilding import number_of

ROOM: Final = 16 << 20
"""Bytes of address space for all tables to come: some 100,000 calls. Only what is used takes memory."""

TIME_NAMESPACE: Final = "/proc/self/ns/time"
"""There is none on a kernel without CONFIG_TIME_NS."""

SHARE: Final = 2
"""What is free must hold a copy so many times."""

AHEAD_NS: Final = 60_000_000_000
"""How far the clocks of a copy may be ahead of where the program's have got to, before it is laid again: nobody knows how long a
checkpoint was on its way."""


def hindrances(state: Snapshot) -> Iterator[str]:
    """Why a program can have no ready copy, one sentence each: others would see what is made, or it is not covered yet."""
    if state.is_tree:
        yield "it has several processes"
        return
    if carried.without(state) is not state:
        yield "files travel with it"
    for vma in state.vmas:
        named = vma.file.path if vma.file is not None else vma.name or "memory"
        if system_v_memory.is_segment(vma):
            yield "it has System V shared memory"
        elif aio_rings.is_ring(vma):
            yield "it has rings of asynchronous I/O"
        elif vma.shared and vma.file is not None and not _is_only_read(vma):
            yield f"it maps {named} shared"
        elif restore_kinds.is_special(vma):
            yield f"it has huge or droppable pages ({named})"
    if departed.of(state.resources, state.process.working_directory):
        yield "it holds what is left of processes that have ended"
    if len(untouched.of(state.resources)):
        yield "it has memory that must stay untouched until it is used"
    if restore_kinds.keys_of(state):
        yield "it uses protection keys"


def _is_only_read(vma: Vma) -> bool:
    """Whether it is a mapping of a file with a name that nobody can write through: the C library has such ones."""
    return restore_memory.is_file_mapping(vma) and not vma.protection & PROT_WRITE and vm_flags.MAY_WRITE not in vma.flags


def require_covered(state: Snapshot) -> None:
    """Refuse a program that can have no ready copy.

    Raises:
        UnsupportedError: with the reasons.
    """
    if reasons := tuple(dict.fromkeys(hindrances(state))):
        raise UnsupportedError(f"{state.component} can have no ready copy: {'; '.join(reasons)}", reasons)


def require_room(base: Snapshot) -> None:
    """Refuse a copy that takes more than its share of what is free: what runs here needs room more than what may have to.

    Raises:
        UnsupportedError: with the reason.
    """
    size, free = pages.total_size(pages.extents(base.runs)), room.free()
    if SHARE * size > free:
        reason = f"it holds {size / room.GB:.2f} GB, more than half of the {free / room.GB:.2f} GB that this machine has free"
        raise UnsupportedError(f"{base.component} can have no ready copy here: {reason}", (reason,))


def lay(vessel_pid: int, base: Snapshot, options: RestoreOptions) -> ReadyCopy:
    """Map and fill everything of a base in a vessel, and leave it standing there.

    Raises:
        UnsupportedError: the program can have no ready copy, or this machine has no room for it.
        MismatchError: this machine lacks a file that is mapped.
        RestoreError: it did not work; the caller kills the vessel.
    """
    require_covered(base)
    require_room(base)
    copy = ReadyCopy(Tracee(vessel_pid), base, options)
    try:
        copy.lay()
    except RestoreError:
        copy.end()
        raise
    except CheckpointError as error:
        copy.end()
        raise RestoreError(f"cannot lay a ready copy of {base.component} in pid {vessel_pid}: {error}") from error
    except BaseException:
        copy.end()
        raise
    return copy


class ReadyCopy(ProcessRestore):
    """The copy of one process. Every call comes from the thread that laid it, which traces it.

    Attributes:
        position: that it stands at.
        torn: a delta was begun and not finished; nothing can be made of it any more.
    """

    def __init__(self, tracee: Tracee, base: Snapshot, options: RestoreOptions) -> None:
        super().__init__(tracee, base, options, Brought())
        self.position: Position = base.position
        self.torn = False
        self._extents = pages.extents(base.runs)
        self._sections: dict[int, bytes] = {}
        self._known: dict[str, tuple[int, ...]] = {}

    @property
    def state(self) -> Snapshot:
        """What it stands at, without its pages."""
        return self._state

    @property
    def size(self) -> int:
        """Bytes of memory that it takes on this machine."""
        fields = procfs.parse_fields(procfs.read_text(self._tracee.pid, "status"))
        return sum(int(fields.get(name, "0 kB").split()[0]) << 10 for name in ("RssAnon", "RssShmem"))

    # --- The three steps ---

    def lay(self) -> None:
        """Seize the vessel, map and fill everything."""
        self._brought = self._checked(self._state)
        self.prepare()
        self._vessel = vessel = look_at_vessel(self._tracee.pid)
        if vessel.inner_pid != self._state.process.pid:
            raise pid_taken(self._state.process.pid)
        if not vessel.may_choose_executable:
            self._execute_program()
        self._own_xstate = self._tracee.xstate()
        self._start_registers = self._tracee.registers()
        mappings = procfs.parse_maps(procfs.read_text(self._tracee.pid, "maps"))
        if not restore_vdso.fits(self._state, restore_memory.kernel_pages(mappings)):
            reason = "it comes from another kernel, whose vdso differs"
            raise UnsupportedError(f"{self._state.component} can have no ready copy: {reason}", (reason,))
        base = self._choose_place(mappings)
        first = self._mappings_table(CallTable(base, descriptors=self._inherited()), vessel, mappings, base + AREA_SIZE)
        self._check_room(first)
        self._lay_stub(base, mappings, ROOM)
        self._lay_out(first)
        self._descriptors = set(first.descriptors)
        self._forget_pages(self._state)

    def advance(self, delta: Snapshot) -> None:
        """Bring it to the position of a delta, all of it or nothing that could be used.

        Args:
            delta: decoded, and so verified whole.

        Raises:
            ChainError: it does not continue this position; nothing was changed.
            UnsupportedError: the program can have no ready copy any more; nothing was changed.
            MismatchError: this machine lacks a file that is mapped now; nothing was changed.
            RestoreError: it must be laid again; `torn` says whether it was changed.
        """
        self._require_whole()
        chain.check_continues(self.position, delta)
        require_covered(delta)
        self._require_same_birth(delta)
        delta = differences.resolved(delta, self._rows_at)
        change = Change.between(self._state.vmas, self._extents, delta)
        brought = self._checked(replace(delta, vmas=tuple(change.fresh_files()))) if change.fresh_files() else Brought()
        table = CallTable(self._stub.base, descriptors=set(self._descriptors))
        run = self._open_with_our_rights(table, brought)
        change.add_calls(table, run)
        for descriptor in run.values():
            table.close(descriptor)
        self._check_room(table)
        rescued = change.rescued(self._tracee.memory)
        self.torn = True
        if table.calls:
            self.notes += self._stub.run(table)
        for extents, content in rescued:
            ranges = extents.copy()
            ranges[:, 1] -= ranges[:, 0]
            self._tracee.memory.write_from(ranges, content)
        restore_memory.fill(self._tracee.memory, delta)
        self._descriptors = set(table.descriptors)
        self._extents = change.carried
        self._forget_pages(delta)
        self.torn = False

    def finish(self, options: RestoreOptions) -> RestoredProgram:
        """Make it the program; it stands still until `RestoredProgram.resume`.

        Raises:
            MismatchError: this machine lacks something.
            RestoreError: it did not work; the caller kills the vessel, and restores from the chain.
        """
        try:
            return self._finished(options)
        except RestoreError:
            self.end()
            raise
        except CheckpointError as error:
            self.end()
            raise RestoreError(f"cannot make {self._state.component} of its ready copy: {error}") from error
        except BaseException:
            self.end()
            raise

    def _finished(self, options: RestoreOptions) -> RestoredProgram:
        self._require_whole()
        self.require_clocks(options.elapsed_ns)
        self._options = options
        known = replace(options, accept_changed=(*options.accept_changed, *self._unchanged_files()))
        (self._brought,) = restore_checks.require(self._state, known, self._tracee.pid)
        arriving, self._state = carried_connections.arriving(self._state, wanted=options.stood_still)
        self._thread = self._state.threads[0]
        self._remember_sections()
        later = self._later_tables(self._stub.base, set(self._descriptors), self._vessel)
        self._check_room(*later.all)
        self.torn = True
        self._complete(later)
        self.become_program()
        arriving.connect([self._tracee.pid])
        notes = (*self.notes, *arriving.notes)
        return RestoredProgram(self.held(), self.position, tuple(notes), arriving=arriving)

    # --- What differs from a restore at once ---

    def _carried(self) -> Words:
        return self._extents

    def _make_directories(self, table: CallTable) -> None:
        """Not before the takeover: they are seen."""

    def _state_table(self, table: CallTable, vessel: restore_process.Vessel) -> CallTable:
        lacking = {path: content for path, content in self._brought.opened.items() if not self._is_open(path)}
        self._open_with_our_rights(table, Brought(opened=lacking))
        super()._make_directories(table)
        return super()._state_table(table, vessel)

    def _content_at(self, address: int, size: int) -> bytes | None:
        return self._sections.get(address)

    # --- Checks ---

    def _require_whole(self) -> None:
        if self.torn:
            raise RestoreError(f"the ready copy of {self._state.component} is torn: lay it again from the chain")

    def _require_same_birth(self, delta: Snapshot) -> None:
        """What was fixed when the vessel was born and laid out."""
        ours, theirs = self._state, delta
        fixed = (
            ("its pid", ours.process.pid == theirs.process.pid),
            ("its user", ours.process.credentials == theirs.process.credentials),
            ("its executable", ours.process.executable.path == theirs.process.executable.path),
            ("its kernel", ours.machine.vdso_digest == theirs.machine.vdso_digest),
            ("its vdso", restore_memory.kernel_pages_of(ours.vmas) == restore_memory.kernel_pages_of(theirs.vmas)),
            ("its confinement", options_for(ours) == options_for(theirs)),
            ("the place of our stub", not self._overlaps_stub(theirs)),
        )
        if changed := ", ".join(what for what, is_same in fixed if not is_same):
            raise RestoreError(f"the ready copy of {ours.component} must be laid again: changed are {changed}")

    def _overlaps_stub(self, state: Snapshot) -> bool:
        start, end = self._stub.base, self._stub.base + ROOM
        return any(vma.start < end and start < vma.end for vma in state.vmas)

    def require_clocks(self, elapsed_ns: int) -> None:
        """Refuse a copy whose clocks would not go on from the program's: a time namespace's offsets are those of its birth.

        Args:
            elapsed_ns: time since the snapshot was taken that it stands at, as far as known.

        Raises:
            RestoreError: it must be laid again.
        """
        off_ns = self._clocks_ahead_ns(elapsed_ns)
        if off_ns is not None and (off_ns + elapsed_ns < 0 or off_ns > AHEAD_NS):
            where = f"{off_ns / 1e9:.1f} s ahead" if off_ns > 0 else f"{-off_ns / 1e9:.1f} s behind"
            raise RestoreError(f"the ready copy of {self._state.component} must be laid again: its clocks are {where}")

    def _clocks_ahead_ns(self, elapsed_ns: int) -> int | None:
        """How far its monotonic time is ahead of the program's; None where it has this machine's, for nothing can be set then."""
        pid = self._tracee.pid
        if not os.path.lexists(TIME_NAMESPACE) or procfs.read_link(pid, "ns/time") == os.readlink(TIME_NAMESPACE):
            return None
        ahead_of_ours_ns = _monotonic_offset_ns(pid) - _monotonic_offset_ns(os.getpid())
        return ahead_of_ours_ns + time.clock_gettime_ns(time.CLOCK_MONOTONIC) - self._state.clocks.monotonic_ns - elapsed_ns

    def _check_room(self, *tables: CallTable) -> None:
        if any(table.end - table.base > ROOM for table in tables):
            raise RestoreError(f"a ready copy has room for {ROOM >> 20} MiB of calls, and {self._state.component} needs more")

    # --- Files ---

    def _checked(self, state: Snapshot) -> Brought:
        """Where what is mapped comes from; remembers how the files looked.

        Raises:
            MismatchError: this machine lacks some.
        """
        reasons, run = restore_checks.of_mapped_files(state, self._options)
        if reasons:
            raise MismatchError(f"{state.component} can have no ready copy here: {'; '.join(reasons)}", reasons)
        for path in {state.process.executable.path, *(vma.file.path for vma in state.vmas if vma.file is not None)} - set(run):
            if key := _look_of(path):
                self._known[path] = key
        return Brought(run)

    def _unchanged_files(self) -> Iterator[str]:
        """Files that were compared when they were mapped, and look as they did then; none that is open besides."""
        opened = {held.facts.get("path") for held in self._state.resources}
        for path, key in self._known.items():
            if path not in opened and _look_of(path) == key:
                yield path

    def _open_with_our_rights(self, table: CallTable, brought: Brought) -> dict[str, int]:
        """Open what was brought along, in a place of ours, though the vessel may look with its user's eyes already."""
        if not brought.run and not brought.opened:
            return {}
        self._brought, ours = brought, self._vessel.credentials
        if self._options.own_eyes:
            table.attempt("", "setfsuid", ours.uids[3])
            table.attempt("", "setfsgid", ours.gids[3])
        run = self._open_brought(table)
        if self._options.own_eyes:
            restore_process.own_eyes(table, self._state.process, self._vessel)
        return run

    def _is_open(self, path: str) -> bool:
        return any(held.facts.get("path") == path and _object_of(held.facts) in self._objects for held in self._state.resources)

    # --- What is kept of the program ---

    def _rows_at(self, addresses: Words) -> Rows:
        """What it holds at these addresses.

        Raises:
            ChainError: there is no page.
        """
        if not pages.covered(self._extents, addresses).all():
            raise ChainError(f"a delta of {self._state.component} tells a difference from a page that its parent does not hold")
        held = self._tracee.memory.read_pages(pages.extents_of_addresses(addresses, PAGE_SIZE))
        return differences.rows_of(held, PAGE_SIZE)

    def _forget_pages(self, snapshot: Snapshot) -> None:
        """Remember a snapshot without its pages, which are in the vessel now."""
        self._state = replace(snapshot, parent=None, cleared=(), runs=(), differences=(), contents=b"", output=())
        self._thread: ThreadState = self._state.threads[0]
        self._filters_of_all = seccomp.of_all(self._state.resources, [thread.tid for thread in self._state.threads])
        self.position = snapshot.position

    def _remember_sections(self) -> None:
        """What registering rseq will forget: the critical sections in which threads stand."""
        self._sections.clear()
        for thread in self._state.threads:
            if thread.rseq is not None:
                place = thread.rseq.address + RSEQ_SECTION_OFFSET
                self._sections[place] = self._tracee.memory.read(place, 8)


def _monotonic_offset_ns(pid: int) -> int:
    """How far a process's monotonic time is ahead of the machine's. Source: time_namespaces(7)."""
    rows = map(str.split, procfs.read_text(pid, "timens_offsets").splitlines())
    return next(int(seconds) * 1_000_000_000 + int(rest) for name, seconds, rest in rows if name == "monotonic")


def _look_of(path: str) -> tuple[int, ...]:
    """What changes with a file's content; nothing where it is not there."""
    try:
        about = os.stat(path)
    except OSError:
        return ()
    return about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns


def _object_of(facts: Mapping[str, Fact]) -> tuple[int, int]:
    return number_of(facts.get("device", 0)), number_of(facts.get("inode", 0))
