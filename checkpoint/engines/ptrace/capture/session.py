"""Capture one protected component through ptrace, from `PtraceSession.open` to `PtraceSession.close`.

One capture::

    copy         most pages, while it runs (`capture.memory`)                     the program runs
    freeze       stop its threads; registers, mask, pending signals               it is frozen
    scan, copy   which pages were written since, and their bytes
    ask          a batch of system calls inside it (`capture.frozen_process`); descriptors; output counts
    thaw         everything as it was
    describe     zero pages dropped, digests, files identified, refusals          it runs

If the program writes a page after the capture has copied it, the capture copies it again. So the freeze does not grow with the
size of the memory. As long as the capture copies faster than the program writes, the freeze does not grow with the time since the
last capture either.

A component of several processes (`checkpoint.engines.ptrace.capture.tree`) takes the same steps, with all of its processes at the
same time.
"""

from __future__ import annotations

import contextlib
import gc
import itertools
import time
from collections.abc import Iterator, Mapping
from typing import Final

from msgspec import Struct, field
from msgspec.structs import replace

from checkpoint.engine import NOTED, PTRACE, REFUSED, CaptureOrder, ProtectOrder
from checkpoint.engines.ptrace.capture.freeze_budget import FreezeBudget, OverBudgetError
from checkpoint.engines.ptrace.capture.memory import RunningCopy
from checkpoint.engines.ptrace.capture.pages import Pages, joined, with_parcel
from checkpoint.engines.ptrace.capture.process import RAN_ON_MAX, CapturedProcess, Look
from checkpoint.engines.ptrace.capture.tree import CapturedTree, MovedError, SeenOthers
from checkpoint.engines.ptrace.facts import describe, memory_limits, probe
from checkpoint.engines.stream_output import Outputs
from checkpoint.errors import (
    CaptureError,
    CheckpointError,
    ProbeError,
    ProcessGoneError,
    RanOnError,
    UnsupportedError,
    let_go,
)
from checkpoint.linux import abi, system_v_ipc
from checkpoint.linux.memory.remote_memory import Memory
from checkpoint.linux.procfs import descendants, procfs
from checkpoint.linux.procfs.descendants import Kinship
from checkpoint.linux.procfs.live_thread import SPOKESMEN_MAX, told_by_spokesman
from checkpoint.linux.procfs.procfs import MapsLine
from checkpoint.linux.realtime_boost import Precedence
from checkpoint.linux.system_v_ipc import Segment
from checkpoint.linux.trace.stop_events import Reports
from checkpoint.model import Position, Snapshot
from checkpoint.pages import page_set
from checkpoint.pages.page_set import PageTable, Words
from checkpoint.program import cpu_baseline, epoch_variable
from checkpoint.resources import registry
from checkpoint.resources.carried import capture as carried_capture
from checkpoint.resources.carried.capture import NO_PARCEL, CarriedTrees, Parcel, Seen
from checkpoint.resources.ipc import shared_memory, system_v_memory
from checkpoint.resources.open_file import OpenFile, Surroundings
from checkpoint.resources.process import control_groups, refused_threads, thread_credentials
from checkpoint.resources.sockets import tcp_handover
from checkpoint.resources.sockets.tcp_handover import Departing
from checkpoint.resources.survey import glance, look
from checkpoint.runtime import parallel
from checkpoint.segment.output_counters import Totals
from checkpoint.snapshot import credentials, process_tree
from checkpoint.store.base_in_process import UnreadBase
from checkpoint.store.chain import position_of

NS_PER_US: Final = 1000
MOVED_S: Final = 2.0
"""How long a capture is made again because processes came and went in the middle of it."""
MOVED_PAUSE_S: Final = 0.005
FREEZES_MAX: Final = 4
"""Freezes of one capture that may be given up because they would take too long."""


class Frozen(Struct, frozen=True):
    """Everything that one freeze brought home; nothing in it needs the process any more.

    Attributes:
        first: of the first process.
        others: what was seen of the others; None where there are none.
        freeze_us: how long the program stood still; of several times, which a capture that is made again has, the longest.
        seen: its carried files.
        departing: its connections, where it may stand still for good.
        segments: System V shared memory of this machine, where any of them has some attached.
    """

    first: Look
    others: SeenOthers | None
    freeze_us: int
    seen: Seen = field(default_factory=Seen)
    departing: Departing = tcp_handover.NOBODY
    segments: Mapping[int, Segment] = field(default_factory=dict)


class PtraceSession:
    """One protected component; every call from the thread that opened it. See ``checkpoint.engine.Session``.

    Invariants: between captures nobody traces it; ``_table`` is the state at the last capture that was handed out.

    Attributes:
        frozen_size: bytes of pages that the last capture copied while the program stood still.
    """

    def __init__(
        self,
        order: ProtectOrder,
        first: CapturedProcess,
        kin: Kinship,
        surroundings: Surroundings,
        trees: CarriedTrees | None = None,
    ) -> None:
        self.pid = first.threads.process
        self.component = order.component
        self.notes = first.notes
        self.totals: Totals = (0, 0)
        self.frozen_size = 0
        self._surroundings = surroundings
        self._detached: tuple[shared_memory.Mapped, ...] = ()
        self._names_detached: dict[shared_memory.Object, str] = {}
        self._level = cpu_baseline.level_in(told_by_spokesman(self.pid, lambda tid: procfs.read_bytes(tid, "environ")))
        self._first = first
        self._tree = CapturedTree(first, kin)
        self._outputs: Outputs | None = None
        self._carried = trees
        self._departing = tcp_handover.NOBODY
        self._table = PageTable.empty(abi.PAGE_SIZE)
        self._totals_at: dict[Position, Totals] = {}
        self._refused = False
        self._is_single = True
        self._held = False
        self._longest_us = 0
        self._collects = False
        self._precedence = Precedence()
        self._reports = Reports()
        self._budget = FreezeBudget(order.terms.freeze_budget_ns, order.terms.freeze_overrun_ns)
        self._budget_ms = order.terms.freeze_budget_ns / 1e6
        first.memory.budget = self._budget
        self._owner = order.terms.owner
        self._epoch = 0
        self._closed = False
        self._changing: frozenset[str] = frozenset()

    # Opening and closing

    @classmethod
    def open(cls, pid: int, order: ProtectOrder) -> PtraceSession:
        """See ``checkpoint.engine.Engine.protect``."""
        outputs = Outputs(order.streams) if order.streams else None
        trees = None
        try:
            if reasons := thread_credentials.refuse(pid, order.terms.owner):
                raise UnsupportedError(f"cannot {order.verb} pid {pid}: {reasons[0]}", reasons)
            surroundings = probe.surroundings_of(pid, order.streams, order.terms, may_repeat=order.is_guarded)
            report = probe.probe(pid, surroundings, files_kept=order.names is not None, verb=order.verb)
            trees = told_by_spokesman(pid, lambda tid: carried_capture.followed(tid, order.terms))
            reasons = (*report.reasons, *(trees.refuse() if trees else ()))
            if reasons:
                raise UnsupportedError(f"cannot {order.verb} pid {pid} ({report.command}): {'; '.join(reasons)}", reasons)
            if surroundings.connections:
                tcp_handover.heard_again(told_by_spokesman(pid, glance))
            kin = Kinship(pid, descendants.reaper_of(pid, is_guarded=order.streams is not None))
            first = CapturedProcess.entered_first(pid, order)
            try:
                session = cls(order, first, kin, surroundings, trees)
            except BaseException:
                first.close()
                raise
        except BaseException:
            if outputs:
                outputs.close()
            if trees:
                trees.close()
            raise
        session._outputs = outputs
        session.notes += report.notes
        session._changing = frozenset(found.text for found in report.findings if found.kind in registry.OF_ALL)
        return session

    def close(self) -> None:
        """See ``checkpoint.engine.Session.close``."""
        if self._closed:
            return
        self._closed = True
        if self._held:
            self._thaw()
        self._tree.close()
        self._first.close()
        if self._outputs:
            self._outputs.close()
        if self._carried:
            self._carried.close()

    def acknowledge(self, position: Position) -> None:
        """See ``checkpoint.engine.Session.acknowledge``. A position that is not known (any more) changes nothing."""
        if self._first.memory.acknowledge(position):
            self._tree.acknowledge(position)
            self._forget_totals()

    def open_file(self, path: str, digest: bytes) -> int:
        """See ``checkpoint.engine.Session.open_file``."""
        for process in (self._first, *self._tree.processes()):
            with contextlib.suppress(CheckpointError, FileNotFoundError):  # another one may have it
                return process.identities.open(path, digest)
        raise CaptureError(f"cannot open {path} of {self.component} (pid {self.pid}): none of its processes has it any more")

    def _forget_totals(self) -> None:
        """Of positions that no delta can be relative to any more."""
        known = self._first.memory.positions()
        self._totals_at = {position: totals for position, totals in self._totals_at.items() if position in known}
        if self._carried:
            self._carried.keep(known)

    # Capturing

    def capture(self, order: CaptureOrder) -> Snapshot:
        """See ``checkpoint.engine.Session.capture``."""
        captured = self._captured(order, may_stay=False)
        assert isinstance(captured, Snapshot), "it was to be read"
        return captured

    def capture_standing(self, order: CaptureOrder) -> Snapshot | UnreadBase:
        """See ``checkpoint.engine.Session.capture_standing``: pages of one process alone stay where they are."""
        return self._captured(order, may_stay=order.base and order.hold and self._carried is None and self._is_single)

    def _captured(self, order: CaptureOrder, *, may_stay: bool) -> Snapshot | UnreadBase:
        ran_on = 0
        for _ in range(SPOKESMEN_MAX):
            try:
                return self._captured_once(order, may_stay=may_stay)
            except RanOnError:
                ran_on += 1
                if ran_on == RAN_ON_MAX:
                    raise
            except CaptureError:
                if not self._speaks_by_another():
                    raise
        raise CaptureError(
            f"cannot capture {self.component} (pid {self.pid}): its threads end while failover examines it; try again"
        )

    def _captured_once(self, order: CaptureOrder, *, may_stay: bool) -> Snapshot | UnreadBase:
        parent = None if order.base else self._first.memory.acknowledged
        if self._refused:
            self._look_from_outside()
        if order.epoch > self._epoch:
            self._tell_epoch(order.epoch)
        try:
            if self._carried:
                self._carried.prepare(carried_capture.mapped_shared(self._first.pid))
            frozen = self._frozen(order, base=parent is None, may_stay=may_stay)
        except CaptureError as error:
            explained = self._explained(error)
            if explained is error:
                raise
            raise explained from error
        try:
            return self._described(order, parent, frozen)
        except (FileNotFoundError, ProcessLookupError) as error:
            gone = ProcessGoneError(f"{self.component} (pid {self.pid}) ended while failover captured it")
            raise self._explained(gone) from error
        except ProcessGoneError as error:  # a child that it has a pidfd of, for one
            raise self._explained(error) from error

    def _tell_epoch(self, epoch: int) -> None:
        """Write it into the environment of each process: a copy may go on under a later one than it was born or restored with."""
        self._epoch = epoch
        for process in (self._first, *self._tree.processes()):
            with contextlib.suppress(ProcessGoneError, ProbeError):  # it has ended, as the capture finds next
                stat = procfs.stat(process.pid)
                epoch_variable.renew(process.threads.leader.memory, stat.env_start, stat.env_end, epoch)

    def _speaks_by_another(self) -> bool:
        """Where the thread has ended by which the first process is looked at, enter it by another: the next capture is a base.

        Raises:
            UnsupportedError: it cannot be kept so (before Linux 6.9, or one of several processes); nothing was touched.
        """
        try:
            if self._held or not self._first.has_lost_its_voice():
                return False
        except ProcessGoneError:
            return False
        self._refuse(probe.reasons_of(self.pid, self._surroundings, files_kept=self._first.files_kept))
        first = CapturedProcess.entered_first(self.pid, self._first.order)
        self._first.close()
        first.memory.budget = self._budget
        self._first = first
        self._tree.follow(first)
        if self._carried:
            self._carried.pid = first.pid
        return True

    def _frozen(self, order: CaptureOrder, *, base: bool, may_stay: bool) -> Frozen:
        """One freeze; again where processes came and went in the middle of it.

        Args:
            may_stay: the pages of a single process need not be read.
        """
        deadline = time.monotonic() + MOVED_S
        self._longest_us = 0
        copied: RunningCopy | None = None
        given_up = 0
        while True:
            try:
                self._tree.admit(held=self._held)
                self._detach()
                if base and (others := self._tree.processes()):
                    self._refuse(memory_limits.refuse_capture((self.pid, *(process.pid for process in others))))
                may_stay = may_stay and not self._tree.processes()
                copied = None if may_stay else self._copied_running(order, copied, base=base)
                self._budget.begin(is_free=order.hold, is_last=given_up == FREEZES_MAX - 1)
                frozen = self._frozen_look(copied, base=base, hold=order.hold)
                if not order.hold:
                    self._require_whole(frozen.first, frozen.others)
                if frozen.others:
                    frozen.others.describe()
                return frozen
            except MovedError as moved:
                let_go(moved)  # its frames hold what was copied
                is_last = time.monotonic() > deadline and not may_stay  # one that took it for a single process is never the last
                self._is_single, may_stay = self._is_single and not may_stay, False
                if is_last:
                    raise
                time.sleep(MOVED_PAUSE_S)
            except OverBudgetError as late:
                let_go(late)
                given_up += 1
                if given_up == FREEZES_MAX:
                    raise self._over_budget(given_up) from late

    def _detach(self) -> None:
        """Where the rules say so: find the shared memory that others have mapped, too, and tell of it as of its own."""
        known = self._surroundings.detached
        if known is None:
            return
        processes = (self._first, *self._tree.processes())
        for process in processes:
            process.memory.refresh()
        lines = {process.pid: process.memory.lines for process in processes}
        self._detached = shared_memory.of_all(lines)
        mapped = {(line.device, line.inode) for of_one in lines.values() for line in of_one if line.shared}
        names = {one.key: one.name for one in self._detached}
        self._names_detached = {key: name for key, name in (self._names_detached | names).items() if key in mapped}
        objects = self._names_detached
        covered = shared_memory.covered(itertools.chain.from_iterable(lines.values()), objects)
        self._surroundings = replace(self._surroundings, detached=covered)
        for process in processes:
            process.detach(covered.keys())

    def _require_detached(self, first: Look, others: SeenOthers | None) -> None:
        """All that others have mapped is told as its own, and whole.

        Raises:
            CaptureError: it was shared, or unmapped, in the middle of the capture; the next one succeeds.
        """
        known = self._surroundings.detached
        if known is None:
            return
        looks = [(self._first, first), *(others.looks() if others else ())]
        lines = {process.pid: seen.taken.lines for process, seen in looks}
        found = shared_memory.of_all(lines)
        covered = shared_memory.covered(_lines_of_all(first, others), known)
        if any(one.key not in known for one in found) or any(covered[key] < size for key, size in known.items()):
            what = "another process has mapped shared memory of it in the middle of the capture, or it has unmapped some"
            raise CaptureError(f"cannot capture {self.component} (pid {self.pid}): {what}; capture it again")

    def _over_budget(self, given_up: int) -> CaptureError:
        """What is said when no freeze of a capture fits the budget."""
        coming_ns = self._budget.overrun_in_ns()
        cure = "raise freeze_budget_ms, or set freeze_overrun_s"
        if coming_ns is not None:
            cure = f"in {coming_ns / 1e9:.0f} s one may take longer (freeze_overrun_s); to change that raise freeze_budget_ms"
        return OverBudgetError(
            f"cannot capture {self.component} (pid {self.pid}): failover gave {given_up} freezes up that would have taken "
            f"longer than its freeze_budget_ms of {self._budget_ms:g}; {cure}"
        )

    def _copied_running(self, order: CaptureOrder, copied: RunningCopy | None, *, base: bool) -> RunningCopy:
        """What is copied of the first process before the freeze; those of the others are kept by the tree.

        Args:
            copied: before a freeze that came to nothing.
        """
        enough = self._enough()
        self._first.memory.readers = parallel.thread_count() if order.hold else 1  # it is not to run on by itself
        is_again = copied is not None
        copied = self._first.copy_running(base=base, enough=enough, copied=copied)
        self._tree.copy_running(base=base, enough=enough, again=is_again)
        return copied

    def _enough(self) -> int:
        """Pages that each process may leave for the freeze; 0 where nobody has set a budget."""
        return max(1, self._budget.page_count // (1 + len(self._tree.processes()))) if self._budget else 0

    def _look_from_outside(self) -> None:
        """What was refused once is looked at without stopping it: a program that has an epoll for a week is left in peace."""
        with contextlib.suppress(ProcessGoneError, ProbeError):
            reasons = probe.reasons_of(self.pid, self._surroundings, files_kept=self._first.files_kept)
            self._refuse(
                (*thread_credentials.refuse(self.pid, self._owner), *reasons, *(self._carried.refuse() if self._carried else ()))
            )

    def _refuse(self, reasons: tuple[str, ...]) -> None:
        self._refused = bool(reasons)
        if reasons:
            raise UnsupportedError(f"cannot capture {self.component} (pid {self.pid}): {'; '.join(reasons)}", reasons)

    def _explained(self, error: CaptureError) -> CaptureError:
        """A process that executed another program is not the one that was protected; one that has lost a thread is."""
        with contextlib.suppress(ProcessGoneError, ProbeError):
            if procfs.status(self.pid).has_ended:
                return error
            if not self._first.onlooker.is_entered():
                if procfs.stat(self.pid).flags & procfs.PF_EXITING:  # its memory goes before it says that it has ended
                    return ProcessGoneError(f"{self.component} (pid {self.pid}) has ended")
                self._first.memory.start_over()
                return ProcessGoneError(f"{self.component} (pid {self.pid}) has become another program (exec): protect it anew")
            if isinstance(error, ProcessGoneError):
                return CaptureError(f"{error}: it was a thread or a child of pid {self.pid}, which lives on; capture it again")
        return error

    # While it stands still

    def _frozen_look(self, copied: RunningCopy | None, *, base: bool, hold: bool) -> Frozen:
        """Everything that needs the program to stand still."""
        self._first.memory.buffer.begin()
        if copied is None:
            self._first.prepare(base=base)
        elif not self._held:
            for process in (self._first, *self._tree.processes()):
                process.rehearse()
        began = self._freeze()
        try:
            self._budget.require()
            others = None
            if self._tree.stand_still():
                if copied is None:
                    raise MovedError(f"pid {self.pid} is not alone any more; capture it again")
                self._refuse(refused_threads.refuse_kin(self._first.threads))
                others = self._tree.begin_look()
                self._budget.require()
            first = self._first.look(copied, self._outputs, base=base, opened=others.opened[self._first.pid] if others else None)
            if others:
                self._tree.look(others, first, self._surroundings, base=base)
            seen = self._carried.look(self._shared_inodes(first, others)) if self._carried else Seen()
            segments = self._segments(others)
            if hold:
                self._require_whole(first, others)
            if hold and self._surroundings.connections:
                self._departing = tcp_handover.depart(self._opened(first, others))
        except BaseException as error:
            self._note_freeze(began, self._thaw())
            self._raise_if_late(error)
            raise
        ended = self._hold() if hold else self._thaw()
        self._budget.ended(ended)
        return Frozen(first, others, self._note_freeze(began, ended), seen, self._departing, segments)

    def _raise_if_late(self, error: BaseException) -> None:
        """Whatever goes wrong with a capture when its time is over goes wrong because of that; but an end is an end.

        Raises:
            OverBudgetError: the time is over.
        """
        if isinstance(error, CaptureError) and not isinstance(error, ProcessGoneError) and self._budget.is_over:
            raise OverBudgetError(str(error)) from error

    def _segments(self, others: SeenOthers | None) -> dict[int, Segment]:
        """The System V shared memory of this machine, where any of them has some: whoever runs may attach it, and be born."""
        looked_at = (self._first, *(process for process, _ in others.looks())) if others else (self._first,)
        return system_v_ipc.segments() if any(process.memory.has_segments for process in looked_at) else {}

    def _note_freeze(self, began: int, ended: int) -> int:
        """Note how long it stood still; the longest time of this capture, in µs."""
        self._longest_us = max(self._longest_us, (ended - began) // NS_PER_US)
        return self._longest_us

    def _require_whole(self, first: Look, others: SeenOthers | None) -> None:
        """Nothing was left out that must be asked while it stands still; the first thing to be done when it runs again.

        Raises:
            MovedError: something was: it is known now.
        """
        for process, seen in ((self._first, first), *(others.looks() if others else ())):
            try:
                is_whole = process.memory.confirm()
            except ProcessGoneError as error:
                raise MovedError(f"process {process.pid} ended as soon as it ran again; capture it again") from error
            if not is_whole:
                raise MovedError(f"pid {process.pid} may have dropped its changes to a mapped file; capture it again")
            if held := process.onlooker.overlooked(seen.standing.opened):
                raise MovedError(
                    f"{held.name} of pid {process.pid} was given an owner of its signals (F_SETOWN); capture it again"
                )

    @staticmethod
    def _opened(first: Look, others: SeenOthers | None) -> list[OpenFile]:
        """What any of them has open."""
        looks = [first, *(look for _, look in others.looks())] if others else [first]
        return [held for look in looks for held in look.standing.opened]

    @staticmethod
    def _shared_inodes(first: Look, others: SeenOthers | None) -> set[int]:
        """Of the files that any of them has mapped to be shared."""
        return {line.inode for line in _lines_of_all(first, others) if line.shared}

    def _freeze(self) -> int:
        """Stop it, nothing of ours half done inside; answers when it was first asked to, in ns: until then it runs."""
        if self._held:
            return time.perf_counter_ns()
        self._collects = gc.isenabled()
        gc.disable()
        self._reports.keep()
        self._precedence.take()
        self._first.threads.patience_ns = self._budget.left_ns()
        try:
            self._first.threads.freeze()
        except BaseException as error:
            self._be_ordinary()
            self._raise_if_late(error)
            raise
        return self._first.threads.asked_ns

    def _hold(self) -> int:
        """Leave it standing; answers when that was."""
        self._precedence.give_back()
        self._reports.give_back()
        self._held = True
        self._first.threads.hold()
        self._tree.hold()
        return time.perf_counter_ns()

    def _thaw(self) -> int:
        """Let it go; answers when the last of it was, in ns."""
        self._departing.stay(self._first.pid)
        self._departing = tcp_handover.NOBODY
        self._held = False
        try:
            self._first.threads.thaw()
        finally:
            try:
                self._tree.thaw()
                ended = time.perf_counter_ns()
            finally:
                self._be_ordinary()
        return ended

    def _be_ordinary(self) -> None:
        """As before the freeze: what this thread makes may be collected, and it has no precedence."""
        self._precedence.give_back()
        self._reports.give_back()
        if self._collects:
            gc.enable()

    # Describing, while the program runs

    def _described(self, order: CaptureOrder, parent: Position | None, frozen: Frozen) -> Snapshot | UnreadBase:
        """The snapshot of what a freeze brought home."""
        first, others = frozen.first, frozen.others
        totals = first.standing.totals
        held = look(first.standing.opened, self._surroundings)
        of_files = self._carried.reasons(frozen.seen) if self._carried else ()
        of_others = others.reasons(first) if others else ()
        family = others.pids if others else ()
        every = (*held.resources, *(others.resources() if others else ()))
        findings = registry.findings_of_all(every, self._surroundings, standing=True)
        of_all = tuple(found.text for found in findings if found.verdict == REFUSED)
        detaches = self._surroundings.detached is not None
        of_segments = system_v_memory.refuse(_lines_of_all(first, others), frozen.segments, detaches=detaches)
        self._require_detached(first, others)
        self._refuse((*held.reasons, *of_all, *self._first.reasons(first, family), *of_others, *of_segments, *of_files))
        parcel = self._carried.parcel(frozen.seen, parent) if self._carried else NO_PARCEL
        lasting = (note for note in self.notes if note not in self._changing)
        outline = replace(
            self._outline(order, parent, frozen, parcel),
            notes=(
                *lasting,
                *(found.text for found in findings if found.verdict == NOTED),
                *shared_memory.detached(self._detached),
            ),
            resources=(
                *self._first.known(held.resources),
                *self._first.unopened(first),
                *self._first.stopped(),
                *shared_memory.describe(self._names_detached.items()),
                *parcel.resources,
            ),
            output=self._outputs.pieces(self._output_since(parent), totals) if self._outputs else (),
        )
        outline = frozen.departing.added_to(outline)
        pids = (self.pid, *(others.in_order() if others else ()))
        outline = control_groups.added_to(outline, pids, is_guarded=self._first.order.is_guarded)
        if self._owner is not None and (beyond := credentials.refusal(credentials.beyond(outline, self._owner), self._owner)):
            self._refuse((beyond,))
        if first.taken.unread is not None:
            self.totals = totals
            return self._unread(outline, first.taken.unread)
        looks = [(self._first, first), *(others.looks() if others else ())]
        taken = joined(looks, is_base=parent is None)
        self.frozen_size = taken.frozen_size
        self._budget.note(frozen.freeze_us * NS_PER_US, sum(look.taken.copy_ns for _, look in looks), taken.frozen_size)
        snapshot = self._with_pages(outline, with_parcel(taken, parcel, is_base=parent is None))
        snapshot = replace(snapshot, position=position_of(snapshot, order.generation, order.sequence))
        for process, _ in looks:
            process.settle(snapshot.position)
        if self._carried:
            self._carried.settle(snapshot.position)
        self._totals_at[snapshot.position] = self.totals = totals
        self._forget_totals()
        return snapshot

    def _unread(self, outline: Snapshot, unread: Words) -> UnreadBase:
        """The base whose pages are where they were; those that are zero are carried, for to look for them is to read all."""
        self.frozen_size = page_set.total_size(unread)
        pid = self._first.pid
        return UnreadBase(
            replace(outline, runs=page_set.page_runs(unread), page_sum=page_set.EMPTY_SUM),
            lambda piece, buffer: Memory(pid).read_pages_into(piece, buffer),
        )

    def _output_since(self, parent: Position | None) -> Totals:
        """Where a snapshot's output begins: a base may go to a robot that has nothing yet."""
        return self._totals_at.get(parent, (0, 0)) if parent else (0, 0)

    def _outline(self, order: CaptureOrder, parent: Position | None, frozen: Frozen, parcel: Parcel) -> Snapshot:
        """A snapshot without pages, descriptors and output."""
        first, others = frozen.first, frozen.others
        masks = first.xstate_mask | (others.xstate_mask if others else 0)
        return Snapshot(
            component=self.component,
            engine=PTRACE,
            position=Position(order.generation, order.sequence, bytes(16)),
            parent=parent,
            machine=replace(
                describe.this_machine(),
                robot=order.robot,
                xstate_mask=masks,
                features=cpu_baseline.features_used(describe.this_machine().features, self._level),
            ),
            clocks=first.standing.told.clocks,
            process=self._first.process(first),
            threads=self._first.thread_states(first),
            vmas=(*self._first.mappings(first, others.pids if others else frozenset()), *parcel.vmas),
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


def _lines_of_all(first: Look, others: SeenOthers | None) -> Iterator[MapsLine]:
    """The mappings of all processes."""
    yield from first.taken.lines
    for _, other in others.looks() if others else ():
        yield from other.taken.lines
