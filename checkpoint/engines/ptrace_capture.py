"""Capture by ptrace: one protected process, from `PtraceSession.open` to `PtraceSession.close`.

One capture::

    freeze       stop it; registers, mask, pending signals; maps                  the program stands still
    scan, copy   which pages were written, and their bytes
    ask          a batch of system calls inside it (`checkpoint.linux.remote`); descriptors; output counts
    thaw         everything as it was
    describe     zero pages dropped, digests, files identified, refusals          the program runs

The first base does not freeze for its size: pages are protected and copied while the program runs, and the freeze brings what was
written meanwhile.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import signal
import time
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from checkpoint import pages
from checkpoint.arch import x86_64 as arch
from checkpoint.chain import position_of
from checkpoint.engine import CaptureOrder, Streams
from checkpoint.engines import description, entering
from checkpoint.engines import probe as probing
from checkpoint.engines.entering import Entered, where_it_stands
from checkpoint.engines.identities import Identities
from checkpoint.engines.inquiry import Inquiry, Told, rearmed
from checkpoint.engines.outputs import Outputs, Totals
from checkpoint.errors import CaptureError, ProbeError, ProcessGoneError, UnsupportedError
from checkpoint.linux import abi, digests, pagetables, procfs, tracking
from checkpoint.linux.digests import SharedPages
from checkpoint.linux.procfs import MapsLine, MapsReader, Stat, Status
from checkpoint.linux.timers import parse_timers
from checkpoint.linux.tracee import Tracee
from checkpoint.linux.tracking import NONE
from checkpoint.model import (
    Position,
    ProcessState,
    Rseq,
    Snapshot,
    ThreadState,
    Vma,
)
from checkpoint.pages import PageTable, Words
from checkpoint.resources import OpenFile, Surroundings, gather, look, unsupported, with_contents

US_PER_NS: Final = 1000
EMPTY_CONTENT: Final = bytearray()
BUFFER_SIZE: Final = 8 << 20
"""Bytes that a freeze may copy without asking for memory first."""


@dataclass(frozen=True, slots=True)
class Frozen:
    """Everything that one freeze brought home; nothing in it needs the process any more.

    Attributes:
        written, cleared: relative to the acknowledged position, see `tracking.Scan`.
        content: begins with the bytes of ``written``.
        status, stat: of /proc, unparsed.
        freeze_us: how long the program stood still.
    """

    registers: bytes
    xstate: bytes
    mask: int
    pending: tuple[bytes, ...]
    shared_pending: tuple[bytes, ...]
    rseq: Rseq | None
    settled: arch.Registers
    interrupted: str
    lines: tuple[MapsLine, ...]
    status: bytes
    stat: bytes
    told: Told
    opened: tuple[OpenFile, ...]
    totals: Totals
    written: Words
    cleared: Words
    guards: Words
    content: bytearray
    freeze_us: int


UNACKNOWLEDGED_LIMIT: Final = 64
"""Scans that are remembered one by one. Beyond, the oldest two become one, and the older position can be acknowledged no more: a
standby whose disk is full for a week must not make every freeze longer."""

NOWHERE: Final = Position(0, 0, b"")


@dataclass(frozen=True, slots=True)
class Unacknowledged:
    """What one scan found, kept until a position that holds it is acknowledged."""

    position: Position | None
    written: Words
    cleared: Words


class PtraceSession:
    """One protected process; every call from the thread that opened it. See ``checkpoint.engine.Session``.

    Invariants: between captures nobody traces the process; ``_unacknowledged`` holds every page written since the newest
    acknowledged position; ``_table`` is the state at the last capture that was handed out.
    """

    def __init__(self, pid: int, component: str, tracee: Tracee, entered: Entered) -> None:
        self.pid = pid
        self.component = component
        self.notes = entered.notes
        self.totals: Totals = (0, 0)
        self._tracee = tracee
        self._borrowed = entered.pages
        self._tracker = entered.tracker
        self._shared = SharedPages(pid)
        self._page_tables = pagetables.existence(pid)
        self._maps = MapsReader(pid)
        self._has_moved = False
        self._lines: tuple[MapsLine, ...] = ()
        self._private: list[MapsLine] = []
        self._shared_lines: list[MapsLine] = []
        self._had_shared = False
        self._inquiry: Inquiry | None = None
        self._inquiry_key: tuple[object, ...] = ()
        self._buffer = bytearray(BUFFER_SIZE)
        self._flags: dict[int, tuple[str, ...]] = {}
        self._flags_of: tuple[MapsLine, ...] = ()
        self._identities = Identities(pid)
        self._interruption = entered.interruption
        self._outputs: Outputs | None = None
        self._based = False
        self._table = PageTable.empty(abi.PAGE_SIZE)
        self._unacknowledged: list[Unacknowledged] = []
        self._acknowledged: Position | None = None
        self._totals_at: dict[Position, Totals] = {}
        self._refused = False
        self._held = False
        self._before_hold: Any = None
        self._closed = False

    # Opening and closing

    @classmethod
    def open(cls, pid: int, component: str, streams: Streams | None) -> PtraceSession:
        """See ``checkpoint.engine.Engine.protect``."""
        outputs = Outputs(streams) if streams else None
        try:
            report = probing.probe(pid, streams)
            if not report.supported:
                listed = "; ".join(report.reasons)
                raise UnsupportedError(f"cannot protect pid {pid} ({report.command}): {listed}", report.reasons)
            tracee = Tracee(pid)
            session = cls(pid, component, tracee, entering.enter(tracee))
        except BaseException:
            if outputs:
                outputs.close()
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
        self._tracker.close()
        self._shared.close()
        self._page_tables.close()
        if self._outputs:
            self._outputs.close()

    def acknowledge(self, position: Position) -> None:
        """See ``checkpoint.engine.Session.acknowledge``. A position that is not known (any more) changes nothing."""
        places = [index for index, held in enumerate(self._unacknowledged) if held.position == position]
        if not places:
            return
        del self._unacknowledged[: places[-1] + 1]
        self._acknowledged = position
        self._totals_at = {known: totals for known, totals in self._totals_at.items() if known >= position}

    # Capturing

    def capture(self, order: CaptureOrder) -> Snapshot:
        """See ``checkpoint.engine.Session.capture``."""
        parent = None if order.base else self._acknowledged
        if self._refused:
            self._look_from_outside()
        try:
            copied = self._copy_running() if parent is None else None
            frozen = self._frozen_look(base=copied is not None, hold=order.hold)
        except ProcessGoneError as error:
            raise self._gone(error) from error
        frozen = replace(frozen, content=frozen.content[: pages.total_size(frozen.written)])
        try:
            return self._described(order, parent, copied, frozen)
        except (FileNotFoundError, ProcessLookupError) as error:
            raise ProcessGoneError(f"{self.component} (pid {self.pid}) ended while it was being described") from error

    def _described(
        self, order: CaptureOrder, parent: Position | None, copied: tuple[Words, bytearray] | None, frozen: Frozen
    ) -> Snapshot:
        """The snapshot of what a freeze brought home, while the program runs."""
        held = look(frozen.opened, self._outputs.surroundings if self._outputs else Surroundings())
        reasons = (*held.reasons, *self._reasons_of(frozen))
        self._refuse(reasons)
        if copied is not None:
            frozen = _merged(copied, frozen)
        vmas = self._identities.vmas(frozen.lines, self._flags, frozen.guards)
        snapshot = self._with_pages(self._outline(order, parent, frozen, vmas), frozen)
        snapshot = replace(
            snapshot,
            resources=held.resources,
            output=self._outputs.pieces(self._output_since(parent), frozen.totals) if self._outputs else (),
        )
        snapshot = replace(snapshot, position=position_of(snapshot, order.generation, order.sequence))
        self._unacknowledged[-1] = replace(self._unacknowledged[-1], position=snapshot.position)
        self._totals_at[snapshot.position] = self.totals = frozen.totals
        return snapshot

    def _look_from_outside(self) -> None:
        """What was refused once is looked at without stopping it: a program that has an epoll for a week is left in peace."""
        with contextlib.suppress(ProcessGoneError, ProbeError):
            held = look(gather(self.pid), self._outputs.surroundings if self._outputs else Surroundings())
            self._refuse((*held.reasons, *unsupported.refuse_process(self.pid, procfs.status(self.pid))))

    def _refuse(self, reasons: tuple[str, ...]) -> None:
        self._refused = bool(reasons)
        if reasons:
            raise UnsupportedError(f"cannot capture {self.component} (pid {self.pid}): {'; '.join(reasons)}", reasons)

    def _gone(self, error: ProcessGoneError) -> ProcessGoneError:
        """A process that executed another program is not the one that was protected."""
        with contextlib.suppress(ProcessGoneError, ProbeError):
            if procfs.status(self.pid).state in "ZX":
                return error
            self._based = False
            return ProcessGoneError(f"{self.component} (pid {self.pid}) has become another program (exec): protect it anew")
        return error

    def _output_since(self, parent: Position | None) -> Totals:
        """Where a snapshot's output begins: a base may go to a robot that has nothing yet."""
        return self._totals_at.get(parent, (0, 0)) if parent else (0, 0)

    def _copy_running(self) -> tuple[Words, bytearray]:
        """Copy everything that exists while the program runs: the set of pages, and their bytes.

        What changes meanwhile is written once more by the scan that follows. A page that cannot be read now has gone
        or is coming, and is then found by that scan, too.
        """
        self._refresh_mappings()
        lines = self._private
        if not self._based:
            self._tracker.arm(lines)
            self._based = True
        self._shared.forget()
        self._read_flags()
        existing = self._tracker.existing(lines)
        found, content = [], bytearray(pages.total_size(existing))
        filled = 0
        for chunk in digests.chunks_of(existing):
            chunk, part = self._tracee.memory.readable_pages(chunk)
            found.append(chunk)
            content[filled : filled + len(part)] = part
            filled += len(part)
        del content[filled:]
        return pagetables.pages_joined(np.concatenate(found)) if found else NONE, content

    def _frozen_look(self, *, base: bool, hold: bool) -> Frozen:
        tracee = self._tracee
        began = self._freeze()
        try:
            look_ = self._look(base=base)
        except BaseException:
            self._thaw()
            raise
        if hold:
            self._hold()
        else:
            self._thaw()
        return replace(look_, freeze_us=(time.perf_counter_ns() - began) // US_PER_NS if tracee else 0)

    def _freeze(self) -> int:
        """Stop it, nothing of ours half done inside; answers when that began."""
        if self._held:
            return time.perf_counter_ns()
        gc.disable()
        began = time.perf_counter_ns()
        self._tracee.seize()
        self._tracee.freeze()
        return began

    def _hold(self) -> None:
        """Leave it standing; should it be killed meanwhile, its parent hears of it only after we have taken note."""
        self._held = True
        if procfs.status(self.pid).ppid != os.getpid():  # a parent takes note by itself
            self._before_hold = signal.signal(signal.SIGCHLD, lambda *_: self._take_note())

    def _take_note(self) -> None:
        with contextlib.suppress(ChildProcessError):
            os.waitid(os.P_PID, self.pid, os.WEXITED | os.WNOHANG)

    def _thaw(self) -> None:
        if self._before_hold is not None:
            signal.signal(signal.SIGCHLD, self._before_hold)
        self._held, self._before_hold = False, None
        with contextlib.suppress(ProcessGoneError):
            self._tracee.detach()
        gc.enable()

    def _look(self, *, base: bool) -> Frozen:
        """Everything that needs the program to stand still."""
        tracee = self._tracee
        status = procfs.read_bytes(self.pid, "status")
        special, waits_here, waits_shared = procfs.signal_sets(status)
        pending = tracee.pending(shared=False) if waits_here else ()
        shared_pending = tracee.pending(shared=True) if waits_shared else ()
        mask, rseq = tracee.signal_mask(), tracee.rseq()
        decoded = where_it_stands(tracee, mask, (*pending, *shared_pending), rseq)
        if self._borrowed.holds(decoded[arch.INSTRUCTION_POINTER]):
            raise CaptureError(f"pid {self.pid} still stands in code of an earlier look; capture it again in a moment")
        registers = arch.encode_registers(decoded)
        self._refresh_mappings()
        guards = self._page_tables.guards(self._mapped())
        self._remember(_without(guards, self._scan()))
        written, cleared = self._since_acknowledged(base=base)
        content = tracee.memory.read_pages(written, self._buffer) if len(written) else EMPTY_CONTENT
        told = self._ask(special, registers, mask)
        waiting = (*tracee.pending(shared=False), *tracee.pending(shared=True)) if self._has_signals() else ()
        settled, interrupted = self._interruption.settled(decoded)
        return Frozen(
            registers=registers,
            xstate=tracee.xstate(),
            mask=mask,
            pending=pending,
            shared_pending=shared_pending,
            rseq=rseq,
            settled=settled,
            interrupted=interrupted,
            lines=self._lines,
            status=status,
            stat=procfs.read_bytes(self.pid, "stat"),
            told=rearmed(told, (*pending, *shared_pending), waiting),
            opened=with_contents(gather(self.pid)),
            totals=self._outputs.totals() if self._outputs else (0, 0),
            written=written,
            cleared=cleared,
            guards=guards,
            content=content,
            freeze_us=0,
        )

    def _refresh_mappings(self) -> None:
        """Read and sort the mappings; that they have changed is kept until a scan has been told."""
        if not self._maps.refresh():
            return
        self._has_moved = True
        self._lines = tuple(line for line in self._maps.lines if not self._borrowed.holds(line.start))
        self._private = [line for line in self._lines if tracking.is_private(line)]
        self._shared_lines = [line for line in self._lines if tracking.is_shared(line) or tracking.is_orphan(line)]

    def _scan(self) -> tracking.Scan:
        """What was written since the last scan. One that fails half-way has protected pages that it tells nobody of."""
        try:
            scan = self._tracker.scan(self._private, changed=self._has_moved)
        except CaptureError:
            self._start_over()
            raise
        self._has_moved = False
        if not self._shared_lines and not self._had_shared:
            return scan
        self._had_shared = bool(self._shared_lines)
        shared = self._shared.scan(self._shared_lines)
        orphans = tracking.extents_of([line for line in self._shared_lines if tracking.is_orphan(line)])
        cleared = pages.difference(
            scan.cleared, orphans
        )  # what the tracker says of them dates from before their file was deleted
        return tracking.Scan(pages.union(scan.written, shared.written), pages.union(cleared, shared.cleared))

    def _start_over(self) -> None:
        """Make the next snapshot a base, with everything armed anew: what was written is not known any more."""
        self._based, self._acknowledged = False, None
        self._unacknowledged.clear()

    def _ask(self, special: int, registers: bytes, mask: int) -> Told:
        """Have the process say what only it can; the questions stay the same while its signals and timers do."""
        timers = parse_timers(text) if (text := procfs.read_text(self.pid, "timers")) else ()
        key = (special, timers)
        if self._inquiry is None or self._inquiry_key != key:
            self._inquiry, self._inquiry_key = Inquiry(self._borrowed.table, special, timers), key
        return self._inquiry.read(self._borrowed.run(self._tracee, self._inquiry.batch, registers, mask))

    def _has_signals(self) -> bool:
        return any(procfs.signal_sets(procfs.read_bytes(self.pid, "status"))[1:])

    def _read_flags(self) -> None:
        """VmFlags cost a walk over all pages: read while the program runs, and only when the mappings changed."""
        if self._flags_of != self._maps.lines:
            self._flags = procfs.parse_vm_flags(procfs.read_text(self.pid, "smaps"))
            self._flags_of = self._maps.lines

    def _remember(self, scan: tracking.Scan) -> None:
        """Keep what a scan found until it is acknowledged; a scan whose capture failed is joined with the next."""
        if self._unacknowledged and self._unacknowledged[-1].position is None:
            last = self._unacknowledged.pop()
            still = pages.intersection(pages.difference(last.written, scan.cleared), self._mapped())
            scan = tracking.Scan(pages.union(still, scan.written), pages.union(last.cleared, scan.cleared))
        self._unacknowledged.append(Unacknowledged(None, scan.written, scan.cleared))
        if len(self._unacknowledged) > UNACKNOWLEDGED_LIMIT:
            oldest, next_one, *rest = self._unacknowledged
            self._totals_at.pop(oldest.position or NOWHERE, None)
            self._unacknowledged = [_joined(oldest, next_one), *rest]

    def _since_acknowledged(self, *, base: bool) -> tuple[Words, Words]:
        """What a delta must carry: the union of all scans since. A base needs the last scan alone."""
        scans = self._unacknowledged[-1:] if base else self._unacknowledged
        if len(scans) == 1:
            return scans[0].written, scans[0].cleared
        union = functools.reduce(_joined, scans)
        return pages.intersection(union.written, self._mapped()), union.cleared

    def _mapped(self) -> Words:
        """Everything that a snapshot may carry pages of."""
        return tracking.extents_of([line for line in self._lines if line.name not in tracking.NOT_CARRIED])

    # Describing, while the program runs

    def _reasons_of(self, frozen: Frozen) -> tuple[str, ...]:
        """Why what it has turned into cannot be captured."""
        try:
            self._read_flags()
            of_mappings = (unsupported.refuse_mapping(line, self._foreign_flags(line)) for line in frozen.lines)
            return (*unsupported.refuse_process(self.pid, _status_of(frozen)), *(reason for reason in of_mappings if reason))
        except ProcessGoneError:
            return ()  # the picture was taken before it ended

    def _foreign_flags(self, line: MapsLine) -> tuple[str, ...]:
        """VmFlags without those that our own write protection sets."""
        return tuple(flag for flag in self._flags.get(line.start, ()) if flag not in ("um", "uw"))

    def _outline(self, order: CaptureOrder, parent: Position | None, frozen: Frozen, vmas: tuple[Vma, ...]) -> Snapshot:
        """A snapshot without pages, descriptors and output."""
        return Snapshot(
            component=self.component,
            engine="ptrace",
            position=Position(order.generation, order.sequence, bytes(16)),
            parent=parent,
            machine=replace(description.this_machine(), robot=order.robot, xstate_mask=description.xstate_mask(frozen.xstate)),
            clocks=frozen.told.clocks,
            process=self._process_state(frozen),
            threads=(self._thread_state(frozen),),
            vmas=vmas,
            epoch=order.epoch,
            freeze_us=frozen.freeze_us,
            notes=self.notes,
        )

    def _with_pages(self, outline: Snapshot, frozen: Frozen) -> Snapshot:
        """Add the pages: zero pages of anonymous memory are told, not carried."""
        addresses = pages.addresses_of(frozen.written, abi.PAGE_SIZE)
        content: bytearray | memoryview = frozen.content
        zero = pages.zero_pages(content, abi.PAGE_SIZE) if len(addresses) else np.zeros(0, dtype=np.bool_)
        of_files = tracking.extents_of([line for line in frozen.lines if line.has_file])
        zero &= ~pages.covered(of_files, addresses)
        cleared = frozen.cleared
        if zero.any():
            rows = np.frombuffer(content, dtype=np.uint8).reshape(-1, abi.PAGE_SIZE)
            content = rows[~zero].data.cast("B").toreadonly()
            cleared = pages.union(cleared, pages.extents_of_addresses(addresses[zero], abi.PAGE_SIZE))
            addresses = addresses[~zero]
        runs = pages.page_runs(pages.extents_of_addresses(addresses, abi.PAGE_SIZE))
        is_base = outline.parent is None
        forgotten = () if is_base else pages.page_runs(cleared)
        before = PageTable.empty(abi.PAGE_SIZE) if is_base else self._table
        self._table = before.apply(forgotten, runs, content, outline.vmas)
        return replace(
            outline, cleared=forgotten, runs=runs, contents=memoryview(content).toreadonly(), page_sum=self._table.page_sum
        )

    def _thread_state(self, frozen: Frozen) -> ThreadState:
        told, stat, status = frozen.told, _stat_of(frozen), _status_of(frozen)
        return ThreadState(
            tid=status.pids[-1],
            name=status.name,
            registers={"prstatus": arch.encode_registers(frozen.settled), "xstate": frozen.xstate},
            signal_mask=frozen.mask,
            pending=frozen.pending,
            altstack=told.altstack,
            robust_list=told.robust_list,
            clear_tid=told.clear_tid,
            rseq=frozen.rseq,
            policy=description.policy(self.pid),
            priority=stat.priority,
            nice=stat.nice,
            io_priority=abi.io_priority(self.pid),
            affinity=description.affinity(self.pid),
            timer_slack_ns=told.timer_slack_ns,
            interrupted=frozen.interrupted,
        )

    def _process_state(self, frozen: Frozen) -> ProcessState:
        status, told = _status_of(frozen), frozen.told
        return ProcessState(
            pid=status.pids[-1],
            ppid=status.ppid if len(status.pids) == 1 else 0,
            pgid=status.pgids[-1] if status.pgids else 0,
            sid=status.sids[-1] if status.sids else 0,
            executable=self._identities.executable(),
            arguments=tuple(os.fsdecode(procfs.read_bytes(self.pid, "cmdline")).split("\0")[:-1]),
            layout=description.layout(_stat_of(frozen), told, procfs.read_bytes(self.pid, "auxv")),
            working_directory=procfs.read_link(self.pid, "cwd"),
            root_directory=procfs.read_link(self.pid, "root"),
            umask=status.umask,
            credentials=description.credentials(status, told),
            personality=int(procfs.read_text(self.pid, "personality"), 16),
            limits=procfs.limits(self.pid),
            oom_score_adj=int(procfs.read_text(self.pid, "oom_score_adj")),
            dumpable=told.dumpable,
            keep_caps=told.keep_caps,
            child_subreaper=told.child_subreaper,
            parent_death_signal=told.parent_death_signal,
            thp_disabled=told.thp_disabled,
            switches=told.switches,
            coredump_filter=description.coredump_filter(self.pid),
            signal_actions=told.actions,
            pending=frozen.shared_pending,
            interval_timers=told.interval_timers,
            posix_timers=told.posix_timers,
            isolated=len(status.pids) > 1,
        )


# Pieces


def _without(guards: Words, scan: tracking.Scan) -> tracking.Scan:
    """A page that has become a guard counts as written, and there is nothing to read."""
    installed = pages.intersection(scan.written, guards) if len(guards) else NONE
    if not len(installed):
        return scan
    return tracking.Scan(pages.difference(scan.written, installed), pages.union(scan.cleared, installed))


def _joined(earlier: Unacknowledged, later: Unacknowledged) -> Unacknowledged:
    """Two scans as one, known by the later one's position."""
    written = pages.union(pages.difference(earlier.written, later.cleared), later.written)
    return Unacknowledged(later.position, written, pages.union(earlier.cleared, later.cleared))


def _merged(copied: tuple[Words, bytearray], frozen: Frozen) -> Frozen:
    """One base of the pages that were copied while the program ran and those of the freeze."""
    before, content = copied
    mapped = tracking.extents_of([line for line in frozen.lines if line.name not in tracking.NOT_CARRIED])
    replaced = pages.union(frozen.written, frozen.cleared)
    keep = pages.intersection(pages.difference(before, replaced), mapped)
    old = pages.addresses_of(before, abi.PAGE_SIZE)
    kept = pages.covered(keep, old)
    new = pages.addresses_of(frozen.written, abi.PAGE_SIZE)
    addresses = np.concatenate((old[kept], new))
    order = np.argsort(addresses, kind="stable")
    rows = np.empty((len(addresses), abi.PAGE_SIZE), dtype=np.uint8)
    places = np.empty(len(addresses), dtype=np.int64)
    places[order] = np.arange(len(addresses))
    count = int(kept.sum())
    rows[places[:count]] = np.frombuffer(content, dtype=np.uint8).reshape(-1, abi.PAGE_SIZE)[kept]
    rows[places[count:]] = np.frombuffer(frozen.content, dtype=np.uint8).reshape(-1, abi.PAGE_SIZE)
    return replace(
        frozen,
        written=pages.extents_of_addresses(addresses[order], abi.PAGE_SIZE),
        cleared=NONE,
        content=bytearray(rows.data.cast("B")),
    )


def _status_of(frozen: Frozen) -> Status:
    return procfs.parse_status(os.fsdecode(frozen.status))


def _stat_of(frozen: Frozen) -> Stat:
    return procfs.parse_stat(os.fsdecode(frozen.stat))
