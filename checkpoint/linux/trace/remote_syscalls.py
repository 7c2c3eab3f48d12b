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

How the pages get there at first, and how a tracer deals with those of an earlier one: `checkpoint.linux.trace.entry`.

No instruction changes a flag or touches the stack. Source: signal(7), ptrace(2), vdso(7); kernel/signal.c, get_signal().
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import operator
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

from msgspec import Struct

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import Call, Registers, TablePlaces
from checkpoint.errors import CaptureError, ProcessGoneError, RanOnError
from checkpoint.linux import abi
from checkpoint.linux.memory.remote_memory import Memory, Place, ranges_of
from checkpoint.linux.trace.thread_dispatch import Round
from checkpoint.linux.trace.tracee import LOST_SIZE, Tracee, rest

LARGE_DESK: Final = max(arch.LARGE_DESK_SIZE, 4 * abi.PAGE_SIZE)
"""Bytes of the large desk's code, and of its table."""
DESK_COUNT: Final = 32
FRAME_SIZE: Final = arch.frame_size(LOST_SIZE)
"""Bytes at the end of a desk's table that are the code's own."""
_SHARE_OF_A_PAGE: Final = abi.PAGE_SIZE // DESK_COUNT
SMALL_DESK: Final = -(-(arch.SMALL_DESK_SIZE + FRAME_SIZE) // _SHARE_OF_A_PAGE) * _SHARE_OF_A_PAGE
"""Bytes of a small desk's code, and of its table: room for four short calls. All of them are whole pages."""
CODE_SIZE: Final = LARGE_DESK + DESK_COUNT * SMALL_DESK
TABLE_SIZE: Final = CODE_SIZE
SIZE: Final = CODE_SIZE + TABLE_SIZE
MAGIC: Final = b"failover borrows these pages; 2\0"
"""Stands at the end of the code pages, and at the beginning of the table."""
BATCH_TIMEOUT_S: Final = 1.0
"""How long a batch may take: its calls never wait, so only a machine that does not run the program at all exceeds this."""
BUSY_TIMEOUT_NS: Final = 900_000_000
"""How long a program waits for us on a machine that has once left us no processor for `arch.ENTRY_TIMEOUT_NS`."""
STOPPED_TIMEOUT_NS: Final = 10_000_000_000
"""How long a program waits for us that somebody has stopped: that we are late is no reason for it to run."""
CALL_LIMIT: Final = 200
"""Calls in one batch; ``LARGE_DESK`` holds 220 of the longest."""

IDLE: Final = 0
ARMED: Final = 1
ENDED: Final = 2
ABANDONED: Final = 3

_HEAD: Final = struct.Struct(f"<32s8Q{len(arch.CLOBBERED)}Q")
"""Magic, state, done, serial, mask, timeout (2 words), empty set, resume, registers."""
_HEAD_SIZE: Final = _HEAD.size
_of_clobbered: Final = operator.itemgetter(*map(arch.REGISTER_NAMES.index, arch.CLOBBERED))
_OF_RESULT: Final = arch.CLOBBERED.index(arch.RESULT)
_OUTPUT_ALIGNMENT: Final = 16
_STATE_OFFSET: Final = 32
_IDLE_WORD: Final = struct.pack("<Q", IDLE)
_NOTE: Final = struct.Struct("<Ii")
"""At the end of the large desk's table: a descriptor and one more (0: there is no note), and a number."""


class Plan(Struct, frozen=True, dict=True):
    """Where the parts of a desk's table begin: head, then results, then what the calls write.

    Attributes:
        size: of the table; its code has as much room.
        call_limit: calls in one batch.
    """

    size: int
    call_limit: int

    @functools.cached_property
    def results(self) -> int:
        """Offset of the results."""
        return -(-_HEAD_SIZE // _OUTPUT_ALIGNMENT) * _OUTPUT_ALIGNMENT

    @functools.cached_property
    def room(self) -> int:
        """Offset of where the outputs end at the latest: the code's own room, and the note, come after."""
        return (self.size - _NOTE.size) // _OUTPUT_ALIGNMENT * _OUTPUT_ALIGNMENT - FRAME_SIZE

    @functools.cached_property
    def outputs(self) -> int:
        """Offset of the outputs, which end before the note."""
        return self.results + -(-8 * self.call_limit // _OUTPUT_ALIGNMENT) * _OUTPUT_ALIGNMENT


LARGE: Final = Plan(LARGE_DESK, CALL_LIMIT)
SMALL: Final = Plan(SMALL_DESK, 4)


def _places(table: int, plan: Plan) -> TablePlaces:
    words = table + _STATE_OFFSET
    return TablePlaces(
        state=words,
        ended=ENDED,
        done=words + 8,
        serial=words + 16,
        mask=words + 24,
        timeout=words + 32,
        empty_set=words + 48,
        resume=words + 56,
        registers=words + 64,
        results=table + plan.results,
        frame=table + plan.room,
    )


class Batch:
    """System calls put in order for one run; each answers with its place in the results.

    Args:
        table: address of the table of the desk at which they will be made: outputs of the calls go there.
    """

    def __init__(self, table: int, plan: Plan = LARGE) -> None:
        self._table = table
        self._plan = plan
        self.calls: list[Call] = []
        self.output_size = 0

    @property
    def end(self) -> int:
        """Offset in the table after the last output."""
        return self._plan.outputs + self.output_size

    def output(self, size: int) -> int:
        """Reserve room for what a call writes; answers with its address in the tracee."""
        address = self._table + self._plan.outputs + self.output_size
        self.output_size += -(-size // _OUTPUT_ALIGNMENT) * _OUTPUT_ALIGNMENT
        if self.end > self._plan.room:
            raise CaptureError(f"too much to ask of a process at once: {self.output_size} bytes of answers")
        return address

    def add(self, name: str, *arguments: int) -> int:
        """Add a call."""
        if len(self.calls) >= self._plan.call_limit:
            raise CaptureError(f"too much to ask of a process at once: more than {self._plan.call_limit} system calls")
        self.calls.append(Call(name, arguments))
        return len(self.calls) - 1


class Answers:
    """What a batch brought back: a desk's table, read when somebody wants to know.

    Args:
        address: of the table.
        count: of the calls.
    """

    __slots__ = ("_address", "_count", "_plan", "_table")

    def __init__(self, table: bytes, address: int, plan: Plan, count: int) -> None:
        self._table = table
        self._address = address
        self._plan = plan
        self._count = count

    @property
    def results(self) -> tuple[int, ...]:
        """Of each call, signed: negative is an errno."""
        return struct.unpack_from(f"<{self._count}q", self._table, self._plan.results)

    def at(self, address: int, size: int) -> bytes:
        """What a call wrote at an address that `Batch.output` gave."""
        offset = address - self._address
        return self._table[offset : offset + size]


class Guest(NamedTuple):
    """A thread that is to make the calls of a batch, and where it stands.

    Attributes:
        registers: as it was stopped with; given back untouched.
        mask: the program's own signal mask.
        lost: `Tracee.lost_in_calls`, likewise.
    """

    tracee: Tracee
    registers: bytes
    mask: int
    lost: bytes = b""


_busy = threading.Event()
"""Set when a program has gone on by itself because this process got no processor."""


def patience_ns(tracee: Tracee) -> int:
    """How long a thread waits in our code for us before it goes on by itself. After our end, all programs wait so long.

    Source: __ptrace_unlink() in kernel/ptrace.c: whose tracer dies stops again where its process is stopped.
    """
    if tracee.stopped_by:
        return STOPPED_TIMEOUT_NS
    return BUSY_TIMEOUT_NS if _busy.is_set() else arch.ENTRY_TIMEOUT_NS


class Desk:
    """A place in the borrowed pages at which one thread makes the calls of a batch.

    Attributes:
        is_known_idle: whoever was here last was led away by ourselves.
    """

    def __init__(self, memory: Memory, code: int, table: int, plan: Plan) -> None:
        self.code = code
        self.table = table
        self.size = plan.size
        self._memory = memory
        self._plan = plan
        self._places = _places(table, plan)
        self._code_key: tuple[Call, ...] | None = None
        self._serial = 0
        self._lost: bytes | None = None
        self._guest: Tracee | None = None
        self._head = Place(memory, table, _HEAD_SIZE)
        self._state = Place(memory, self._places.state, len(_IDLE_WORD))
        self._of_interest: tuple[int, Place] = (_HEAD_SIZE, self._head)
        self.is_known_idle = False

    def state(self) -> int:
        """`IDLE`, `ARMED`, `ENDED` or `ABANDONED`, as it stands in the table."""
        return int.from_bytes(self._state.read(), "little")

    def set_state(self, state: int) -> None:
        """Write it."""
        self._state.write(struct.pack("<Q", state))

    def lay(self, head: bytes) -> None:
        """Write the head of the table."""
        self._head.write(head)

    def table_until(self, end: int) -> bytes:
        """Read the table, up to an offset."""
        if self._of_interest[0] != end:
            self._of_interest = end, Place(self._memory, self.table, end)
        return self._of_interest[1].read()

    def armed(self, batch: Batch, guest: Guest) -> bytes:
        """Step 1: lay the code; the head of the table, to be laid, too: what a thread needs that goes on by itself."""
        key = tuple(batch.calls)
        if key != self._code_key:
            code = arch.batch_code(self.code, key, self._places)
            assert len(code) + len(MAGIC) <= self._plan.size, "the limit of calls keeps the code within its desk"
            self._memory.poke(self.code, code)
            self._code_key = key
        self._lay_lost(guest.lost)
        self._serial += 1
        self.is_known_idle = False
        tracee, registers, mask, _ = guest
        self._guest = tracee
        patience = divmod(patience_ns(tracee), 10**9)
        return _HEAD.pack(MAGIC, ARMED, 0, self._serial, mask, *patience, 0, *_going_on(tracee.left_alone or registers))

    def rehearse(self) -> None:
        """Read what is to be read, and forget it."""
        self.table_until(self._of_interest[0])

    def is_guest_here(self) -> bool:
        """Whether the thread that was sent here last is to run where we do."""
        return self._guest is not None and self._guest.is_here()

    def _lay_lost(self, lost: bytes) -> None:
        """What the kernel is to give back by the code's own frame besides, unless it stands there."""
        if lost != self._lost:
            place, content = arch.frame_of_lost(self._places.frame, lost)
            if content:
                self._memory.write(place, content)
            self._lost = lost

    def is_done(self, table: bytes) -> bool:
        """Whether the calls have been made, by the table's bytes."""
        done = self._places.done - self.table
        return table[done : done + 8] == struct.pack("<Q", self._serial)

    def answers(self, table: bytes, batch: Batch) -> Answers:
        """What they brought back, by the table's bytes."""
        return Answers(table, self.table, self._plan, len(batch.calls))


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
        self._note = self.table + LARGE_DESK - _NOTE.size
        self._large = Desk(memory, address, self.table, LARGE)
        offsets = range(LARGE_DESK, CODE_SIZE, SMALL_DESK)
        self._of_large = Round(1)
        self.desks = tuple(Desk(memory, address + offset, self.table + offset, SMALL) for offset in offsets)
        self._small_heads = ranges_of([(desk.table, _HEAD_SIZE) for desk in self.desks])

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
        self._memory.write(self._note, _NOTE.pack(descriptor + 1, value))
        try:
            yield
        finally:
            self._memory.write(self._note, bytes(_NOTE.size))

    def take_note(self) -> tuple[int, int] | None:
        """What an earlier tracer had written down and could not put back: a descriptor and a number; it is forgotten here."""
        descriptor, value = _NOTE.unpack(self._memory.read(self._note, _NOTE.size))
        if not descriptor:
            return None
        self._memory.write(self._note, bytes(_NOTE.size))
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
        raw = self._memory.read(desks[0].table, (len(desks) - 1) * size + _HEAD_SIZE)
        for place in range(len(desks)):
            if raw[place * size + _STATE_OFFSET] == ARMED:
                raise CaptureError(
                    f"pid {self._memory.pid} still has to return to code of an earlier capture; capture it again in a moment"
                )

    def _take_back(self, errand: Errand, places: Sequence[tuple[Desk, Guest]]) -> None:
        """As `give_back`, for many: nobody waits for another one's stop, and one that is gone spoils nothing for the others.

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
                states = ranges_of([(desk.table + _STATE_OFFSET, len(_IDLE_WORD)) for desk in given])
                self._memory.write_from(states, bytearray(_IDLE_WORD * len(given)))
            for desk in given:
                desk.is_known_idle = True
        if failures:
            raise failures[0]

    def _take_back_singly(self, places: Sequence[tuple[Desk, Guest]], failures: list[CaptureError]) -> list[Desk]:
        """Stop them, and set them back: the desks of those with whom that worked."""
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
        answers: what they brought back.
        asked: who takes it that they were asked to stop; None: nobody was.
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
        rest(waited, is_here=is_here)


def _tables(memory: Memory, desks: Sequence[Desk], end: int) -> list[bytes]:
    if len(desks) == 1:
        return [desks[0].table_until(end)]
    size = desks[0].size
    raw = memory.read(desks[0].table, (len(desks) - 1) * size + end)
    return [raw[place * size : (place + 1) * size] for place in range(len(desks))]


def give_back(guest: Guest, is_ours: Callable[[int], bool]) -> Registers:
    """Stop the thread in our code, and set it where the program stood. Answers with what it had there; raises as `set_back`."""
    guest.tracee.freeze()
    return set_back(guest, is_ours)


def set_back(guest: Guest, is_ours: Callable[[int], bool]) -> Registers:
    """Set a thread that stands in our code where the program stood. Mask first: see step 5. Answers with what it had there.

    Args:
        is_ours: whether an instruction at an address is of our code.

    Raises:
        CaptureError: it has left our code by itself, and goes on from where it is now.
    """
    tracee, registers, mask, lost = guest
    found = arch.decode_registers(tracee.registers())
    if not is_ours(found[arch.INSTRUCTION_POINTER]):
        tracee.is_as_found = True  # whatever it stands in now it has come to by itself
        waited_ms = patience_ns(tracee) // 1_000_000
        _busy.set()
        raise RanOnError(
            f"pid {tracee.pid} has run on while failover examined it: failover got no processor for {waited_ms} ms; "
            "capture it again"
        )
    tracee.set_signal_mask(mask)
    tracee.set_registers(registers)
    tracee.give_back_lost(lost)
    return found


def resumed(registers: Registers) -> Registers:
    """The registers with which the live program can go on without the kernel's help: an interrupted call is made again."""
    result = ctypes.c_int64(registers[arch.RESULT]).value
    number = ctypes.c_int64(registers[arch.CALL_NUMBER]).value
    again = _call_made_again(result, number)
    if again is None:
        return registers
    return {
        **registers,
        arch.RESULT: again,
        arch.INSTRUCTION_POINTER: registers[arch.INSTRUCTION_POINTER] - len(arch.SYSCALL),
        arch.CALL_NUMBER: arch.NO_CALL,
    }


def _call_made_again(result: int, number: int) -> int | None:
    """The call by which an interrupted one goes on without the kernel's help; None where none was interrupted.

    Args:
        result, number: of the call that a thread stands in, signed.
    """
    if number < 0:
        return None
    if result in arch.RESTARTABLE:
        return number
    return arch.SYSCALLS["restart_syscall"] if result == arch.RESTART_BLOCK else None


def _going_on(registers: bytes) -> tuple[int, ...]:
    """As `resumed`, of what a table has to hold of it: the instruction pointer, then what the calls of a batch change."""
    pointer, result, number = arch.stand_of(registers)
    again = _call_made_again(result, number)
    found: tuple[int, ...] = _of_clobbered(arch.words_of(registers))
    if again is None:
        return (pointer, *found)
    return (pointer - len(arch.SYSCALL), *found[:_OF_RESULT], again, *found[_OF_RESULT + 1 :])
