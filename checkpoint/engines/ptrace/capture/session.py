"""Capture one protected component through ptrace, from `PtraceSession.open` to `PtraceSession.close`.

One capture::

    copy         most pages, while it runs (`capture.memory`)                     the program runs
    freeze       stop its threads (`capture.standstill`); registers, signals      it is frozen
    scan, copy   which pages were written since, and their bytes
    ask          a batch of system calls inside it (`capture.frozen_process`); descriptors; output counts
    thaw         everything as it was
    build        pages, digests, files, refusals (`capture.snapshot_builder`)     it runs

If the program writes a page after the capture has copied it, the capture copies it again. So the freeze does not grow with the
size of the memory. As long as the capture copies faster than the program writes, the freeze does not grow with the time since the
last capture either.

A component of several processes (`checkpoint.engines.ptrace.capture.tree`) takes the same steps, with all of its processes at the
same time.
"""

from __future__ import annotations

import contextlib
import math
import time
from typing import Final

from msgspec.structs import replace

from checkpoint.engine import CaptureOrder, ProtectOrder, Report
from checkpoint.engines.ptrace.capture.at_rest import REST_MAX_S
from checkpoint.engines.ptrace.capture.detached_memory import DetachedMemory
from checkpoint.engines.ptrace.capture.freeze_budget import FreezeBudget, OverBudgetError
from checkpoint.engines.ptrace.capture.frozen_component import Frozen, opened, shared_inodes
from checkpoint.engines.ptrace.capture.memory import RunningCopy
from checkpoint.engines.ptrace.capture.process import RAN_ON_MAX, CapturedProcess, Look
from checkpoint.engines.ptrace.capture.snapshot_builder import SnapshotBuilder
from checkpoint.engines.ptrace.capture.standstill import Standstill
from checkpoint.engines.ptrace.capture.tree import CapturedTree, MovedError, SeenOthers
from checkpoint.engines.ptrace.facts import memory_limits, probe
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
from checkpoint.linux import system_v_ipc
from checkpoint.linux.procfs import descendants, procfs
from checkpoint.linux.procfs.descendants import Kinship
from checkpoint.linux.procfs.live_thread import SPOKESMEN_MAX, told_by_spokesman
from checkpoint.linux.system_v_ipc import Segment
from checkpoint.model import Position, Snapshot
from checkpoint.program import epoch_variable
from checkpoint.resources import registry
from checkpoint.resources.carried import capture as carried_capture
from checkpoint.resources.carried.capture import CarriedTrees, Seen
from checkpoint.resources.open_file import Surroundings
from checkpoint.resources.process import refused_threads, thread_credentials
from checkpoint.resources.sockets import tcp_handover
from checkpoint.resources.survey import glance
from checkpoint.runtime import parallel
from checkpoint.segment.output_counters import Totals
from checkpoint.store.base_in_process import UnreadBase

MOVED_S: Final = 2.0
"""How long a freeze is made again because processes came and went in the middle of it, since the first one."""
MOVED_PAUSE_S: Final = 0.005
DIFFERENCES_SHOWN: Final = 3
"""Times in a row that a program was found to have changed, after which it is asked less often whether it rests…"""
UNASKED_MAX: Final = 7
"""…up to so many captures apart: to compare takes a tenth of a small capture, and a program that works does not rest soon."""
FREEZES_MAX: Final = 4
"""Freezes of one capture that may be given up because they would take too long."""


class PtraceSession:
    """One protected component; every call from the thread that opened it. See ``checkpoint.engine.Session``.

    Invariant: between captures no process traces it.
    """

    def __init__(
        self,
        order: ProtectOrder,
        first: CapturedProcess,
        kin: Kinship,
        surroundings: Surroundings,
        trees: CarriedTrees | None,
        outputs: Outputs | None,
        report: Report,
    ) -> None:
        self.pid = first.threads.process
        self.component = order.component
        self._surroundings = surroundings
        self._detached = DetachedMemory()
        self._first = first
        self._tree = CapturedTree(first, kin)
        self._outputs = outputs
        self._carried = trees
        self._refused = False
        self._is_single = True
        self._budget = FreezeBudget(order.terms.freeze_budget_ns, order.terms.freeze_overrun_ns)
        self._budget_ms = order.terms.freeze_budget_ns / 1e6
        first.memory.budget = self._budget
        self._standstill = Standstill(first, self._tree, self._budget)
        changing = {found.text for found in report.findings if found.kind in registry.OF_ALL}
        self.notes = (*first.notes, *report.notes)
        lasting = tuple(note for note in self.notes if note not in changing)
        self._builder = SnapshotBuilder(self.pid, order, self._budget, outputs, trees, self._refuse, lasting)
        self._owner = order.terms.owner
        self._epoch = 0
        self._rests_until = 0.0
        self._differences = self._unasked = 0
        self._closed = False

    @property
    def totals(self) -> Totals:
        """See ``checkpoint.engine.Session.totals``."""
        return self._builder.totals

    @property
    def frozen_size(self) -> int:
        """Bytes of pages that the last capture copied while the program stood still."""
        return self._builder.frozen_size

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
                session = cls(order, first, kin, surroundings, trees, outputs, report)
            except BaseException:
                first.close()
                raise
        except BaseException:
            if outputs:
                outputs.close()
            if trees:
                trees.close()
            raise
        return session

    def close(self) -> None:
        """See ``checkpoint.engine.Session.close``."""
        if self._closed:
            return
        self._closed = True
        if self._standstill.is_held:
            self._standstill.thaw()
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
            self._builder.forget_unneeded(self._first.memory.positions())

    def open_file(self, path: str, digest: bytes) -> int:
        """See ``checkpoint.engine.Session.open_file``."""
        for process in (self._first, *self._tree.processes()):
            with contextlib.suppress(CheckpointError, FileNotFoundError):  # another one may have it
                return process.identities.open(path, digest)
        raise CaptureError(f"cannot open {path} of {self.component} (pid {self.pid}): none of its processes has it any more")

    # Capturing

    def unchanged(self, epoch: int) -> Position | None:
        """See ``checkpoint.engine.Session.unchanged``."""
        known = self._first.memory.acknowledged
        if (
            known is None
            or epoch > self._epoch
            or time.monotonic() >= self._rests_until
            or self._carried
            or self._standstill.is_held
        ):
            return None
        if self._unasked:
            self._unasked -= 1
            return None
        try:
            processes = {process.pid: process for process in self._tree.processes()}
            has_rested = self._first.has_rested() and all(process.has_rested() for process in processes.values())
            self._differences = 0 if has_rested else min(self._differences + 1, DIFFERENCES_SHOWN + UNASKED_MAX.bit_length())
            self._unasked = min((1 << max(self._differences - DIFFERENCES_SHOWN, 0)) - 1, UNASKED_MAX)
            return known if has_rested and processes.keys() == set(self._tree.others()) else None
        except CheckpointError:  # the capture that follows says why
            return None

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
        began = time.monotonic()
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
            built = self._builder.built(order, parent, frozen, self._first, self._surroundings, self._detached)
            self._builder.forget_unneeded(self._first.memory.positions())
            self._rests_until = began + REST_MAX_S
            return built
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
        """Enter the first process by another thread if the one by which we look at it has ended: the next capture is a base.

        Raises:
            UnsupportedError: it cannot be kept so (before Linux 6.9, or one of several processes); nothing was touched.
        """
        try:
            if self._standstill.is_held or not self._first.has_lost_its_voice():
                return False
        except ProcessGoneError:
            return False
        self._refuse(probe.reasons_of(self.pid, self._surroundings, files_kept=self._first.files_kept))
        first = CapturedProcess.entered_first(self.pid, self._first.order)
        self._first.close()
        first.memory.budget = self._budget
        self._first = self._standstill.first = first
        self._tree.follow(first)
        if self._carried:
            self._carried.pid = first.pid
        return True

    def _frozen(self, order: CaptureOrder, *, base: bool, may_stay: bool) -> Frozen:
        """One freeze; again where processes came and went in the middle of it.

        Args:
            may_stay: the pages of a single process need not be read.
        """
        self._standstill.longest_us = 0
        moved_until = math.inf
        copied: RunningCopy | None = None
        given_up = 0
        self._budget.begin_capture()
        while True:
            try:
                self._admit(base=base)
                may_stay = may_stay and not self._tree.processes()
                copied = None if may_stay else self._copied_running(order, copied, base=base)
                if copied is not None and not self._standstill.is_held:
                    asked = time.monotonic()
                    try:
                        copied = self._ready(order, copied, base=base)
                    finally:  # no wait for the gate counts as time in which the capture did not succeed
                        passed = time.monotonic() - asked
                        moved_until += passed
                        self._budget.waited(passed)
                self._budget.begin(is_free=order.hold, is_last=given_up == FREEZES_MAX - 1)
                frozen = self._frozen_look(copied, base=base, order=order)
                if not order.hold:
                    self._require_whole(frozen.first, frozen.others)
                if frozen.others:
                    frozen.others.describe()
                return frozen
            except MovedError as moved:
                let_go(moved)  # its frames hold what was copied
                is_late = time.monotonic() > moved_until
                is_last = is_late and not may_stay  # one that took it for a single process is never the last
                moved_until = min(moved_until, time.monotonic() + MOVED_S)  # not counted before: to copy gigabytes takes longer
                self._is_single, may_stay = self._is_single and not may_stay, False
                if is_last:
                    raise
                self._budget.begin_capture()  # a long copy excuses one long freeze, not each of those that follow it
                time.sleep(MOVED_PAUSE_S)
            except OverBudgetError as late:
                let_go(late)
                given_up += 1
                if given_up == FREEZES_MAX:
                    raise self._over_budget(given_up) from late

    def _admit(self, *, base: bool) -> None:
        """Enter the processes that have come, while they run: to enter one takes longer than all else of a freeze."""
        self._tree.admit(held=self._standstill.is_held)
        if self._surroundings.detached is not None:
            covered = self._detached.find((self._first, *self._tree.processes()))
            self._surroundings = replace(self._surroundings, detached=covered)
        if base and (others := self._tree.processes()):
            self._refuse(memory_limits.refuse_capture((self.pid, *(process.pid for process in others))))

    def _over_budget(self, given_up: int) -> CaptureError:
        """The message when no freeze of a capture fits the budget."""
        coming_ns = self._budget.overrun_in_ns()
        cure = "raise freeze_budget_ms, or set freeze_overrun_s"
        if coming_ns is not None:
            cure = f"in {coming_ns / 1e9:.0f} s one may take longer (freeze_overrun_s); to change that raise freeze_budget_ms"
        return OverBudgetError(
            f"cannot capture {self.component} (pid {self.pid}): failover gave {given_up} freezes up that would have taken "
            f"longer than its freeze_budget_ms of {self._budget_ms:g}; {cure}"
        )

    def _copied_running(self, order: CaptureOrder, copied: RunningCopy | None, *, base: bool) -> RunningCopy:
        """The copy of the first process before the freeze; the tree keeps those of the others.

        Args:
            copied: the copy before a failed freeze.
        """
        enough = self._enough()
        self._first.memory.readers = parallel.thread_count() if order.hold else 1  # it is not to run on by itself
        is_again = copied is not None
        copied = self._first.copy_running(base=base, enough=enough, copied=copied)
        self._tree.copy_running(base=base, enough=enough, again=is_again)
        return copied

    def _ready(self, order: CaptureOrder, copied: RunningCopy, *, base: bool) -> RunningCopy:
        """Be ready for the freeze, and wait until the program may stand still; what it writes meanwhile is copied again."""
        while True:
            processes = (self._first, *self._tree.processes())
            self._first.memory.buffer.begin()
            for process in processes:
                process.rehearse()
            if order.gate is None or order.gate.opens(tuple(process.pid for process in processes)):
                return copied
            self._admit(base=base)
            copied = self._copied_running(order, copied, base=base)

    def _enough(self) -> int:
        """Pages that each process may leave for the freeze; 0 where no budget is set."""
        return max(1, self._budget.page_count // (1 + len(self._tree.processes()))) if self._budget else 0

    def _look_from_outside(self) -> None:
        """Look at a refused program without stopping it: a program that keeps an epoll for a week is left in peace."""
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

    def _frozen_look(self, copied: RunningCopy | None, *, base: bool, order: CaptureOrder) -> Frozen:
        """Everything that needs the program to stand still; the gate is told when it is over."""
        try:
            return self._looked_at(copied, base=base, hold=order.hold)
        finally:
            if order.gate is not None:
                order.gate.closes(stood_still=True)

    def _looked_at(self, copied: RunningCopy | None, *, base: bool, hold: bool) -> Frozen:
        self._first.memory.buffer.begin()
        if copied is None:
            self._first.prepare(base=base)
        began = self._standstill.freeze()
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
            seen = self._carried.look(shared_inodes(first, others)) if self._carried else Seen()
            segments = self._segments(others)
            if hold:
                self._require_whole(first, others)
            if hold and self._surroundings.connections:
                self._standstill.departing = tcp_handover.depart(opened(first, others))
        except BaseException as error:
            self._standstill.note(began, self._standstill.thaw())
            self._standstill.raise_if_late(error)
            raise
        ended = self._standstill.hold() if hold else self._standstill.thaw()
        self._budget.ended(ended)
        return Frozen(first, others, self._standstill.note(began, ended), seen, self._standstill.departing, segments)

    def _segments(self, others: SeenOthers | None) -> dict[int, Segment]:
        """The System V shared memory of this machine, where any of them has some: others may attach it, and be born."""
        looked_at = (self._first, *(process for process, _ in others.looks())) if others else (self._first,)
        return system_v_ipc.segments() if any(process.memory.has_segments for process in looked_at) else {}

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
