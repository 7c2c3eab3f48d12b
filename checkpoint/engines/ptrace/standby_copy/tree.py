"""The standby copy of a component of several processes: all created, each with its mappings and memory, updated together.

::

    lay        the first steps of `restore.tree`: shared memory, births, sessions, groups, ends; then each as in `single`
    advance    a delta: worked out for all before anything is done; torn from here; mappings of all, pages of all; whole again
    finish     the open files that they share; then, for each, the steps after the pages; registers of all

Open files come with the takeover, and a file that several processes share must lead to the same open file. So all processes are
created with one table of descriptors (CLONE_FILES). The first process makes the shared files there. Then every process leaves the
common table and has inherited the files, like processes that are created later.

Shared memory exists once: each process has it mapped whole beside its tables (anonymous), or it is open in the common table. Any
process may provide the content of a page of it. A part that no process holds any more is emptied for all of them.

A copy does not follow processes that were created or have ended since, nor shared memory that was added, removed or changed in
size: the copy must then be laid again.

Sources: clone(2), unshare(2) (CLONE_FILES), madvise(2) (MADV_REMOVE), fallocate(2) (FALLOC_FL_PUNCH_HOLE).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

import numpy as np
from msgspec.structs import replace

from checkpoint.engine import RestoreOptions
from checkpoint.engines.ptrace.restore import checks, memory, rights, shared_files
from checkpoint.engines.ptrace.restore.checks import Brought
from checkpoint.engines.ptrace.restore.forked_memory import Legacy
from checkpoint.engines.ptrace.restore.memory import Object
from checkpoint.engines.ptrace.restore.process import Estate
from checkpoint.engines.ptrace.restore.restore import RestoredProgram
from checkpoint.engines.ptrace.restore.tree import TreeRestore, first_told
from checkpoint.engines.ptrace.restore.vessel import look_at_vessel
from checkpoint.engines.ptrace.standby_copy.eligibility import require_covered
from checkpoint.engines.ptrace.standby_copy.mappings import MADV_REMOVE, held_of_objects
from checkpoint.engines.ptrace.standby_copy.single import ReadyCopy, ended_on_error, paths_open_in
from checkpoint.errors import MismatchError, RestoreError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.trace.call_table import AREA_SIZE, CallTable, Stub
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.model import Position, Snapshot, Vma
from checkpoint.pages import page_set, xor_delta
from checkpoint.pages.page_set import Words
from checkpoint.pages.source import PageSource
from checkpoint.pages.xor_delta import Rows
from checkpoint.resources.process import shared_with_parent
from checkpoint.resources.sockets import tcp_handover
from checkpoint.sentences import copy_outdated
from checkpoint.snapshot import process_tree
from checkpoint.store import chain

STANDARD: Final = frozenset((0, 1, 2))
PUNCH_HOLE: Final = 1 | 2
"""FALLOC_FL_KEEP_SIZE, FALLOC_FL_PUNCH_HOLE."""

SIZE_KEPT_S: Final = 5.0
"""How long a figure of its memory is believed: asking the kernel for shared memory makes it walk through all page tables."""


class MemberCopy(ReadyCopy):
    """The copy of one of them, in a vessel that was born for it."""

    _room = AREA_SIZE

    def __init__(
        self,
        tracee: Tracee,
        view: Snapshot,
        options: RestoreOptions,
        estate: Estate,
        legacy: Legacy,
        source: PageSource | None,
    ) -> None:
        super().__init__(tracee, view, options, estate, legacy, source)
        self._descriptors = {*STANDARD, *estate.objects.values()}

    @property
    def descriptors(self) -> frozenset[int]:
        """The open descriptors of the common table, as far as this one knows."""
        return frozenset(self._descriptors)

    @property
    def held_of_objects(self) -> dict[Object, Words]:
        """See `mappings.held_of_objects`."""
        return held_of_objects(self._state.vmas, self._extents)

    def lay_among(self, descriptors: Iterable[int]) -> None:
        """Map and fill everything.

        Args:
            descriptors: that are open in the common table.
        """
        self._descriptors = set(descriptors)
        self._brought = self._checked(self._state)
        self._vessel = look_at_vessel(self._tracee.pid)
        mappings = procfs.parse_maps(procfs.read_text(self._tracee.pid, "maps"))
        self._map_and_fill(tuple(line for line in mappings if not self._is_estate(line)))

    def know_open(self, descriptors: Iterable[int]) -> None:
        """Learn the descriptors that are open in the common table now."""
        self._descriptors = set(descriptors)

    def own_table(self, others: Iterable[MemberCopy]) -> None:
        """Part with the common table of descriptors, and close those that others have in it."""
        table = CallTable(self._stub.base)
        table.call("have a table of descriptors alone", "unshare", shared_with_parent.CLONE_FILES)
        for other in others:
            if other is not self and other._executable is not None:
                table.close(other._executable)
        self.notes += self._stub.run(table)

    def complete(self, view: Snapshot, options: RestoreOptions, brought: Brought, estate: Estate) -> None:
        """Everything but the registers, now that the estate has the open files."""
        self._estate, self._objects = estate, dict(estate.objects)
        own = set() if self._executable is None else {self._executable}
        open_by_now = {*STANDARD, *estate.descriptions.values(), *estate.objects.values(), *own}
        self._complete(self._prepared(view, options, brought, open_by_now))

    def _inherited(self) -> set[int]:
        return set(self._descriptors)


class FamilyCopy(TreeRestore):
    """The copy of all of them; see `ready_copy.ReadyCopy`.

    Attributes:
        position: that it stands at.
        torn: a delta was begun and not finished; nothing can be made of it any more.
    """

    _born_with = shared_with_parent.CLONE_FILES

    def __init__(self, vessel_pid: int, base: Snapshot, options: RestoreOptions) -> None:
        super().__init__(vessel_pid, base, options, tuple(Brought() for _ in base.processes))
        self._nameless = {}  # open files come with the takeover
        self._copies: list[MemberCopy] = []
        self._size, self._size_told = 0, -SIZE_KEPT_S
        self.position: Position = base.position
        self.torn = False

    @property
    def state(self) -> Snapshot:
        """The state that it stands at, without its pages."""
        return self._state

    @property
    def size(self) -> int:
        """Bytes of memory that it takes on this machine; what several of them share, once. Some seconds old at most."""
        if time.monotonic() - self._size_told >= SIZE_KEPT_S:
            self._size, self._size_told = sum(map(_share_of, self.pids())), time.monotonic()
        return self._size

    def require_clocks(self, elapsed_ns: int) -> None:
        """See `ReadyCopy.require_clocks`; all of them have the same."""
        self._copies[0].require_clocks(elapsed_ns)

    # --- The three steps ---

    def lay(self) -> None:
        """Seize the vessel, have all processes born, map and fill everything.

        Raises:
            MismatchError: this machine lacks a file that is mapped, or their pids cannot be had.
            RestoreError: it did not work; the caller kills the vessel.
        """
        self._brought = tuple(self._brought_for(view) for view in self._views)
        vessel = self._begin()
        self._estate = self._make_estate(vessel, {})
        self._bear_all(self._estate.base)
        self._copies = [
            MemberCopy(self._born[view.process.pid], view, self._options, self._estate, legacy, source)
            for view, legacy, source in zip(self._views, self._legacies, self._sources, strict=True)
        ]
        self._restoring = [*self._copies]
        self._descriptors = self._copies[0].descriptors
        for copy in self._copies:
            copy.lay_among(self._descriptors)
            self._descriptors = copy.descriptors
        for copy in self._copies:
            copy.know_open(self._descriptors)
        self._objects = _objects_of(self._views)
        self._forget_pages(self._state)

    def advance(self, delta: Snapshot) -> None:
        """Bring all of them to the position of a delta; see `ReadyCopy.advance`."""
        self._require_whole()
        chain.check_continues(self.position, delta)
        self._require_same_shape(delta)
        require_covered(delta)
        views = process_tree.views(xor_delta.resolved(delta, self._rows_at))
        self._require_same_objects(views)
        plans = [copy.planned(view) for copy, view in zip(self._copies, views, strict=True)]
        before = _joined(copy.held_of_objects for copy in self._copies)
        after = _joined(held_of_objects(plan.delta.vmas, plan.change.carried) for plan in plans)
        emptying = self._emptying(before, after)
        self.torn = True
        if emptying.calls:
            self._notes += self._stub.run(emptying)
        for copy, plan in zip(self._copies, plans, strict=True):
            copy.change_mappings(plan)
        for copy, plan in zip(self._copies, plans, strict=True):
            copy.fill(plan)
        self._forget_pages(delta)
        self.torn = False

    def finish(self, options: RestoreOptions) -> RestoredProgram:
        """Make them the program; see `ReadyCopy.finish`."""
        with ended_on_error(self, f"make {self._state.component} of its ready copy"):
            return self._finished(options)

    def _finished(self, options: RestoreOptions) -> RestoredProgram:
        self._require_whole()
        self.require_clocks(options.elapsed_ns)
        opened = paths_open_in(self._state)
        unchanged = {path for copy in self._copies for path in copy.unchanged_files(opened)}
        known = replace(options, accept_changed=(*options.accept_changed, *unchanged))
        brought = checks.require(self._state, known, *self.pids())
        arriving, state = tcp_handover.arriving(self._state, wanted=options.stood_still)
        self._options, self._brought = options, brought
        self._views, self._nameless = shared_files.made_once(process_tree.views(state))
        self.torn = True
        estate = self._open_files_made()
        for copy in self._copies:
            copy.own_table(self._copies)
        for copy, view, one in zip(self._copies, self._views, brought, strict=True):
            copy.complete(view, options, one, estate)
        for copy in self._copies:
            copy.become_program()
        arriving.connect(self.pids())
        first, *others = self.held()
        notes = (*self.notes(), *arriving.notes)
        restored = RestoredProgram(first, self.position, notes, tuple(others), arriving)
        restored.put_back(state, options)
        return restored

    def _open_files_made(self) -> Estate:
        """Have the first one make the open files that several of them share; objects move above all that these need."""
        resources = first_told(self._views)
        numbers = range(max(next(self._numbers(resources, len(self._descriptors))), max(self._descriptors) + 1), 1 << 30)
        objects = (*self._estate.objects, *self._nameless)
        estate = replace(
            self._estate,
            objects=dict(zip(objects, numbers, strict=False)),
            descriptions=dict(zip(resources, numbers[len(objects) :], strict=False)),
        )
        vessel = self._copies[0].vessel
        table = CallTable(estate.base, descriptors=set(self._descriptors))
        with rights.our_eyes(table, self._state.process, vessel, self._options):
            brought = self._open_brought(table, resources)
        self._make_nameless(table, vessel, estate, brought | dict(self._estate.objects), resources)
        if table.end - table.base > AREA_SIZE:
            raise RestoreError(f"cannot restore: files and memory that its processes share take more than {AREA_SIZE >> 20} MiB")
        self._notes += self._stub.run(table)
        return estate

    # --- Checks ---

    def _require_whole(self) -> None:
        if self.torn:
            raise RestoreError(f"the ready copy of {self._state.component} is torn: build it again from the chain")

    def _require_same_shape(self, delta: Snapshot) -> None:
        if _shape_of(delta) != _shape_of(self._state):
            raise RestoreError(copy_outdated("its processes have changed", self._state.component))

    def _require_same_objects(self, views: Sequence[Snapshot]) -> None:
        ours, theirs = self._objects, _objects_of(views)
        is_same = theirs.keys() <= ours.keys() and all(_fits(ours[key], theirs.get(key)) for key in ours)
        if not is_same:
            changed = "shared memory has come, gone, or changed in size"
            raise RestoreError(copy_outdated(changed, self._state.component))

    def _brought_for(self, view: Snapshot) -> Brought:
        reasons, run = checks.of_mapped_files(view, self._options)
        if reasons:
            raise MismatchError(f"{view.component} can have no ready copy here: {'; '.join(reasons)}", reasons)
        return Brought(run)

    # --- Memory ---

    @property
    def _stub(self) -> Stub:
        return self._copies[0].stub

    def _rows_at(self, addresses: Words) -> Rows:
        """As `ReadyCopy._rows_at`, of all of them."""
        slots = [0, *(member.slot for member in self._state.members)]
        rows = []
        for slot, copy in sorted(zip(slots, self._copies, strict=True), key=lambda pair: pair[0]):
            first, last = np.searchsorted(
                addresses, np.array([slot, slot + 1], np.uint64) << np.uint64(process_tree.SLOT_SHIFT)
            ).tolist()
            if first < last:
                rows.append(copy.rows_at(addresses[first:last] - np.uint64(process_tree.base_of(slot))))
        return np.concatenate(rows)

    def _emptying(self, before: Mapping[Object, Words], after: Mapping[Object, Words]) -> CallTable:
        """The calls by which shared memory is again as it was made, where no process holds a page of it any more."""
        table = CallTable(self._stub.base, descriptors=set(self._descriptors))
        for key, held in before.items():
            lost = page_set.difference(held, after[key]) if key in after else held
            for start, end in lost.tolist():
                what = f"empty {(end - start) >> 10} KiB of shared memory"
                if key in self._estate.anonymous:
                    table.call(what, "madvise", self._estate.anonymous[key] + start, end - start, MADV_REMOVE)
                else:
                    table.call(what, "fallocate", self._estate.objects[key], PUNCH_HOLE, start, end - start)
        return table

    def _forget_pages(self, snapshot: Snapshot) -> None:
        """Remember a snapshot without its pages, which are in the vessels now."""
        told = replace(snapshot, parent=None, cleared=(), runs=(), copies=(), differences=(), contents=b"", output=())
        self._state, self._views, self._sources, self._legacies = told, (), (), ()
        self.position = snapshot.position


def _shape_of(state: Snapshot) -> tuple[object, ...]:
    """The processes, as far as they were fixed at birth."""
    first = state.process
    members = tuple(
        (
            one.slot,
            one.exit_signal,
            (one.process.pid, one.process.ppid, one.process.pgid, one.process.sid),
            shared_with_parent.flags_of(one.resources),
        )
        for one in state.members
    )
    return (first.pid, first.pgid, first.sid), members, state.zombies


def _objects_of(views: Iterable[Snapshot]) -> dict[Object, tuple[int, int]]:
    """How long shared memory is, by object, and the mode of its file (0 where there is none, or it is not told)."""
    found: dict[Object, tuple[int, int]] = {}
    for vma in (vma for view in views for vma in view.vmas):
        if memory.is_anonymous_object(vma) or memory.is_object_mapping(vma):
            key = memory.object_of(vma)
            size, mode = _size_of(vma)
            found[key] = max(found.get(key, (0, 0))[0], size), mode
    return found


def _size_of(vma: Vma) -> tuple[int, int]:
    assert vma.file is not None
    if memory.is_anonymous_object(vma) or not vma.file.mode:
        return vma.offset + vma.size, 0
    return vma.file.size, vma.file.mode


def _fits(made: tuple[int, int], wanted: tuple[int, int] | None) -> bool:
    """Whether an object is as it was made; one without a file may be mapped in part, or nowhere."""
    if made[1]:
        return made == wanted
    return wanted is None or wanted[0] <= made[0]


def _joined(every: Iterable[Mapping[Object, Words]]) -> dict[Object, Words]:
    found: dict[Object, Words] = {}
    for one in every:
        for key, held in one.items():
            found[key] = page_set.union(found[key], held) if key in found else held
    return found


def _share_of(pid: int) -> int:
    """Bytes of memory that a process takes, and its part of what it shares. Source: proc_pid_smaps(5)."""
    fields = procfs.parse_fields(procfs.read_text(pid, "smaps_rollup"))
    return sum(int(fields.get(name, "0 kB").split()[0]) << 10 for name in ("Pss_Anon", "Pss_Shmem"))
