"""Capture by ptrace: one protected process, from `PtraceSession.open` to `PtraceSession.close`.

One capture::

    copy         what is much, while it runs (`capture_memory`)                   the program runs
    freeze       stop its threads; registers, mask, pending signals                        it stands still
    scan, copy   which pages were written since, and their bytes
    ask          a batch of system calls inside it (`standing`); descriptors; output counts
    thaw         everything as it was
    describe     zero pages dropped, digests, files identified, refusals          it runs

What is copied while it runs is copied again if it is written meanwhile, so that a freeze does not grow with the memory's size,
nor, as long as we copy faster than the program writes, with the time since the last one.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import operator
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from checkpoint import pages, portable
from checkpoint.arch import x86_64_xstate
from checkpoint.chain import position_of
from checkpoint.engine import PTRACE, CaptureOrder, ProtectOrder
from checkpoint.engines import description, entering, waits
from checkpoint.engines import probe as probing
from checkpoint.engines.capture_memory import MemoryCapture, RunningCopy, Taken
from checkpoint.engines.capture_process import process_state, thread_states
from checkpoint.engines.entering import Entered
from checkpoint.engines.identities import Identities
from checkpoint.engines.outputs import Outputs
from checkpoint.engines.restart import Interruptions
from checkpoint.engines.standing import Onlooker, Standing
from checkpoint.errors import CaptureError, ProbeError, ProcessGoneError, UnsupportedError
from checkpoint.linux import abi, procfs
from checkpoint.linux.procfs import MapsLine, Status
from checkpoint.linux.threads import Threads
from checkpoint.linux.tracee import Tracee
from checkpoint.linux.tracking import NONE, NOT_CARRIED
from checkpoint.linux.vm_flags import FlagsReader
from checkpoint.model import Position, Resource, Snapshot
from checkpoint.pages import PageTable
from checkpoint.resources import Surroundings, carried_trees, glance, kinds, look, memory_locks, system_v_memory, unsupported
from checkpoint.resources.carried_trees import NO_PARCEL, CarriedTrees, Parcel, Seen
from checkpoint.stream_counts import Totals

NS_PER_US: Final = 1000


@dataclass(frozen=True, slots=True)
class Frozen:
    """Everything that one freeze brought home; nothing in it needs the process any more.

    Attributes:
        freeze_us: how long the program stood still.
        seen: its carried files.
    """

    standing: Standing
    taken: Taken
    freeze_us: int
    seen: Seen = field(default_factory=Seen)


def _xstate_mask(standing: Standing) -> int:
    """Which parts of the processor's state any thread uses."""
    return functools.reduce(operator.or_, map(x86_64_xstate.in_use, (standing.xstate, *(one.xstate for one in standing.others))))


class PtraceSession:
    """One protected process; every call from the thread that opened it. See ``checkpoint.engine.Session``.

    Invariants: between captures nobody traces the process; ``_table`` is the state at the last capture that was handed out.

    Attributes:
        frozen_size: bytes of pages that the last capture copied while the program stood still.
    """

    def __init__(
        self,
        pid: int,
        order: ProtectOrder,
        threads: Threads,
        entered: Entered,
        surroundings: Surroundings,
        trees: CarriedTrees | None = None,
    ) -> None:
        self.pid = pid
        self.component = order.component
        self.notes = entered.notes
        self.totals: Totals = (0, 0)
        self.frozen_size = 0
        self._threads = threads
        self._surroundings = surroundings
        self._onlooker = Onlooker(threads, entered, surroundings.devices)
        self._level = portable.level_in(procfs.read_bytes(pid, "environ"))
        self._flags = FlagsReader(pid)
        self._identities = Identities(pid, order.names or {})
        self._files_kept = order.names is not None
        self._outputs: Outputs | None = None
        self._carried = trees
        self._table = PageTable.empty(abi.PAGE_SIZE)
        self._totals_at: dict[Position, Totals] = {}
        self._refused = False
        self._held = False
        self._collects = False
        self._closed = False
        self._memory = MemoryCapture(threads.leader.memory, entered.tracker, entered.pages)

    # Opening and closing

    @classmethod
    def open(cls, pid: int, order: ProtectOrder) -> PtraceSession:
        """See ``checkpoint.engine.Engine.protect``."""
        outputs = Outputs(order.streams) if order.streams else None
        trees = None
        try:
            surroundings = probing.surroundings_of(pid, order.streams, order.terms)
            report = probing.probe(pid, surroundings, files_kept=order.names is not None)
            trees = carried_trees.followed(pid, order.terms.carry)
            reasons = (*report.reasons, *(trees.refuse() if trees else ()))
            if reasons:
                raise UnsupportedError(f"cannot protect pid {pid} ({report.command}): {'; '.join(reasons)}", reasons)
            interruptions = Interruptions(makes_again=waits.makes_calls_again(pid))
            threads = Threads(Tracee(pid), interruptions.mend)
            entered = entering.enter(threads, interruptions)
            try:
                session = cls(pid, order, threads, entered, surroundings, trees)
            except BaseException:
                entered.tracker.close()
                raise
        except BaseException:
            if outputs:
                outputs.close()
            if trees:
                trees.close()
            raise
        session._outputs = outputs
        session.notes += report.notes
        return session

    def close(self) -> None:
        """See ``checkpoint.engine.Session.close``."""
        if self._closed:
            return
        self._closed = True
        if self._held:
            self._thaw()
        self._memory.close()
        if self._outputs:
            self._outputs.close()
        if self._carried:
            self._carried.close()

    def acknowledge(self, position: Position) -> None:
        """See ``checkpoint.engine.Session.acknowledge``. A position that is not known (any more) changes nothing."""
        if self._memory.acknowledge(position):
            self._forget_totals()

    def open_file(self, path: str, digest: bytes) -> int:
        """See ``checkpoint.engine.Session.open_file``."""
        return self._identities.open(path, digest)

    def _forget_totals(self) -> None:
        """Of positions that no delta can be relative to any more."""
        known = self._memory.positions()
        self._totals_at = {position: totals for position, totals in self._totals_at.items() if position in known}
        if self._carried:
            self._carried.keep(known)

    # Capturing

    def capture(self, order: CaptureOrder) -> Snapshot:
        """See ``checkpoint.engine.Session.capture``."""
        parent = None if order.base else self._memory.acknowledged
        if self._refused:
            self._look_from_outside()
        try:
            self._onlooker.prepare()
            if self._carried:
                self._carried.prepare(carried_trees.mapped_shared(self.pid))
            copied = self._copy_running(base=parent is None)
            frozen = self._frozen_look(copied, base=parent is None, hold=order.hold)
        except CaptureError as error:
            explained = self._explained(error)
            if explained is error:
                raise
            raise explained from error
        self.frozen_size = frozen.taken.frozen_size
        try:
            return self._described(order, parent, frozen)
        except (FileNotFoundError, ProcessLookupError) as error:
            raise ProcessGoneError(f"{self.component} (pid {self.pid}) ended while it was being described") from error

    def _copy_running(self, *, base: bool) -> RunningCopy:
        """Copy beforehand what is worth it; for a base the files are looked at before, too, for that takes long."""
        if base:
            self._memory.refresh()
            self._flags.refresh(self._memory.lines, anew=True)
            self._identities.vmas(self._memory.lines, self._flags.flags, NONE)
        return self._memory.copy_running(base=base)

    def _look_from_outside(self) -> None:
        """What was refused once is looked at without stopping it: a program that has an epoll for a week is left in peace."""
        with contextlib.suppress(ProcessGoneError, ProbeError):
            held = look(glance(self.pid), self._surroundings)
            of_files = self._carried.refuse() if self._carried else ()
            self._refuse((*held.reasons, *self._reasons_of_process(procfs.status(self.pid)), *of_files))

    def _reasons_of_process(self, status: Status, had_children: bool | None = None) -> Iterator[str]:
        return unsupported.refuse_process(self.pid, status, files_kept=self._files_kept, had_children=had_children)

    def _refuse(self, reasons: tuple[str, ...]) -> None:
        self._refused = bool(reasons)
        if reasons:
            raise UnsupportedError(f"cannot capture {self.component} (pid {self.pid}): {'; '.join(reasons)}", reasons)

    def _explained(self, error: CaptureError) -> CaptureError:
        """A process that executed another program is not the one that was protected; one that has lost a thread is."""
        with contextlib.suppress(ProcessGoneError, ProbeError):
            if procfs.status(self.pid).state in "ZX":
                return error
            if not self._onlooker.is_entered():
                self._memory.start_over()
                return ProcessGoneError(f"{self.component} (pid {self.pid}) has become another program (exec): protect it anew")
            if isinstance(error, ProcessGoneError):
                return CaptureError(f"{error}: it was a thread of pid {self.pid}, which lives on; capture it again")
        return error

    # While it stands still

    def _frozen_look(self, copied: RunningCopy, *, base: bool, hold: bool) -> Frozen:
        """Everything that needs the program to stand still."""
        began = self._freeze()
        try:
            place = self._onlooker.place()
            taken = self._memory.take(copied, base=base)
            standing = self._onlooker.ask(place, self._outputs)
            seen = self._carried.look(line.inode for line in taken.lines if line.shared) if self._carried else Seen()
        except BaseException:
            self._thaw()
            raise
        if hold:
            self._hold()
        else:
            self._thaw()
        return Frozen(standing, taken, (time.perf_counter_ns() - began) // NS_PER_US, seen)

    def _freeze(self) -> int:
        """Stop it, nothing of ours half done inside; answers when that began."""
        if self._held:
            return time.perf_counter_ns()
        self._collects = gc.isenabled()
        gc.disable()
        began = time.perf_counter_ns()
        try:
            self._threads.freeze()
        except BaseException:
            self._collect_again()
            raise
        return began

    def _hold(self) -> None:
        """Leave it standing."""
        self._held = True
        self._threads.hold()

    def _thaw(self) -> None:
        self._held = False
        self._threads.thaw()
        self._collect_again()

    def _collect_again(self) -> None:
        if self._collects:
            gc.enable()

    # Describing, while the program runs

    def _described(self, order: CaptureOrder, parent: Position | None, frozen: Frozen) -> Snapshot:
        """The snapshot of what a freeze brought home."""
        standing, taken = frozen.standing, frozen.taken
        held = look(standing.opened, self._surroundings)
        of_files = self._carried.reasons(frozen.seen) if self._carried else ()
        reasons = (*held.reasons, *kinds.reasons_of_all(held.resources), *self._reasons_of(standing, taken.lines), *of_files)
        self._refuse(reasons)
        parcel = self._carried.parcel(frozen.seen, parent) if self._carried else NO_PARCEL
        snapshot = replace(
            self._with_pages(self._outline(order, parent, frozen, parcel), taken, parcel),
            resources=(
                *map(self._identities.as_known, held.resources),
                *self._locks(taken.lines),
                *system_v_memory.describe(taken.lines),
                *parcel.resources,
            ),
            output=self._outputs.pieces(self._output_since(parent), standing.totals) if self._outputs else (),
        )
        snapshot = replace(snapshot, position=position_of(snapshot, order.generation, order.sequence))
        self._memory.settle(snapshot.position)
        if self._carried:
            self._carried.settle(snapshot.position)
        self._totals_at[snapshot.position] = self.totals = standing.totals
        self._forget_totals()
        return snapshot

    def _output_since(self, parent: Position | None) -> Totals:
        """Where a snapshot's output begins: a base may go to a robot that has nothing yet."""
        return self._totals_at.get(parent, (0, 0)) if parent else (0, 0)

    def _outline(self, order: CaptureOrder, parent: Position | None, frozen: Frozen, parcel: Parcel) -> Snapshot:
        """A snapshot without pages, descriptors and output."""
        standing, taken = frozen.standing, frozen.taken
        return Snapshot(
            component=self.component,
            engine=PTRACE,
            position=Position(order.generation, order.sequence, bytes(16)),
            parent=parent,
            machine=replace(
                description.this_machine(),
                robot=order.robot,
                xstate_mask=_xstate_mask(standing),
                features=portable.features_used(description.this_machine().features, self._level),
            ),
            clocks=standing.told.clocks,
            process=process_state(self.pid, standing, self._identities),
            threads=thread_states(self.pid, standing),
            vmas=(*self._identities.vmas(taken.lines, self._flags.flags, taken.guards), *parcel.vmas),
            epoch=order.epoch,
            freeze_us=frozen.freeze_us,
            notes=self.notes,
        )

    def _with_pages(self, outline: Snapshot, taken: Taken, parcel: Parcel) -> Snapshot:
        """Add the pages: zero pages of anonymous memory are told, not carried. Carried files have the highest addresses."""
        addresses, content, zero = taken.contents()
        if len(parcel.addresses):
            addresses, content = np.concatenate((addresses, parcel.addresses)), memoryview(b"".join((content, parcel.content)))
        runs = pages.page_runs(pages.extents_of_addresses(addresses, abi.PAGE_SIZE))
        is_base = outline.parent is None
        forgotten = () if is_base else (*pages.page_runs(pages.union(taken.cleared, zero)), *parcel.cleared)
        before = PageTable.empty(abi.PAGE_SIZE) if is_base else self._table
        self._table = before.apply(forgotten, runs, content, outline.vmas)
        return replace(outline, cleared=forgotten, runs=runs, contents=content, page_sum=self._table.page_sum)

    def _reasons_of(self, standing: Standing, lines: tuple[MapsLine, ...]) -> tuple[str, ...]:
        """Why what it has turned into cannot be captured."""
        try:
            self._flags.refresh(self._memory.lines)
            of_mappings = (unsupported.refuse_mapping(line, self._foreign_flags(line)) for line in lines)
            of_segments = system_v_memory.refuse(lines)
            of_process = self._reasons_of_process(standing.status, standing.told.has_children)
            return (*of_process, *(reason for reason in of_mappings if reason), *of_segments)
        except ProcessGoneError:
            return ()  # the picture was taken before it ended

    def _locks(self, lines: tuple[MapsLine, ...]) -> tuple[Resource, ...]:
        """Whether what it maps from now on is locked in memory."""
        told = self._flags.flags
        ours = [codes for start, codes in told.items() if self._memory.borrowed.holds(start)]
        of_program = (told.get(line.start, ()) for line in lines if line.name not in NOT_CARRIED)
        return memory_locks.describe(of_program, ours)

    def _foreign_flags(self, line: MapsLine) -> tuple[str, ...]:
        """VmFlags without those that our own write protection sets."""
        return tuple(flag for flag in self._flags.flags.get(line.start, ()) if flag not in ("um", "uw"))
