"""A desk: the place in the borrowed pages at which one thread of the program makes the calls of a batch, and its way back.

`checkpoint.linux.trace.remote_syscalls` numbers the steps that are meant here.
"""

from __future__ import annotations

import ctypes
import operator
import struct
import threading
from collections.abc import Callable
from typing import Final, NamedTuple

from checkpoint.arch import cpu as arch
from checkpoint.arch.calls import Call, Registers
from checkpoint.errors import RanOnError
from checkpoint.linux.memory.remote_memory import Memory, Place
from checkpoint.linux.trace.syscall_batch import ARMED, HEAD, HEAD_SIZE, IDLE_WORD, MAGIC, Answers, Batch, Plan, places_in
from checkpoint.linux.trace.tracee import Tracee

BUSY_TIMEOUT_NS: Final = 900_000_000
"""How long a program waits for us on a machine that has once left us no processor for `arch.ENTRY_TIMEOUT_NS`."""
STOPPED_TIMEOUT_NS: Final = 10_000_000_000
"""How long a program waits for us that was stopped by a signal: that we are late is no reason for it to run."""
STOPPED_TIMEOUT: Final = struct.pack("<QQ", *divmod(STOPPED_TIMEOUT_NS, 10**9))
"""The same as code of ours reads it: struct timespec."""
_of_clobbered: Final = operator.itemgetter(*map(arch.REGISTER_NAMES.index, arch.CLOBBERED))
_OF_RESULT: Final = arch.CLOBBERED.index(arch.RESULT)


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
        is_known_idle: we led away the thread that was here last.
    """

    def __init__(self, memory: Memory, code: int, table: int, plan: Plan) -> None:
        self.code = code
        self.table = table
        self.size = plan.size
        self._memory = memory
        self._plan = plan
        self._places = places_in(table, plan)
        self._code_key: tuple[Call, ...] | None = None
        self._serial = 0
        self._done_word = b""
        self._lost: bytes | None = None
        self._guest: Tracee | None = None
        self._head = Place(memory, table, HEAD_SIZE)
        self._state = Place(memory, self._places.state, len(IDLE_WORD))
        self._of_interest: tuple[int, Place] = (HEAD_SIZE, self._head)
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
        self._done_word = struct.pack("<Q", self._serial)
        self.is_known_idle = False
        tracee, registers, mask, _ = guest
        self._guest = tracee
        patience = divmod(patience_ns(tracee), 10**9)
        return HEAD.pack(MAGIC, ARMED, 0, self._serial, mask, *patience, 0, *_going_on(tracee.left_alone or registers))

    def rehearse(self) -> None:
        """Read what is to be read, and forget it."""
        self.table_until(self._of_interest[0])

    def is_guest_here(self) -> bool:
        """Whether the thread that was sent here last is to run where we do."""
        return self._guest is not None and self._guest.is_here()

    def let_guest_run_on(self) -> None:
        """As `Tracee.run_on`, of the thread that was sent here last."""
        if self._guest is not None:
            self._guest.run_on(self._is_done_now, self._lengthen)

    def _is_done_now(self) -> bool:
        return self._memory.read(self._places.done, 8) == self._done_word

    def _lengthen(self) -> None:
        self._memory.write(self._places.timeout, STOPPED_TIMEOUT)

    def _lay_lost(self, lost: bytes) -> None:
        """Write the registers that the kernel is to give back by the code's own frame, unless they stand there."""
        if lost != self._lost:
            place, content = arch.frame_of_lost(self._places.frame, lost)
            if content:
                self._memory.write(place, content)
            self._lost = lost

    def is_done(self, table: bytes) -> bool:
        """Whether the calls have been made, by the table's bytes."""
        done = self._places.done - self.table
        return table[done : done + 8] == self._done_word

    def answers(self, table: bytes, batch: Batch) -> Answers:
        """The results of its calls, by the table's bytes."""
        return Answers(table, self.table, self._plan, len(batch.calls))


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
        tracee.is_as_found = True  # it has come to its present place by itself
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
