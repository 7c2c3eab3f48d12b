"""Query the threads besides the first one while all threads are frozen.

The kernel reports most of the facts. Three facts only the thread itself can report, through a batch of its own: all threads
answer at the same time, at the small call areas (desks) of the borrowed pages. Facts that cannot change in a thread's life are
looked up before the freeze.
"""

from __future__ import annotations

import contextlib
import functools
import os
import struct
from collections.abc import Collection, Mapping, Sequence
from typing import Final, NamedTuple

from msgspec import Struct

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import Registers
from checkpoint.engines.ptrace.capture.enter import Entered, where_it_stands
from checkpoint.engines.ptrace.capture.seccomp import Confinements, Life
from checkpoint.engines.ptrace.capture.syscall_restart import Interruption
from checkpoint.errors import CaptureError, ProbeError, ProcessGoneError, UnsupportedError
from checkpoint.linux import abi
from checkpoint.linux.procfs import procfs
from checkpoint.linux.procfs.descriptor_cache import TEXTS_KEPT
from checkpoint.linux.procfs.tasks import thread_ids
from checkpoint.linux.trace.bulk_reads import NO_FILE, Reading, Unread
from checkpoint.linux.trace.seccomp import FILTERED, FREE, Confinement
from checkpoint.linux.trace.syscall_batch import SMALL, Answers, Batch
from checkpoint.linux.trace.syscall_desk import Desk, Guest
from checkpoint.linux.trace.threads import Threads
from checkpoint.linux.trace.tracee import Tracee
from checkpoint.model import Rseq


class Read:
    """The state read of any thread that stands, the first one or another."""

    __slots__ = ()

    unread: Unread

    @property
    def reading(self) -> Reading:
        """The kernel's answers."""
        return self.unread.reading

    @property
    def mask(self) -> int:
        """The program's own."""
        return self.unread.mask

    @property
    def pending(self) -> tuple[bytes, ...]:
        """Signals sent to this very thread."""
        return self.reading.pending

    @property
    def rseq(self) -> Rseq | None:
        """Its registration for restartable sequences."""
        return self.reading.rseq


class ThreadPlace(Read, Struct, frozen=True):
    """Where a thread stands.

    Attributes:
        registers: that it is given back, as `Tracee.registers` gives them.
        inner_tid: its id as it sees it itself.
        comm: its /proc/PID/task/TID/comm; empty where that was read with all the rest.
        confinement: by seccomp(2); suspended as long as it stands.
    """

    tracee: Tracee
    life: Life
    inner_tid: int
    registers: bytes
    unread: Unread
    comm: bytes = b""
    confinement: Confinement = FREE


class ThreadStanding(Struct, frozen=True, dict=True):
    """Everything that a thread was asked; nothing in it needs the process any more.

    Attributes:
        interruption: of the thread.
    """

    place: ThreadPlace
    interruption: Interruption
    questions: ThreadQuestions
    answers: Answers

    @property
    def reading(self) -> Reading:
        """The kernel's answers about it."""
        return self.place.reading

    def settle(self) -> None:
        """Have the call remembered that it stands in: before the program is stopped again."""
        _ = self._settled

    @property
    def settled(self) -> Registers:
        """Registers that a snapshot goes on with."""
        return self._settled[0]

    @property
    def interrupted(self) -> str:
        """See ``checkpoint.model.ThreadState``."""
        return self._settled[1]

    @functools.cached_property
    def _settled(self) -> tuple[Registers, str]:
        return self.interruption.settled(arch.decode_registers(self.place.registers))

    @property
    def name(self) -> str:
        """The name that PR_SET_NAME sets."""
        return os.fsdecode((self.place.comm or self.reading.text).removesuffix(b"\n"))

    @functools.cached_property
    def altstack(self) -> tuple[int, int, int]:
        """(address, flags, size) of sigaltstack(2)."""
        return self.questions.altstack_in(self.answers)

    @property
    def clear_tid(self) -> int:
        """The address given to set_tid_address(2)."""
        return self.questions.clear_tid_in(self.answers)

    @property
    def timer_slack_ns(self) -> int:
        """The answer of prctl(2), PR_GET_TIMERSLACK."""
        return self.questions.timer_slack_in(self.answers)

    @property
    def death_signal(self) -> int:
        """The answer of prctl(2), PR_GET_PDEATHSIG; 0 for none."""
        return self.questions.death_signal_in(self.answers)


class ThreadQuestions:
    """The calls that one thread makes at one desk."""

    def __init__(self, desk: Desk) -> None:
        self.batch = Batch(desk.table, SMALL)
        self._altstack = self.batch.output(24)
        self.batch.add("sigaltstack", 0, self._altstack)
        self._clear_tid = self.batch.output(8)
        self._told_clear_tid = self.batch.add("prctl", abi.PR_GET_TID_ADDRESS, self._clear_tid)
        self._slack = self.batch.add("prctl", abi.PR_GET_TIMERSLACK)
        self._death_signal = self.batch.output(4)
        self.batch.add("prctl", abi.PR_GET_PDEATHSIG, self._death_signal)

    def altstack_in(self, answers: Answers) -> tuple[int, int, int]:
        """(address, flags, size)."""
        address, flags, size = struct.unpack("<Qi4xQ", answers.at(self._altstack, 24))
        return address, flags, size

    def clear_tid_in(self, answers: Answers) -> int:
        """The address that the kernel clears when the thread ends: a thread that joins it waits there.

        Raises:
            UnsupportedError: this kernel does not tell.
        """
        if answers.results[self._told_clear_tid] < 0:
            reason = (
                "it has several threads, and this kernel does not tell where their end is noted: boot one with "
                "CONFIG_CHECKPOINT_RESTORE"
            )
            raise UnsupportedError(f"cannot capture: {reason}", (reason,))
        return int.from_bytes(answers.at(self._clear_tid, 8), "little")

    def death_signal_in(self, answers: Answers) -> int:
        """0 for none."""
        return int.from_bytes(answers.at(self._death_signal, 4), "little")

    def timer_slack_in(self, answers: Answers) -> int:
        """In nanoseconds."""
        return max(answers.results[self._slack], 0)


def _start_time(stat_text: bytes) -> int:
    """When a thread began, of its unparsed stat: the 22nd field, counted from the name's end, which is the second."""
    return int(stat_text[stat_text.rindex(b")") + 2 :].split(b" ", 20)[19])


class _KeptName(NamedTuple):
    """The file that tells the name of a thread, and which thread that is."""

    file: int
    life: Life


NOTHING_KEPT: Final = _KeptName(NO_FILE, (0, 0))


class ThreadOnlooker:
    """Asks the threads of one process besides the first, again and again."""

    def __init__(self, threads: Threads, entered: Entered, confinements: Confinements) -> None:
        self._threads = threads
        self._confinements = confinements
        self._modes: dict[Life, int] = {}
        self._borrowed = entered.pages
        self._questions = [ThreadQuestions(desk) for desk in entered.pages.desks]
        self._inner_tids: dict[Life, int] = {}
        self._names: dict[int, _KeptName] = {}
        self._interruptions = entered.interruptions
        self._asked: tuple[ThreadStanding, ...] = ()

    def close(self) -> None:
        """Close the files that are kept open about them."""
        self._keep_only(())

    def _keep_only(self, tids: Collection[int]) -> None:
        for tid in [tid for tid in self._names if tid not in tids]:
            os.close(self._names.pop(tid).file)

    def prepare(self) -> None:
        """Look up, while the program runs, what does not change and an earlier look has not found yet."""
        self._settle()
        for tid in thread_ids(self._threads.pid):
            if tid != self._threads.pid:
                try:
                    self._inner_tid(self._named(tid)[0])
                except (ProcessGoneError, ProbeError):
                    continue  # it has ended

    def _settle(self) -> None:
        """Note where threads stood at the last look, also where that is not asked for: the kernel forgets which call that was."""
        asked, self._asked = self._asked, ()
        for standing in asked:
            standing.settle()

    def _named(self, tid: int) -> tuple[Life, bytes]:
        """The thread that has this id now, and its comm.

        By a file that stays open: reading it again takes a third of opening it anew, and once its thread has ended it tells of no
        other one. So if it still answers after the thread's stat has been read, by name, that was the same thread's.
        """
        kept = self._names.get(tid)
        if kept is not None:
            with contextlib.suppress(ProcessLookupError):
                return kept.life, os.pread(kept.file, procfs.READ_SIZE, 0)
            os.close(self._names.pop(tid).file)
        pid, name = self._threads.pid, f"task/{tid}/comm"
        file = procfs.opened(pid, name)
        try:
            life = tid, _start_time(procfs.read_line(pid, f"task/{tid}/stat"))
            comm = procfs.read_kept(file, pid, name)
        except BaseException:
            os.close(file)
            raise
        if len(self._names) < TEXTS_KEPT:
            self._names[tid] = _KeptName(file, life)
        else:
            os.close(file)
        return life, comm

    def _inner_tid(self, life: Life) -> int:
        """Its id as it sees it itself; whether it is confined since its birth is noted by the way."""
        tid = life[0]
        if life not in self._inner_tids:
            status = procfs.parse_status(procfs.read_text(self._threads.pid, f"task/{tid}/status"))
            if status.seccomp:
                self._modes[life] = status.seccomp
            self._inner_tids[life] = status.pids[-1]
        return self._inner_tids[life]

    def name_files(self) -> list[int]:
        """Files of the threads that stand still, for `Readings.read`."""
        return [self._names.get(tracee.pid, NOTHING_KEPT).file for tracee in self._threads.others]

    def places(self, readings: Sequence[Unread], modes: Mapping[int, int], of_first: int) -> tuple[ThreadPlace, ...]:
        """Where they stand.

        Args:
            readings: the kernel's answers about each.
            modes: of seccomp(2), by thread, of those that were confined before the freeze.
            of_first: that of the first thread, which may have given its filters to all.

        Raises:
            CaptureError: one has not left the code of an earlier look yet.
            UnsupportedError: it is confined, and we may do nothing about it.
        """
        self._settle()
        unknown = FILTERED if of_first else 0
        told = zip(self._threads.others, readings, strict=True)
        found = tuple(self._place(tracee, reading, modes.get(tracee.pid, unknown)) for tracee, reading in told)
        if len(self._inner_tids) > len(found):
            lives = {place.life for place in found}
            self._inner_tids = {life: tid for life, tid in self._inner_tids.items() if life in lives}
            self._modes = {life: mode for life, mode in self._modes.items() if life in lives}
            tids = frozenset(tid for tid, _ in lives)
            self._interruptions.keep_only({self._threads.pid, *tids})
            self._confinements.keep_only({(self._threads.pid, 0), *lives})
            self._keep_only(tids)
        return found

    def _place(self, tracee: Tracee, unread: Unread, mode: int) -> ThreadPlace:
        life, comm = (self._names[tracee.pid].life, b"") if unread.has_text else self._named(tracee.pid)
        inner_tid = self._inner_tid(life)
        mode = self._modes.get(life, mode) or (FILTERED if unread.is_filtered else 0)
        found = self._confinements.suspended(tracee, mode, life)
        registers = where_it_stands(tracee, unread.registers, lambda: unread.rseq, self._interruptions)
        pointer, _, _ = arch.stand_of(registers)
        if self._borrowed.holds(pointer):
            raise CaptureError(f"thread {tracee.pid} is still in code of an earlier capture; capture it again in a moment")
        return ThreadPlace(tracee, life, inner_tid, registers, unread, comm, found)

    def ask(self, places: tuple[ThreadPlace, ...]) -> tuple[ThreadStanding, ...]:
        """Everything else."""
        if not places:
            return ()
        guests = [Guest(place.tracee, place.registers, place.mask) for place in places]
        answers = self._borrowed.run_each([questions.batch for questions in self._questions], guests)
        count = len(self._questions)
        self._asked = tuple(
            ThreadStanding(place, self._interruptions.of(place.tracee), self._questions[index % count], answer)
            for index, (place, answer) in enumerate(zip(places, answers, strict=True))
        )
        for standing in self._asked:
            if not standing.interruption.remembers(standing.place.registers):
                standing.settle()
        return self._asked

    @staticmethod
    def waiting(places: tuple[ThreadPlace, ...]) -> tuple[bytes, ...]:
        """The signals that are pending for them now."""
        return tuple(siginfo for place in places for siginfo in place.tracee.pending(shared=False))
