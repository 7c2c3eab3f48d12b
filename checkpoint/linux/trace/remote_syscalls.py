"""Make system calls inside a stopped tracee, by one batch of straight-line code in a few borrowed pages.

The pages: ``CODE_SIZE`` bytes r-x, then ``TABLE_SIZE`` bytes rw-. They lie in the middle of the largest hole, are never given to
a child (MADV_DONTFORK), belong to no snapshot, and stay between captures. Each of the two areas begins with a large call area
(*desk*) for the batch of the first thread. `DESK_COUNT` small desks follow, at which other threads answer all at the same time.

A batch, and why a SIGKILL of the tracer at any instant leaves the program unharmed (each step is a test):

1. The thread is stopped; its registers and mask are known. Code and table are written: registers to give back, mask, state ARMED.
   *Killed here:* nothing leads to the code.
2. Registers: the instruction pointer leads to the code, and no system call is pending. *Killed here:* the batch runs, gives the
   mask and registers back by itself, and jumps to where the program was.
3. Mask: every signal blocked, so that no handler runs with its return address in a page that a snapshot does not hold. *Killed
   here:* as before; the batch's last call sets the program's mask.
4. The thread runs the batch, says done and waits (rt_sigtimedwait of no signal; it leaves a restart block alone): 100 ms at most,
   or 10 s in a program that a signal has stopped (`patience_ns`).
5. The tracer stops it there: mask back, then registers back, as they were at the first stop, orig_rax and all, so that the kernel
   itself restarts or ends the interrupted call as signals then demand. *Killed between or before:* the wait ends and the batch
   continues as in 2. A signal that comes just then may run its handler on top of the batch; such pages are marked ARMED, and a
   later tracer leaves them to the program as ordinary memory.
6. *Late* (a busy machine, a tracer that was stopped): the wait ends as well, and the program makes steps of its own. If it got
   the registers of the first stop, it would repeat those steps: it keeps its own registers, and the query has failed.
7. *SIGSTOP meanwhile* cannot be blocked. It takes effect, and the thread makes its calls in a program that is stopped now.

A batch and its table: `checkpoint.linux.trace.syscall_batch`. One desk, and the way back of its thread:
`checkpoint.linux.trace.syscall_desk`. Here: the pages as a whole, and the threads that are out at the same time.

How the pages get there at first, and how a tracer deals with those of an earlier one: `checkpoint.linux.trace.entry`.

No instruction changes a flag or touches the stack. Source: signal(7), ptrace(2), vdso(7); kernel/signal.c, get_signal().
"""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Iterator, Sequence
from typing import Final

from checkpoint.arch import cpu as arch
from checkpoint.errors import CaptureError, ProcessGoneError
from checkpoint.linux.memory.remote_memory import Memory, ranges_of
from checkpoint.linux.trace.syscall_batch import (
    ABANDONED,
    ARMED,
    CODE_SIZE,
    DESK_COUNT,
    HEAD_SIZE,
    IDLE,
    IDLE_WORD,
    LARGE,
    LARGE_DESK,
    MAGIC,
    NOTE,
    SIZE,
    SMALL,
    SMALL_DESK,
    STATE_OFFSET,
    Answers,
    Batch,
)
from checkpoint.linux.trace.syscall_desk import Desk, Guest, set_back
from checkpoint.linux.trace.thread_dispatch import Round
from checkpoint.linux.trace.tracee import LOST_SIZE, Tracee, rest

BATCH_TIMEOUT_S: Final = 1.0
"""How long a batch may take: its calls never wait, so only a machine that does not run the program at all exceeds this."""
STOPPED_S: Final = 0.001
"""A batch that takes so long may have met a SIGSTOP."""


class BorrowedPages:
    """Our pages in one tracee; every method is called while it stands still, and leaves it standing still.

    Attributes:
        address: of the code pages; the table follows them.
        desks: the small ones.
    """

    def __init__(self, memory: Memory, address: int) -> None:
        self.address = address
        self.table = address + CODE_SIZE
        self._memory = memory
        self._note = self.table + LARGE_DESK - NOTE.size
        self._large = Desk(memory, address, self.table, LARGE)
        offsets = range(LARGE_DESK, CODE_SIZE, SMALL_DESK)
        self._of_large = Round(1)
        self.desks = tuple(Desk(memory, address + offset, self.table + offset, SMALL) for offset in offsets)
        self._small_heads = ranges_of([(desk.table, HEAD_SIZE) for desk in self.desks])

    @functools.cached_property
    def _of_small(self) -> Round:
        return Round(DESK_COUNT)

    @property
    def end(self) -> int:
        """The first address after them."""
        return self.address + SIZE

    def holds(self, address: int) -> bool:
        """Whether an address lies inside."""
        return self.address <= address < self.end

    def are_there(self) -> bool:
        """Whether they still are: a process that has become another program (exec) has lost them."""
        try:
            return self._memory.read(self.table - len(MAGIC), len(MAGIC)) == MAGIC
        except CaptureError:
            return False

    def state(self) -> int:
        """`IDLE`, `ARMED`, `ENDED` or `ABANDONED`: of the large desk, unless a small one is still `ARMED`."""
        state = self._large.state()
        if state not in (ARMED, ABANDONED) and any(desk.state() == ARMED for desk in self.desks):
            return ARMED
        return state

    def abandon(self) -> None:
        """Leave the pages to the program as ordinary memory: something of its own may still lead there."""
        self._large.set_state(ABANDONED)

    @contextlib.contextmanager
    def noted(self, descriptor: int, value: int) -> Iterator[None]:
        """Write down for the body what of a descriptor is to be put back: for the next tracer, should we die in it."""
        self._memory.write(self._note, NOTE.pack(descriptor + 1, value))
        try:
            yield
        finally:
            self._memory.write(self._note, bytes(NOTE.size))

    def take_note(self) -> tuple[int, int] | None:
        """The note of an earlier tracer about a value that it could not put back: a descriptor and a number. Erases the note."""
        descriptor, value = NOTE.unpack(self._memory.read(self._note, NOTE.size))
        if not descriptor:
            return None
        self._memory.write(self._note, bytes(NOTE.size))
        return descriptor - 1, value

    def rehearse(self, tracee: Tracee) -> None:
        """Do what `run` is going to do with a thread, as far as that changes nothing; it may run."""
        self._large.rehearse()
        self._of_large.rehearse(tracee.pid)

    def run(self, tracee: Tracee, batch: Batch, registers: bytes, mask: int) -> Answers:
        """Make the calls of a batch; afterwards the thread stands exactly as before.

        Args:
            registers: as the thread was stopped with; given back untouched.
            mask: the program's own signal mask.

        Raises:
            ProcessGoneError: it was killed meanwhile.
            CaptureError: the batch did not run in time, or we came too late to take the thread back; the program goes on.
        """
        return self._run_at([self._large], [batch], [Guest(tracee, registers, mask)])[0]

    def run_each(self, batches: Sequence[Batch], guests: Sequence[Guest]) -> list[Answers]:
        """Have each of many threads make the calls of a batch, as many at a time as there are small desks; raises as `run`.

        Args:
            batches: one for each small desk.
        """
        found: list[Answers] = []
        for first in range(0, len(guests), len(self.desks)):
            found += self._run_at(self.desks, batches, guests[first : first + len(self.desks)])
        return found

    @contextlib.contextmanager
    def errand(self, tracee: Tracee, batch: Batch, registers: bytes, mask: int) -> Iterator[Errand]:
        """As `run`, with the body carried out meanwhile; it must be short, for the thread does not wait for ever (6).

        The answers are there after `Errand.call_back`, or after the body.
        """
        with self._errand([self._large], [batch], [Guest(tracee, registers, mask)]) as errand:
            yield errand

    def _run_at(self, desks: Sequence[Desk], batches: Sequence[Batch], guests: Sequence[Guest]) -> list[Answers]:
        with self._errand(desks, batches, guests) as errand:
            pass
        return errand.answers

    @contextlib.contextmanager
    def _errand(self, desks: Sequence[Desk], batches: Sequence[Batch], guests: Sequence[Guest]) -> Iterator[Errand]:
        guests = [guest._replace(lost=guest.tracee.lost_in_calls()) for guest in guests] if LOST_SIZE else guests
        places = list(zip(desks, batches, guests, strict=False))
        self._require_free([desk for desk, _, _ in places])
        heads = [desk.armed(batch, guest) for desk, batch, guest in places]
        if len(heads) == 1:
            desks[0].lay(heads[0])
        else:
            self._memory.write_from(self._small_heads[: len(heads)], bytearray(b"".join(heads)))
        tracees = [guest.tracee for guest in guests]
        sent = self._of_small if desks is self.desks else self._of_large
        registers, masks = [guest.registers for guest in guests], [guest.mask for guest in guests]
        errand = Errand(self._memory, sent, places)
        try:
            if not sent.start(tracees, [desk.code for desk, _, _ in places], registers, masks):
                raise ProcessGoneError(f"pid {self._memory.pid} ended while failover examined it")
            yield errand
            errand.call_back()
        finally:
            self._take_back(errand, [(desk, guest) for desk, _, guest in places])

    def _require_free(self, desks: Sequence[Desk]) -> None:
        if all(desk.is_known_idle for desk in desks):
            return
        size = desks[0].size
        raw = self._memory.read(desks[0].table, (len(desks) - 1) * size + HEAD_SIZE)
        for place in range(len(desks)):
            if raw[place * size + STATE_OFFSET] == ARMED:
                raise CaptureError(
                    f"pid {self._memory.pid} still has to return to code of an earlier capture; capture it again in a moment"
                )

    def _take_back(self, errand: Errand, places: Sequence[tuple[Desk, Guest]]) -> None:
        """As `give_back`, for many: no thread waits for another one's stop, and one that is gone spoils nothing for the others.

        Raises:
            ProcessGoneError, CaptureError: of the first of those that could not be given back.
        """
        failures: list[CaptureError] = []
        tracees = [guest.tracee for _, guest in places]
        errand.ask_to_stop()
        sent, asked = errand.sent, errand.asked
        if asked is None:
            given = self._take_back_singly(places, failures)
        elif all(stand := sent.await_stops(tracees, asked)) and sent.give_back(self.holds):
            given = [desk for desk, _ in places]
            for _, guest in places:
                guest.tracee.give_back_lost(guest.lost)
        else:
            moving = [was and not stands for was, stands in zip(asked, stand, strict=True)]
            given = self._set_back_singly(places, moving, failures)
        with _collected(failures):
            if len(given) == 1:
                given[0].set_state(IDLE)
            elif given:
                states = ranges_of([(desk.table + STATE_OFFSET, len(IDLE_WORD)) for desk in given])
                self._memory.write_from(states, bytearray(IDLE_WORD * len(given)))
            for desk in given:
                desk.is_known_idle = True
        if failures:
            raise failures[0]

    def _take_back_singly(self, places: Sequence[tuple[Desk, Guest]], failures: list[CaptureError]) -> list[Desk]:
        """Stop them, and set them back; answers with the desks of those for which that worked."""
        moving = [False] * len(places)
        for index, (_, guest) in enumerate(places):
            with _collected(failures):
                moving[index] = guest.tracee.ask_to_stop() is None
        return self._set_back_singly(places, moving, failures)

    def _set_back_singly(
        self, places: Sequence[tuple[Desk, Guest]], moving: Sequence[bool], failures: list[CaptureError]
    ) -> list[Desk]:
        given = []
        for (desk, guest), moves in zip(places, moving, strict=True):
            with _collected(failures):
                if moves:
                    guest.tracee.await_stop()
                set_back(guest, self.holds)
                given.append(desk)
        return given


class Errand:
    """Threads at the desks: on their way there, at work, or asked to stop.

    Attributes:
        answers: the results of their calls.
        asked: for each, whether it takes the request to stop; None: none was asked.
    """

    def __init__(self, memory: Memory, sent: Round, places: Sequence[tuple[Desk, Batch, Guest]]) -> None:
        self.sent = sent
        self.answers: list[Answers] = []
        self.asked: list[bool] | None = None
        self._memory = memory
        self._places = places
        self._is_over = False

    def call_back(self) -> None:
        """Wait until the calls have been made, read what they have brought, and ask the threads to stop. Once.

        Raises:
            ProcessGoneError: the process was killed meanwhile.
            CaptureError: the calls were not made in time.
        """
        if self._is_over:
            return
        desks = [desk for desk, _, _ in self._places]
        tables = _tables_when_done(self._memory, desks, self._places[0][1].end)
        self.answers = [desk.answers(table, batch) for (desk, batch, _), table in zip(self._places, tables, strict=True)]
        self.ask_to_stop()

    def ask_to_stop(self) -> None:
        """Ask the threads to stop, wherever they are. Once."""
        if not self._is_over:
            self._is_over, self.asked = True, self.sent.ask_to_stop()


@contextlib.contextmanager
def _collected(failures: list[CaptureError]) -> Iterator[None]:
    try:
        yield
    except CaptureError as failure:
        failures.append(failure)


def _tables_when_done(memory: Memory, desks: Sequence[Desk], end: int) -> list[bytes]:
    """The tables of desks that lie one after the other, when all the calls have been made.

    Args:
        end: offset of the first byte in the last table that is not of interest.

    Raises:
        CaptureError: they were not, in time.
    """
    is_here: bool | None = None
    began = time.perf_counter()
    while True:
        tables = _tables(memory, desks, end)
        if all(desk.is_done(table) for desk, table in zip(desks, tables, strict=True)):
            # that they are done may have been read before what they stored
            return tables if arch.SHOWS_STORES_IN_ORDER else _tables(memory, desks, end)
        waited = time.perf_counter() - began
        if waited > BATCH_TIMEOUT_S:
            raise CaptureError(
                f"pid {memory.pid} did not run for {BATCH_TIMEOUT_S:g} s while failover examined it: it is frozen by its "
                "cgroup, or higher priorities leave it no processor; capture it again when it runs"
            )
        if is_here is None:
            is_here = desks[0].is_guest_here()
        elif waited > STOPPED_S:
            for desk in desks:
                desk.let_guest_run_on()
        rest(waited, is_here=is_here)


def _tables(memory: Memory, desks: Sequence[Desk], end: int) -> list[bytes]:
    if len(desks) == 1:
        return [desks[0].table_until(end)]
    size = desks[0].size
    raw = memory.read(desks[0].table, (len(desks) - 1) * size + end)
    return [raw[place * size : (place + 1) * size] for place in range(len(desks))]
