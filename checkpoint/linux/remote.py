"""System calls made inside a stopped tracee, by one batch of straight-line code in a few pages that we borrow there.

The pages: ``CODE_SIZE`` bytes r-x, then ``TABLE_SIZE`` bytes rw-. They lie in the middle of the largest hole, are never
given to a child (MADV_DONTFORK), belong to no snapshot, and stay between captures.

A batch, and why a SIGKILL of the tracer at any instant leaves the program unharmed (each step is a test):

1. The thread stands; its registers and mask are known. Code and table are written: registers to give back, mask, state ARMED.
   *Killed here:* nothing leads to the code.
2. Registers: the instruction pointer leads to the code, and no system call is pending. *Killed here:* the batch runs, gives
   the mask and registers back by itself, and jumps to where the program stood.
3. Mask: every signal blocked, so that no handler runs with its return address in a page that a snapshot does not hold.
   *Killed here:* as before; the batch's last call sets the program's mask.
4. The thread runs the batch, says done and waits (rt_sigtimedwait of no signal, 100 ms at most; it leaves a restart block alone).
5. The tracer stops it there: mask back, then registers back, as they were at the first stop, orig_rax and all, so that the
   kernel itself restarts or ends the interrupted call as signals then demand. *Killed between or before:* the wait ends and
   the batch goes on as in 2. A signal that comes just then may run its handler on top of the batch; such pages are marked
   ARMED, and a later tracer leaves them to the program as ordinary memory.
6. *Late* (a busy machine, a tracer that was stopped): the wait ends as well, and the program makes steps of its own. Giving it
   the registers of the first stop would make it repeat them: it keeps its own, and the look has failed.

How the pages get there at first, and what is done with those of an earlier tracer: `checkpoint.linux.entry`.

No instruction changes a flag or touches the stack. Source: signal(7), ptrace(2), vdso(7); kernel/signal.c, get_signal().
"""

from __future__ import annotations

import ctypes
import os
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from checkpoint.arch import x86_64 as arch
from checkpoint.arch.x86_64 import Call
from checkpoint.errors import CaptureError
from checkpoint.linux import abi
from checkpoint.linux.memory import Memory
from checkpoint.linux.tracee import Tracee

CODE_SIZE: Final = 4 * abi.PAGE_SIZE
TABLE_SIZE: Final = 4 * abi.PAGE_SIZE
SIZE: Final = CODE_SIZE + TABLE_SIZE
MAGIC: Final = b"failover borrows these pages; 1\0"
"""Stands at the end of the code pages, and at the beginning of the table."""
BATCH_TIMEOUT_S: Final = 1.0
"""How long a batch may take: its calls never wait, so only a machine that does not run the program at all exceeds this."""
CALL_LIMIT: Final = 200
"""Calls in one batch; ``CODE_SIZE`` holds 220 of the longest."""

IDLE: Final = 0
ARMED: Final = 1
ENDED: Final = 2
ABANDONED: Final = 3

_RESULTS: Final = 0x100
_OUTPUTS: Final = _RESULTS + 8 * CALL_LIMIT
_OUTPUT_ALIGNMENT: Final = 16
_HEAD: Final = struct.Struct("<32sQQQQQQQQ")  # magic, state, done, serial, mask, timeout (2 words), empty set, resume


def _places(table: int) -> arch.TablePlaces:
    words = table + 32
    return arch.TablePlaces(
        state=words,
        ended=ENDED,
        done=words + 8,
        serial=words + 16,
        mask=words + 24,
        timeout=words + 32,
        empty_set=words + 48,
        resume=words + 56,
        registers=words + 64,
        results=table + _RESULTS,
    )


class Batch:
    """System calls put in order for one run; each answers with its place in the results.

    Args:
        table: address of the borrowed table: outputs of the calls go there.
    """

    def __init__(self, table: int) -> None:
        self._table = table
        self.calls: list[Call] = []
        self.output_size = 0

    def output(self, size: int) -> int:
        """Reserve room for what a call writes; answers with its address in the tracee."""
        address = self._table + _OUTPUTS + self.output_size
        self.output_size += -(-size // _OUTPUT_ALIGNMENT) * _OUTPUT_ALIGNMENT
        if _OUTPUTS + self.output_size > TABLE_SIZE:
            raise CaptureError(f"too much to ask of a process at once: {self.output_size} bytes of answers")
        return address

    def add(self, name: str, *arguments: int) -> int:
        """Add a call."""
        if len(self.calls) >= CALL_LIMIT:
            raise CaptureError(f"too much to ask of a process at once: more than {CALL_LIMIT} system calls")
        self.calls.append(Call(name, arguments))
        return len(self.calls) - 1


@dataclass(frozen=True, slots=True)
class Answers:
    """What a batch brought back.

    Attributes:
        results: of each call, signed: negative is an errno.
    """

    results: tuple[int, ...]
    _outputs: bytes
    _base: int

    def at(self, address: int, size: int) -> bytes:
        """What a call wrote at an address that `Batch.output` gave."""
        offset = address - self._base
        return self._outputs[offset : offset + size]


class BorrowedPages:
    """Our pages in one tracee; every method is called while it stands still, and leaves it standing still.

    Attributes:
        address: of the code pages; the table follows them.
    """

    def __init__(self, memory: Memory, address: int) -> None:
        self.address = address
        self.table = address + CODE_SIZE
        self._memory = memory
        self._places = _places(self.table)
        self._code_key: tuple[Call, ...] | None = None
        self._serial = 0

    @property
    def end(self) -> int:
        """The first address after them."""
        return self.address + SIZE

    def holds(self, address: int) -> bool:
        """Whether an address lies inside."""
        return self.address <= address < self.end

    def state(self) -> int:
        """`IDLE`, `ARMED`, `ENDED` or `ABANDONED`, as it stands in the table."""
        return int.from_bytes(self._memory.read(self._places.state, 8), "little")

    def abandon(self) -> None:
        """Leave the pages to the program as ordinary memory: something of its own may still lead there."""
        self._memory.write(self._places.state, struct.pack("<Q", ABANDONED))

    def run(self, tracee: Tracee, batch: Batch, registers: bytes, mask: int) -> Answers:
        """Make the calls of a batch; afterwards the thread stands exactly as before.

        Args:
            registers: as the thread was stopped with; given back untouched.
            mask: the program's own signal mask.

        Raises:
            ProcessGoneError: it was killed meanwhile.
            CaptureError: the batch did not run in time, or we came too late to take the thread back; the program goes on.
        """
        if self.state() == ARMED:
            raise CaptureError(f"pid {tracee.pid} still has to return to code of an earlier look; capture it again in a moment")
        self._write(batch, arch.decode_registers(registers), mask)
        there = arch.decode_registers(registers)
        there[arch.INSTRUCTION_POINTER] = self.address
        there[arch.CALL_NUMBER] = -1
        tracee.set_registers(arch.encode_registers(there))
        tracee.set_signal_mask(abi.ALL_SIGNALS)
        tracee.cont()
        try:
            self._wait_done()
        finally:
            give_back(tracee, registers, mask, self.holds)
            self._memory.write(self._places.state, struct.pack("<Q", IDLE))
        return self._answers(batch)

    def _write(self, batch: Batch, registers: arch.Registers, mask: int) -> None:
        key = tuple(batch.calls)
        if key != self._code_key:
            code = arch.batch_code(self.address, key, self._places)
            assert len(code) + len(MAGIC) <= CODE_SIZE, "CALL_LIMIT keeps the code within its pages"
            self._memory.poke(self.address, code)
            self._code_key = key
        self._serial += 1
        resume = resumed(registers)
        head = _HEAD.pack(
            MAGIC, ARMED, 0, self._serial, mask, 0, arch.ENTRY_TIMEOUT_NS, 0, resume[arch.INSTRUCTION_POINTER]
        ) + struct.pack(f"<{len(arch.CLOBBERED)}Q", *(resume[name] for name in arch.CLOBBERED))
        self._memory.write(self.table, head)

    def _wait_done(self) -> None:
        deadline = time.perf_counter() + BATCH_TIMEOUT_S
        done = struct.pack("<Q", self._serial)
        while self._memory.read(self._places.done, 8) != done:
            if time.perf_counter() > deadline:
                raise CaptureError(
                    f"pid {self._memory.pid} did not run for {BATCH_TIMEOUT_S:g} s while it was looked at: it is frozen by its "
                    "cgroup, or higher priorities leave it no processor; capture it again when it runs"
                )
            os.sched_yield()

    def _answers(self, batch: Batch) -> Answers:
        count = len(batch.calls)
        raw = self._memory.read(self._places.results, _OUTPUTS - _RESULTS + batch.output_size)
        results = struct.unpack_from(f"<{count}q", raw)
        return Answers(results, raw[_OUTPUTS - _RESULTS :], self.table + _OUTPUTS)


def give_back(tracee: Tracee, registers: bytes, mask: int, is_ours: Callable[[int], bool]) -> arch.Registers:
    """Stop the thread in our code, and set it where the program stood. Mask first: see step 5. Answers with what it had there.

    Args:
        is_ours: whether an instruction at this address is of our code.

    Raises:
        CaptureError: it has left our code by itself, and goes on from where it is now.
    """
    tracee.freeze()
    found = arch.decode_registers(tracee.registers())
    if not is_ours(found[arch.INSTRUCTION_POINTER]):
        raise CaptureError(
            f"pid {tracee.pid} has run on while it was looked at: the machine left us no processor for "
            f"{arch.ENTRY_TIMEOUT_NS // 1_000_000} ms; capture it again"
        )
    tracee.set_signal_mask(mask)
    tracee.set_registers(registers)
    return found


def resumed(registers: arch.Registers) -> arch.Registers:
    """The registers with which the live program can go on without the kernel's help: an interrupted call is made again."""
    result = ctypes.c_int64(registers[arch.RESULT]).value
    number = ctypes.c_int64(registers[arch.CALL_NUMBER]).value
    if number < 0:
        return registers
    if result in arch.RESTARTABLE:
        again = number
    elif result == arch.RESTART_BLOCK:
        again = arch.SYSCALLS["restart_syscall"]
    else:
        return registers
    return {
        **registers,
        arch.RESULT: again,
        arch.INSTRUCTION_POINTER: registers[arch.INSTRUCTION_POINTER] - len(arch.SYSCALL),
        arch.CALL_NUMBER: -1,
    }
