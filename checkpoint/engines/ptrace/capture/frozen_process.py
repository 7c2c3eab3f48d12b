"""Query a frozen process for everything besides its memory; parsing waits until the process runs again where that is possible."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Sequence
from typing import Final

from msgspec import Struct

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import Registers
from checkpoint.device_rules import DeviceRule
from checkpoint.engines.ptrace.capture.enter import Entered, where_it_stands
from checkpoint.engines.ptrace.capture.frozen_threads import Read, ThreadOnlooker, ThreadPlace, ThreadStanding
from checkpoint.engines.ptrace.capture.seccomp import Confinements
from checkpoint.engines.ptrace.facts.remote_queries import Inquiry, Told, rearmed
from checkpoint.engines.stream_output import Outputs
from checkpoint.errors import CaptureError
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptors import lending
from checkpoint.linux.procfs.procfs import KeptFiles, Stat, Status
from checkpoint.linux.procfs.timers import parse_timers
from checkpoint.linux.trace import seccomp
from checkpoint.linux.trace.bulk_reads import Readings, Unread, Waiting
from checkpoint.linux.trace.seccomp import FREE, Confinement
from checkpoint.linux.trace.syscall_batch import Answers
from checkpoint.linux.trace.threads import Threads
from checkpoint.resources import signal_owners
from checkpoint.resources.open_file import Opened, OpenFile, Owners
from checkpoint.resources.process.thread_credentials import ThreadRights
from checkpoint.resources.process.unshared_threads import ThreadTables
from checkpoint.resources.socket_cache import Recollection
from checkpoint.resources.survey import Kept, gather, with_contents
from checkpoint.segment.output_counters import Totals

NOTHING_WRITTEN: Final[Totals] = (0, 0)
FEW: Final = 64
"""Descriptors that are read, in less than a millisecond, while the process makes its calls: it does not wait for us for ever."""


class Place(Read, Struct, frozen=True):
    """Where the first thread stands, and the others.

    Attributes:
        registers: that it is given back, as `Tracee.registers` gives them.
        special: signals with an action of their own, bit 0 is signal 1.
    """

    registers: bytes
    unread: Unread
    special: int
    shared_pending: tuple[bytes, ...]
    status_text: bytes
    others: tuple[ThreadPlace, ...] = ()
    confinement: Confinement = FREE

    def every_pending(self) -> tuple[bytes, ...]:
        """All pending signals, of any thread and of the process."""
        return (*self.pending, *self.shared_pending, *(siginfo for other in self.others for siginfo in other.pending))


class Standing(Struct, frozen=True, dict=True):
    """Everything that was asked; nothing in it needs the process any more.

    Attributes:
        others: the threads besides the first.
        waiting: signals that were pending after the process had been asked.
        totals: see `Outputs.totals`.
    """

    place: Place
    others: tuple[ThreadStanding, ...]
    settled: Registers
    interrupted: str
    inquiry: Inquiry
    answers: Answers
    waiting: tuple[bytes, ...]
    opened: tuple[OpenFile, ...]
    totals: Totals

    @functools.cached_property
    def told(self) -> Told:
        """Its own answers about itself."""
        return rearmed(self.inquiry.read(self.answers), self.place.every_pending(), self.waiting)

    @functools.cached_property
    def status(self) -> Status:
        """Its /proc/PID/status."""
        return procfs.parse_status(os.fsdecode(self.place.status_text))

    @functools.cached_property
    def stat(self) -> Stat:
        """Its /proc/PID/stat."""
        return procfs.parse_stat(os.fsdecode(self.place.reading.text))


class Onlooker:
    """Asks one process, again and again; the questions stay the same while its signals and timers do.

    Attributes:
        rights: those of threads whose rights differ from the first thread's.
        tables: descriptors and directories that threads have for themselves.
    """

    def __init__(self, threads: Threads, entered: Entered, devices: tuple[DeviceRule, ...]) -> None:
        self._devices = devices
        self._tracee = threads.leader
        self._threads = threads
        self._kept = Kept(threads.pid)
        self._files = KeptFiles(threads.pid)
        self._readings = Readings()
        self._waiting = Waiting(threads.leader)
        self._confinements = Confinements(entered.interruptions)
        self._others = ThreadOnlooker(threads, entered, self._confinements)
        self._recollection = Recollection()
        self.rights = ThreadRights(threads.pid)
        self.tables = ThreadTables(threads.pid)
        self._borrowed = entered.pages
        self._interruptions = entered.interruptions
        self._inquiry: Inquiry | None = None
        self._inquiry_key: tuple[int, bytes] = (0, b"")

    def gather(self) -> Opened:
        """Its open files. The picture is exact only if the process stands still."""
        return gather(self._tracee.pid, self._kept)

    @property
    def owners(self) -> Owners:
        """The known owners of its files' signals."""
        return self._kept.owners

    def overlooked(self, opened: Sequence[OpenFile]) -> OpenFile | None:
        """See `checkpoint.resources.signal_owners.overlooked`."""
        return signal_owners.overlooked(opened, self._kept.owners)

    def _with_contents(self, opened: Opened) -> tuple[OpenFile, ...]:
        with lending(self._tracee.pid):
            return with_contents(opened, self._borrowed.noted, self._devices, self._recollection)

    def close(self) -> None:
        """Close the files that are kept open about it."""
        self._kept.texts.close()
        self._files.close()
        self._others.close()
        self._recollection.close()

    def is_entered(self) -> bool:
        """Whether it still is the program that was entered."""
        return self._borrowed.are_there()

    def prepare(self) -> None:
        """Do what the first look would do for the first time, while the program runs."""
        if self._inquiry is None:
            special, _, _ = procfs.signal_sets(procfs.read_bytes(self._tracee.pid, "status"))
            self._questions(special)
            with contextlib.suppress(CaptureError):  # it runs: one of its threads has just closed something
                opened = self.gather()
                self.overlooked(opened)
                with_contents(opened, None, self._devices)
            self._kept.texts.forget()
            if self._threads.is_one_of_many:  # open files of several processes are read for all at once, not through kept files
                self._kept.texts.close()
        self._recollection.prepare()
        self._others.prepare()
        self.rights.prepare()
        self.tables.prepare()

    def rehearse(self) -> None:
        """See `CapturedProcess.rehearse`."""
        procfs.signal_sets(self._files.read("status"))
        self._files.read("timers")
        self._readings.rehearse(self._tracee.pid, self._files.descriptor("stat"))
        self._borrowed.rehearse(self._tracee)
        self._kept.texts.rehearse()

    def place(self) -> Place:
        """Where it stands, before anything else is asked.

        Raises:
            CaptureError: it has not left the code of an earlier look yet.
            UnsupportedError: it has come under a seccomp filter since, and we may do nothing about it.
        """
        tracee = self._tracee
        status = self._files.read("status")
        mode = seccomp.mode_in(status)
        confined = self._confinements.suspended(tracee, mode, (tracee.pid, 0))
        unread, *of_others = self._readings.read(
            [tracee, *self._threads.others], [self._files.descriptor("stat"), *self._others.name_files()]
        )
        special, _, waits_shared = procfs.signal_sets(status)
        shared_pending = tracee.pending(shared=True) if waits_shared else ()
        registers = where_it_stands(tracee, unread.registers, lambda: unread.rseq, self._interruptions)
        if self._borrowed.holds(arch.stand_of(registers)[0]):
            raise CaptureError(f"pid {tracee.pid} is still in code of an earlier capture; capture it again in a moment")
        others = self._others.places(of_others, self.rights.modes, mode)
        return Place(registers, unread, special, shared_pending, status, others, confined)

    def ask(self, place: Place, outputs: Outputs | None, opened: Opened | None = None) -> Standing:
        """Everything else. Its system calls are made inside the process: the memory has been taken before.

        Args:
            opened: its open files, if they are known already.
        """
        tracee = self._tracee
        self.tables.look()
        inquiry = self._questions(place.special)
        with self._borrowed.errand(tracee, inquiry.batch, place.registers, place.mask) as errand:
            if opened is None and 0 < len(self._kept.texts.numbers) <= FEW:
                opened = self.gather()
            errand.call_back()
            contents = self._with_contents(self.gather() if opened is None else opened)  # meanwhile it stops
        others = self._others.ask(place.others)
        waiting = self._waiting.read()
        if inquiry.has_timers:
            waiting += self._others.waiting(place.others)
        settled, interrupted = self._interruptions.of(tracee).settled(arch.decode_registers(place.registers))
        return Standing(
            place=place,
            others=others,
            settled=settled,
            interrupted=interrupted,
            inquiry=inquiry,
            answers=errand.answers[0],
            waiting=waiting,
            opened=contents,
            totals=outputs.totals() if outputs else NOTHING_WRITTEN,
        )

    def _questions(self, special: int) -> Inquiry:
        timers = self._files.read("timers")
        key = (special, timers)
        if self._inquiry is None or self._inquiry_key != key:
            lines = parse_timers(os.fsdecode(timers)) if timers else ()
            self._inquiry, self._inquiry_key = Inquiry(self._borrowed.table, special, lines), key
        return self._inquiry
