"""Build a snapshot from the result of a freeze, while the program runs again: refusals, resources, pages, digest."""

from __future__ import annotations

from collections.abc import Callable, Collection

from msgspec.structs import replace

from checkpoint.engine import NOTED, PTRACE, REFUSED, CaptureOrder, ProtectOrder
from checkpoint.engines.ptrace.capture import detached_memory
from checkpoint.engines.ptrace.capture.detached_memory import DetachedMemory
from checkpoint.engines.ptrace.capture.freeze_budget import FreezeBudget
from checkpoint.engines.ptrace.capture.frozen_component import Frozen, lines_of_all
from checkpoint.engines.ptrace.capture.pages import Pages, joined, with_parcel
from checkpoint.engines.ptrace.capture.process import CapturedProcess
from checkpoint.engines.ptrace.capture.standstill import NS_PER_US
from checkpoint.engines.ptrace.facts import describe
from checkpoint.engines.stream_output import Outputs
from checkpoint.errors import CaptureError
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.live_thread import told_by_spokesman
from checkpoint.model import Position, Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import PageTable, Words
from checkpoint.program import cpu_baseline
from checkpoint.resources import registry
from checkpoint.resources.carried.capture import NO_PARCEL, CarriedTrees, Parcel
from checkpoint.resources.ipc import system_v_memory
from checkpoint.resources.open_file import Surroundings
from checkpoint.resources.process import control_groups
from checkpoint.resources.survey import look
from checkpoint.segment.output_counters import Totals
from checkpoint.snapshot import credentials, format, process_tree
from checkpoint.store.base_in_process import UnreadBase
from checkpoint.store.chain import position_of


class SnapshotBuilder:
    """Builds the snapshots of one component.

    Attributes:
        totals: bytes of output at the last snapshot that was handed out.
        frozen_size: bytes of pages that the last capture copied while the program stood still.

    Invariant: ``_table`` is the state at the last snapshot that was handed out.
    """

    def __init__(
        self,
        pid: int,
        order: ProtectOrder,
        budget: FreezeBudget,
        outputs: Outputs | None,
        carried: CarriedTrees | None,
        refuse: Callable[[tuple[str, ...]], None],
        notes: tuple[str, ...],
    ) -> None:
        """
        Args:
            pid: of the first process.
            budget: is told what the freezes cost.
            carried: trees of files that the program carries; None: none.
            refuse: raises if there are reasons.
            notes: for an operator, that belong to every snapshot.
        """
        self._pid = pid
        self._component = order.component
        self.totals: Totals = (0, 0)
        self.frozen_size = 0
        self._budget = budget
        self._outputs = outputs
        self._carried = carried
        self._refuse = refuse
        self._notes = notes
        self._owner = order.terms.owner
        self._is_guarded = order.is_guarded
        self._level = cpu_baseline.level_in(told_by_spokesman(pid, lambda tid: procfs.read_bytes(tid, "environ")))
        self._table = PageTable.empty(abi.PAGE_SIZE)
        self._totals_at: dict[Position, Totals] = {}

    def forget_unneeded(self, known: Collection[Position | None]) -> None:
        """Forget the totals and carried files of positions that no delta can be relative to any more.

        Args:
            known: those that one can.
        """
        self._totals_at = {position: totals for position, totals in self._totals_at.items() if position in known}
        if self._carried:
            self._carried.keep(known)

    def built(
        self,
        order: CaptureOrder,
        parent: Position | None,
        frozen: Frozen,
        first_process: CapturedProcess,
        surroundings: Surroundings,
        detached: DetachedMemory,
    ) -> Snapshot | UnreadBase:
        """The snapshot from the result of a freeze.

        Raises:
            UnsupportedError: it cannot be kept, with the reasons.
            CaptureError: memory was shared, or unmapped, in the middle of the capture; the next one succeeds.
        """
        first, others = frozen.first, frozen.others
        totals = first.standing.totals
        held = look(first.standing.opened, surroundings)
        of_files = self._carried.reasons(frozen.seen) if self._carried else ()
        of_others = others.reasons(first) if others else ()
        family = others.pids if others else ()
        every = (*held.resources, *(others.resources() if others else ()))
        findings = registry.findings_of_all(every, surroundings, standing=True)
        of_all = tuple(found.text for found in findings if found.verdict == REFUSED)
        detaches = surroundings.detached is not None
        of_segments = system_v_memory.refuse(lines_of_all(first, others), frozen.segments, detaches=detaches)
        looks = [(first_process, first), *(others.looks() if others else ())]
        if surroundings.detached is not None and detached_memory.changed(surroundings.detached, looks):
            what = "another process has mapped shared memory of it in the middle of the capture, or it has unmapped some"
            raise CaptureError(f"cannot capture {self._component} (pid {self._pid}): {what}; capture it again")
        self._refuse((*held.reasons, *of_all, *first_process.reasons(first, family), *of_others, *of_segments, *of_files))
        parcel = self._carried.parcel(frozen.seen, parent) if self._carried else NO_PARCEL
        outline = replace(
            self._outline(order, parent, frozen, first_process, parcel),
            notes=(*self._notes, *(found.text for found in findings if found.verdict == NOTED), *detached.notes()),
            resources=(
                *first_process.known(held.resources),
                *first_process.unopened(first),
                *first_process.stopped(),
                *detached.resources(),
                *parcel.resources,
            ),
            output=self._outputs.pieces(self._output_since(parent), totals) if self._outputs else (),
        )
        outline = frozen.departing.added_to(outline)
        places = {self._pid: first_process.groups(), **(others.groups() if others else {})}
        outline = control_groups.added_to(outline, places, first.standing.status.ppid if self._is_guarded else 0)
        if self._owner is not None and (beyond := credentials.refusal(credentials.beyond(outline, self._owner), self._owner)):
            self._refuse((beyond,))
        if first.taken.unread is not None:
            self.totals = totals
            return self._unread(outline, first.taken.unread, first_process.pid)
        taken = joined(looks, is_base=parent is None)
        self.frozen_size = taken.frozen_size
        self._budget.note(frozen.freeze_us * NS_PER_US, sum(look.taken.copy_ns for _, look in looks), taken.frozen_size)
        snapshot = self._with_pages(outline, with_parcel(taken, parcel, is_base=parent is None))
        packed = format.encoded_state(snapshot)
        snapshot = replace(snapshot, position=position_of(snapshot, order.generation, order.sequence, packed))
        for process, _ in looks:
            process.settle(snapshot.position)
        if self._carried:
            self._carried.settle(snapshot.position)
        self._totals_at[snapshot.position] = self.totals = totals
        return snapshot

    def _unread(self, outline: Snapshot, unread: Words, pid: int) -> UnreadBase:
        """The base whose pages are where they were; those that are zero are carried, for to look for them is to read all."""
        self.frozen_size = page_set.total_size(unread)
        return UnreadBase(
            replace(outline, runs=page_set.page_runs(unread), page_sum=page_set.EMPTY_SUM),
            lambda piece, buffer: Memory(pid).read_pages_into(piece, buffer),
        )

    def _output_since(self, parent: Position | None) -> Totals:
        """Where a snapshot's output begins: a base may go to a robot that has nothing yet."""
        return self._totals_at.get(parent, (0, 0)) if parent else (0, 0)

    def _outline(
        self, order: CaptureOrder, parent: Position | None, frozen: Frozen, first_process: CapturedProcess, parcel: Parcel
    ) -> Snapshot:
        """A snapshot without pages, descriptors and output."""
        first, others = frozen.first, frozen.others
        masks, here = first.xstate_mask | (others.xstate_mask if others else 0), describe.this_machine()
        mappings = first_process.mappings(first, others.pids if others else frozenset())
        return Snapshot(
            component=self._component,
            engine=PTRACE,
            position=Position(order.generation, order.sequence, bytes(16)),
            parent=parent,
            machine=replace(
                here,
                robot=order.robot,
                xstate_mask=masks,
                features=cpu_baseline.features_used(here.features, self._level),
            ),
            clocks=first.standing.told.clocks,
            process=first_process.process(first),
            threads=first_process.thread_states(first),
            vmas=mappings if not parcel.vmas else (*mappings, *parcel.vmas),
            epoch=order.epoch,
            freeze_us=frozen.freeze_us,
            members=others.members(first) if others else (),
            zombies=others.zombies(first) if others else (),
        )

    def _with_pages(self, outline: Snapshot, taken: Pages) -> Snapshot:
        """Add the pages: zero pages of anonymous memory are told, not carried."""
        before = PageTable.empty(abi.PAGE_SIZE) if outline.parent is None else self._table
        self._table = before.apply(taken.forgotten, taken.runs, taken.contents, process_tree.every_mapping(outline), taken.copies)
        return replace(
            outline,
            cleared=taken.forgotten,
            runs=taken.runs,
            contents=taken.contents,
            copies=taken.copies,
            page_sum=self._table.page_sum,
        )
