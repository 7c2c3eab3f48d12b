"""The standby copy of one process: a vessel that already has the program's mappings and memory, updated by each delta.

::

    lay        a base: the vessel is seized, everything is mapped and filled; there it stands still
    advance    a delta, verified whole before: it is torn from here; mappings, then pages; whole again
    finish     descriptors, threads, timers, rights, registers, as in any restore: no step grows with the memory

No code of the program runs before `RestoredProgram.resume`: the vessel is in a ptrace stop of the tracer and dies with it
(PTRACE_O_EXITKILL), so that a copy that was interrupted in the middle of a delta does not remain. An error in the middle leaves
the copy *torn*, and it refuses all further use: the user must end it and lay it again from the chain.

The copy folds nothing: each position of a store was verified when it was stored. Pages go from the decoded snapshot into the
vessel.

Programs that are not covered (`checkpoint.engines.ptrace.standby_copy.eligibility`) are restored from their chain, as usual.
"""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Container, Iterator, Mapping
from contextlib import contextmanager
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from checkpoint.engine import Copy, RestoreOptions, pid_taken
from checkpoint.engines.ptrace.restore import checks, memory, rights, vdso
from checkpoint.engines.ptrace.restore.checks import Brought
from checkpoint.engines.ptrace.restore.forked_memory import Legacy
from checkpoint.engines.ptrace.restore.memory import NOTHING_PRESENT, Present
from checkpoint.engines.ptrace.restore.process import RSEQ_SECTION_OFFSET, Estate, LaterTables, ProcessRestore, options_for
from checkpoint.engines.ptrace.restore.restore import RestoredProgram
from checkpoint.engines.ptrace.restore.vessel import Vessel, look_at_vessel
from checkpoint.engines.ptrace.standby_copy.eligibility import require_covered
from checkpoint.engines.ptrace.standby_copy.mappings import Change
from checkpoint.errors import ChainError, CheckpointError, MismatchError, RestoreError, UnsupportedError
from checkpoint.linux.abi import PAGE_SIZE
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.call_table import AREA_SIZE, CallTable, Stub
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.model import Fact, Position, Snapshot, ThreadState
from checkpoint.pages import page_set, xor_delta
from checkpoint.pages.page_set import Words
from checkpoint.pages.source import PageSource
from checkpoint.pages.xor_delta import Rows
from checkpoint.resources.process import seccomp
from checkpoint.resources.restore_context import number_of
from checkpoint.resources.sockets import tcp_handover
from checkpoint.sentences import copy_outdated
from checkpoint.store import chain

ROOM: Final = 16 << 20
"""Bytes of address space for all tables to come: some 100,000 calls. Only what is used takes memory."""

TIME_NAMESPACE: Final = "/proc/self/ns/time"
"""There is none on a kernel without CONFIG_TIME_NS."""

AHEAD_NS: Final = 60_000_000_000
"""How far the clocks of a copy may be ahead of where the program's have got to, before it is laid again: it is not known how long
a checkpoint was on its way."""


@contextmanager
def ended_on_error(copy: Copy, what: str) -> Iterator[None]:
    """End a copy with which something goes wrong.

    Raises:
        RestoreError, MismatchError, UnsupportedError: as they come; all else that can go wrong as a RestoreError.
    """
    try:
        yield
    except (RestoreError, UnsupportedError):
        copy.end()
        raise
    except CheckpointError as error:
        copy.end()
        raise RestoreError(f"cannot {what}: {error}") from error
    except BaseException:
        copy.end()
        raise


class Plan(Struct, frozen=True):
    """The changes of a delta to the copy of one process, worked out before any of them is made.

    Attributes:
        delta: tells its pages whole.
        rescued: pages that keep their content although they are mapped afresh, and that content.
    """

    delta: Snapshot
    change: Change
    table: CallTable
    rescued: tuple[tuple[Words, bytearray], ...]


class ReadyCopy(ProcessRestore):
    """The copy of one process. Every call comes from the thread that laid it, which traces it.

    Attributes:
        position: that it stands at.
        torn: a delta was begun and not finished; nothing can be made of it any more.
    """

    _room = ROOM

    def __init__(
        self,
        tracee: Tracee,
        base: Snapshot,
        options: RestoreOptions,
        estate: Estate | None = None,
        legacy: Legacy = memory.NOTHING,
        source: PageSource | None = None,
    ) -> None:
        super().__init__(tracee, base, options, Brought(), estate, legacy, source)
        self.position: Position = base.position
        self.torn = False
        self._extents, self._stiff = page_set.extents(base.runs), legacy.kept
        self._sections: dict[int, bytes] = {}
        self._known: dict[str, tuple[int, ...]] = {}

    @property
    def state(self) -> Snapshot:
        """The state that it stands at, without its pages."""
        return self._state

    @property
    def stub(self) -> Stub:
        """From which its calls are made."""
        return self._stub

    @property
    def vessel(self) -> Vessel:
        """The state with which it was laid."""
        return self._vessel

    @property
    def size(self) -> int:
        """Bytes of memory that it takes on this machine."""
        return sum(procfs.sizes_in(procfs.read_bytes(self._tracee.pid, "status"), "RssAnon", "RssShmem"))

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
        self._map_and_fill(procfs.parse_maps(procfs.read_text(self._tracee.pid, "maps")))

    def _map_and_fill(self, mappings: tuple[procfs.MapsLine, ...]) -> None:
        """All of it, in a vessel that stands still.

        Args:
            mappings: that the vessel has of its own.
        """
        self._own_xstate = self._tracee.xstate()
        self._start_registers = self._tracee.registers()
        if not vdso.fits(self._state, memory.kernel_pages(mappings)):
            reason = "it comes from another kernel, whose vdso differs"
            raise UnsupportedError(f"{self._state.component} can have no ready copy: {reason}", (reason,))
        base = self._choose_place(mappings)
        first = self._mappings_table(CallTable(base, descriptors=self._inherited()), self._vessel, mappings, base + AREA_SIZE)
        self._check_room(first)
        self._lay_stub(base, mappings, self._room)
        self._lay_out(first)
        self._source = None
        self._descriptors = first.descriptors
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
        if delta.is_tree:
            raise RestoreError(copy_outdated("it has several processes by now", delta.component))
        require_covered(delta)
        plan = self.planned(xor_delta.resolved(delta, self.rows_at))
        self.torn = True
        self.change_mappings(plan)
        self.fill(plan)
        self.torn = False

    def planned(self, delta: Snapshot) -> Plan:
        """The changes of a delta to it; none is made yet.

        Args:
            delta: of this process, and tells its pages whole.

        Raises:
            MismatchError: this machine lacks a file that is mapped now.
            RestoreError: it must be laid again.
        """
        self._require_same_birth(delta)
        change = Change.between(self._state.vmas, self._extents, delta, self._stiff)
        brought = self._checked(replace(delta, vmas=tuple(change.fresh_files()))) if change.fresh_files() else Brought()
        table = CallTable(self._stub.base, descriptors=set(self._descriptors))
        run = self._open_with_our_rights(table, brought)
        present = Present(self._estate.objects, self._estate.anonymous) if self._estate else NOTHING_PRESENT
        change.add_calls(table, run, present)
        for descriptor in run.values():
            table.close(descriptor)
        self._check_room(table)
        return Plan(delta, change, table, tuple(change.rescued(self._tracee.memory)))

    def change_mappings(self, plan: Plan) -> None:
        """The first half of a plan."""
        if plan.table.calls:
            self.notes += self._stub.run(plan.table)

    def fill(self, plan: Plan) -> None:
        """The other half."""
        for extents, content in plan.rescued:
            self._tracee.memory.write_pages_from(extents, content)
        memory.fill(self._tracee.memory, plan.delta)
        self._descriptors = plan.table.descriptors
        self._extents, self._stiff = plan.change.carried, plan.change.stiff
        self._forget_pages(plan.delta)

    def finish(self, options: RestoreOptions) -> RestoredProgram:
        """Make it the program; it stands still until `RestoredProgram.resume`.

        Raises:
            MismatchError: this machine lacks something.
            RestoreError: it did not work; the caller kills the vessel, and restores from the chain.
        """
        with ended_on_error(self, f"make {self._state.component} of its ready copy"):
            return self._finished(options)

    def _finished(self, options: RestoreOptions) -> RestoredProgram:
        self._require_whole()
        self.require_clocks(options.elapsed_ns)
        known = replace(options, accept_changed=(*options.accept_changed, *self.unchanged_files(paths_open_in(self._state))))
        (brought,) = checks.require(self._state, known, self._tracee.pid)
        arriving, state = tcp_handover.arriving(self._state, wanted=options.stood_still)
        later = self._prepared(state, options, brought, set(self._descriptors))
        self.torn = True
        self._complete(later)
        self.become_program()
        arriving.connect([self._tracee.pid])
        notes = (*self.notes, *arriving.notes)
        restored = RestoredProgram(self.held(), self.position, tuple(notes), arriving=arriving)
        restored.put_back(state, options)
        return restored

    def _prepared(self, state: Snapshot, options: RestoreOptions, brought: Brought, descriptors: set[int]) -> LaterTables:
        """Everything that comes after the pages, of which nothing is done yet.

        Args:
            descriptors: that are open by then.
        """
        self._options, self._brought, self._state = options, brought, state
        self._thread = state.threads[0]
        self._remember_sections()
        later = self._later_tables(self._stub.base, descriptors, self._vessel)
        self._check_room(*later.all)
        return later

    # --- What differs from a restore at once ---

    def _carried(self) -> Words:
        return self._extents

    def _make_directories(self, table: CallTable) -> None:
        """Not before the takeover: they are seen."""

    def _state_table(self, table: CallTable, vessel: Vessel) -> CallTable:
        lacking = {path: content for path, content in self._brought.opened.items() if not self._is_open(path)}
        self._open_with_our_rights(table, Brought(opened=lacking))
        super()._make_directories(table)
        return super()._state_table(table, vessel)

    def _content_at(self, address: int, size: int) -> bytes | None:
        return self._sections.get(address)

    # --- Checks ---

    def _require_whole(self) -> None:
        if self.torn:
            raise RestoreError(f"the ready copy of {self._state.component} is torn: build it again from the chain")

    def _require_same_birth(self, delta: Snapshot) -> None:
        """The facts that were fixed when the vessel was born and laid out."""
        ours, theirs = self._state, delta
        fixed = (
            ("its pid", ours.process.pid == theirs.process.pid),
            ("its user", ours.process.credentials == theirs.process.credentials),
            ("its executable", ours.process.executable.path == theirs.process.executable.path),
            ("its kernel", ours.machine.vdso_digest == theirs.machine.vdso_digest),
            ("its vdso", memory.kernel_pages_of(ours.vmas) == memory.kernel_pages_of(theirs.vmas)),
            ("its confinement", options_for(ours) == options_for(theirs)),
            ("the address of failover's stub", not self._overlaps_stub(theirs)),
        )
        if changed := ", ".join(what for what, is_same in fixed if not is_same):
            raise RestoreError(copy_outdated(f"these have changed: {changed}", ours.component))

    def _overlaps_stub(self, state: Snapshot) -> bool:
        start, end = self._stub.base, self._stub.base + self._area_size
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
            raise RestoreError(copy_outdated(f"its clocks are {where}", self._state.component))

    def _clocks_ahead_ns(self, elapsed_ns: int) -> int | None:
        """How far its monotonic time is ahead of the program's; None where it has this machine's, for nothing can be set then."""
        ahead_of_ours_ns = self._ahead_of_ours_ns
        if ahead_of_ours_ns is None:
            return None
        return ahead_of_ours_ns + time.clock_gettime_ns(time.CLOCK_MONOTONIC) - self._state.clocks.monotonic_ns - elapsed_ns

    @functools.cached_property
    def _ahead_of_ours_ns(self) -> int | None:
        """How far its monotonic time is ahead of ours, as at its birth (see `require_clocks`); None where both are the same."""
        pid = self._tracee.pid
        if not os.path.lexists(TIME_NAMESPACE) or procfs.read_link(pid, "ns/time") == os.readlink(TIME_NAMESPACE):
            return None
        return _monotonic_offset_ns(pid) - _monotonic_offset_ns(os.getpid())

    def _check_room(self, *tables: CallTable) -> None:
        if any(table.end - table.base > self._room for table in tables):
            raise RestoreError(f"a ready copy has room for {self._room >> 20} MiB of calls, {self._state.component} needs more")

    # --- Files ---

    def _checked(self, state: Snapshot) -> Brought:
        """The files that its mappings come from; remembers how they looked.

        Raises:
            MismatchError: this machine lacks some.
        """
        reasons, run = checks.of_mapped_files(state, self._options)
        if reasons:
            raise MismatchError(f"{state.component} can have no ready copy here: {'; '.join(reasons)}", reasons)
        for path in {state.process.executable.path, *(vma.file.path for vma in state.vmas if vma.file is not None)} - set(run):
            if key := _look_of(path):
                self._known[path] = key
        return Brought(run)

    def unchanged_files(self, opened: Container[str]) -> tuple[str, ...]:
        """Files that were compared when they were mapped, and look as they did then.

        Args:
            opened: paths of those that are open besides, which are compared again.
        """
        return tuple(path for path, key in self._known.items() if path not in opened and _look_of(path) == key)

    def _open_with_our_rights(self, table: CallTable, brought: Brought) -> dict[str, int]:
        """Open files that were brought along, in a place of ours; the vessel may have its user's rights already."""
        if not brought.run and not brought.opened:
            return {}
        self._brought = brought
        with rights.our_eyes(table, self._state.process, self._vessel, self._options):
            return self._open_brought(table)

    def _is_open(self, path: str) -> bool:
        return any(held.facts.get("path") == path and _object_of(held.facts) in self._objects for held in self._state.resources)

    # --- Parts of the program that are kept ---

    def rows_at(self, addresses: Words) -> Rows:
        """Its bytes at these addresses.

        Raises:
            ChainError: there is no page.
        """
        if not page_set.covered(self._extents, addresses).all():
            raise ChainError(f"a delta of {self._state.component} tells a difference from a page that its parent does not hold")
        held = self._tracee.memory.read_pages(page_set.extents_of_addresses(addresses, PAGE_SIZE))
        return xor_delta.rows_of(held, PAGE_SIZE)

    def _forget_pages(self, snapshot: Snapshot) -> None:
        """Remember a snapshot without its pages, which are in the vessel now."""
        self._state = replace(snapshot, parent=None, cleared=(), runs=(), differences=(), contents=b"", output=())
        self._thread: ThreadState = self._state.threads[0]
        self._filters_of_all = seccomp.of_all(self._state.resources, [thread.tid for thread in self._state.threads])
        self.position = snapshot.position

    def _remember_sections(self) -> None:
        """Remember the critical sections in which threads stand, because registering rseq clears them."""
        self._sections.clear()
        for thread in self._state.threads:
            if thread.rseq is not None:
                place = thread.rseq.address + RSEQ_SECTION_OFFSET
                self._sections[place] = self._tracee.memory.read(place, 8)


def paths_open_in(state: Snapshot) -> frozenset[str]:
    """The names of the files that any of its processes has open."""
    return frozenset(str(held.facts.get("path", "")) for one in state.processes for held in one.resources)


def _monotonic_offset_ns(pid: int) -> int:
    """How far a process's monotonic time is ahead of the machine's. Source: time_namespaces(7)."""
    rows = map(str.split, procfs.read_text(pid, "timens_offsets").splitlines())
    return next(int(seconds) * 1_000_000_000 + int(rest) for name, seconds, rest in rows if name == "monotonic")


def _look_of(path: str) -> tuple[int, ...]:
    """Facts that change with a file's content; () where it is not there."""
    try:
        about = os.stat(path)
    except OSError:
        return ()
    return about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns


def _object_of(facts: Mapping[str, Fact]) -> tuple[int, int]:
    return number_of(facts.get("device", 0)), number_of(facts.get("inode", 0))
